"""Keys of cells, a quarter as wide as a voxel: three voxel indices of BITS each, then three digits of 2 bits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semstab.core.types import Int64
from semstab.errors import DataError

CELLS = 4
"""Cells along a voxel's edge."""

DIGITS = 6
"""Bits of a key that say which cell of its voxel it is."""

BITS = 19
"""Bits of a voxel's index along an axis, from the voxel on at which keys begin."""

SPAN = 1 << BITS
SHIFTS = DIGITS + 2 * BITS, DIGITS + BITS, DIGITS
WITHIN = 4, 2, 0
"""Where in a key the three voxel indices begin, and the three digits."""

Voxel = tuple[int, int, int]


def cells_of(key: Int64, low: Voxel) -> Int64:
    """(n, 3) indices of the cells with these keys, which begin at voxel `low`."""
    cells = np.empty((len(key), 3), np.int64)
    for axis, (shift, first, digit) in enumerate(zip(SHIFTS, low, WITHIN, strict=True)):
        voxel = ((key >> shift) & (SPAN - 1)) + first
        cells[:, axis] = CELLS * voxel + ((key >> digit) & (CELLS - 1))
    return cells


def keys_of(cells: Int64) -> tuple[Int64, Voxel]:
    """Keys (n,) of cells (n, 3), and the voxel at which they begin. Raises DataError where they span too much."""
    key, low = np.zeros(len(cells), np.int64), [0, 0, 0]
    for axis, (shift, digit) in enumerate(zip(SHIFTS, WITHIN, strict=True)):
        voxel = cells[:, axis] // CELLS
        low[axis] = int(voxel.min()) if len(voxel) else 0
        key |= (_near(voxel - low[axis]) << shift) | ((cells[:, axis] % CELLS) << digit)
    return key, (low[0], low[1], low[2])


def alike(keys: Sequence[Int64], lows: Sequence[Voxel]) -> tuple[list[Int64], Voxel]:
    """Keys of several samples that all begin at the same voxel, the lowest of all, and that voxel.

    Raises DataError where they span too much.
    """
    if len({*lows}) == 1:
        return list(keys), lows[0]
    low, moved = [0, 0, 0], list(keys)
    for axis, shift in enumerate(SHIFTS):
        voxels = [((key >> shift) & (SPAN - 1)) + own[axis] for key, own in zip(keys, lows, strict=True)]
        low[axis] = min((int(voxel.min()) for voxel in voxels if len(voxel)), default=0)
        for k, voxel in enumerate(voxels):
            moved[k] = moved[k] + ((_near(voxel - low[axis]) - (voxel - lows[k][axis])) << shift)
    return moved, (low[0], low[1], low[2])


def _near(voxel: Int64) -> Int64:
    if voxel.max(initial=0) >= SPAN:
        raise DataError(f"the maps span more than {SPAN} voxels; leave out far depth, or use larger voxels")
    return voxel
