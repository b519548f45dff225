"""Compiled passes over a frame's pixels, which draw what it changed in their voxels, and over the voxels of a map."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.keys import mix
from semstab.backends.shared.pixel_keys import in_voxels
from semstab.core.compiled import helper, serial

NO_VOXEL, AGREES, CONTRADICTS = 0, 1, 2
"""Values of a picture of contradictions, the first one of a picture of drift as well."""

FIRST_SEEN, NO_DRIFT = 1, 2
"""Further values of a picture of drift; levels of drift follow."""

AXIS = 21
"""Bits of an index in a key."""


@serial
def draw_changes(
    depth, points, valid, labels, ray_x, ray_y, T, size, stride, index, before, moved, edges, contradictions, drift
):
    """Draw valid pixels, every n-th of (H, W), into pictures that hold NO_VOXEL: label against map, level of drift.

    - `points`: (H, W, 3) of a scan, for which rays do not count; (0, 0, 3) of an image
    - `index`, `before`, `moved`: (n, 3) indices of each voxel, (n,) the map's class, (n,) its drift, bits
    - `edges`: see `level_of`
    """
    key, level, rows = np.empty(len(index), np.int64), np.empty(len(index), np.uint8), make_table(len(index))
    for row in range(len(index)):
        key[row], level[row] = key_of(index[row, 0], index[row, 1], index[row, 2]), level_of(moved[row], edges)
        rows[find(key[row], key, rows)] = row
    for line in range(drift.shape[0]):
        for column in range(drift.shape[1]):
            v, u = line * stride, column * stride
            if not valid[v, u]:
                continue
            if points.shape[0]:
                x, y, z = np.float64(points[v, u, 0]), np.float64(points[v, u, 1]), np.float64(points[v, u, 2])
            else:
                z = np.float64(depth[v, u])
                x, y = ray_x[u] * z, ray_y[v] * z
            a = np.floor(in_voxels(T[0, 0], T[0, 1], T[0, 2], T[0, 3], x, y, z, size))
            b = np.floor(in_voxels(T[1, 0], T[1, 1], T[1, 2], T[1, 3], x, y, z, size))
            c = np.floor(in_voxels(T[2, 0], T[2, 1], T[2, 2], T[2, 3], x, y, z, size))
            row = rows[find(key_of(np.int64(a), np.int64(b), np.int64(c)), key, rows)]
            if row >= 0:
                contradictions[line, column] = CONTRADICTS if labels[v, u] != before[row] else AGREES
                drift[line, column] = level[row]


@serial
def level_of(drift, edges):
    """Return the level of drift in bits: how many of the ascending edges it reaches; FIRST_SEEN for NaN."""
    if np.isnan(drift):
        return FIRST_SEEN
    if drift == 0:
        return NO_DRIFT
    return NO_DRIFT + 1 + np.searchsorted(edges, np.float64(drift), side="right")


@serial
def first_of_blocks(index, shift):
    """Return the first row of each block of 2^shift voxels an axis, ascending, of voxels (n, 3)."""
    n, count = len(index), 0
    key, rows, first = np.empty(n, np.int64), make_table(n), np.empty(n, np.int64)
    for row in range(n):
        key[row] = key_of(index[row, 0] >> shift, index[row, 1] >> shift, index[row, 2] >> shift)
        place = find(key[row], key, rows)
        if rows[place] < 0:
            rows[place] = row
            first[count] = row
            count += 1
    return first[:count].copy()


@helper
def make_table(n):
    """Return an empty table for the rows of n keys, see `find`."""
    bits = 1
    while 1 << bits <= 2 * n:
        bits += 1
    return np.full(1 << bits, -1, np.int32)


@helper
def key_of(x, y, z):
    """Return one number for a voxel, different for voxels within 2^20 of each other along each axis."""
    low = (1 << AXIS) - 1
    return (x & low) << 2 * AXIS | (y & low) << AXIS | (z & low)


@serial
def find(wanted, key, rows):
    """Return the place of a key in a table of rows, or the free place for the key."""
    place = np.int64(mix(wanted) & np.uint64(len(rows) - 1))
    while rows[place] >= 0 and key[rows[place]] != wanted:
        place = (place + 1) & (len(rows) - 1)
    return place
