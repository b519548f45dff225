"""Spatial blocks of voxels, and confidence intervals from resampling them: voxels of one block are not independent."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64
from semstab.metrics.agreement import voxel_keys
from semstab.model.evidence import row_chunks
from semstab.model.statistics import Estimate
from semstab.model.voxels import VoxelTable

Statistic = Callable[[Float64], Float64]
"""From sums over voxels (..., C) to a value (...,); the same when all sums are doubled, and a formula of which complex
sums make sense: its slopes are found with them (`slope`), so that it compares `.real` only."""

LEAST_BLOCKS = 32
LEVEL = 0.95
REPLICATES = 2000
ROUNDING = 1e-9
TINY = 1e-12
MOST_CELLS = LEAST_BLOCKS * 16**3
"""Cells that tell which edge leaves so many blocks: finer ones than an eighth of it do not matter."""
STEP = 1e-20
"""Of a sum, into the complex plane: its square is nothing beside 1."""

AT_ONCE = 2**20
"""Numbers in the sums of which a statistic is taken together: all of 20,000 classes would take 3 GB."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Cubes of space and the voxels in them.

    of     (n,) int64 block of each voxel, 0 to count - 1
    count  occupied blocks
    size   their edge, metres
    """

    of: Int64
    count: int
    size: float

    def sums(self, columns: Float64) -> Float64:
        """Sums (count, C) over the voxels of each block of columns (n, C)."""
        return _sums(self.of, columns, self.count)

    def sums_of(self, table: VoxelTable, rows: Int64, formula: Callable[[VoxelTable], Float64]) -> Float64:
        """Those of the columns (n, C) that a formula makes of these rows (n,) of a table, which are never all there."""
        parts = (
            _sums(self.of[some], formula(table.rows(rows[some])), self.count) for some in row_chunks(len(rows), table.K)
        )
        return functools.reduce(np.add, parts)


def _sums(of: Int64, columns: Float64, count: int) -> Float64:
    return np.stack([np.bincount(of, weights=column, minlength=count) for column in columns.T], axis=1)


def spatial_blocks(
    index: npt.NDArray[np.integer], voxel_size: float, *, size: float | None = None, least: int = LEAST_BLOCKS
) -> Blocks:
    """Cut space into cubes aligned with the voxels (n, 3).

    Their edge is `size` metres, rounded to whole voxels; where it is not given, the largest one, in steps of an eighth,
    that leaves at least `least` occupied blocks: large, so that errors hardly reach from one block into the next, and
    many, so that an interval from resampling them holds its level.
    """
    edge = _largest_edge(index, least) if size is None else max(1, round(size / voxel_size))
    (key,) = voxel_keys(index // edge)
    blocks, of = np.unique(key, return_inverse=True)
    return Blocks(of.astype(np.int64), len(blocks), edge * voxel_size)


@dataclass(frozen=True, eq=False)
class Occupied:
    """Where voxels are, as finely as the edge of blocks asks for: cells (c, 3) of `unit` voxels, a power of 2."""

    cells: npt.NDArray[np.integer]
    unit: int

    @classmethod
    def of(cls, index: npt.NDArray[np.integer]) -> Occupied:
        """Those of voxels (n, 3)."""
        return cls.merged([cls(index, 1)])

    @classmethod
    def merged(cls, parts: Sequence[Occupied]) -> Occupied:
        """Those of a map from its parts."""
        unit = max(part.unit for part in parts)
        cells = np.concatenate([part.cells // (unit // part.unit) for part in parts])
        while len(cells := _distinct(cells)) > MOST_CELLS:
            cells, unit = cells // 2, 2 * unit
        return cls(cells, unit)

    def edge(self, least: int = LEAST_BLOCKS) -> int:
        """That of `spatial_blocks`, in voxels."""
        return _largest_edge(self.cells, least, self.unit)


def _largest_edge(index: npt.NDArray[np.integer], least: int, unit: int = 1) -> int:
    """The edge, in voxels: first the power of 2, then what can be added to it."""
    cells, steps = _distinct(index), 1  # blocks of `steps` cells, cells of `unit` voxels
    while len(_distinct(cells // (2 * steps))) >= max(least, 2):
        if steps < 8:
            steps *= 2
        else:
            cells, unit = _distinct(cells // 2), 2 * unit
    fitting = (more for more in range(2 * steps, steps, -1) if len(_distinct(cells // more)) >= least)
    return unit * next(fitting, steps)


def _distinct(index: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    (key,) = voxel_keys(index)
    return index[np.unique(key, return_index=True)[1]]


class BlockBootstrap:
    """Resamples of the blocks with replacement, the same ones for every estimate (Künsch 1989; Lahiri 2003).

    weights (R, B) is how often each block is in each resample.
    """

    def __init__(self, blocks: Blocks, *, replicates: int = REPLICATES, seed: int = 0) -> None:
        self.blocks = blocks
        rng = np.random.default_rng(seed)
        drawn = rng.integers(max(blocks.count, 1), size=(replicates, blocks.count))
        resample = np.arange(replicates)[:, None] * blocks.count
        counts = np.bincount((drawn + resample).ravel(), minlength=replicates * blocks.count)
        self.weights: Float64 = counts.reshape(replicates, blocks.count).astype(np.float64)

    def estimate(
        self, columns: Float64, statistic: Statistic, bounds: tuple[float, float] = (-math.inf, math.inf)
    ) -> Estimate:
        """The statistic of the voxels' columns (n, C) with its interval."""
        return interval(self.blocks.sums(columns), statistic, self.weights, bounds)

    def estimate_of(
        self,
        table: VoxelTable,
        rows: Int64,
        formula: Callable[[VoxelTable], Float64],
        statistic: Statistic,
        bounds: tuple[float, float] = (-math.inf, math.inf),
    ) -> Estimate:
        """The statistic of the columns that a formula makes of these rows of a table, with its interval."""
        return interval(self.blocks.sums_of(table, rows, formula), statistic, self.weights, bounds)

    def replicates(self, columns: Float64, statistic: Statistic) -> Float64:
        """The statistic (R,) in each resample."""
        return statistic(self.weights @ self.blocks.sums(columns))


