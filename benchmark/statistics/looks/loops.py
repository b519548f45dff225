"""The compiled pass over a frame's pixels that finds those which show a sampled voxel."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.hashing import mix
from semstab.backends.shared.pixels.pixel_keys import in_voxels
from semstab.runtime.compiled import serial
from semstab.statistics.looks.entries import CELLS


@serial
def draw(depth, valid, ray_x, ray_y, T, size, origin, reach, share, cell, drawn, pixel):
    """The cell, hash and number of each pixel that shows a sampled voxel; returns how many there are.

    A cell's key is its voxel's (19 bits an axis) with 2 bits an axis more.
    """
    n = 0
    H, W = depth.shape
    at, hashed = np.empty((3, W)), np.empty(W, np.uint32)
    for v in range(H):
        place_row(depth[v], valid[v], ray_x, ray_y[v], T, size, at[0], at[1], at[2], hashed)
        for u in range(W):
            if not valid[v, u] or hashed[u] >= share:
                continue
            key, child, inside = np.int64(0), np.int64(0), True
            for i in range(3):
                index = np.floor(at[i, u])
                relative = np.int64(index) - origin[i] + reach
                inside = inside and relative >= 0 and relative < 2 * reach
                key = (key << np.int64(19)) | relative
                child = child * CELLS + min(np.int64((at[i, u] - index) * CELLS), np.int64(CELLS - 1))
            if inside:
                cell[n], drawn[n], pixel[n] = (key << np.int64(6)) | child, hashed[u], v * W + u
                n += 1
    return n


@serial
def place_row(depth, valid, ray_x, ray_y, T, size, at_x, at_y, at_z, hashed):
    """Where a row's pixels lie, in voxels, and the hash of each one's voxel; without a branch, for vectors."""
    x0, x1, x2, x3 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    y0, y1, y2, y3 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    z0, z1, z2, z3 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for u in range(len(depth)):
        z = np.float64(depth[u]) if valid[u] else 0.0
        x, y = ray_x[u] * z, ray_y * z
        at_x[u] = in_voxels(x0, x1, x2, x3, x, y, z, size)
        at_y[u] = in_voxels(y0, y1, y2, y3, x, y, z, size)
        at_z[u] = in_voxels(z0, z1, z2, z3, x, y, z, size)
        h = mix(np.uint64(np.int64(np.floor(at_x[u]))))
        h = mix(h ^ np.uint64(np.int64(np.floor(at_y[u]))))
        h = mix(h ^ np.uint64(np.int64(np.floor(at_z[u]))))
        hashed[u] = h >> np.uint64(32)
