"""Agreement beyond chance of two views of a spot by their distance: time, angle, range and baseline.

One number of a map averages over all pairs of frames, so that it depends on the flight as much as on the model.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from semstab.core.arrays import distinct_keys
from semstab.core.types import Float64, Int64, UInt16
from semstab.data.events import Events
from semstab.data.statistics import UNKNOWN, Correlogram, LagBin
from semstab.statistics.agreement import alpha_of
from semstab.statistics.cluster_sums import (
    ALPHA_SUMS,
    MOST_GROUPS,
    ClusterSums,
    FrameGroups,
    Functional,
    cubes_of,
    side_by_side,
)
from semstab.statistics.intervals import estimate, scope_of
from semstab.statistics.observations import SpotObservations

STANDARD = (5.0, 15.0)
"""Degrees between the viewing directions at which alpha is stated: a baseline of a tenth to a quarter of the range."""

LEAST_PAIRS, LEAST_CUBES = 100, 8
"""A bin with fewer pairs, or fewer cubes that hold them, is left out."""

MOST_CUBES, MOST_SUMS = 160, 2**17
"""Most cubes, and most sums of a bin: with many classes fewer groups of frames are kept apart."""

EDGES: dict[str, tuple[float, ...]] = {
    "time": (1, 2, 3, 5, 9, 17, 33, 65, 129, 1e9),
    "angle": (0, 1, 2, 5, 10, 20, 40, 80, 180.1),
    "range": (1, 1.02, 1.05, 1.1, 1.2, 1.5, 2, 1e9),
    "baseline": (0, *(float(f"{digit}e{power}") for power in range(-3, 5) for digit in (1, 2, 5))),
}
"""Edges of the bins: frames, degrees, ratio of the ranges, metres."""

AXES = EDGES | {"standard": STANDARD}


PAIRED_ALPHA = Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=ALPHA_SUMS[:2], of_spots=True)
"""Alpha of pairs of observations: neither has half of its agreement with the other one for itself alone."""


BINS = tuple((axis, *edges) for axis, limits in AXES.items() for edges in itertools.pairwise(limits))


def correlogram(spots: SpotObservations) -> Correlogram:
    """Return alpha in bins of the distance of two views of a spot.

    Views of a spot that are 1, 2, 4, 8, ... apart are paired, so that the cost is linear. Chance is computed from the
    pairs in the bin. Bands are at CONFIDENCE, for this scene flown again if the bin has enough frames for that, else
    for these frames.
    """
    logs = spots.logs()
    labels = np.unique(np.concatenate([log.evidence.label for log, _ in logs]))  # the other classes change nothing

    def sums(by_lag: Sequence[Lag], cluster: Int64, clusters: int) -> list[Float64]:
        return [_sums(log, labels, square, by_lag, cluster, clusters) for log, square in logs]

    return in_bins(spots, sums, len(labels), PAIRED_ALPHA)


def in_bins(
    spots: SpotObservations,
    sums_of: Callable[[Sequence[Lag], Int64, int], Sequence[Float64]],
    K: int,
    number: Functional,
) -> Correlogram:
    """Return a number of pairs in bins of the distance of two views of a spot.

    Args:
        spots: Observations, whose first answers are paired.
        sums_of: Returns the sums (bins + 1, clusters, 4 + K) of pairs, of one answer or of the three, from the pairs of
            each lag, the cluster of each observation and the number of clusters.
        K: Number of columns of evidence.
        number: The number, which is of `ALPHA_SUMS`.
    """
    log = spots.observations()
    cubes, of, edge = cubes_of((log.ix, log.iy, log.iz), log.voxel_size, most=MOST_CUBES)
    most = min(MOST_GROUPS, max(1, MOST_SUMS // (max(len(cubes), 1) * (4 + K))))
    groups, group, step, _ = FrameGroups.at_most(most, log.frame)
    keys, cluster = distinct_keys(of[log.voxel].astype(np.int64) * len(groups) + group)
    cube, group = np.divmod(keys, max(len(groups), 1))
    pairs, distance = np.zeros((2, len(BINS) + 1))
    by_lag = []
    for first, second, apart in _pairs(spots, log):
        bins = _bins(apart)
        pairs += np.bincount(bins.ravel(), minlength=len(pairs))
        distance += np.bincount(bins.ravel(), weights=apart.ravel(), minlength=len(pairs))
        by_lag.append((first, second, bins))
    sums = sums_of(by_lag, cluster, len(keys))
    columns = side_by_side(dict(zip((*ALPHA_SUMS, "square"), (1, 1, 1, K, 1), strict=True)))
    of_axis: dict[str, tuple[LagBin, ...]] = dict.fromkeys(AXES, ())
    for k in np.flatnonzero(pairs[:-1] >= LEAST_PAIRS):
        occupied = np.flatnonzero(sums[0][k, :, 1])
        if len(np.unique(cube[occupied])) < LEAST_CUBES:
            continue
        where = cubes[cube[occupied]], groups[group[occupied]].astype(np.int32)
        answers = tuple(ClusterSums(*where, of_answer[k, occupied], columns, edge, step) for of_answer in sums)
        of_bin = dataclasses.replace(answers[0], answers=answers)
        alpha = estimate(of_bin, number, scope=scope_of(of_bin, key=number))
        axis, low, high = BINS[k]
        of_axis[axis] += (LagBin(low, high, float(distance[k] / pairs[k]), int(pairs[k]), alpha),)
    (standard,) = of_axis.pop("standard") or (LagBin(*STANDARD, math.nan, 0, UNKNOWN),)
    return Correlogram(**of_axis, standard=standard)


Lag = tuple[Int64, Int64, Int64]


def _sums(
    log: Events, labels: UInt16, square: Float64, by_lag: Sequence[Lag], cluster: Int64, clusters: int
) -> Float64:
    """Return the sums (bins + 1, clusters, 4 + K) of pairs: the sums of `ALPHA_SUMS`, then squared distances."""
    from semstab.statistics.loops.pairs import add_pairs

    sums = np.zeros((len(BINS) + 1, clusters, 4 + len(labels)))
    entries = log.evidence.only(labels).entries
    for first, second, bins in by_lag:
        add_pairs(first, second, bins, cluster, entries, square, sums)
    return sums


def _pairs(spots: SpotObservations, log: Events) -> Iterator[tuple[Int64, Int64, Float64]]:
    """Yield the pairs (m,) of observations with lags of 1, 2, 4 and so on.

    Lag by lag, the third array has their distance (m, 5) along `AXES`.
    """
    rank, centre = spots.views.rank(log.frame), spots.views.centre
    index = np.stack([log.ix, log.iy, log.iz], axis=1)
    ray = centre[rank] - ((index + 0.5) * log.voxel_size)[log.voxel]
    distance = np.linalg.norm(ray, axis=1)
    lag = 1
    while len(first := np.flatnonzero(log.voxel[lag:] == log.voxel[:-lag])):
        second = first + lag
        near, far = np.minimum(distance[first], distance[second]), np.maximum(distance[first], distance[second])
        cosine = (ray[first] * ray[second]).sum(axis=1) / (distance[first] * distance[second])
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        baseline = np.linalg.norm(centre[rank[second]] - centre[rank[first]], axis=1)
        yield first, second, np.stack([abs(rank[second] - rank[first]), angle, far / near, baseline, angle], axis=1)
        lag *= 2


def _bins(apart: Float64) -> Int64:
    """Return the number (m, 5) in `BINS` of each pair along each axis, the last one beyond the edges."""
    bins, before = np.empty(apart.shape, np.int64), 0
    for axis, edges in enumerate(AXES.values()):
        of = np.searchsorted(edges, apart[:, axis], side="right")
        bins[:, axis] = np.where((of > 0) & (of < len(edges)), of + (before - 1), len(BINS))
        before += len(edges) - 1
    return bins
