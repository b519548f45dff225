"""The compiled loop that looks up which of a frame's voxels is behind a pixel."""

from __future__ import annotations

from typing import Any

import numpy as np

from semstab.backends.shared.hashing import mix
from semstab.backends.shared.pixel_keys import exact_keys_of_row
from semstab.compiled import serial
from semstab.labels import IGNORE_8BIT


@serial
def find_voxels(depth: Any, ray_x: Any, ray_y: Any, T: Any, size: float, origin: Any, keys: Any, found: Any) -> None:
    """Which of the keys is the voxel behind each pixel, (H, W); `found` is left as it is where none is.

    Depth is 0 where it does not count.
    """
    mask = np.int64(15)
    while mask < 2 * keys.shape[0]:
        mask = 2 * mask + 1
    slots = np.full(mask + 1, -1, dtype=np.int32)
    for i in range(keys.shape[0]):
        at = np.int64(mix(keys[i]) & np.uint64(mask))
        while slots[at] >= 0:
            at = (at + 1) & mask
        slots[at] = i
    H, W = depth.shape
    ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
    labels, of_row = np.zeros(W, dtype=np.uint8), np.empty(W, dtype=np.int64)
    for v in range(H):
        exact_keys_of_row(depth[v], labels, ray_x, ray_y[v], T, size, ox, oy, oz, IGNORE_8BIT, of_row)
        for u in range(W):
            if of_row[u] < 0:
                continue
            if u > 0 and of_row[u] == of_row[u - 1]:
                found[v, u] = found[v, u - 1]
                continue
            at = np.int64(mix(of_row[u]) & np.uint64(mask))
            while slots[at] >= 0 and keys[slots[at]] != of_row[u]:
                at = (at + 1) & mask
            found[v, u] = slots[at]
