"""The same voxels in several maps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.errors import DataError
from semstab.model.voxels import Events, VoxelTable

Int64 = npt.NDArray[np.int64]


def voxel_keys(*indices: npt.NDArray[np.integer]) -> list[Int64]:
    """One int64 key a voxel of each index array (n, 3), ascending with (ix, iy, iz), the same for all arrays.

    Raises DataError where the voxels span more than 2^63 cells together.
    """
    filled = [index for index in indices if len(index)]
    if not filled:
        return [np.zeros(0, dtype=np.int64) for _ in indices]
    low = np.min([index.min(axis=0) for index in filled], axis=0).astype(np.int64)
    high = np.max([index.max(axis=0) for index in filled], axis=0).astype(np.int64)
    size = [int(n) for n in high - low + 1]
    if math.prod(size) >= 2**63:
        raise DataError(f"the maps span {' x '.join(map(str, size))} voxels; leave out far depth, or use larger voxels")
    keys = []
    for index in indices:
        x, y, z = (index.astype(np.int64) - low).T
        keys.append((x * size[1] + y) * size[2] + z)
    return keys


def shared_rows(*tables: VoxelTable) -> list[Int64]:
    """Rows of the voxels that all tables hold, one array a table, in the same order of voxels.

    Raises DataError where the tables differ in K or voxel size.
    """
    require_same_grid(*tables)
    if same_voxels(*tables):
        return [np.arange(len(tables[0]))] * len(tables)
    keys = voxel_keys(*(table.index for table in tables))
    common = reduce(lambda a, b: np.intersect1d(a, b, assume_unique=True), keys)
    return [np.searchsorted(own, common).astype(np.int64) for own in keys]


def same_voxels(first: VoxelTable, *others: VoxelTable) -> bool:
    """Whether all tables have the same voxels."""
    names = ("ix", "iy", "iz")
    return all(np.array_equal(getattr(first, name), getattr(other, name)) for other in others for name in names)


def shared_observations(*logs: Events) -> list[Events]:
    """The observations (voxel, frame) that all logs have, of each log, in the same order.

    Raises DataError where the logs differ in K or voxel size.
    """
    require_same_grid(*logs)
    names = ("ix", "iy", "iz", "voxel", "frame")
    if all(np.array_equal(getattr(logs[0], name), getattr(log, name)) for log in logs[1:] for name in names):
        return list(logs)
    index = [np.stack([log.ix, log.iy, log.iz], axis=1) for log in logs]
    frames = 1 + max((int(log.frame.max()) for log in logs if len(log)), default=0)
    keys = [key[log.voxel] * frames + log.frame for key, log in zip(_dense(index), logs, strict=True)]
    common = reduce(lambda a, b: np.intersect1d(a, b, assume_unique=True), keys)
    return [observations(log, np.flatnonzero(np.isin(own, common))) for log, own in zip(logs, keys, strict=True)]


def observations(log: Events, rows: Int64) -> Events:
    """These rows of a log, ascending, with the voxels that they are of."""
    voxels, of = np.unique(log.voxel[rows], return_inverse=True)
    own: dict[str, Any] = {name: getattr(log, name)[voxels] for name in ("ix", "iy", "iz")}
    own |= {"frame": log.frame[rows], "evidence": log.evidence.take(rows), "pixels": log.pixels[rows]}
    return dataclasses.replace(log, **own, voxel=of)


def _dense(indices: Sequence[npt.NDArray[np.integer]]) -> list[Int64]:
    """A number for each voxel of the index arrays (n, 3), the same in all, from 0 on without gaps."""
    keys = voxel_keys(*indices)
    distinct = np.unique(np.concatenate(keys))
    return [np.searchsorted(distinct, key) for key in keys]


def rows_of(table: VoxelTable, where: npt.NDArray[np.bool_]) -> VoxelTable:
    """The voxels of a table for which `where` (n,) holds."""
    return table.rows(where)


def require_same_grid(*tables: VoxelTable | Events) -> None:
    """Raise DataError where tables differ in K or voxel size."""
    first, *others = tables
    for other in others:
        if (first.K, first.voxel_size) != (other.K, other.voxel_size):
            raise DataError(
                f"maps of {first.K} classes in voxels of {first.voxel_size:g} m and of {other.K} in"
                f" {other.voxel_size:g} m cannot be compared; fuse both alike"
            )


def require_same_map(table: VoxelTable, events: Events) -> None:
    """Raise DataError where the events are not the log behind the table."""
    op = np.diff(events.bounds)
    if not (len(table) == len(events.ix) and np.array_equal(table.op, op)):
        raise DataError(
            f"events of {len(events.ix)} voxels and {len(events)} observations do not belong to a table of"
            f" {len(table)} and {int(table.op.sum(dtype=np.int64))}; take both from one backend"
        )
