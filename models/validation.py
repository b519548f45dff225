"""Models around others; the predictions of each are checked here once."""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Iterator, Sequence
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32
from semstab.data.features import Features
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace, ignore_id
from semstab.errors import ConfigError, DataError
from semstab.models import Image, Model, Prediction, Streamed, ask

# A model around another one, the base of filters, taxonomies and votes.


class Wrapped(Model):
    """A model that changes the predictions of another one; all that is not overridden is the inner one's.

    If it leaves scores as they are, it may set `streams` to the inner model's. The memory of a sequence belongs into
    attributes that `reset` replaces: copies for other sequences (`fit`) share the attributes until `reset`.
    """

    def __init__(self, inner: Model) -> None:
        self.inner = inner
        self.label_space = inner.label_space
        self.gives_scores = inner.gives_scores
        self.fit_frames = inner.fit_frames
        self.sequential = inner.sequential
        self.wants_geometry = inner.wants_geometry
        self.gives_features = inner.gives_features

    def fit(self, images: Sequence[Image]) -> Self:
        """Return a copy around the inner model adapted to the sequence."""
        fitted = copy.copy(self)
        fitted.inner = self.inner.fit(images)
        return fitted

    def reset(self) -> None:
        """Forget all images."""
        if self.inner.sequential:
            self.inner.reset()

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Model`."""
        return self.ask(images, scores, geometry)

    def ask(self, images: Sequence[Image], scores: bool, geometry: Sequence[Frame]) -> list[Prediction]:
        """Return the predictions of the inner model; a model that wants geometry gets the geometry."""
        inner = geometry if self.inner.wants_geometry else ()
        return ask(self.inner, images, scores=scores, geometry=inner)

    def identity(self) -> dict[str, Any]:
        """Return the identity of the inner model."""
        return self.inner.identity()


MEMBERS = (
    "label_space", "gives_scores", "fit_frames", "sequential", "wants_geometry", "gives_features", "streams", "fit",
    "reset", "predict", "stream", "identity",
)  # fmt: skip

SUM_TOLERANCE = 0.01
"""The largest distance of a pixel's summed scores from 1, which half precision may reach."""


class Checked(Wrapped):
    """A model whose predictions are checked: one line names their fault.

    Raises:
        ConfigError: For a class that is no model.
        DataError: For predictions that do not belong to these images.
    """

    def __init__(self, model: Any, name: str) -> None:
        self.name = name
        self._components = 0
        if lacks := [member for member in MEMBERS if not hasattr(model, member)]:
            raise ConfigError(
                f"model '{name}': a {type(model).__name__} has no {', '.join(lacks)}; derive its class from"
                " semstab.models.Model"
            )
        super().__init__(model)
        self.streams = model.streams
        if not isinstance(self.label_space, LabelSpace | None):
            what = type(self.label_space).__name__
            raise ConfigError(f"model '{name}': label_space is a {what}; make it a semstab.LabelSpace, or None")

    def fit(self, images: Sequence[Image]) -> Self:
        """Return the model adapted to a sequence."""
        fitted = super().fit(images)
        if not hasattr(fitted.inner, "predict"):
            raise ConfigError(f"model '{self.name}': fit gave {_kind(fitted.inner)}; let it return the model")
        return fitted

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Model`; scores that were not asked for are left out."""
        answer = self.ask(images, scores, geometry)
        if not isinstance(answer, Sequence) or len(answer) != len(images):
            what = f"{len(answer)} predictions" if isinstance(answer, Sequence) else _kind(answer)
            raise self._wrong(f"gave {what} for {len(images)} images; give a list with one each")
        return [self._checked(prediction, image, scores) for prediction, image in zip(answer, images, strict=True)]

    def stream(self, image: Image) -> Streamed:
        """See `Model`."""
        answer = self.inner.stream(image)
        self._check_labels(answer.labels, image.shape[:2])
        self._check_features(answer.features, image.shape[:2])
        return Streamed(answer.labels, lambda: self._maps(answer, image.shape[:2]), answer.features)

    def identity(self) -> dict[str, Any]:
        """Return the identity of the model, which JSON must hold."""
        identity: Any = self.inner.identity()
        try:
            json.dumps(identity, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"model '{self.name}': identity() is not for JSON ({error}); use texts, numbers, lists"
            ) from error
        if not isinstance(identity, dict):
            raise ConfigError(f"model '{self.name}': identity() gave {_kind(identity)}; give a dict of settings")
        return identity

    def _checked(self, prediction: Any, image: Image, wants_scores: bool) -> Prediction:
        if not isinstance(prediction, Prediction):
            raise self._wrong(f"gave {_kind(prediction)}; give a semstab.models.Prediction")
        self._check_labels(prediction.labels, image.shape[:2])
        self._check_features(prediction.features, image.shape[:2])
        if not wants_scores:
            return dataclasses.replace(prediction, scores=None)
        self._check_scores(prediction.scores, image.shape[:2])
        return prediction

    def _maps(self, answer: Streamed, shape: tuple[int, ...]) -> Iterator[Float32]:
        K, count, total = len(self.label_space or ()), 0, np.zeros((*shape, 1), dtype=np.float32)
        for scores in answer.maps():
            count += 1
            if scores.shape != shape or not (scores >= 0).all():
                raise self._wrong(
                    f"gave scores of shape {scores.shape} or below 0; give one of 0 or more for each pixel"
                )
            total[..., 0] += scores
            yield scores
        if count != K or not _add_up(total):
            raise self._wrong(f"gave {count} maps of scores that do not sum to 1; give {K}, one a class, that do")

    def _check_labels(self, labels: Any, shape: tuple[int, ...]) -> None:
        if not isinstance(labels, np.ndarray) or labels.dtype not in (np.uint8, np.uint16):
            raise self._wrong(f"gave labels that are {_kind(labels)}; give an array of uint8 or uint16")
        if labels.shape != shape:
            raise self._wrong(f"gave labels of shape {labels.shape} for an image of {shape}; give one label a pixel")
        if self.label_space is not None:
            valid = np.zeros(1 << 8 * labels.itemsize, dtype=np.bool_)
            valid[[id_ for id_ in (*self.label_space.ids, ignore_id(labels)) if id_ < len(valid)]] = True
            if not (fine := valid[labels]).all():
                raise self._wrong(
                    f"gave the id {labels[~fine][0]}, which is not an id of its {len(self.label_space)} classes"
                )

    def _check_scores(self, scores: Any, shape: tuple[int, ...]) -> None:
        K = 0 if self.label_space is None else len(self.label_space)
        if not isinstance(scores, np.ndarray) or scores.dtype.kind != "f":
            raise self._wrong(f"gave scores that are {_kind(scores)}; give an array of float32")
        if scores.shape != (*shape, K):
            raise self._wrong(f"gave scores of shape {scores.shape}; give {(*shape, K)}, the classes last")
        if not _add_up(scores):
            raise self._wrong("gave scores that are no shares: they must be 0 or more and sum to 1; apply a softmax")

    def _check_features(self, features: Any, shape: tuple[int, ...]) -> None:
        if (features is not None) != self.gives_features:
            statement = "gives_features = True" if features is None else "no gives_features = True"
            raise self._wrong(f"says {statement}, and gave {_kind(features)} as features; let both agree")
        if features is None:
            return
        try:
            D = Features.over(features, (shape[0], shape[1])).D
        except DataError as error:
            raise self._wrong(f"gave bad features: {error}") from error
        self._components = self._components or D
        if self._components != D:
            raise self._wrong(f"gave features of {D} components, and of {self._components} before; keep to one number")

    def _wrong(self, what: str) -> DataError:
        return DataError(f"model '{self.name}' {what}")


def _add_up(scores: npt.NDArray[np.floating[Any]]) -> bool:
    """Return whether each pixel's scores (H, W, K) are not negative and sum to 1, or to 0 without a prediction."""
    total = scores.sum(axis=2, dtype=np.float32)
    return bool((scores >= 0).all() and ((np.abs(total - 1) <= SUM_TOLERANCE) | (total == 0)).all())


def _kind(value: Any) -> str:
    if value is None:
        return "nothing"
    return f"a {type(value).__name__}" + (f" of {value.dtype}" if isinstance(value, np.ndarray) else "")
