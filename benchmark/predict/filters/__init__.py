"""What steadies a model's labels: `parse("ema:0.6")` makes a filter, `Filtered` puts some over a backbone."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np
import numpy.typing as npt

from semstab.backbones import Image
from semstab.errors import ConfigError
from semstab.model.frames import Frame
from semstab.runtime.registry import Entry, Registry

Belief = npt.NDArray[np.float32]
"""(H, W, K) float32: what is believed of each pixel, sums to 1 over the classes; to 0 where nothing is said."""

REGISTRY = Registry(
    "filter",
    {
        "ema": Entry("semstab.predict.filters.average:Ema", "KEEP: average at the pixel; KEEP is the share of before"),
        "ema-warped": Entry(
            "semstab.predict.filters.average:EmaWarped", "KEEP: the same of the place, by depth and pose"
        ),
        "vote": Entry("semstab.predict.filters.vote:Vote", "N: majority of the pixel's last N labels"),
        "vote-warped": Entry("semstab.predict.filters.vote:VoteWarped", "N: the same of the place, by depth and pose"),
        "guided": Entry(
            "semstab.predict.filters.guided:Guided",
            "PIXELS: guided filter: borders follow those of the image",
        ),
        "threshold": Entry(
            "semstab.predict.filters.threshold:Threshold",
            "SCORE: ignore where no class has it; needs scores",
        ),
        "map-prior": Entry(
            "semstab.predict.filters.map_prior:MapPrior",
            "METRES: times the belief of the map so far, in such voxels",
        ),
    },
)


@dataclass(frozen=True)
class Parameter:
    """The number behind a filter's name: what it is, its usual value, from and up to what; whether it is whole."""

    what: str
    usual: float
    low: float
    high: float
    whole: bool = False

    def read(self, text: str, where: str) -> float:
        """The number in a text. Raises ConfigError that begins with `where`."""
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
    """What a filter may look at beside the belief.

    frame  depth and pose at the image's pixels, where the filter wants geometry
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

    parameter       what stands behind the colon
    sequential      whether it remembers the images before
    wants_geometry  whether it looks at depth and pose
    wants_color     whether it looks at the image
    needs_scores    whether labels alone will not do; else a label counts as certain
    """

    parameter: ClassVar[Parameter]
    sequential: ClassVar[bool] = False
    wants_geometry: ClassVar[bool] = False
    wants_color: ClassVar[bool] = False
    needs_scores: ClassVar[bool] = False

    def __init__(self, value: float) -> None:
        self.value = value

    @abstractmethod
    def __call__(self, belief: Belief, shown: Shown) -> Belief:
        """The belief after what it does; the array that it is given stays as it is."""


@dataclass(frozen=True)
class FilterSpec:
    """A filter by name with its number: 'ema:0.6'."""

    name: str
    value: float
    kind: type[Filter]

    def __call__(self) -> Filter:
        """A new one, which remembers nothing."""
        return self.kind(self.value)

    def __str__(self) -> str:
        return f"{self.name}:{self.value:g}"


def parse(text: str) -> FilterSpec:
    """'ema:0.6', or 'ema' with its usual number.

    Raises ConfigError for an unknown name or a number that it cannot have.
    """
    name, _, value = text.strip().partition(":")
    kind = cast("type[Filter]", REGISTRY.load(name))
    number = kind.parameter.read(value, f"filter '{text}'") if value else kind.parameter.usual
    return FilterSpec(name, number, kind)


def one_hot(rows: npt.NDArray[Any], K: int) -> Belief:
    """Beliefs that are certain: (H, W) rows 0..K-1, K where nothing is said."""
    belief = np.zeros((rows.size, K + 1), dtype=np.float32)
    belief[np.arange(rows.size), rows.reshape(-1)] = 1
    return belief[:, :K].reshape(*rows.shape, K)


def normalised(belief: Belief) -> Belief:
    """Shares of each pixel's sum, in place; 0 where that is 0."""
    total = belief.sum(axis=2, keepdims=True)
    np.divide(belief, total, out=belief, where=total > 0)
    return belief
