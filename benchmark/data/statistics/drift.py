"""Locations whose labels change: flipping classes, drift of the belief in time, frames that stand out."""

from __future__ import annotations

import math
from dataclasses import dataclass

from semstab.data.statistics.intervals import Interval


@dataclass(frozen=True)
class Flipping:
    """Locations about which frames do not agree: with OP >= 2, and two frames agree with a probability below 0.8.

    Attributes:
        share: Share of these locations, each counting by how likely it is one, for these frames.
        seen: The part of them that four frames or more saw: fewer observations do not show whether errors
            recur at the same locations.
        a, b: The two classes between which most of them flip, with the part of all flips that is between these.
    """

    share: Interval
    seen: float
    a: str = ""
    b: str = ""
    part: float = math.nan


@dataclass(frozen=True)
class FlipRates:
    """Share of the steps at which the predicted class changes, that in random order; frames since the last change."""

    rate: Interval
    null: Interval
    excess: Interval
    frames_since: Interval


@dataclass(frozen=True)
class DriftStatistics:
    """SBD in bits, and SBD of the same observations in random order, the null, over the `voxels` that have one."""

    voxels: int
    sbd_op2: Interval
    null: Interval
    excess: Interval
    flips: FlipRates | None = None


@dataclass(frozen=True)
class FrameDisagreement:
    """A frame that stands alone.

    Attributes:
        frame: Its index, of frames that share a view the first one's.
        name: The name of its file.
        places: The sampled places that it saw, as two other views did at least.
        share: Share of these at which its neighbours, the views before and after it, agree on another class.
        null: The mean of that over the other views of the same places.
    """

    frame: int
    name: str
    places: int
    share: float
    null: float

    @property
    def excess(self) -> float:
        """Share less its null."""
        return self.share - self.null


@dataclass(frozen=True)
class OutlyingFrames:
    """The frames that stand alone more often than frames of the same quality do.

    Attributes:
        judged: Number of views that were tested; 0 where they are too few for one to stand out.
        unjudged: Number of views that see too few places which two other views saw, and were not tested.
        usual: Mean excess of the frames that are not named.
        frames: Those that are named, the largest excess first.
    """

    judged: int
    unjudged: int
    usual: float
    frames: tuple[FrameDisagreement, ...] = ()
