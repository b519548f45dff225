"""A chain of filters over a backbone, which is a backbone again."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.backbones import Backbone, Image, Labels, Prediction, narrowed
from semstab.backbones.wrapped import Wrapped
from semstab.errors import ConfigError
from semstab.model.frames import Frame
from semstab.model.labels import LabelSpace, ignore_id
from semstab.predict.filters import Belief, FilterSpec, Shown, one_hot


class Filtered(Wrapped):
    """What a backbone says, after filters in their order. Where it says nothing, nothing is said.

    Filters see its scores where it has any; else its labels count as certain. Raises ConfigError for a backbone without
    classes, and for one without scores where the first filter needs them.
    """

    def __init__(self, inner: Backbone, filters: Sequence[FilterSpec], name: str) -> None:
        super().__init__(inner)
        if inner.label_space is None:
            raise ConfigError(f"--filter {filters[0]}: '{name}' finds regions without classes; leave the filter out")
        if filters[0].kind.needs_scores and not inner.gives_scores:
            raise ConfigError(
                f"--filter {filters[0]}: it needs scores, and '{name}' gives labels alone; leave it out, or put one"
                " before it that makes shares of them, such as vote:5"
            )
        self.filters = tuple(filters)
        self.space = inner.label_space
        self.gives_scores = True
        self.sequential = inner.sequential or any(spec.kind.sequential for spec in filters)
        self.wants_geometry = inner.wants_geometry or any(spec.kind.wants_geometry for spec in filters)
        self.seconds: list[float] = []
        """Of CPU time that the filters took for each image so far."""
        self._begin(())

    def reset(self) -> None:
        """Forget all images."""
        super().reset()
        self._begin(())

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Backbone`; an image of another size begins anew."""
        found = self.ask(images, self.inner.gives_scores, geometry)
        frames: Sequence[Frame | None] = geometry or [None] * len(images)
        return [self._filtered(*each, scores) for each in zip(found, images, frames, strict=True)]

    def identity(self) -> dict[str, Any]:
        """That of the inner backbone, and the filters."""
        return {**self.inner.identity(), "filters": [str(spec) for spec in self.filters]}

    def _begin(self, shape: tuple[int, ...]) -> None:
        self._chain = [make() for make in self.filters]
        self._shape = shape

    def _filtered(self, prediction: Prediction, image: Image, frame: Frame | None, scores: bool) -> Prediction:
        if image.shape != self._shape:
            self._begin(image.shape)
        started = time.thread_time()
        belief = belief_of(prediction, self.space)
        said = belief.any(axis=2, keepdims=True)
        for one in self._chain:
            belief = one(belief, Shown(image, frame)) * said
        labels = labels_of(belief, self.space, prediction.labels)
        self.seconds.append(time.thread_time() - started)
        return Prediction(labels, belief if scores else None)


def belief_of(prediction: Prediction, space: LabelSpace) -> Belief:
    """Its scores, 0 where the label is ignored; of labels alone, each of them certain."""
    ignored = prediction.labels == ignore_id(prediction.labels)
    if prediction.scores is not None:
        return np.where(ignored[..., None], np.float32(0), prediction.scores)
    K = len(space)
    row_of_id = np.full(1 << 8 * prediction.labels.itemsize, K, dtype=np.intp)
    row_of_id[list(space.ids)] = np.arange(K)
    return one_hot(np.where(ignored, K, row_of_id[prediction.labels]), K)


def labels_of(belief: Belief, space: LabelSpace, like: npt.NDArray[Any]) -> Labels:
    """The likeliest class of each pixel, by its id in maps such as `like`; the ignore id where nothing is said."""
    ids = np.array([*space.ids], dtype=like.dtype)[belief.argmax(axis=2)]
    ids[~belief.any(axis=2)] = ignore_id(like)
    return ids if like.dtype == np.uint8 else narrowed(ids, np.iinfo(np.uint16).max)
