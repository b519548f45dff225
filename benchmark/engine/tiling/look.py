"""The compiled pass over a frame's depth that finds the columns of voxels it shows, and a sample of the voxels."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.hashing import mix
from semstab.backends.shared.keys import HALF
from semstab.runtime.compiled import serial

RECENT = 64
"""Cells that are remembered, so that hardly any is named twice."""


@serial
def look(depth, ray_x, ray_y, T, size, origin, shift, share, cells, keys, drawn):
    """Cells and sampled voxels of the pixels with depth, in order of appearance, some of them more than once.

    A cell is 2^shift by 2^shift columns, packed into 64 bits; a voxel is in the sample where its hash is below `share`.
    The order of operations is the protocol's, so that no pixel falls into another voxel here than when it is fused.
    Returns how many cells and voxels there are; -1 where there is no room for them, or an index is beyond 32 bits (-2).
    """
    n, m = np.int64(0), np.int64(0)
    recent = np.full(RECENT, np.int64(-1) << np.int64(62))
    q, before = np.empty(3), np.full(3, np.nan)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = np.float64(depth[v, u])
            if not (z > 0.0 and z < np.inf):
                continue
            x, y = ray_x[u] * z, ray_y[v] * z
            for i in range(3):
                q[i] = np.floor((((T[i, 0] * x + T[i, 1] * y) + T[i, 2] * z) + T[i, 3]) / size)
            if q[0] == before[0] and q[1] == before[1] and q[2] == before[2]:
                continue
            before[:] = q
            if np.abs(q).max() >= 2147483648.0:
                return np.int64(-2), m
            cell = ((np.int64(q[0]) >> shift) << np.int64(32)) | ((np.int64(q[1]) >> shift) & np.int64(0xFFFFFFFF))
            at = np.int64(mix(cell) >> np.uint64(58))
            if recent[at] != cell:
                if n == cells.shape[0]:
                    return np.int64(-1), m
                recent[at] = cells[n] = cell
                n += 1
            key, inside = np.int64(0), True
            for i in range(3):
                k = np.int64(q[i]) - origin[i] + HALF
                inside = inside and k >= 0 and k < 2 * HALF
                key = (key << np.int64(21)) | k
            hashed = mix(key) >> np.uint64(32)
            if inside and hashed < share:
                if m == keys.shape[0]:
                    return np.int64(-1), m
                keys[m], drawn[m] = key, hashed
                m += 1
    return n, m
