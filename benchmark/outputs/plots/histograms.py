"""The voxels of units as histograms by OP, from which ECDFs and the curves against OP are read off; they add up."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import reduce

import numpy as np
import numpy.typing as npt

from semstab.model.measures import Measure, measures, op
from semstab.model.voxels import VoxelTable

Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]

BINS = 1000
"""Bins of a measure between 0 and its largest value; a further one, the first, holds 0 alone."""


def _op_bounds() -> Int64:
    """The lowest OP of each bin: single values up to 8, then steps of about a quarter."""
    bounds = list(range(1, 10))
    while bounds[-1] < 2**31:
        bounds.append(max(bounds[-1] + 1, round(bounds[-1] * 1.25)))
    return np.array(bounds)


OP_BOUNDS = _op_bounds()


@dataclass(frozen=True, eq=False)
class MeasureByOP:
    """A measure's voxels by OP and value: counts (OP bins, 1 + BINS), sums (OP bins,); `largest` ends the last bin.

    The values count from the best one: of a measure of which more is better they are what it lacks, as in 1 - VSS.
    """

    counts: Int64
    sums: Float64
    largest: float

    @classmethod
    def of(cls, values: Float64, bins: Int64, largest: float) -> MeasureByOP:
        """The histogram of values (n,) in OP bins (n,); undefined values do not count."""
        defined = ~np.isnan(values)
        values, bins = values[defined], bins[defined]
        column = np.ceil(values / largest * BINS - 1e-6).clip(0, BINS).astype(np.int64)
        cells = np.bincount(bins * (BINS + 1) + column, minlength=len(OP_BOUNDS) * (BINS + 1))
        sums = np.bincount(bins, weights=values, minlength=len(OP_BOUNDS)).astype(np.float64)
        return cls(cells.reshape(len(OP_BOUNDS), BINS + 1), sums, largest)

    def __add__(self, other: MeasureByOP) -> MeasureByOP:
        return MeasureByOP(self.counts + other.counts, self.sums + other.sums, self.largest)

    @property
    def values(self) -> Float64:
        """(1 + BINS,) the upper end of each bin."""
        return np.arange(BINS + 1) / BINS * self.largest

    @property
    def voxels(self) -> Int64:
        """(OP bins,) voxels where the measure is defined."""
        total: Int64 = self.counts.sum(axis=1)
        return total

    def ecdf(self, lowest_op: int = 1) -> Float64:
        """(1 + BINS,) share of the voxels with at least that OP whose value is at most that of the bin."""
        counts = self.counts[np.searchsorted(OP_BOUNDS, lowest_op) :].sum(axis=0)
        share: Float64 = counts.cumsum() / max(1, counts.sum())
        return share

    def mean(self) -> Float64:
        """(OP bins,) mean by OP; NaN where there are no voxels."""
        mean: Float64 = np.where(self.voxels > 0, self.sums / np.maximum(1, self.voxels), np.nan)
        return mean

    def quantile(self, q: float) -> Float64:
        """(OP bins,) the value that a share q of the voxels does not exceed, by OP; NaN where there are none."""
        reached = self.counts.cumsum(axis=1) >= q * self.voxels[:, None]
        return np.where(self.voxels > 0, self.values[reached.argmax(axis=1)], np.nan)


Histograms = Mapping[str, MeasureByOP]
"""Of a unit's voxels, or of several units' together: each measure by its key."""


def lacking(measure: Measure, value: Float64) -> Float64:
    """How far values are from the best, and back."""
    return value if measure.better == "lower" else measure.largest - value


def histograms(table: VoxelTable) -> Histograms:
    """The histograms of a unit."""
    bins = np.searchsorted(OP_BOUNDS, op(table), side="right") - 1
    return {m.key: MeasureByOP.of(lacking(m, m.of(table)), bins, m.largest) for m in measures()}


def together(units: Iterable[Histograms]) -> Histograms:
    """The voxels of several units pooled."""
    return reduce(lambda a, b: {key: one + b[key] for key, one in a.items()}, units)


def op_position() -> Float64:
    """(OP bins,) where a bin stands on a logarithmic axis: the geometric mean of its OP."""
    last = np.append(OP_BOUNDS[1:] - 1, OP_BOUNDS[-1])
    return np.sqrt(OP_BOUNDS * last.astype(np.float64))
