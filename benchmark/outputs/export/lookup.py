"""Which voxel a point belongs to: the one that it lies in, else the nearest within a radius."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from semstab.metrics.matching import voxel_keys
from semstab.model.voxels import VoxelTable

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

NONE = -1
"""The row of a point that belongs to no voxel."""


class VoxelLookup:
    """Finds voxels of a table by coordinates, those of the scene and an offset; a radius of 0 takes no neighbours."""

    def __init__(self, table: VoxelTable, offset: npt.ArrayLike = (0.0, 0.0, 0.0), radius: float = 0.0) -> None:
        self.table, self._offset, self._radius = table, np.asarray(offset, dtype=np.float64), radius
        index = self.table.index.astype(np.int64)
        self._low, self._high = index.min(axis=0), index.max(axis=0)
        (self._keys,) = voxel_keys(index)

    @property
    def bounds(self) -> tuple[Float64, Float64]:
        """(3,) the lowest and the highest coordinates that may belong to a voxel, metres."""
        r = self.table.voxel_size
        return self._low * r + self._offset - self._radius, (self._high + 1) * r + self._offset + self._radius

    def rows(self, points: Float64) -> Int64:
        """(n,) the voxel of each point (n, 3), a row of the table, or NONE."""
        return self.nearest(points)[0]

    def nearest(self, points: Float64) -> tuple[Int64, Float64]:
        """The same, with the distance of its centre, 0 for the voxel that a point lies in."""
        points = points - self._offset
        index = np.floor(points / self.table.voxel_size).astype(np.int64)
        inside = np.flatnonzero(((index >= self._low) & (index <= self._high)).all(axis=1))
        rows, apart = np.full(len(points), NONE), np.full(len(points), np.inf)
        keys = np.ravel_multi_index(tuple((index[inside] - self._low).T), tuple(self._high - self._low + 1))
        at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        met = inside[self._keys[at] == keys]
        rows[met], apart[met] = at[self._keys[at] == keys], 0.0
        if self._radius > 0:
            lost = np.flatnonzero(rows == NONE)
            rows[lost], apart[lost] = self._around(points[lost])
        return rows, apart

    def _around(self, points: Float64) -> tuple[Int64, Float64]:
        """(n,) the voxel whose centre is nearest to each point of the scene, within the radius, and how near."""
        low, high = (edge - self._offset for edge in self.bounds)
        near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        rows, apart = np.full(len(points), NONE), np.full(len(points), np.inf)
        apart[near], found = self._tree.query(points[near], distance_upper_bound=self._radius, workers=-1)
        rows[near] = np.where(found < len(self.table), found, NONE)
        return rows, apart

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.table.centers)