def interval(
    sums: Float64, statistic: Statistic, weights: Float64, bounds: tuple[float, float] = (-math.inf, math.inf)
) -> Estimate:
    """The bootstrap-t interval of a statistic of block sums (B, C) (Efron and Tibshirani 1993, section 12.5).

    The standard error of each resample is that of the statistic's linear part. Blocks differ much in size and few of
    them may hold all the disagreement; there the percentiles of the resampled values cover too seldom, these do not.
    Bounds are the statistic's range. Undefined for fewer than two blocks.
    """
    value = float(statistic(sums.sum(axis=0)))
    if len(sums) < 2 or math.isnan(value):
        return Estimate(value, math.nan, math.nan)
    everything = np.ones((1, len(sums)))
    error = float(_standard_errors(sums, statistic, everything)[0])
    if error < ROUNDING:
        return Estimate(value, value, value)
    if math.isnan(error):
        return Estimate(value, math.nan, math.nan)
    resampled = statistic(weights @ sums)
    errors = np.maximum(_standard_errors(sums, statistic, weights), 1e-9 * error)
    pivots = (resampled - value) / errors
    pivots = pivots[~np.isnan(pivots)]
    if len(pivots) < len(weights) / 2:
        return Estimate(value, math.nan, math.nan)
    low, high = np.quantile(pivots, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    ends = np.clip([value - high * error, value - low * error], *bounds)
    return Estimate(value, float(ends[0]), float(ends[1]))


def _standard_errors(sums: Float64, statistic: Statistic, weights: Float64) -> Float64:
    """Standard errors (R,) by the delta method: blocks are the sampling units, weights (R, B) how often they are in."""
    slopes = _slopes(statistic, weights @ sums, sums)
    n = weights.sum(axis=1)
    variance = np.zeros(len(weights))
    with np.errstate(invalid="ignore", over="ignore"):  # resamples in which the statistic is not defined
        for rows in np.array_split(np.arange(len(weights)), max(1, weights.size // 2**22)):
            linear = slopes(rows)
            mean = (weights[rows] * linear).sum(axis=1, keepdims=True) / n[rows, None]
            variance[rows] = (weights[rows] * (linear - mean) ** 2).sum(axis=1)
    errors: Float64 = np.sqrt(variance * n / np.maximum(n - 1, 1))
    return errors


def _slopes(statistic: Statistic, totals: Float64, sums: Float64) -> Callable[[Int64], Float64]:
    """The statistic's linear part in each block's sums (B, C) at some of the totals (R, C): (r, B)."""
    if len(sums) < totals.shape[1]:  # fewer blocks than columns, as with many classes
        along = np.stack([slope(statistic, totals, own) for own in sums], axis=1)
        return lambda rows: along[rows]
    scale = np.abs(totals).max(axis=0)
    gradient = np.zeros_like(totals)
    for column in np.flatnonzero(scale):
        step = np.zeros(totals.shape[1])
        step[column] = scale[column]
        gradient[:, column] = slope(statistic, totals, step) / scale[column]
    return lambda rows: gradient[rows] @ sums.T


def slope(statistic: Statistic, totals: Float64, direction: Float64) -> Float64:
    """The derivative (...,) of a statistic at totals (..., C) along a direction (..., C); NaN where it is undefined.

    By a step into the complex plane, which takes no difference and so loses no digit (Squire and Trapp 1998, SIAM
    Review 40).
    """
    with np.errstate(all="ignore"):  # complex numbers warn of NaN where real ones do not
        value = statistic(totals + STEP * 1j * direction)
    derivative: Float64 = np.where(np.isnan(value.real), np.nan, value.imag / STEP)
    return derivative


def gradient_of(statistic: Statistic, total: Float64) -> Float64:
    """The gradient (C,) of a statistic at sums (C,), 0 where there is nothing to sum."""
    gradient = np.zeros_like(total)
    some = np.flatnonzero(total)
    for at in np.array_split(some, len(some) * len(total) // AT_ONCE + 1):
        scale = np.maximum(np.abs(total[at]), TINY)
        along = np.zeros((len(at), len(total)))
        along[np.arange(len(at)), at] = scale
        gradient[at] = slope(statistic, total, along) / scale
    return gradient
