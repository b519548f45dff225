"""Agreement beyond chance of two looks at a place, by how far apart they are: in time, angle, range and baseline.

One number of a map averages over all pairs of frames, so that it says as much about the flight as about the model.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.model.evidence import Evidence
from semstab.model.statistics import UNKNOWN, Correlogram, LagBin
from semstab.model.voxels import Events
from semstab.statistics.agreement import between_of
from semstab.statistics.looks.entries import Sample
from semstab.statistics.sampling.cubes import cubes
from semstab.statistics.sampling.influence import MOST_GROUPS
from semstab.statistics.sampling.intervals import Asked, answers, asked_of_looks

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

STANDARD = (5.0, 15.0)
"""Degrees between the viewing directions at which alpha is stated: a baseline of a tenth to a quarter of the range."""

LEAST_PAIRS, LEAST_CUBES = 100, 8
"""Below so many pairs, or cubes that hold them, a bin is left out."""

MOST_CUBES, MOST_SUMS = 160, 2**17
"""Of cubes, and of the sums of a bin: of many classes fewer groups of frames are kept apart."""


@dataclass(frozen=True, eq=False)
class _Looks:
    """Looks (m,) by the entries of their evidence, with ||s||^2 of each."""

    entries: tuple[Int64, npt.NDArray[np.uint16], Float64]
    squares: Float64

    @classmethod
    def of(cls, evidence: Evidence) -> _Looks:
        squares = cls(evidence.entries, np.zeros(0)).products(np.arange(len(evidence)), 0)
        return cls(evidence.entries, squares)

    def products(self, first: Int64, lag: int) -> Float64:
        """s . s' of each of these and the look that is `lag` later."""
        from semstab.statistics.looks.pairing import products

        found = np.empty(len(first))
        products(*self.entries, first, lag, found)
        return found

    def add(self, sums: Float64, which: Int64, into: Int64, product: Float64) -> None:
        """Add these looks to the rows of the sums (rows, 3 + K), see `add_looks`."""
        from semstab.statistics.looks.pairing import add_looks

        add_looks(sums, which, into, product, self.squares, *self.entries)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of looks (m,) at one voxel each: their numbers, how far they are apart by axis, and s . s' of each.

    seen, limit  all looks, as they were and in the limit, and the products of these pairs
    """

    first: Int64
    second: Int64
    apart: dict[str, Float64]
    seen: tuple[_Looks, Float64]
    limit: tuple[_Looks, Float64]


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cubes (G, 3) and groups of frames (F,) that are kept apart.

    of     (m,) the cube and group of each observation, as one number
    edge   of a cube in metres, step frames of a group
    """

    at: npt.NDArray[np.int32]
    frames: npt.NDArray[np.int32]
    of: Int64
    edge: float
    step: int

    @classmethod
    def over(cls, seen: Events) -> _Cells:
        index = seen.ix, seen.iy, seen.iz
        at, of, edge = cubes(index, seen.voxel_size)
        while len(at) > MOST_CUBES:
            at, of, edge = cubes(index, seen.voxel_size, 2 * edge)
        step, most = 1, min(MOST_GROUPS, max(1, MOST_SUMS // (max(len(at), 1) * (3 + seen.K))))
        while len(frames := np.unique(seen.frame // step)) > most:
            step *= 2
        group = np.searchsorted(frames, seen.frame // step)
        return cls(at, frames, of[seen.voxel] * len(frames) + group, edge, step)


EDGES: dict[str, tuple[float, ...]] = {
    "time": (1, 2, 3, 5, 9, 17, 33, 65, 129, 1e9),
    "angle": (0, 1, 2, 5, 10, 20, 40, 80, 180.1),
    "range": (1, 1.02, 1.05, 1.1, 1.2, 1.5, 2, 1e9),
    "baseline": (0, *(float(f"{digit}e{power}") for power in range(-3, 5) for digit in (1, 2, 5))),
}
"""Edges of the bins: frames, degrees, ratio of the ranges, metres."""


def correlogram(sample: Sample) -> Correlogram:
    """Alpha between frames in bins of the distance of two looks, over the pairs of looks at sampled voxels.

    Of a voxel's looks those that are 1, 2, 4, 8, ... looks apart are paired, so that the cost is linear. Chance is that
    of the pairs in the bin. Bands are at 95 %, for the next flight where the frames of a bin tell of it, else for this
    map.
    """
    seen, limit = _of_seen_classes(*sample.shared())
    cells = _Cells.over(seen)
    bins = {axis: _Bins(edges, cells, 3 + seen.K) for axis, edges in (*EDGES.items(), ("standard", STANDARD))}
    for pairs in _pairs(sample, seen, limit):
        for axis, into in bins.items():
            into.add(pairs.apart["angle" if axis == "standard" else axis], pairs)
    there = [(axis, *own) for axis, into in bins.items() for own in into.found()]
    alphas = answers(asked for _, _, asked in there)
    found: dict[str, tuple[LagBin, ...]] = dict.fromkeys(bins, ())
    for (axis, own, _), alpha in zip(there, alphas, strict=True):
        found[axis] += (dataclasses.replace(own, alpha=alpha),)
    nothing = LagBin(*STANDARD, math.nan, 0, UNKNOWN, math.nan)
    (standard,) = found.pop("standard") or (nothing,)
    return Correlogram(**found, standard=standard)


def _of_seen_classes(*logs: Events) -> Iterator[Events]:
    """Without the classes that are in none of them: of the others nothing changes."""
    labels = np.unique(np.concatenate([log.evidence.label for log in logs]))
    return (dataclasses.replace(log, evidence=log.evidence.only(labels), classes=()) for log in logs)


def _pairs(sample: Sample, seen: Events, limit: Events) -> Iterator[_Pairs]:
    """The pairs of looks that are 1, 2, 4, ... looks apart, one lag after the other."""
    rank = sample.views.rank(seen.frame)
    camera = sample.views.centre[rank]
    index = np.stack([seen.ix, seen.iy, seen.iz], axis=1)
    ray = camera - ((index + 0.5) * seen.voxel_size)[seen.voxel]
    reach = np.linalg.norm(ray, axis=1)
    own, still = _Looks.of(seen.evidence), _Looks.of(limit.evidence)
    lag = 1
    while len(first := np.flatnonzero(seen.voxel[lag:] == seen.voxel[:-lag])):
        second = first + lag
        cosine = (ray[first] * ray[second]).sum(axis=1) / (reach[first] * reach[second])
        apart = {
            "time": np.abs(rank[second] - rank[first]).astype(np.float64),
            "angle": np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))),
            "range": np.maximum(reach[first], reach[second]) / np.minimum(reach[first], reach[second]),
            "baseline": np.linalg.norm(camera[second] - camera[first], axis=1),
        }
        yield _Pairs(first, second, apart, *((looks, looks.products(first, lag)) for looks in (own, still)))
        lag *= 2


class _Bins:
    """Sums of the pairs by bin: of looks by cube and group of frames (n, G, F, C), of the limit (n, C)."""

    def __init__(self, edges: tuple[float, ...], cells: _Cells, columns: int) -> None:
        n = len(edges) - 1
        self.edges = np.array(edges)
        self.cells = cells
        self._looks = np.zeros((n, len(cells.at), len(cells.frames), columns))
        self._limit = np.zeros((n, columns))
        self._pairs, self._apart = np.zeros(n), np.zeros(n)

    def add(self, apart: Float64, pairs: _Pairs) -> None:
        """Pairs (m,) that are so far apart; those beyond the edges are left out."""
        n, of = len(self._pairs), np.searchsorted(self.edges, apart, side="right") - 1
        of[of == n] = -1
        known = of >= 0
        self._pairs += np.bincount(of[known], minlength=n)
        self._apart += np.bincount(of[known], weights=apart[known], minlength=n)
        (seen, product), (limit, still) = pairs.seen, pairs.limit
        cells, columns = self._looks[0].size // self._looks.shape[-1], self._looks.shape[-1]
        for looks in (pairs.first, pairs.second):
            into = np.where(known, of * cells + self.cells.of[looks], -1)
            seen.add(self._looks.reshape(-1, columns), looks, into, product)
            limit.add(self._limit, looks, of, still)

    def found(self) -> Iterator[tuple[LagBin, Asked]]:
        """The bins in which there is enough, and what is asked of each."""
        for k in np.flatnonzero(self._pairs >= LEAST_PAIRS):
            columns = self._looks[k]
            cube, group = np.nonzero(columns[:, :, 1])
            if len(np.unique(cube)) < LEAST_CUBES:
                continue
            own, looks = self.cells, columns[cube, group]
            whole = looks[:, :2]  # of its agreement with the other one, neither look has half for itself alone
            alpha = asked_of_looks(own.at[cube], own.frames[group], own.edge, own.step, looks, whole, between_of)
            low, high, pairs = float(self.edges[k]), float(self.edges[k + 1]), self._pairs[k]
            ceiling = float(between_of(self._limit[k]))
            yield LagBin(low, high, float(self._apart[k] / pairs), int(pairs), UNKNOWN, ceiling), alpha
