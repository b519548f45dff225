"""Movers in a flight: the numbers of its spots that other views see through, and agreement of the other spots."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from semstab.core.types import THIS_SCENE, Float64, Int64, Mask, Scope, UInt8
from semstab.data.events import accumulated
from semstab.data.records import Record
from semstab.data.statistics import Interval, MisplacedFrame, MovedClass, MovedSpots
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import chance_of, value
from semstab.statistics.intervals import estimate, scope_of
from semstab.statistics.observations import SpotObservations

UNTOLD, STAYED, MOVED = 0, 1, 2
"""States of a place: it is not known whether it moved, it stayed, or it moved."""

STATE_COLORS = ((190, 190, 190), (86, 180, 233), (213, 94, 0))
STATE_NAMES = ("not told", "stayed", "moved")


def moved_spots(
    spots: SpotObservations,
    alpha: Interval,
    scope: Scope = THIS_SCENE,
    frame_name: Callable[[int], str] = str,
) -> MovedSpots | None:
    """Return which spots moved, and agreement of the others; None if no votes of views were kept.

    Args:
        spots: Labels that views give spots.
        alpha: Alpha of all spots.
        scope: Scope of the interval, if there are enough views for it.
        frame_name: Returns the name of a frame's file by its index.
    """
    if (votes := spots.votes) is None or not len(spots):
        return None
    asked = np.zeros(len(spots.point), np.bool_)
    asked[spots.spot] = True
    decided, moved = asked & votes.decided, asked & votes.moved
    share, static = 0.0, alpha
    if moved.any():
        share, rest = share_of_disagreement(spots, moved, decided & ~moved), sums_of_spots(static_spots(spots))
        static = estimate(rest, "alpha", scope=scope_of(rest, scope))
    return MovedSpots(
        spots=int(decided.sum()),
        unknown=1 - float(decided.sum() / asked.sum()),
        moved=float(moved.sum() / decided.sum()) if decided.any() else math.nan,
        disagreement=share,
        alpha=static,
        gap=votes.gap,
        false_rate=votes.false_rate,
        false_share=votes.false_share,
        classes=_classes(spots, decided, moved),
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


def states_at(spots: SpotObservations, point: Float64) -> UInt8:
    """Return the state (n,) of points (n, 3): the nearest spot's, which is at most a spacing of spots away."""
    from scipy.spatial import cKDTree

    states = np.full(len(spots.point) + 1, UNTOLD, np.uint8)  # the last one is of points without a spot
    if spots.votes is None or not len(spots.point):
        return np.full(len(point), UNTOLD, np.uint8)
    states[:-1][spots.votes.static], states[:-1][spots.votes.moved] = STAYED, MOVED
    _, nearest = cKDTree(spots.point).query(point, distance_upper_bound=spots.spacing)
    return np.asarray(states[nearest], np.uint8)


def has_movers(record: Record) -> bool:
    """Return whether movers were found in a unit, and its spots are there to tell where."""
    found = record.statistics is not None and record.statistics.static is not None
    return found and record.observations_file is not None


def states_of(record: Record, point: Float64) -> UInt8 | None:
    """Return the state (n,) of points (n, 3) of a unit's map, see `states_at`; None if no movers were found."""
    file = record.observations_file
    return None if file is None or not has_movers(record) else states_at(SpotObservations.load(file), point)


def share_of_disagreement(spots: SpotObservations, moved: Mask, static: Mask) -> float:
    """Return which share of the disagreement at spots (n,) that moved or are static is at the former; NaN without any.

    Spots that are neither do not count: it is not known whether they moved.
    """
    at_moved, at_static = (_disagreement(spots.only(of_kind[spots.spot])) for of_kind in (moved, static))
    return at_moved / (at_moved + at_static) if at_moved + at_static > 0 else math.nan


def _disagreement(spots: SpotObservations) -> float:
    """Return how many observations disagree: all observations of spots, times the share of pairs that disagree."""
    first = (sums := sums_of_spots(spots)).answers[0]
    by_chance = float(first["observations"].sum()) * (1 - chance_of(first))
    return max(by_chance * (1 - value(sums, "alpha")), 0.0) if by_chance > 0 else 0.0


def _classes(spots: SpotObservations, decided: Mask, moved: Mask) -> tuple[MovedClass, ...]:
    """Return the classes of which spots moved, by the class that most views give a spot."""
    label = _dominant(spots)
    of_class = (np.bincount(label[mask & (label >= 0)], minlength=spots.K) for mask in (decided, moved))
    names = spots.classes or tuple(str(k) for k in range(spots.K))
    rows = [
        MovedClass(name, n, n_moved / n)
        for name, n, n_moved in zip(names, *(counts.tolist() for counts in of_class), strict=True)
        if n_moved
    ]
    return tuple(sorted(rows, key=lambda row: -row.moved))


def _dominant(spots: SpotObservations) -> Int64:
    """Return the dominant class (n,) of each spot; -1 without a label."""
    log, at = spots.observations(), spots.of_log()
    label = np.full(len(spots.point), -1, np.int64)
    label[at] = accumulated(log).argmax(axis=1)
    return label


def misplaced_frames(spots: SpotObservations, frame_name: Callable[[int], str] = str) -> tuple[MisplacedFrame, ...]:
    """Return the frames whose poses do not fit those of the others."""
    if (votes := spots.votes) is None:
        return ()
    frames: Int64 = spots.views.frame[votes.misplaced]
    shares: Float64 = votes.through_of_view[votes.misplaced]
    rows = zip(frames.tolist(), shares.tolist(), strict=True)
    return tuple(MisplacedFrame(frame, frame_name(frame), share) for frame, share in rows)
