"""Voxel indices packed into one integer each, for sorting and looking up voxels."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from semstab.core.types import Int64
from semstab.errors import DataError


def voxel_keys(*indices: npt.NDArray[np.integer]) -> list[Int64]:
    """Return one int64 key per voxel of each index array (n, 3), ascending with (ix, iy, iz), the same for all arrays.

    Raises:
        DataError: If the voxels span more than 2^63 cells together.
    """
    columns = [np.ascontiguousarray(index.T, dtype=np.int64) for index in indices]
    filled = [column for column in columns if column.size]
    if not filled:
        return [np.zeros(0, dtype=np.int64) for _ in indices]
    low = np.min([column.min(axis=1) for column in filled], axis=0)
    high = np.max([column.max(axis=1) for column in filled], axis=0)
    size = [int(n) for n in high - low + 1]
    if math.prod(size) >= 2**63:
        raise DataError(f"the maps span {' x '.join(map(str, size))} voxels; leave out far depth, or use larger voxels")
    return [((x - low[0]) * size[1] + (y - low[1])) * size[2] + (z - low[2]) for x, y, z in columns]


def in_order(index: npt.NDArray[np.integer]) -> Int64:
    """Return the order of voxel indices (n, 3) by ix, iy, iz, however far apart the voxels are."""
    try:
        (keys,) = voxel_keys(index)
    except DataError:
        order: Int64 = np.lexsort(index.T[::-1])
        return order
    return np.argsort(keys, kind="stable")
