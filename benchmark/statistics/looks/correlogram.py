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

from semstab.metrics.matching import shared_observations
from semstab.model.evidence import Evidence
from semstab.model.statistics import UNKNOWN, Correlogram, LagBin
from semstab.model.voxels import Events
from semstab.statistics.agreement import between_of
from semstab.statistics.looks.entries import Sample
from semstab.statistics.sampling.cubes import cell_edge, cells_of
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
class _Pairs:
    """Pairs of looks (m,) at one voxel each: the cube it is in, how far apart they are by axis, and their sums.

    group  of the frames of the first looks, and of the second ones
    seen   (m, 3 + K) what `between_of` is a function of, of the first looks and of the second ones
    limit  (m, 3 + K) of both together, in the limit
    """

    cube: Int64
    apart: dict[str, Float64]
    group: tuple[Int64, Int64]
    seen: tuple[Float64, Float64]
    limit: Float64


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cubes (G, 3) and groups of frames (F,) that are kept apart.

    of     (n,) the cube of each voxel, group (m,) the group of each observation
    edge   of a cube in metres, step frames of a group
    """

    at: npt.NDArray[np.int32]
    frames: npt.NDArray[np.int32]
    of: Int64
    group: Int64
    edge: float
    step: int

    @classmethod
    def over(cls, seen: Events) -> _Cells:
        index = np.stack([seen.ix, seen.iy, seen.iz], axis=1)
        edge = cell_edge(index, seen.voxel_size)
        while len((found := cells_of(index, seen.voxel_size, edge))[0]) > MOST_CUBES:
            edge *= 2
        at, of = found
        step, most = 1, min(MOST_GROUPS, max(1, MOST_SUMS // (max(len(at), 1) * (3 + seen.K))))
        while len(frames := np.unique(seen.frame // step)) > most:
            step *= 2
        return cls(at, frames, of, np.searchsorted(frames, seen.frame // step), edge, step)


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
    seen, limit = _of_seen_classes(*shared_observations(sample.seen, sample.limit))
    cells = _Cells.over(seen)
    bins = {axis: _Bins(edges, cells, 3 + seen.K) for axis, edges in (*EDGES.items(), ("standard", STANDARD))}
    for pairs in _pairs(sample, seen, limit, cells):
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


def _pairs(sample: Sample, seen: Events, limit: Events, cells: _Cells) -> Iterator[_Pairs]:
    """The pairs of looks that are 1, 2, 4, ... looks apart, one lag after the other."""
    order = {view.frame: rank for rank, view in enumerate(sample.views)}
    rank = np.array([order[frame] for frame in seen.frame.tolist()], dtype=np.int64)
    camera = np.array([view.centre for view in sample.views]).reshape(-1, 3)[rank]
    index = np.stack([seen.ix, seen.iy, seen.iz], axis=1)
    ray = camera - ((index + 0.5) * seen.voxel_size)[seen.voxel]
    reach = np.linalg.norm(ray, axis=1)
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
        groups = cells.group[first], cells.group[second]
        one, other = _sums(limit.evidence, first, second)
        looks = _sums(seen.evidence, first, second)
        yield _Pairs(cells.of[seen.voxel[first]], apart, groups, looks, one + other)
        lag *= 2


def _sums(evidence: Evidence, first: Int64, second: Int64) -> tuple[Float64, Float64]:
    """(m, 3 + K) of each look of pairs: s . s' with the other one, how many, ||s||^2 and s."""
    a, b = evidence[first], evidence[second]
    both = (a * b).sum(axis=1), np.ones(len(a))
    one, other = (np.concatenate([np.stack([*both, (own**2).sum(axis=1)], axis=1), own], axis=1) for own in (a, b))
    return one, other


class _Bins:
    """Sums of the pairs by bin: of looks by cube and group of frames (n, G, F, C), of the limit (n, C)."""

    def __init__(self, edges: tuple[float, ...], cells: _Cells, columns: int) -> None:
        n = len(edges) - 1
        self.edges = np.array(edges)
        self.cells = cells
        self._looks = np.zeros((columns, n, len(cells.at), len(cells.frames)))
        self._limit = np.zeros((columns, n))
        self._pairs, self._apart = np.zeros(n), np.zeros(n)

    def add(self, apart: Float64, pairs: _Pairs) -> None:
        """Pairs (m,) that are so far apart; those beyond the edges are left out."""
        n, of = len(self._pairs), np.searchsorted(self.edges, apart, side="right") - 1
        inside = (of >= 0) & (of < n)
        of = of[inside]
        self._pairs += np.bincount(of, minlength=n)
        self._apart += np.bincount(of, weights=apart[inside], minlength=n)
        for to, column in zip(self._limit, pairs.limit.T, strict=True):
            to += np.bincount(of, weights=column[inside], minlength=n)  # noqa: PLW2901 - in place
        shape = self._looks.shape[1:]
        for group, looks in zip(pairs.group, pairs.seen, strict=True):
            cell = np.ravel_multi_index((of, pairs.cube[inside], group[inside]), shape)
            for to, column in zip(self._looks, looks.T, strict=True):
                to += np.bincount(cell, weights=column[inside], minlength=to.size).reshape(shape)  # noqa: PLW2901

    def found(self) -> Iterator[tuple[LagBin, Asked]]:
        """The bins in which there is enough, and what is asked of each."""
        for k in np.flatnonzero(self._pairs >= LEAST_PAIRS):
            columns = self._looks[:, k].transpose(1, 2, 0)
            cube, group = np.nonzero(columns[:, :, 1])
            if len(np.unique(cube)) < LEAST_CUBES:
                continue
            own, looks = self.cells, columns[cube, group]
            whole = looks[:, :2]  # of its agreement with the other one, neither look has half for itself alone
            alpha = asked_of_looks(own.at[cube], own.frames[group], own.edge, own.step, looks, whole, between_of)
            low, high, pairs = float(self.edges[k]), float(self.edges[k + 1]), self._pairs[k]
            ceiling = float(between_of(self._limit[:, k]))
            yield LagBin(low, high, float(self._apart[k] / pairs), int(pairs), UNKNOWN, ceiling), alpha
