"""Cubes of space over any set of voxels, and intervals for this map of any statistic of their sums."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from semstab.model.statistics import Interval
from semstab.model.voxels import VoxelTable
from semstab.statistics.blocks import Blocks
from semstab.statistics.sampling.collect import cell_edge, cells_of
from semstab.statistics.sampling.influence import Scale, Statistic
from semstab.statistics.sampling.intervals import of_places

Float64 = npt.NDArray[np.float64]


class Places:
    """The cubes of voxels (n, 3), at most MOST_CELLS unless their edge is given, in metres."""

    def __init__(self, index: npt.NDArray[np.int32], voxel_size: float, edge: float | None = None) -> None:
        self.edge = cell_edge(index, voxel_size) if edge is None else edge
        self.cell, of = cells_of(index, voxel_size, self.edge)
        self._blocks = Blocks(of, len(self.cell), self.edge)

    @property
    def count(self) -> int:
        """How many cubes there are."""
        return len(self.cell)

    def estimate(
        self,
        columns: Float64,
        statistic: Statistic,
        bounds: tuple[float, float] = (0.0, 1.0),
        scale: Scale | None = None,
    ) -> Interval:
        """The statistic of the sums of the voxels' columns (n, C), the second of which counts, with its interval.

        Where no scale is given, what goes from 0 to 1 is a share.
        """
        return self._of(self._blocks.sums(columns.astype(np.float64)), statistic, bounds, scale)

    def estimate_of(
        self,
        table: VoxelTable,
        rows: npt.NDArray[np.int64],
        formula: Callable[[VoxelTable], Float64],
        statistic: Statistic,
        bounds: tuple[float, float] = (0.0, 1.0),
        scale: Scale | None = None,
    ) -> Interval:
        """The same of the columns that a formula makes of these rows of a table, which are the voxels."""
        return self._of(self._blocks.sums_of(table, rows, formula), statistic, bounds, scale)

    def _of(self, sums: Float64, statistic: Statistic, bounds: tuple[float, float], scale: Scale | None) -> Interval:
        kind: Scale = scale or ("share" if bounds == (0.0, 1.0) else "plain")
        return of_places(self.cell, self.edge, sums, statistic, kind, bounds)
