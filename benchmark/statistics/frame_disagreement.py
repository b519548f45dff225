"""Frames that stand alone: at places where the views before and after them agree, they give another class.

A place is a spot of the sample (`Sampler`). The neighbours of a view at a place are the NEIGHBOURS other views that saw
it next before and after. A frame next to a bad one is not blamed: its neighbours do not agree with each other where the
bad one errs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64, Mask
from semstab.data.events import Events
from semstab.data.statistics import FrameDisagreement, OutlyingFrames
from semstab.statistics.observations import SpotObservations

NEIGHBOURS = 4
"""Most other views that a view is held against at a place: half of them before it, half after it, or the nearest."""

LEAST_VIEWS = 3
"""Views of a place from which on one of them can stand alone."""

LEAST_PLACES = 50
"""The least number of places of a frame that is tested."""

LEAST_FRAMES = 6
"""Judged frames from which on one of them can stand out."""

LEAST_EXCESS = 0.03
"""Share of its places by which a frame stands out at least: 3 in 100."""

LEVEL = 0.025
"""Nominal level at which a frame is named if no frame is bad; 1 to 7 of 100 simulated runs (docs/validity.md)."""

LEAST_ODDS = 0.001
"""Added to both shares of the odds, so that they are finite; a few places then hardly move the odds."""


@dataclass(frozen=True, eq=False)
class LoneDisagreement:
    """How often each frame with enough places stands alone.

    Attributes:
        frame: (F,) indices of frames, the first of their view, ascending.
        places: (F,) places that the frame saw, as two other views did at least.
        share: (F,) share of them at which all neighbours agree on another class than the frame's.
        null: (F,) the mean of the same over the other views of these places: what the frame would have if it were one
            of them.
    """

    frame: Int64
    places: Int64
    share: Float64
    null: Float64

    @property
    def excess(self) -> Float64:
        """(F,) share minus null; its mean is 0 if all views of a place have the same quality."""
        return self.share - self.null

    @property
    def log_odds_ratio(self) -> Float64:
        """(F,) logit of the share minus logit of the null: about normal if the quality of frames differs.

        Qualities multiply the odds of an error. On the scale of `excess` they are skewed, and the worst of many good
        frames would look like an outlier.
        """
        share, null = (np.log((p + LEAST_ODDS) / (1 - p + LEAST_ODDS)) for p in (self.share, self.null))
        return np.asarray(share - null, np.float64)


def lone_disagreement(spots: SpotObservations) -> LoneDisagreement:
    """Return how often each frame disagrees with all of its neighbours at a place, while these agree.

    x_vt = 1 where view t of place v stands alone, else 0. If the T_v views of a place are exchangeable, x_vt has the
    same mean for all of them, so that

        excess_t = mean over v of (x_vt - (sum_s x_vs - x_vt) / (T_v - 1))

    is 0 in the mean, however hard the places are that frame t sees, and however often they were seen.
    """
    log = spots.observations()
    voxel, alone = log.voxel.astype(np.int64), stands_alone(log)
    T, total = np.bincount(voxel)[voxel], np.bincount(voxel, alone)[voxel]
    several = LEAST_VIEWS <= T
    frame, of = np.unique(log.frame[several], return_inverse=True)
    places = np.bincount(of, minlength=len(frame))
    share_of_others = (total - alone)[several] / (T - 1)[several]
    share, null = (np.bincount(of, x, len(frame)) / places for x in (alone[several], share_of_others))
    return LoneDisagreement(frame.astype(np.int64), places, share, null)


def by_frame(lone: LoneDisagreement, outlying: OutlyingFrames | None) -> dict[int, dict[str, float]]:
    """Return the numbers of each frame by its index, as the time series names them."""
    outliers = {row.frame for row in outlying.frames} if outlying else set()
    rows = zip(lone.frame.tolist(), lone.share.tolist(), lone.null.tolist(), strict=True)
    return {
        frame: {"lone_percent": 100 * share, "lone_null_percent": 100 * null, "outlying": int(frame in outliers)}
        for frame, share, null in rows
    }


def stands_alone(log: Events) -> Mask:
    """Return the observations (m,) whose neighbours at the place, two or more, all have one class that is another."""
    label, rows = log.evidence.argmax(axis=1), np.arange(len(log))
    first, last = log.starts[log.voxel], log.ends[log.voxel]
    width = np.minimum(last - first, NEIGHBOURS + 1)
    start = np.clip(rows - NEIGHBOURS // 2, first, last - width)
    reference = label[np.where(start == rows, np.minimum(start + 1, len(log) - 1), start)]
    alone: Mask = (width >= LEAST_VIEWS) & (label != reference)
    for k in range(NEIGHBOURS + 1):
        at = np.minimum(start + k, len(log) - 1)
        alone &= (k >= width) | (at == rows) | (label[at] == reference)
    return alone


def outlying_rows(values: Float64, level: float = LEVEL) -> Int64:
    """Return the rows of values (n,) that lie above the others, by the generalized extreme studentized deviate test.

    The largest value is taken away again and again, up to half of all; R_i is the i-th one's distance from the mean of
    those that are left with it, in their standard deviations. With the largest i for which R_i exceeds its limit, i
    values lie above the others: so several outliers do not hide each other (Rosner 1983, Technometrics 25, one-sided).

    Args:
        values: (n,) finite numbers, about normal where nothing lies above the others.
        level: The nominal probability that any of n values from one normal distribution is returned.
    """
    order, outlying = np.argsort(-values, kind="stable"), 0
    for i in range((len(values) - 1) // 2):
        remaining = values[order[i:]]
        deviation = float(remaining.std(ddof=1))
        if deviation > 0 and remaining[0] - remaining.mean() > largest_deviate(len(remaining), level) * deviation:
            outlying = i + 1
    return np.asarray(np.sort(order[:outlying]), np.int64)


def largest_deviate(n: int, level: float) -> float:
    """Return the studentized deviate that the largest of n normal values exceeds with this probability (Grubbs)."""
    from scipy.special import stdtrit

    t = float(stdtrit(n - 2, 1 - level / n))
    return float((n - 1) * t / np.sqrt((n - 2 + t * t) * n))


def outlying_frames(lone: LoneDisagreement, views: int, *, name: Callable[[int], str] = str) -> OutlyingFrames:
    """Return the frames that stand alone more often than the quality of the other frames explains.

    The null is the spread of the frames, which contains the variation of places, labels and qualities. A frame is named
    if its log odds ratio is an outlier among the frames' and its excess is at least LEAST_EXCESS above the mean of the
    frames that are not named. The log odds ratio of a frame with fewer places than the median is more uncertain: its
    distance from the median is multiplied by sqrt(places / median).

    Args:
        lone: How often each frame of a map stands alone.
        views: Distinct views of the map; views without enough places are counted, not tested.
        name: Returns the name of a frame's file by its index.
    """
    testable = np.flatnonzero(lone.places >= LEAST_PLACES)
    if len(testable) < LEAST_FRAMES:
        return OutlyingFrames(judged=0, unjudged=views, usual=math.nan)
    places, excess = lone.places[testable], lone.excess[testable]
    odds = lone.log_odds_ratio[testable]
    above = outlying_rows((odds - np.median(odds)) * np.sqrt(np.minimum(places / np.median(places), 1.0)))
    usual = float(np.delete(excess, above).mean())
    outliers = above[excess[above] >= usual + LEAST_EXCESS]
    rows = testable[outliers[np.argsort(-excess[outliers], kind="stable")]]
    return OutlyingFrames(
        judged=len(testable),
        unjudged=views - len(testable),
        usual=usual,
        frames=tuple(
            FrameDisagreement(
                int(lone.frame[k]), name(int(lone.frame[k])), int(lone.places[k]), float(lone.share[k]),
                float(lone.null[k]),
            )
            for k in rows
        ),
    )  # fmt: skip
