"""Compiled loops of the map that is asked for priors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from semstab.backends.shared.keys import mix
from semstab.core.compiled import serial

HALF = 1 << 20
"""The map reaches that many voxels to either side of its origin; beyond, pixels have no voxel."""


@serial
def slot_of(key: Any, keys: Any) -> Any:
    """Where a key is, or the free slot where it goes."""
    last = len(keys) - 1
    at = np.int64(mix(key)) & last
    while keys[at] != key and keys[at] != -1:
        at = (at + 1) & last
    return at


@serial
def find(depth: Any, rays: Any, R: Any, t: Any, size: float, keys: Any, rows: Any, used: int, out: Any) -> Any:
    """The row of each pixel's voxel, new ones from `used` on, -1 without depth; returns how many there are then.

    depth  (H, W) metres; rays (u - cx) / fx of each column, then (v - cy) / fy of each row
    R, t   camera to the map's axes; size the edge of a voxel
    keys   (n,) of the slots, -1 where free; rows (n,) theirs; out (H, W) int32 is filled
    """
    ray_x, ray_y = rays
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            out[v, u] = -1
            d = float(depth[v, u])
            if not 0.0 < d < math.inf:
                continue
            x, y = ray_x[u] * d, ray_y[v] * d
            i = math.floor((R[0, 0] * x + R[0, 1] * y + R[0, 2] * d + t[0]) / size) + HALF
            j = math.floor((R[1, 0] * x + R[1, 1] * y + R[1, 2] * d + t[1]) / size) + HALF
            k = math.floor((R[2, 0] * x + R[2, 1] * y + R[2, 2] * d + t[2]) / size) + HALF
            if not (0 <= i < 2 * HALF and 0 <= j < 2 * HALF and 0 <= k < 2 * HALF):
                continue
            key = (np.int64(i) << 42) | (np.int64(j) << 21) | np.int64(k)
            at = slot_of(key, keys)
            if keys[at] == -1:
                keys[at] = key
                rows[at] = used
                used += 1
            out[v, u] = rows[at]
    return used


@serial
def move(keys: Any, rows: Any, new_keys: Any, new_rows: Any) -> None:
    """All that is in some slots into others."""
    for at in range(len(keys)):
        if keys[at] != -1:
            to = slot_of(keys[at], new_keys)
            new_keys[to] = keys[at]
            new_rows[to] = rows[at]


@serial
def priors(row: Any, sums: Any, out: Any) -> None:
    """(E + 1/K) / (n + 1) of each pixel's row of `sums`, n their sum; 1/K where it has none."""
    K = sums.shape[1]
    for v in range(row.shape[0]):
        for u in range(row.shape[1]):
            n = np.float32(1.0)
            if row[v, u] >= 0:
                for k in range(K):
                    n += sums[row[v, u], k]
            for k in range(K):
                seen = sums[row[v, u], k] if row[v, u] >= 0 else np.float32(0.0)
                out[v, u, k] = (seen + np.float32(1.0 / K)) / n


@serial
def add_frame(row: Any, belief: Any, sums: Any, pixels: Any) -> None:
    """Add to each row of `sums` the mean belief of its pixels that say something; `pixels` (n,) are zeros, and are so
    again at the end.
    """
    H, W, K = belief.shape
    for turn in range(3):
        for v in range(H):
            for u in range(W):
                at = row[v, u]
                if at < 0:
                    continue
                total = np.float32(0.0)
                for k in range(K):
                    total += belief[v, u, k]
                if total <= 0:
                    continue
                if turn == 0:
                    pixels[at] += 1
                elif turn == 1:
                    for k in range(K):
                        sums[at, k] += belief[v, u, k] / pixels[at]
                else:
                    pixels[at] = 0
