"""Agreement of features: two views of a spot, beyond the likeness of any two features of the map."""

from __future__ import annotations

from dataclasses import dataclass

from semstab.data.statistics.agreement import Correlogram, RangeStratum
from semstab.data.statistics.drift import OutlyingFrames
from semstab.data.statistics.intervals import Interval


@dataclass(frozen=True)
class FeaturePlace:
    """A cube of space where features of two views differ most.

    Attributes:
        centre: (x, y, z) mean of its spots, metres.
        spots: Its spots that two views saw.
        cosine: Mean cosine of two views at these.
        share: Its share of all disagreement.
        frames: Frames that see most of its spots, at most five.
    """

    centre: tuple[float, float, float]
    spots: int
    cosine: float
    share: float
    frames: tuple[int, ...]


@dataclass(frozen=True)
class FeatureAgreement:
    """Features that views give spots of the surface.

    Attributes:
        components: Number of components of a vector.
        spots: Spots that two views saw or more, of those that are kept.
        views: Distinct views.
        one_in: The sample keeps one in `one_in` spots of alpha, for lack of memory.
        alpha: 1 - (1 - cosine) / (1 - chance).
        cosine: Mean cosine of two views at a spot.
        chance: Mean cosine of two observations from anywhere.
        alone: Whether the model gives features and no labels.
        correlogram: Alpha by time, angle, range and baseline between two views.
        ranges: Alpha by the distance from which spots were seen; empty if that is about one distance.
        outlying_frames: Frames whose features differ from those of other views at the same spots more than usual; a
            share is half of 1 - cosine.
        places: Worst places, the one with most disagreement first.
    """

    components: int
    spots: int
    views: int
    one_in: int
    alpha: Interval
    cosine: float
    chance: float
    alone: bool
    correlogram: Correlogram
    ranges: tuple[RangeStratum, ...] = ()
    outlying_frames: OutlyingFrames | None = None
    places: tuple[FeaturePlace, ...] = ()

    @property
    def text(self) -> str:
        """'features: alpha .71 (.69 to .73), 128 components; cosine .80 at a spot, .31 by chance'."""
        return (
            f"features: alpha {self.alpha.text()}, {self.components} components; mean cosine {self.cosine:.2f} of two"
            f" views at a spot, {self.chance:.2f} of any two"
        )
