"""Compiled loops over what is drawn: what each voxel's belief says, and which voxel is behind a pixel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from semstab.backends.shared.keys import mix
from semstab.backends.shared.pixel_keys import exact_keys_of_row
from semstab.core.compiled import serial
from semstab.model.labels import IGNORE_8BIT


@serial
def read_off(evidence: Any, label: Any, vss: Any, bits: Any) -> None:
    """Dominant class, VSS and entropy in bits of evidence (n, K), as `semstab.metrics` defines them, in one pass.

    Fills label (n,) uint16, and vss and bits (n,) float64.
    """
    n, K = evidence.shape
    for i in range(n):
        total = 0.0
        most = 0
        for k in range(K):
            total += evidence[i, k]
            if evidence[i, k] > evidence[i, most]:
                most = k
        label[i] = most
        vss[i] = evidence[i, most] / total
        bits[i] = 0.0
        if evidence[i, most] < total:
            for k in range(K):
                if evidence[i, k] > 0.0:
                    p = evidence[i, k] / total
                    bits[i] -= p * math.log2(p)


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
