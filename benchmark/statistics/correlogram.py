"""Agreement beyond chance of two looks at a place, by how far apart they are: in time, angle, range and baseline.

One number of a map averages over all pairs of frames, so that it says as much about the flight as about the model.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int32, Int64, UInt16
from semstab.model.events import Events
from semstab.model.evidence import Evidence
from semstab.model.statistics import UNKNOWN, Correlogram, LagBin
from semstab.statistics.agreement import between_of
from semstab.statistics.cluster_sums import MOST_GROUPS, cubes_of
from semstab.statistics.intervals import EstimateSpec, confidence_intervals, spec_of_observations
from semstab.statistics.observations import ObservationSample

STANDARD = (5.0, 15.0)
"""Degrees between the viewing directions at which alpha is stated: a baseline of a tenth to a quarter of the range."""

LEAST_PAIRS, LEAST_CUBES = 100, 8
"""Below so many pairs, or cubes that hold them, a bin is left out."""

MOST_CUBES, MOST_SUMS = 160, 2**17
"""Of cubes, and of the sums of a bin: of many classes fewer groups of frames are kept apart."""


@dataclass(frozen=True, eq=False)
class _Looks:
    """CellObservations (n,) by the entries of their evidence, with ||s||^2 of each."""

    entries: tuple[Int64, UInt16, Float64]
    squares: Float64

    @classmethod
    def of(cls, evidence: Evidence) -> _Looks:
        squares = cls(evidence.entries, np.zeros(0)).products(np.arange(len(evidence)), 0)
        return cls(evidence.entries, squares)

    def products(self, first: Int64, lag: int) -> Float64:
        """s . s' of each of these and the look that is `lag` later."""
        from semstab.statistics.loops.observations import products

        found = np.empty(len(first))
        products(*self.entries, first, lag, found)
        return found


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of looks (m,) at one voxel each: the first one's number, how many looks later the second is.

    apart  (4, m) how far they are apart, by axis as in EDGES
    seen, limit  s . s' (m,) as they were, and in the limit
    """

    first: Int64
    lag: int
    apart: Float64
    seen: Float64
    limit: Float64


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cubes (G, 3), and the groups of frames (C,) of which there are looks in cube (C,): what is kept apart.

    of     (n,) which of the C each look is in
    edge   of a cube in metres, step frames of a group
    """

    at: Int32
    cube: Int64
    frames: Int32
    of: Int64
    edge: float
    step: int

    @classmethod
    def over(cls, seen: Events) -> _Cells:
        index = seen.ix, seen.iy, seen.iz
        at, cube_of, edge = cubes_of(index, seen.voxel_size)
        while len(at) > MOST_CUBES:
            at, cube_of, edge = cubes_of(index, seen.voxel_size, 2 * edge)
        step, most = 1, min(MOST_GROUPS, max(1, MOST_SUMS // (max(len(at), 1) * (3 + seen.K))))
        while len(frames := np.unique(seen.frame // step)) > most:
            step *= 2
        group = np.searchsorted(frames, seen.frame // step)
        there, of = np.unique(cube_of[seen.voxel].astype(np.int64) * len(frames) + group, return_inverse=True)
        cube, group = np.divmod(there, max(len(frames), 1))
        return cls(at, cube, frames[group], of, edge, step)


EDGES: dict[str, tuple[float, ...]] = {
    "time": (1, 2, 3, 5, 9, 17, 33, 65, 129, 1e9),
    "angle": (0, 1, 2, 5, 10, 20, 40, 80, 180.1),
    "range": (1, 1.02, 1.05, 1.1, 1.2, 1.5, 2, 1e9),
    "baseline": (0, *(float(f"{digit}e{power}") for power in range(-3, 5) for digit in (1, 2, 5))),
}
"""Edges of the bins: frames, degrees, ratio of the ranges, metres."""

AXES = EDGES | {"standard": STANDARD}


def correlogram(sample: ObservationSample) -> Correlogram:
    """Alpha between frames in bins of the distance of two looks, over the pairs of looks at sampled voxels.

    Of a voxel's looks those that are 1, 2, 4, 8, ... looks apart are paired, so that the cost is linear. Chance is that
    of the pairs in the bin. Bands are at 95 %, for this scene flown again where the frames of a bin tell of it, else
    for these frames.
    """
    seen, limit = _of_seen_classes(*sample.shared())
    looks, still = _Looks.of(seen.evidence), _Looks.of(limit.evidence)
    sums = _Sums(_Cells.over(seen), 3 + seen.K)
    for pairs in _pairs(sample, seen, looks, still):
        sums.add(pairs, looks, still)
    there = list(sums.found())
    alphas = confidence_intervals(asked for _, _, asked in there)
    found: dict[str, tuple[LagBin, ...]] = dict.fromkeys(AXES, ())
    for (axis, own, _), alpha in zip(there, alphas, strict=True):
        found[axis] += (dataclasses.replace(own, alpha=alpha),)
    nothing = LagBin(*STANDARD, math.nan, 0, UNKNOWN, math.nan)
    (standard,) = found.pop("standard") or (nothing,)
    return Correlogram(**found, standard=standard)


def _of_seen_classes(*logs: Events) -> Iterator[Events]:
    """Without the classes that are in none of them: of the others nothing changes."""
    labels = np.unique(np.concatenate([log.evidence.label for log in logs]))
    return (dataclasses.replace(log, evidence=log.evidence.only(labels), classes=()) for log in logs)


def _pairs(sample: ObservationSample, seen: Events, looks: _Looks, still: _Looks) -> Iterator[_Pairs]:
    """The pairs of looks that are 1, 2, 4, ... looks apart, one lag after the other."""
    from semstab.statistics.loops.observations import distances

    rank = sample.views.rank(seen.frame)
    centre = sample.views.centre
    index = np.stack([seen.ix, seen.iy, seen.iz], axis=1)
    ray = centre[rank] - ((index + 0.5) * seen.voxel_size)[seen.voxel]
    reach = np.linalg.norm(ray, axis=1)
    lag = 1
    while len(first := np.flatnonzero(seen.voxel[lag:] == seen.voxel[:-lag])):
        apart = np.empty((len(EDGES), len(first)))
        distances(first, lag, rank, centre, ray, reach, *apart)
        angle = apart[1]
        np.degrees(np.arccos(np.clip(angle, -1.0, 1.0)), out=angle)
        yield _Pairs(first, lag, apart, looks.products(first, lag), still.products(first, lag))
        lag *= 2


class _Sums:
    """Sums of the pairs by bin, one axis after the other: of looks by cell (n, C, 3 + K), of the limit (n, 3 + K).

    The last bin has what is beyond the edges of an axis.
    """

    def __init__(self, cells: _Cells, columns: int) -> None:
        self._bins = [(axis, *edges) for axis, own in AXES.items() for edges in itertools.pairwise(own)]
        n = len(self._bins) + 1
        self._cells = cells
        self._looks, self._limit = np.zeros((n, len(cells.cube), columns)), np.zeros((n, columns))
        self._pairs, self._apart = np.zeros(n), np.zeros(n)

    def add(self, pairs: _Pairs, looks: _Looks, still: _Looks) -> None:
        """Pairs (m,)."""
        from semstab.statistics.loops.observations import add_pairs

        apart = np.stack([*pairs.apart, pairs.apart[1]], axis=1)  # the standard baseline is one of angles
        bins, before = np.empty(apart.shape, np.int64), 0
        for axis, edges in enumerate(AXES.values()):
            of = np.searchsorted(edges, apart[:, axis], side="right")
            bins[:, axis] = np.where((of > 0) & (of < len(edges)), of + (before - 1), len(self._bins))
            before += len(edges) - 1
        add_pairs(
            pairs.first, pairs.lag, bins, apart, self._cells.of, (*looks.entries, looks.squares, pairs.seen),
            (*still.entries, still.squares, pairs.limit), self._looks, self._limit, self._pairs, self._apart,
        )  # fmt: skip

    def found(self) -> Iterator[tuple[str, LagBin, EstimateSpec]]:
        """The bins in which there is enough, each with its axis, and what is asked of it."""
        for k in np.flatnonzero(self._pairs[:-1] >= LEAST_PAIRS):
            cells, there = self._cells, np.flatnonzero(self._looks[k, :, 1])
            cube, looks, pairs = cells.cube[there], self._looks[k, there], self._pairs[k]
            if len(np.unique(cube)) < LEAST_CUBES:
                continue
            whole = looks[:, :2]  # of its agreement with the other one, neither look has half for itself alone
            where = cells.at[cube], cells.frames[there], cells.edge, cells.step
            axis, low, high = self._bins[k]
            ceiling = float(between_of(self._limit[k]))
            own = LagBin(low, high, float(self._apart[k] / pairs), int(pairs), UNKNOWN, ceiling)
            yield axis, own, spec_of_observations(*where, looks, whole, between_of)
