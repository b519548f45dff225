"""Backbone `sam-heuristic`: Segment Anything's proposals with classes from rules on colour, size and shape."""

from __future__ import annotations

import importlib.resources
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field, model_validator

from semstab.backbones import Backbone, Image, Prediction
from semstab.backbones.sam.proposals import Mask, SamOptions, SamProposer
from semstab.config import Settings, read_yaml, validated
from semstab.model.labels import LabelSpace

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

    def _labels(self, image: Image) -> npt.NDArray[np.uint8]:
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
