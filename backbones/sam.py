"""Backbone `sam-heuristic`: Segment Anything's proposals with classes from rules on colour, size and shape."""

from __future__ import annotations

import importlib.resources
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from pydantic import BaseModel, Field, model_validator

from semstab.backbones import Backbone, Image, Labels, Prediction, create
from semstab.backbones.border import Checked, Wrapped
from semstab.backbones.sam_proposals import Proposals, SamOptions, SamProposer, region_map
from semstab.config import Settings, read_yaml, validated
from semstab.core.types import Mask, UInt8
from semstab.errors import ConfigError
from semstab.model.frames import Frame
from semstab.model.labels import LabelSpace, ignore_id

HUES = 180
"""OpenCV's hue runs from 0 to 180."""


class Range(Settings):
    """What a value must be; what is not said does not matter."""

    min: float | None = None
    max: float | None = None
    above: float | None = None
    below: float | None = None
    outside: tuple[float, float] | None = None

    def holds(self, value: float) -> bool:
        """Whether the value is what it must be."""
        return (
            (self.min is None or value >= self.min)
            and (self.max is None or value <= self.max)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
            and (self.outside is None or not self.outside[0] <= value <= self.outside[1])
        )


class Rule(Settings):
    """A class, and what a mask of it looks like; see configs/backbones/sam_heuristic.yaml."""

    name: str
    hue: Range = Range()
    saturation: Range = Range()
    value: Range = Range()
    area: Range = Range()
    aspect: Range = Range()

    def holds(self, look: dict[str, float]) -> bool:
        """Whether a mask of that look is of this class."""
        return all(getattr(self, feature).holds(value) for feature, value in look.items())


class Rules(Settings):
    """The rules in their order, the classes in the order of their ids, and the class of the rest."""

    classes: list[str] = Field(min_length=1)
    rest: str
    rules: list[Rule] = Field(min_length=1)

    @model_validator(mode="after")
    def _classes_are_known(self) -> Self:
        if unknown := [rule.name for rule in self.rules if rule.name not in self.names]:
            raise ValueError(f"the rule '{unknown[0]}' has no class of that name; add it to classes")
        return self

    @property
    def names(self) -> list[str]:
        """All classes."""
        return [*self.classes, self.rest] if self.rest not in self.classes else self.classes

    def class_of(self, look: dict[str, float]) -> int:
        """The id of the first rule that holds."""
        return self.names.index(next((rule.name for rule in self.rules if rule.holds(look)), self.rest))


class SamHeuristicOptions(SamOptions):
    """The proposals and the rules."""

    rules: Path | None = Field(
        None, description="YAML file like configs/backbones/sam_heuristic.yaml, which is the default"
    )


class SamHeuristic(Backbone):
    """Masks painted by area, the largest first, each in the class of the first rule that holds for it."""

    Options: type[BaseModel] = SamHeuristicOptions

    def __init__(self, options: SamHeuristicOptions) -> None:
        self.rules = read_rules(options.rules)
        self.label_space = LabelSpace("sam heuristic", tuple(self.rules.names))
        self.proposer = SamProposer(options)

    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Backbone`; there are no scores."""
        return [Prediction(self._labels(image)) for image in images]

    def identity(self) -> dict[str, Any]:
        """The checkpoint's revision, the settings and the rules."""
        return self.proposer.identity() | {"rules": self.rules.model_dump(mode="json")}

    def _labels(self, image: Image) -> UInt8:
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV).astype(np.uint8, copy=False)
        labels = np.full(image.shape[:2], self.rules.names.index(self.rules.rest), dtype=np.uint8)
        for mask in self.proposer.propose(image).by_area(self.proposer.options.min_area):
            labels[mask] = self.rules.class_of(look_of(hsv, mask))
        return labels


def look_of(hsv: Image, mask: Mask) -> dict[str, float]:
    """Mean colour, area share and aspect of a mask that is not empty; hsv as OpenCV scales it.

    The mean hue is that of the summed unit vectors: of 179 and 3 it is 1.
    """
    hue, saturation, value = hsv[mask].astype(np.float64).T
    angle = 2 * np.pi / HUES * hue
    mean = np.arctan2(np.sin(angle).sum(), np.cos(angle).sum()) * HUES / (2 * np.pi)
    rows, columns = np.nonzero(mask)
    sides = sorted((int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1))
    return {
        "hue": float(mean % HUES),
        "saturation": float(saturation.mean()),
        "value": float(value.mean()),
        "area": len(rows) / mask.size,
        "aspect": sides[1] / sides[0],
    }


def read_rules(path: Path | None) -> Rules:
    """The rules of a file, those that ship where none is named. Raises ConfigError that names file and setting."""
    shipped = importlib.resources.files("semstab.configs") / "backbones" / "sam_heuristic.yaml"
    path = path or Path(str(shipped))
    return validated(Rules, read_yaml(path), f"{path}: ")


# Backbone `sam-raw`: Segment Anything's proposals as regions without classes.


class SamRaw(Backbone):
    """Regions 1, 2, ... from the largest mask to the smallest, smaller ones over larger ones, 0 where there is none.

    Ids mean nothing across frames: `semstab.metrics.matched_region_flicker` compares such maps.
    """

    Options: type[BaseModel] = SamOptions

    def __init__(self, options: SamOptions) -> None:
        self.proposer = SamProposer(options)

    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Backbone`; there are no scores."""
        min_area = self.proposer.options.min_area
        return [Prediction(region_map(self.proposer.propose(image), min_area)) for image in images]

    def identity(self) -> dict[str, Any]:
        """The checkpoint's revision and the settings."""
        return self.proposer.identity()


# Backbone `sam-vote`: another backbone's labels, made one inside each of Segment Anything's proposals by majority.


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
