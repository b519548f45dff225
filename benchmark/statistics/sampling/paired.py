"""Intervals of what has no sums by frame and cube: a series over frames, and how much of a map another one covers."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64
from semstab.model.statistics import NEXT_FLIGHT, UNKNOWN, Interval
from semstab.statistics.agreement import ratio_of
from semstab.statistics.blocks import LEVEL
from semstab.statistics.sampling.influence import MOST_GROUPS, InfluenceSums
from semstab.statistics.sampling.intervals import LEAST_FRAMES, TOO_FEW, none, of_places

LASTS = "what frames are like lasts as long as the flight: fly more"


def mean_over_frames(frame: npt.NDArray[np.integer], values: Float64, level: float = LEVEL) -> Interval:
    """The mean of values (F,), NaN where undefined, of frames (F,) by their index, for the next flight.

    Frames that are near each other may be alike: how far that goes is found as for places, on a line.
    """
    there = ~np.isnan(values)
    if there.sum() < 2:
        return UNKNOWN
    frame, values = np.asarray(frame)[there], values[there]
    step = 1
    while len(groups := np.unique(frame // step)) > MOST_GROUPS:
        step *= 2
    at = np.searchsorted(groups, frame // step)
    columns = np.stack([np.bincount(at, weights=values), np.bincount(at)], axis=1).astype(np.float64)
    cell = np.stack([groups, np.zeros_like(groups), np.zeros_like(groups)], axis=1)
    found = of_places(cell, step, columns, ratio_of, "plain", level=level)
    reasons = [LASTS] if found.undecided else []
    reasons += [TOO_FEW.format(least=LEAST_FRAMES)] if len(values) < LEAST_FRAMES else []
    return dataclasses.replace(
        found, question=NEXT_FLIGHT, frames=len(values), places=0, block_size=math.nan, undecided="; ".join(reasons)
    )


def difference_over_frames(a: Mapping[int, float], b: Mapping[int, float], level: float = LEVEL) -> Interval:
    """The mean of a series by frame less that of another one, paired on the frames of both, for the next flight."""
    frames = sorted(a.keys() & b.keys())
    differences = np.array([a[frame] - b[frame] for frame in frames])
    if not differences.any():
        return none(Interval(0.0, 0.0, 0.0, NEXT_FLIGHT, frames=len(frames)))
    return mean_over_frames(np.array(frames), differences, level)


def coverage(new: InfluenceSums, base: InfluenceSums, level: float = LEVEL) -> Interval:
    """How many voxels with OP >= 2 a map has for each one of another, less 1, paired on cubes, for this map."""
    edge = max(new.edge, base.edge)
    parts = [sums.coarsened(edge, 0) for sums in (new, base)]
    cell, row = np.unique(np.concatenate([part.cell for part in parts]), axis=0, return_inverse=True)
    of = np.split(row.ravel(), [len(parts[0].cell)])
    after, before = (
        np.bincount(at, weights=part["voxels"][:, 0], minlength=len(cell)) for at, part in zip(of, parts, strict=True)
    )
    columns = np.stack([after - before, after + before, before], axis=1)
    found = of_places(cell, edge, columns, lambda s: ratio_of(s[..., [0, 2]]), "plain", level=level)
    return none(found) if np.allclose(after, before, rtol=1e-9) else found


def same_flight(a: InfluenceSums, b: InfluenceSums) -> bool:
    """Whether both have the same groups of frames, so that they can be paired."""
    step = max(a.step, b.step)
    if not a.step or not b.step:
        return False
    one, other = (np.unique(part.frame[part.frame >= 0] // (step // part.step)) for part in (a, b))
    return len(one) > 0 and np.array_equal(one, other)
