"""The compiled pass over a frame's depth that finds the columns of voxels it shows, and a sample of the voxels."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.keys import HALF, mix
from semstab.backends.shared.pixel_keys import keys_of_row
from semstab.core.compiled import serial

RECENT = 64
"""Cells that are remembered, so that hardly any is named twice."""

NO_ROOM, LOST = -1, -2
"""Instead of a number of cells."""


@serial
def look(depth, labels, ray_x, ray_y, T, size, origin, rays, margin, shift, share, row, cells, keys, drawn):
    """Cells and sampled voxels of the pixels with depth, in order of appearance, some of them more than once.

    A cell is 2^shift by 2^shift columns, packed into 64 bits; a voxel is in the sample where its hash is below `share`.
    Pixels become voxels by the very loop that fuses them; labels (W,) say that all count.
    Returns how many cells and voxels there are: NO_ROOM for them, or LOST where a pixel is out of the keys' reach.
    """
    n, m = np.int64(0), np.int64(0)
    recent = np.full(RECENT, np.int64(-1) << np.int64(62))
    before, mask = np.int64(-1), np.int64(2 * HALF - 1)
    ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
    for v in range(depth.shape[0]):
        if keys_of_row(depth[v], labels, ray_x, ray_y[v], T, size, ox, oy, oz, 255, rays, margin, row):
            return np.int64(LOST), m
        for u in range(row.shape[0]):
            key = row[u]
            if key == before or key < 0:
                continue
            before = key
            ix, iy = (key >> 42) - HALF + origin[0], ((key >> 21) & mask) - HALF + origin[1]
            cell = ((ix >> shift) << np.int64(32)) | ((iy >> shift) & np.int64(0xFFFFFFFF))
            at = np.int64(mix(cell) >> np.uint64(58))
            if recent[at] != cell:
                if n == cells.shape[0]:
                    return np.int64(NO_ROOM), m
                recent[at] = cells[n] = cell
                n += 1
            hashed = mix(key) >> np.uint64(32)
            if hashed < share:
                if m == keys.shape[0]:
                    return np.int64(NO_ROOM), m
                keys[m], drawn[m] = key, hashed
                m += 1
    return n, m
