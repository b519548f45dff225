"""Scans: a point held against the scan before, by voxels, and a scan as a picture."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, Int64
from semstab.data.frames import Frame

WIDTH = 1280
"""Pixels around the horizon of a picture of a scan."""

REACH = 1 << 14
"""Voxels to either side of the sensor within which scans are compared."""

ROWS = 64
"""Rows of such a picture, from the highest ray to the lowest, as many as a common scanner has."""


def dominant_before(previous: Frame, current: Frame, voxel_size: float) -> Int32:
    """Return for each valid point (n,) of a scan the label of most points that the previous scan has in its voxel.

    Of equally many it is the lowest; -1 where the previous scan has no valid point in the voxel. Scores count by their
    largest class.
    """
    origin = np.floor(current.T_wc[:3, 3] / voxel_size)
    keys, voxel = _voxels(current, origin, voxel_size), _voxels(previous, origin, voxel_size)
    pairs, count = np.unique(voxel << 16 | previous.predicted[previous.valid].astype(np.int64), return_counts=True)
    if not len(pairs):
        return np.full(len(keys), -1, np.int32)
    order = np.lexsort((pairs, -count, pairs >> 16))
    pairs = pairs[order]
    first = np.flatnonzero(np.diff(pairs >> 16, prepend=-2))
    voxels_before, label = pairs[first] >> 16, (pairs[first] & 0xFFFF).astype(np.int32)
    positions = np.minimum(np.searchsorted(voxels_before, keys), len(voxels_before) - 1)
    return np.where((voxels_before[positions] == keys) & (keys >= 0), label[positions], np.int32(-1))


def _voxels(frame: Frame, origin: Float64, voxel_size: float) -> Int64:
    """Return a key (n,) of 45 bits of each valid point's voxel within REACH of the origin, another -1."""
    assert frame.points is not None
    R, t = frame.T_wc[:3, :3], frame.T_wc[:3, 3]
    index = np.floor((frame.points[frame.valid].astype(np.float64) @ R.T + t) / voxel_size) - origin + REACH
    near = np.logical_and.reduce([(axis >= 0) & (axis < 2 * REACH) for axis in index.T])
    i, j, k = np.where(near[:, None], index, 0).astype(np.int64).T
    return np.where(near, i << 30 | j << 15 | k, -1)


def pictured(frame: Frame, values: npt.NDArray[Any], fill: float) -> npt.NDArray[Any]:
    """Return values (H, W) of a scan's points as a picture around the sensor (ROWS, WIDTH).

    Columns go once around from behind over the left, rows from the highest ray to the lowest; each pixel has the value
    of the nearest point that falls into it, or `fill` without a point.
    """
    assert frame.points is not None
    valid = np.flatnonzero((frame.depth > 0) & (frame.depth < np.inf))
    picture = np.full((ROWS, WIDTH), fill, dtype=values.dtype)
    if not len(valid):
        return picture
    x, y, z = frame.points.reshape(-1, 3)[valid].T.astype(np.float64)
    elevation = np.arctan2(z, np.hypot(x, y))
    low, high = np.quantile(elevation, [0.001, 0.999])
    row = np.clip((high - elevation) / max(high - low, 1e-6) * ROWS, 0, ROWS - 1).astype(int)
    column = np.clip((math.pi - np.arctan2(y, x)) / (2 * math.pi) * WIDTH, 0, WIDTH - 1).astype(int)
    far_first = np.argsort(-frame.depth.reshape(-1)[valid], kind="stable")
    picture[row[far_first], column[far_first]] = values.reshape(-1)[valid][far_first]
    return picture
