"""Backbone `sam-raw`: Segment Anything's proposals as regions without classes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel

from semstab.backbones import Backbone, Image, Prediction
from semstab.backbones.sam.proposals import SamOptions, SamProposer, region_map


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
