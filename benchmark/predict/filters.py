"""Filters that steady a model's labels: `parse("ema:0.6")` makes one, `Filtered` puts some over a model."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np
import numpy.typing as npt

from semstab.core.registry import Registration, Registry
from semstab.core.types import Float32, UInt16
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace, ignore_id
from semstab.errors import ConfigError, DataError
from semstab.models import Image, Labels, Model, Prediction, narrowed
from semstab.models.validation import Wrapped
from semstab.pixels.warp import LEAST_DENSITY, carry, density

Belief = Float32
"""(H, W, K) float32: the belief of each pixel, which sums to 1 over the classes, or to 0 without a prediction."""

REGISTRY = Registry(
    "filter",
    {
        "ema": Registration(
            "semstab.predict.filters:Ema",
            "KEEP: running mean of a pixel; KEEP weighs its past",
        ),
        "ema-warped": Registration(
            "semstab.predict.filters:EmaWarped",
            "KEEP: running mean of a surface point, by its pose",
        ),
        "vote": Registration("semstab.predict.filters:Vote", "N: majority of the pixel's last N labels"),
        "guided": Registration(
            "semstab.predict.filters:Guided",
            "PIXELS: guided filter; borders follow the image",
        ),
    },
)


@dataclass(frozen=True)
class Parameter:
    """The number behind a filter's name: its meaning, its default, its limits, and whether it is whole."""

    what: str
    usual: float
    low: float
    high: float
    whole: bool = False

    def read(self, text: str, where: str) -> float:
        """Return the number in a text.

        Raises:
            ConfigError: If it is none; the message begins with `where`.
        """
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not self.low <= value <= self.high or (self.whole and value != int(value)):
            kind = "a whole number" if self.whole else "a number"
            raise ConfigError(f"{where}: {self.what} is {kind} from {self.low:g} to {self.high:g}; got '{text}'")
        return value


@dataclass(frozen=True, eq=False)
class Shown:
    """The data that a filter may look at in addition to the belief.

    Attributes:
        frame: Depth and pose at the image's pixels, where the filter wants geometry.
    """

    image: Image
    frame: Frame | None = None

    @property
    def geometry(self) -> Frame:
        """The frame of a filter that wants geometry."""
        assert self.frame is not None
        return self.frame


class Filter(ABC):
    """Beliefs in, beliefs out, image by image; one is made for each sequence. `REGISTRY` names its subclasses.

    Attributes:
        parameter: Name of the number behind the colon.
        sequential: Whether it remembers the images before.
        wants_geometry: Whether it looks at depth and pose.
        wants_color: Whether it looks at the image.
        warps: Whether it looks points up in the frames before pixel by pixel, which sparse depth does not allow.
    """

    parameter: ClassVar[Parameter]
    sequential: ClassVar[bool] = False
    wants_geometry: ClassVar[bool] = False
    wants_color: ClassVar[bool] = False
    warps: ClassVar[bool] = False

    def __init__(self, value: float) -> None:
        self.value = value

    @abstractmethod
    def __call__(self, belief: Belief, view: Shown) -> Belief:
        """Return the belief after the filter; the given array is not changed."""


@dataclass(frozen=True)
class FilterSpec:
    """A filter by name with its number: 'ema:0.6'."""

    name: str
    value: float
    kind: type[Filter]

    def __call__(self) -> Filter:
        """Return a new one, which remembers nothing."""
        return self.kind(self.value)

    def __str__(self) -> str:
        return f"{self.name}:{self.value:g}"


def parse(text: str) -> FilterSpec:
    """Return 'ema:0.6', or 'ema' with its usual number.

    Raises:
        ConfigError: For an unknown name or a number that it cannot have.
    """
    name, _, value = text.strip().partition(":")
    kind = cast("type[Filter]", REGISTRY.load(name))
    number = kind.parameter.read(value, f"filter '{text}'") if value else kind.parameter.usual
    return FilterSpec(name, number, kind)


def too_sparse(filters: Sequence[FilterSpec], density: float) -> str | None:
    """Return why filters that warp cannot be used with depth of this density, or None if all filters can be used."""
    warped = [str(spec) for spec in filters if spec.kind.warps]
    if not warped or not density < LEAST_DENSITY:
        return None
    return (
        f"depth is sparse: {100 * density:.0f} % of the neighbours of a pixel with depth have depth,"
        f" {100 * LEAST_DENSITY:.0f} % are needed; {', '.join(warped)} would find few points in the frame before: make"
        " depth dense, or use ema or vote"
    )


