"""The compiled pass over a frame's pixels that finds those which show a sampled voxel."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.hashing import mix
from semstab.runtime.compiled import serial
from semstab.statistics.looks.entries import CELLS


@serial
def draw(depth, valid, ray_x, ray_y, T, size, origin, reach, share, cell, drawn, pixel):
    """The cell, hash and number of each pixel that shows a sampled voxel; returns how many there are.

    The order of operations is the protocol's. A cell's key is its voxel's (19 bits an axis) with 2 bits an axis more.
    """
    n = 0
    H, W = depth.shape
    at, q, before = np.empty(3), np.empty(3), np.full(3, np.nan)
    key, sampled, hashed = np.int64(0), False, np.uint64(0)
    for v in range(H):
        for u in range(W):
            if not valid[v, u]:
                continue
            z = np.float64(depth[v, u])
            x, y = ray_x[u] * z, ray_y[v] * z
            for i in range(3):
                at[i] = (((T[i, 0] * x + T[i, 1] * y) + T[i, 2] * z) + T[i, 3]) / size
                q[i] = np.floor(at[i])
            if q[0] != before[0] or q[1] != before[1] or q[2] != before[2]:
                before[:] = q
                key, inside, h = np.int64(0), True, np.uint64(0)
                for i in range(3):
                    relative = np.int64(q[i]) - origin[i] + reach
                    inside = inside and relative >= 0 and relative < 2 * reach
                    key = (key << np.int64(19)) | relative
                    h = mix(h ^ np.uint64(np.int64(q[i])))
                hashed = h >> np.uint64(32)
                sampled = inside and hashed < share
            if sampled:
                child = np.int64(0)
                for i in range(3):
                    child = child * CELLS + min(np.int64((at[i] - q[i]) * CELLS), np.int64(CELLS - 1))
                cell[n] = (key << np.int64(6)) | child
                drawn[n] = hashed
                pixel[n] = v * W + u
                n += 1
    return n
