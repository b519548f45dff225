"""Cubes of space over any set of voxels, and intervals for this map of any statistic of their sums."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semstab.model.statistics import Interval
from semstab.statistics.sampling.collect import cell_edge, cells_of
from semstab.statistics.sampling.influence import Scale, Statistic
from semstab.statistics.sampling.intervals import of_places

Float64 = npt.NDArray[np.float64]


class Places:
    """The cubes of voxels (n, 3), at most MOST_CELLS unless their edge is given, in metres."""

    def __init__(self, index: npt.NDArray[np.int32], voxel_size: float, edge: float | None = None) -> None:
        self.edge = cell_edge(index, voxel_size) if edge is None else edge
        self.cell, self.of = cells_of(index, voxel_size, self.edge)

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
        by_column = [np.bincount(self.of, weights=own, minlength=self.count) for own in columns.T]
        sums = np.stack(by_column, axis=1).astype(np.float64)
        kind: Scale = scale or ("share" if bounds == (0.0, 1.0) else "plain")
        return of_places(self.cell, self.edge, sums, statistic, kind, bounds)
