"""Labels that a scene has already, as a model: what filters take where nothing is to be predicted."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from pydantic import Field

from semstab.backbones import Backbone, Image, Labels, Prediction, narrowed
from semstab.config import Settings
from semstab.datasets import GROUND_TRUTH, Scene
from semstab.datasets.views.resampling import Scores
from semstab.datasets.views.same_view import require_same_view
from semstab.errors import ConfigError
from semstab.model.frames import Frame
from semstab.model.labels import ignore_id

NAME = "stored"

NEAR = 4
"""Frames that are at hand: each is asked for its image, its geometry and its labels."""


class StoredOptions(Settings):
    """Which labels."""

    source: str = Field(min_length=1, description="a label source of the scene: a folder of labels/, NAME-scores, ...")


class Stored(Backbone):
    """Says of each frame what the scene's labels or scores of it say; its images are shown by `StoredSequence`.

    gives_scores is that of the scene's first frame that has such labels. Raises ConfigError where there are none.
    """

    Options = StoredOptions
    wants_geometry = True

    def __init__(self, options: StoredOptions, sequence: StoredSequence | None = None) -> None:
        if sequence is None:
            raise ConfigError(f"backbone '{NAME}' takes the labels of a scene; choose one with --data or --dataset")
        self.label_space = sequence.scene.label_space(options.source)
        self.gives_scores = sequence.has_scores
        self._source = options.source

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Backbone`."""
        return [Prediction(self._labels(frame), shares(frame) if scores else None) for frame in geometry]

    def _labels(self, frame: Frame) -> Labels:
        """Class ids; of scores the likeliest class's."""
        if frame.labels is not None:
            return frame.labels
        assert self.label_space is not None
        ids = narrowed(np.array(self.label_space.ids), max(self.label_space.ids) + 1)
        ignored = frame.predicted == frame.ignore_id
        labels: Labels = ids[np.where(ignored, 0, frame.predicted)]
        labels[ignored] = ignore_id(labels)
        return labels

    def identity(self) -> dict[str, Any]:
        """Where the labels are from; what they are is in the digest of each frame."""
        assert self.label_space is not None
        return {NAME: self._source, "classes": self.label_space.to_dict()}


class StoredSequence:
    """A scene's frames at the pixels of the depth, with labels of one source; colour only where it is looked at."""

    labels_like_depth = True

    def __init__(self, scene: Scene, source: str, color: bool) -> None:
        if source not in (*scene.backbones, *((GROUND_TRUTH,) if scene.ground_truth else ())):
            known = ", ".join(scene.backbones) or "none"
            raise ConfigError(f"{scene.name}: there are no labels '{source}' for filters to take; there is {known}")
        self.scene, self.source, self.name, self._color = scene, source, scene.name, color
        self._frame = functools.lru_cache(maxsize=NEAR)(partial(scene.frame, backbone=source, color=False))

    def __len__(self) -> int:
        return len(self.scene)

    @property
    def has_scores(self) -> bool:
        """Whether the first frame that has these labels has scores."""
        first = next((index for index in range(len(self)) if not self.missing(index)), 0)
        return self.scene.frame(first, self.source, color=False).scores is not None

    def image(self, index: int) -> Image:
        """(H, W, 3) uint8 RGB at the depth's pixels; black where nobody looks at it."""
        import cv2

        if not self._color:
            return np.zeros((*self._frame(index).shape, 3), dtype=np.uint8)
        image, shape = self.scene.color(index), self._frame(index).shape
        if image is None:
            raise ConfigError(f"{self.name}, {self.image_name(index)}: has no colour, which a filter looks at")
        require_same_view(
            image.shape, shape, f"{self.name}, {self.image_name(index)}", "the image is {} but depth is {}"
        )
        if image.shape[:2] == shape:
            return image
        return np.asarray(cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def image_name(self, index: int) -> str:
        """What the frame's files are called."""
        return self.scene.image_name(index)

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Files that the frame lacks, its labels among them."""
        return self.scene.missing(index, [*sources, self.source], color=self._color)

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """The frame with other labels or scores."""
        return dataclasses.replace(self._frame(index), labels=labels, scores=scores)

    def view(self, index: int, shape: tuple[int, int]) -> Frame:
        """The frame, with its labels."""
        return self._frame(index)


def shares(frame: Frame) -> Any:
    """Scores (H, W, K) float32 that sum to 1 where they can be used, else to 0; None of labels."""
    if frame.scores is None:
        return None
    said = (frame.predicted != ignore_id(frame.predicted))[..., None]
    scores = np.where(said, frame.scores, 0).astype(np.float32)
    return np.divide(scores, scores.sum(axis=2, keepdims=True), out=scores, where=said)
