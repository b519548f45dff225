"""Which blocks of voxels the voxels of a frame lie in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semstab.backends.shared.hashing import mix
from semstab.runtime.compiled import serial

Int64 = npt.NDArray[np.int64]


def blocks_of(index: Int64, resolution: int) -> tuple[npt.NDArray[np.int32], Int64, npt.NDArray[np.int32]]:
    """The distinct blocks (m, 3) of voxels (n, 3), the row of each voxel's block, and its place in it, x fastest."""
    size = 1 << max(4, (2 * len(index)).bit_length())
    blocks, block = np.empty((len(index), 3), dtype=np.int32), np.empty(len(index), dtype=np.int64)
    place, slots = np.empty(len(index), dtype=np.int32), np.full(size, -1, dtype=np.int32)
    n = _number(index, resolution, blocks, block, place, slots)
    return blocks[:n], block, place


@serial
def _number(index, r, blocks, block, place, slots):
    """Number the blocks in order of appearance; returns how many there are."""
    mask = slots.shape[0] - 1
    n = 0
    for v in range(index.shape[0]):
        x, y, z = index[v, 0], index[v, 1], index[v, 2]
        a, b, c = x // r, y // r, z // r
        place[v] = ((z - c * r) * r + (y - b * r)) * r + (x - a * r)
        at = np.int64(mix((a * 73856093) ^ (b * 19349663) ^ (c * 83492791)) & np.uint64(mask))
        while slots[at] >= 0:
            e = slots[at]
            if blocks[e, 0] == a and blocks[e, 1] == b and blocks[e, 2] == c:
                break
            at = (at + 1) & mask
        if slots[at] < 0:
            slots[at] = n
            blocks[n, 0], blocks[n, 1], blocks[n, 2] = a, b, c
            n += 1
        block[v] = slots[at]
    return n
