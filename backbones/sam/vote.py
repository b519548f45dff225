"""Backbone `sam-vote`: another backbone's labels, made one inside each of Segment Anything's proposals by majority."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from semstab.backbones import Image, Labels, Prediction, create
from semstab.backbones.outside.border import Checked
from semstab.backbones.sam.proposals import Proposals, SamOptions, SamProposer
from semstab.backbones.wrapped import Wrapped
from semstab.errors import ConfigError
from semstab.model.frames import Frame
from semstab.model.labels import ignore_id


class SamVoteOptions(SamOptions):
    """The proposals, and who votes."""

    voter: str = Field(description="the backbone whose labels vote, e.g. segformer")
    voter_options: dict[str, Any] = Field(default_factory=dict, description="its options, e.g. {model: FOLDER}")


class SamVote(Wrapped):
    """Masks painted by area, the largest first, each in the label that most of its pixels have (ties: the lowest id).

    Pixels that the voter ignores do not vote; outside the masks its labels stay.
    Raises ConfigError for a voter without classes.
    """

    Options: type[BaseModel] = SamVoteOptions

    def __init__(self, options: SamVoteOptions) -> None:
        super().__init__(Checked(create(options.voter, **options.voter_options), options.voter))
        self.options = options
        if self.label_space is None:
            raise ConfigError(f"sam-vote: the voter '{options.voter}' has no classes; choose one that has")
        self.gives_scores = False
        self.proposer = SamProposer(options)

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Backbone`; there are no scores."""
        min_area = self.proposer.options.min_area
        return [
            Prediction(majority(vote.labels, self.proposer.propose(image), min_area))
            for image, vote in zip(images, self.ask(images, False, geometry), strict=True)
        ]

    def identity(self) -> dict[str, Any]:
        """Those of the proposals and of the voter."""
        return self.proposer.identity() | {"voter": self.options.voter, "voter_options": self.inner.identity()}


def majority(labels: Labels, proposals: Proposals, min_area: int) -> Labels:
    """The labels (H, W) with each mask in the label that most of its pixels had, the largest mask first."""
    voted = labels.copy()
    for mask in proposals.by_area(min_area):
        inside = labels[mask]
        votes = np.bincount(inside[inside != ignore_id(labels)])
        if votes.size:
            voted[mask] = votes.argmax()
    return voted