def one_hot(rows: npt.NDArray[Any], K: int) -> Belief:
    """Return beliefs (H, W, K) that are certain, from (H, W) rows 0..K-1, or K for pixels without a prediction."""
    belief = np.zeros((rows.size, K + 1), dtype=np.float32)
    belief[np.arange(rows.size), rows.reshape(-1)] = 1
    return belief[:, :K].reshape(*rows.shape, K)


def normalised(belief: Belief) -> Belief:
    """Return shares of each pixel's sum, in place; 0 where that is 0."""
    total = belief.sum(axis=2, keepdims=True)
    np.divide(belief, total, out=belief, where=total > 0)
    return belief


# A chain of filters over a model, which is a model again.


class Filtered(Wrapped):
    """A model behind filters in their order. Pixels without a prediction stay without.

    Filters see its scores, if any; else its labels count as certain.

    Raises:
        ConfigError: For a model without classes.
    """

    def __init__(self, inner: Model, filters: Sequence[FilterSpec], name: str) -> None:
        super().__init__(inner)
        if inner.label_space is None:
            raise ConfigError(f"--filter {filters[0]}: '{name}' finds regions without classes; leave the filter out")
        self.filters = tuple(filters)
        self.space = inner.label_space
        self.gives_scores, self.gives_features = True, False
        self.sequential = inner.sequential or any(spec.kind.sequential for spec in filters)
        self.wants_geometry = inner.wants_geometry or any(spec.kind.wants_geometry for spec in filters)
        self.seconds: list[float] = []
        """Seconds of CPU time that the filters took for each image so far."""
        self._begin(())

    def reset(self) -> None:
        """Forget all images."""
        super().reset()
        self._begin(())

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Model`; an image of another size begins a new sequence."""
        predictions = self.ask(images, self.inner.gives_scores, geometry)
        frames: Sequence[Frame | None] = geometry or [None] * len(images)
        return [self._filtered(*inputs, scores) for inputs in zip(predictions, images, frames, strict=True)]

    def identity(self) -> dict[str, Any]:
        """Return the identity of the inner model, and the filters."""
        return {**self.inner.identity(), "filters": [str(spec) for spec in self.filters]}

    def _begin(self, shape: tuple[int, ...]) -> None:
        self._chain = [make() for make in self.filters]
        self._shape = shape
        self._density = math.nan

    def _filtered(self, prediction: Prediction, image: Image, frame: Frame | None, scores: bool) -> Prediction:
        if image.shape != self._shape:
            self._begin(image.shape)
        if frame is not None and math.isnan(self._density):  # of the first frame with depth
            self._density = density(frame.depth)
            if (reason := too_sparse(self.filters, self._density)) is not None:
                raise DataError(f"{frame.where('depth')}: {reason}")
        started = time.thread_time()
        belief = belief_of(prediction, self.space)
        is_labelled = belief.any(axis=2, keepdims=True)
        for step in self._chain:
            belief = step(belief, Shown(image, frame)) * is_labelled
        labels = labels_of(belief, self.space, prediction.labels)
        self.seconds.append(time.thread_time() - started)
        return Prediction(labels, belief if scores else None)


def belief_of(prediction: Prediction, space: LabelSpace) -> Belief:
    """Return its scores, 0 where the label is ignored; of labels alone, each of them certain."""
    ignored = prediction.labels == ignore_id(prediction.labels)
    if prediction.scores is not None:
        return np.where(ignored[..., None], np.float32(0), prediction.scores)
    K = len(space)
    row_of_id = np.full(1 << 8 * prediction.labels.itemsize, K, dtype=np.intp)
    row_of_id[list(space.ids)] = np.arange(K)
    return one_hot(np.where(ignored, K, row_of_id[prediction.labels]), K)


def labels_of(belief: Belief, space: LabelSpace, like: npt.NDArray[Any]) -> Labels:
    """Return the likeliest class of each pixel, by its id in maps such as `like`.

    Pixels without a prediction get the ignore id.
    """
    ids = np.array([*space.ids], dtype=like.dtype)[belief.argmax(axis=2)]
    ids[~belief.any(axis=2)] = ignore_id(like)
    return ids if like.dtype == np.uint8 else narrowed(ids, np.iinfo(np.uint16).max)


# Exponential averages of beliefs: at the pixel, or at the surface point.


class Ema(Filter):
    """b_t = keep b_{t-1} + (1 - keep) p_t at each pixel, whatever it shows; it begins with p_t."""

    parameter = Parameter("the share of the previous belief", 0.6, 0, 0.999)
    sequential = True

    def __init__(self, value: float) -> None:
        super().__init__(value)
        self._before: Belief | None = None

    def __call__(self, belief: Belief, view: Shown) -> Belief:
        """See `Filter`."""
        self._before = belief if self._before is None else mixed(self._before, belief, self.value)
        return self._before


class EmaWarped(Filter):
    """The same at each surface point: b_{t-1} is looked up where the pixel's surface point was, by depth and pose.

    A pixel begins again without b_{t-1} if its point was hidden or out of view, or if the pixel has no depth.
    """

    parameter = Ema.parameter
    sequential = True
    wants_geometry = True
    warps = True

    def __init__(self, value: float) -> None:
        super().__init__(value)
        self._before: tuple[Belief, Frame] | None = None

    def __call__(self, belief: Belief, view: Shown) -> Belief:
        """See `Filter`."""
        now = view.geometry
        if self._before is not None:
            belief = mixed(carry(*self._before, now), belief, self.value)
        self._before = belief, now
        return belief


def mixed(before: Belief, now: Belief, keep: float) -> Belief:
    """Return keep * before + (1 - keep) * now; one of them alone where the other has no belief."""
    weight = np.where(now.any(axis=2), np.where(before.any(axis=2), keep, 0.0), 1.0).astype(np.float32)[..., None]
    return weight * before + (1 - weight) * now


# Borders of classes that follow those of the image: the guided filter (He, Sun and Tang 2013, TPAMI).

EPSILON = 0.05**2
"""Variance of grey values, black 0 and white 1, from which an edge is preserved rather than smoothed."""

Grey = npt.NDArray[Any]
"""(H, W) float32."""


class Guided(Filter):
    """Each class's belief as a linear function of the grey value in every window of that radius, averaged.

    Means over windows of (2 radius + 1)^2 pixels: the time does not depend on the radius. Pixels of which nothing is
    said have no part.
    """

    parameter = Parameter("the radius of the windows in pixels", 8, 1, 500, whole=True)
    wants_color = True

    def __call__(self, belief: Belief, view: Shown) -> Belief:
        """See `Filter`."""
        import cv2

        grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(np.float32) / np.float32(255)
        labelled = belief.any(axis=2).astype(np.float32)
        count = np.maximum(self._sum(labelled), 1)
        mean = self._sum(grey * labelled) / count
        variance = self._sum(grey * grey * labelled) / count - mean * mean
        filtered = np.empty_like(belief)
        for k in range(belief.shape[2]):
            p = np.ascontiguousarray(belief[..., k])
            mean_p = self._sum(p) / count
            a = (self._sum(grey * p) / count - mean * mean_p) / (variance + EPSILON)
            b = mean_p - a * mean
            filtered[..., k] = (self._sum(a * labelled) * grey + self._sum(b * labelled)) / count
        return normalised(np.maximum(filtered, 0))

    def _sum(self, values: Any) -> Grey:
        """Return the sums over the window of each pixel."""
        import cv2

        side = 2 * int(self.value) + 1
        return np.asarray(cv2.boxFilter(values, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT))


# The majority of the last labels at the pixel.


class Vote(Filter):
    """Each class's share of the last N labels at the pixel, this one included: no later frame is looked at.

    If classes tie, the newer labels win.
    """

    parameter = Parameter("the number of labels that vote", 5, 2, 1000, whole=True)
    sequential = True

    def __init__(self, value: float) -> None:
        super().__init__(value)
        self._last: deque[UInt16] = deque(maxlen=int(value))

    def __call__(self, belief: Belief, view: Shown) -> Belief:
        """See `Filter`."""
        K, N = belief.shape[2], int(self.value)
        rows = np.where(belief.any(axis=2), belief.argmax(axis=2), K).astype(np.uint16)
        self._last.append(rows)
        counts = np.zeros((rows.size, K + 1), dtype=np.float32)
        pixels = np.arange(rows.size)
        for age, past_rows in enumerate(reversed(self._last)):
            counts[pixels, past_rows.reshape(-1)] += 1 + (N - age) / (N * (N + 1))  # of all N together less than 1
        return normalised(counts[:, :K].reshape(belief.shape))
