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
from semstab.model.statistics import UNDEFINED, Correlogram, Estimate, LagBin
from semstab.model.voxels import Events
from semstab.statistics.agreement import between_of
from semstab.statistics.blocks import LEVEL, Statistic, gradient_of, spatial_blocks
from semstab.statistics.looks.entries import Sample

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

STANDARD = (5.0, 15.0)
"""Degrees between the viewing directions at which alpha is stated: a baseline of a tenth to a quarter of the range."""

LEAST_PAIRS, LEAST_BLOCKS = 100, 8
"""Below so many pairs, or blocks that hold them, a bin is left out."""


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of looks (m,) at one voxel each: the block it is in, how far apart they are by axis, and their sums.

    seen, limit  (m, 3 + K) what `between_of` is a function of, of each pair by itself
    """

    block: Int64
    apart: dict[str, Float64]
    seen: Float64
    limit: Float64


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
    of the pairs in the bin. Bands are at 95 % over blocks of space, for these frames.
    """
    seen, limit = _of_seen_classes(*shared_observations(sample.seen, sample.limit))
    bins = {axis: _Bins(edges, 3 + seen.K) for axis, edges in (*EDGES.items(), ("standard", STANDARD))}
    index = np.stack([seen.ix, seen.iy, seen.iz], axis=1)
    blocks = spatial_blocks(index, seen.voxel_size)
    for pairs in _pairs(sample, seen, limit, index, blocks.of):
        for axis, into in bins.items():
            into.add(pairs.apart["angle" if axis == "standard" else axis], pairs, blocks.count)
    found = {axis: into.found() for axis, into in bins.items()}
    nothing = LagBin(*STANDARD, math.nan, 0, UNDEFINED, math.nan)
    (standard,) = found.pop("standard") or (nothing,)
    return Correlogram(**found, standard=standard)


def _of_seen_classes(*logs: Events) -> Iterator[Events]:
    """Without the classes that are in none of them: of the others nothing changes."""
    labels = np.unique(np.concatenate([log.evidence.label for log in logs]))
    return (dataclasses.replace(log, evidence=log.evidence.only(labels), classes=()) for log in logs)


def _pairs(sample: Sample, seen: Events, limit: Events, index: npt.NDArray[np.int32], block: Int64) -> Iterator[_Pairs]:
    """The pairs of looks that are 1, 2, 4, ... looks apart, one lag after the other."""
    order = {view.frame: rank for rank, view in enumerate(sample.views)}
    rank = np.array([order[frame] for frame in seen.frame.tolist()], dtype=np.int64)
    camera = np.array([view.centre for view in sample.views]).reshape(-1, 3)[rank]
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
        of_pair = block[seen.voxel[first]]
        yield _Pairs(of_pair, apart, *(_sums(log.evidence, first, second) for log in (seen, limit)))
        lag *= 2


def _sums(evidence: Evidence, first: Int64, second: Int64) -> Float64:
    """(m, 3 + K) of pairs of observations: s . s', how many, ||s||^2 and s, summed over both."""
    a, b = evidence[first], evidence[second]
    own = (a**2).sum(axis=1) + (b**2).sum(axis=1)
    columns = np.stack([2 * (a * b).sum(axis=1), np.full(len(a), 2.0), own], axis=1)
    return np.concatenate([columns, a + b], axis=1)


class _Bins:
    """Sums of the pairs by bin and block."""

    def __init__(self, edges: tuple[float, ...], columns: int) -> None:
        self.edges = np.array(edges)
        self.columns = columns
        self._sums: npt.NDArray[np.float64] | None = None

    def add(self, apart: Float64, pairs: _Pairs, blocks: int) -> None:
        """Pairs (m,) that are so far apart; those beyond the edges are left out."""
        n = len(self.edges) - 1
        if self._sums is None:
            self._sums = np.zeros((n, blocks, 2 + 2 * self.columns))
        of = np.searchsorted(self.edges, apart, side="right") - 1
        inside = (of >= 0) & (of < n)
        cell = (of * blocks + pairs.block)[inside]
        columns = (np.ones(len(apart)), apart, *pairs.seen.T, *pairs.limit.T)
        for k, column in enumerate(columns):
            self._sums[..., k] += np.bincount(cell, weights=column[inside], minlength=n * blocks).reshape(n, blocks)

    def found(self) -> tuple[LagBin, ...]:
        """The bins in which there is enough."""
        return () if self._sums is None else tuple(self._rows(self._sums))

    def _rows(self, sums: Float64) -> Iterator[LagBin]:
        for low, high, by_block in zip(self.edges[:-1], self.edges[1:], sums, strict=True):
            of_bin = by_block[by_block[:, 0] > 0]
            pairs, apart = of_bin[:, :2].sum(axis=0)
            if pairs >= LEAST_PAIRS and len(of_bin) >= LEAST_BLOCKS:
                seen, limit = np.split(of_bin[:, 2:], 2, axis=1)
                ceiling = float(between_of(limit.sum(axis=0)))
                yield LagBin(float(low), float(high), float(apart / pairs), int(pairs), band(seen, between_of), ceiling)


def band(sums: Float64, statistic: Statistic, level: float = LEVEL) -> Estimate:
    """A statistic of block sums (B, C) with its interval by the delta method, t(B - 1), on the scale log(1 - value)."""
    from scipy.stats import t as student

    total, B = sums.sum(axis=0), len(sums)
    value = float(statistic(total))
    error = math.sqrt(B / max(B - 1, 1) * float(np.square(sums @ gradient_of(statistic, total)).sum()))
    if B < 2 or math.isnan(error) or value >= 1:
        return Estimate(value, math.nan, math.nan)
    half = float(student.ppf((1 + level) / 2, B - 1)) * error / (1 - value)
    return Estimate(value, max(-1.0, 1 - (1 - value) * math.exp(min(half, 30.0))), 1 - (1 - value) * math.exp(-half))
