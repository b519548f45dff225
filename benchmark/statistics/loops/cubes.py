"""Compiled loops over the voxels of a map that find the cubes of space which hold them."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import serial

ROOM = 1024
"""Places of a table of cubes."""


@serial
def _cube(index, scale):
    """That of a voxel's centre, along one axis."""
    return np.int64(np.floor((index + 0.5) * scale))


@serial
def _place(cell, table, used):
    """Where a cube stands in a table (ROOM, 3) of some, or would stand."""
    at = (cell[0] * 73856093 ^ cell[1] * 19349663 ^ cell[2] * 83492791) & (ROOM - 1)
    while used[at] and (table[at, 0] != cell[0] or table[at, 1] != cell[1] or table[at, 2] != cell[2]):
        at = (at + 1) & (ROOM - 1)
    return at


@serial
def _halved(table, used):
    """A table of the cubes twice as large that hold those of another, and how many they are."""
    halves, taken, count = np.empty_like(table), np.zeros_like(used), 0
    for at in range(ROOM):
        if used[at]:
            cell = (table[at, 0] >> 1, table[at, 1] >> 1, table[at, 2] >> 1)
            to = _place(cell, halves, taken)
            count += 0 if taken[to] else 1
            halves[to, 0], halves[to, 1], halves[to, 2] = cell
            taken[to] = True
    return halves, taken, count


@serial
def occupied(ix, iy, iz, some, scale, most):
    """How often cubes are doubled until at most `most` of them hold the voxels (n,) for which `some` (n,) holds.

    scale  of the first ones
    """
    table, used, count, doublings = np.empty((ROOM, 3), np.int64), np.zeros(ROOM, np.bool_), 0, 0
    before = (np.int64(0), np.int64(0), np.int64(0))
    for i in range(ix.shape[0]):
        if not some[i]:
            continue
        cell = _cube(ix[i], scale), _cube(iy[i], scale), _cube(iz[i], scale)
        if count > 0 and cell == before:
            continue
        before, at = cell, _place(cell, table, used)
        if used[at]:
            continue
        table[at, 0], table[at, 1], table[at, 2] = cell
        used[at] = True
        count += 1
        while count > most:
            table, used, count = _halved(table, used)
            doublings, scale = doublings + 1, 0.5 * scale
            before = (cell[0] >> 1, cell[1] >> 1, cell[2] >> 1)
            cell = before
    return doublings


@serial
def runs(ix, iy, iz, some, scale, cells, of):
    """Number the runs of voxels (n,) that are in one cube: of (n,), -1 where `some` (n,) does not hold.

    cells (r, 3) takes the cube of each run, as long as there is room. Returns how many runs there are.
    """
    count = 0
    before = (np.int64(0), np.int64(0), np.int64(0))
    for i in range(ix.shape[0]):
        of[i] = -1
        if not some[i]:
            continue
        cell = _cube(ix[i], scale), _cube(iy[i], scale), _cube(iz[i], scale)
        if count == 0 or cell != before:
            if count < cells.shape[0]:
                cells[count, 0], cells[count, 1], cells[count, 2] = cell
            before = cell
            count += 1
        of[i] = count - 1
    return count


@serial
def renumber(of, number):
    """Put the number of a run's cube in the place of the run's (n,)."""
    for i in range(of.shape[0]):
        if of[i] >= 0:
            of[i] = number[of[i]]
