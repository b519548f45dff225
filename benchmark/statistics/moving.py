"""What moved in a flight: the numbers of its spots that other views see through, and agreement of the others."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from semstab.core.types import THIS_SCENE, Float64, Int64, Mask, Scope
from semstab.data.measures import dominant
from semstab.data.statistics import Interval, MisplacedFrame, MovedClass, MovedSpots
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import ClusterSums, chance_of, value
from semstab.statistics.intervals import estimate, scope_of
from semstab.statistics.observations import SpotObservations


def moved_spots(
    spots: SpotObservations,
    sums: ClusterSums,
    alpha: Interval,
    scope: Scope = THIS_SCENE,
    frame_name: Callable[[int], str] = str,
) -> MovedSpots | None:
    """Return which spots moved, and agreement of the others; None if no votes of views were kept.

    Args:
        spots: Labels that views give spots.
        sums: Sums of these spots.
        alpha: Alpha of all spots.
        scope: Scope of the interval, if there are enough views for it.
        frame_name: Returns the name of a frame's file by its index.
    """
    if (votes := spots.votes) is None or not len(spots):
        return None
    asked = np.zeros(len(spots.point), np.bool_)
    asked[spots.spot] = True
    known, moved = asked & votes.known, asked & votes.moved
    share, static = 0.0, alpha
    if moved.any():
        rest = sums_of_spots(static_spots(spots))
        share, static = share_of_disagreement(sums, rest), estimate(rest, "alpha", scope=scope_of(rest, scope))
    return MovedSpots(
        spots=int(known.sum()),
        unknown=1 - float(known.sum() / asked.sum()),
        moved=float(moved.sum() / known.sum()) if known.any() else math.nan,
        disagreement=share,
        alpha=static,
        gap=votes.gap,
        false_rate=votes.false_rate,
        false_share=votes.false_share,
        classes=_classes(spots, known, moved),
        misplaced=misplaced_frames(spots, frame_name),
    )


def static_spots(spots: SpotObservations) -> SpotObservations:
    """Return the answers for spots that did not move, as far as that is known."""
    return spots.only(~spots.moved)


def moving_percent(spots: SpotObservations) -> dict[int, float]:
    """Return which percentage of the answers of each frame, by its index, is for spots that moved."""
    if spots.votes is None:
        return {}
    answers = np.bincount(spots.view, minlength=len(spots.views))
    moved = np.bincount(spots.view, spots.moved, len(spots.views))
    shares = zip(spots.views.frame.tolist(), moved.tolist(), answers.tolist(), strict=True)
    return {frame: 100 * of_moved / n for frame, of_moved, n in shares if n}


def share_of_disagreement(sums: ClusterSums, rest: ClusterSums) -> float:
    """Return the share of all disagreement that is not at the rest of the spots, by their sums; NaN without any."""

    def disagreement(of: ClusterSums) -> float:
        first = of.answers[0]
        return float(first["observations"].sum()) * (1 - min(value(of, "alpha"), 1.0)) * (1 - chance_of(first))

    everywhere = disagreement(sums)
    return min(max(1 - disagreement(rest) / everywhere, 0.0), 1.0) if everywhere > 0 else math.nan


def _classes(spots: SpotObservations, known: Mask, moved: Mask) -> tuple[MovedClass, ...]:
    """Return the classes of which spots moved, by the class that most views give a spot."""
    own = _dominant(spots)
    of_class = (np.bincount(own[some & (own >= 0)], minlength=spots.K) for some in (known, moved))
    names = spots.classes or tuple(str(k) for k in range(spots.K))
    rows = [
        MovedClass(name, n, n_moved / n)
        for name, n, n_moved in zip(names, *(each.tolist() for each in of_class), strict=True)
        if n_moved
    ]
    return tuple(sorted(rows, key=lambda row: -row.moved))


def _dominant(spots: SpotObservations) -> Int64:
    """Return the dominant class (n,) of each spot; -1 without a label."""
    log, at = spots.observations(), spots.of_log()
    own = np.full(len(spots.point), -1, np.int64)
    own[at] = dominant(log.table())
    return own


def misplaced_frames(spots: SpotObservations, frame_name: Callable[[int], str] = str) -> tuple[MisplacedFrame, ...]:
    """Return the frames whose poses do not fit those of the others."""
    if (votes := spots.votes) is None:
        return ()
    frames: Int64 = spots.views.frame[votes.misplaced]
    shares: Float64 = votes.through_of_view[votes.misplaced]
    rows = zip(frames.tolist(), shares.tolist(), strict=True)
    return tuple(MisplacedFrame(frame, frame_name(frame), share) for frame, share in rows)
