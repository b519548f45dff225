"""Voxel indices packed into one int64, 21 bits an axis, as they count from the origin of a map."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.backends.shared.association import back_project, voxel_index
from semstab.core.compiled import helper, serial
from semstab.core.types import Int64
from semstab.data.frames import Frame
from semstab.data.voxels import INDEX
from semstab.errors import DataError

HALF = 1 << 20
"""A map reaches that many voxels to either side of its origin."""


def columns_of_keys(keys: Int64, origin: npt.ArrayLike) -> dict[str, Any]:
    """Return the columns ix, iy, iz (n,) of packed keys (n,), which sort like them."""
    columns = np.empty((3, len(keys)), np.int32)
    unpack_keys(keys, np.asarray(origin, np.int64) - HALF, columns)
    return dict(zip(INDEX, columns, strict=True))


def index_of_keys(keys: Int64, origin: npt.ArrayLike) -> Int64:
    """Return voxel indices (n, 3) of packed keys (n,)."""
    index = np.empty((len(keys), 3), np.int64)
    unpack_keys(keys, np.asarray(origin, np.int64) - HALF, index.T)
    return index


@serial
def unpack_keys(keys, start, index):
    """Unpack keys (n,) into indices (3, n) that count from `start` (3,)."""
    for i in range(len(keys)):
        for axis in range(3):
            index[axis, i] = (keys[i] >> (42 - 21 * axis) & (2 * HALF - 1)) + start[axis]


def out_of_reach(frame: Frame, origin: npt.ArrayLike, voxel_size: float) -> DataError:
    """Return the error for a frame with points too far from the origin, or too far for 32-bit indices altogether."""
    points = back_project(frame)
    voxel_index(points, voxel_size, frame)
    low, high = (edge.round(1).tolist() for edge in (points.min(axis=1), points.max(axis=1)))
    return DataError(
        f"{frame.where('depth')}: frame {frame.index} spans {low} to {high} m, more than 2^20 voxels of"
        f" {voxel_size:g} m from the map's origin {(np.asarray(origin) * voxel_size).round(1).tolist()};"
        " leave out far depth (sky?), check depth and pose units, or use larger voxels"
    )


# The hash of packed voxel keys, which cuts observations and maps into partitions.

PARTITIONS = 64


@serial
def mix(key):
    """Return the finaliser of splitmix64: every bit of the key moves every bit of the hash."""
    x = np.uint64(key)
    x ^= x >> np.uint64(30)
    x *= np.uint64(0xBF58476D1CE4E5B9)
    x ^= x >> np.uint64(27)
    x *= np.uint64(0x94D049BB133111EB)
    x ^= x >> np.uint64(31)
    return x


@helper
def partition_of(key):
    """Return the partition of a key: the top 6 bits of its hash."""
    return np.int64(mix(key) >> np.uint64(58))


@helper
def bounds_of(number):
    """Return the bounds (n + 1,) of consecutive parts with `number` (n,) elements: each part's first, and the end."""
    bounds = np.zeros(number.shape[0] + 1, np.int64)
    for part in range(number.shape[0]):
        bounds[part + 1] = bounds[part] + number[part]
    return bounds


def partitions_of(keys: Int64) -> Int64:
    """Return the partition of each key (n,)."""
    partition: Int64 = (mix.py_func(keys) >> np.uint64(58)).astype(np.int64)
    return partition
