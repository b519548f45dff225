"""Coarse cells of space: their hashes, the table of those that surfaces meet, and the spots of those that count.

A cell counts with a probability in proportion to the area of the surface in it. So spots are even over surfaces,
whichever way these are turned: of all cells, 1 in the square of their edge meets a floor, up to 1.73 an oblique wall.
"""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import helper, serial

BITS = 21
"""Bits of a coarse cell's index along each axis in its key."""

SPAN = 1 << BITS

ALONG_X, ALONG_Y, ALONG_Z = np.uint32(0xD1B54A33), np.uint32(0xABC98389), np.uint32(0x8CB92BA7)
"""Weights of a cell's indices in its hash: 2^32 / g^k of the root g of g^4 = g + 1, so that along no line and in no
plane the same sum comes again soon (Roberts 2018, The Unreasonable Effectiveness of Quasirandom Sequences)."""

GOLDEN = np.uint64(0x9E3779B97F4A7C15)

EMPTY = np.int64(-1)

EDGE = 53 / 64
"""Edge of a coarse cell, by the spacing of spots: the most 64ths with which no plane has more than the square of the
spacing in a cell. The largest section of a cube has sqrt(2) times the square of its edge."""

PHASE = 20.5 / 53
"""Part of its edge by which coarse cells are moved from the origin, near the golden section. Faces lie halfway between
64ths of the spacing: floors and walls of models do not lie in faces, and no two spots have the same place in a log, see
`SpotObservations.places`."""

FLAT = 1e-3
"""Least component of a unit normal, for `area_in_cell`."""


@helper
def mixed(number):
    """Return a hash of 32 bits, lowbias32 (Wellons 2018, Prospecting for Hash Functions)."""
    h = np.uint32(number)
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(h ^ (h >> np.uint32(16)))


@serial
def hash_cell(x, y, z):
    """Return the hash of a coarse cell, the same in each run."""
    weighted = np.uint32(np.uint32(x) * ALONG_X) + np.uint32(np.uint32(y) * ALONG_Y) + np.uint32(np.uint32(z) * ALONG_Z)
    return mixed(np.uint32(weighted))


@helper
def fraction(number):
    """Return a number from 0 to 1, without both, from a hash."""
    return (np.float64(mixed(number)) + 0.5) / 4294967296.0


@helper
def slot_of(table, key):
    """Return where a key is looked for first in a table with open addressing, of a power of 2 slots, at most 2^24.

    The upper bits of the product count, which depend on all three indices.
    """
    return np.int64(np.uint64(key) * GOLDEN >> np.uint64(40) & np.uint64(len(table) - 1))


@helper
def is_new(table, key, added):
    """Return whether a table with open addressing lacks a key, which may then be added."""
    slot = slot_of(table, key)
    while table[slot] != EMPTY:
        if table[slot] == key:
            return False
        slot = (slot + 1) & (len(table) - 1)
    if added:
        table[slot] = key
    return True


@helper
def key_of(a, b, c):
    """Return the key of a cell by its indices from the lowest ones on, each below SPAN."""
    return np.int64(a) << (2 * BITS) | np.int64(b) << BITS | np.int64(c)


@serial
def refill(table, share, low, new):
    """Add the cells of a table that are in the sample to a new table; return how many."""
    n = 0
    for key in table:
        if key != EMPTY:
            a, b, c = key >> np.int64(2 * BITS), (key >> np.int64(BITS)) & (SPAN - 1), key & (SPAN - 1)
            if hash_cell(a + low[0], b + low[1], c + low[2]) < share:
                is_new(new, key, True)
                n += 1
    return n


@helper
def above(number):
    """Return the square of a number, 0 of one below 0."""
    return number * number if number > 0.0 else 0.0


@helper
def area_in_cell(normal, x, y, z):
    """Return the area of a plane in the unit cube, by its normal and a point (x, y, z) of it in the cube.

    It is the derivative of the volume below the plane, which is a sum over the cube's corners.
    """
    nx, ny, nz = normal
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    a, b, c = max(abs(nx) / length, FLAT), max(abs(ny) / length, FLAT), max(abs(nz) / length, FLAT)
    t = a * (x if nx > 0.0 else 1.0 - x) + b * (y if ny > 0.0 else 1.0 - y) + c * (z if nz > 0.0 else 1.0 - z)
    one, two = above(t - a) + above(t - b) + above(t - c), above(t - a - b) + above(t - a - c) + above(t - b - c)
    return (t * t - one + two) / (2.0 * a * b * c)


@helper
def add_spot(p, normal, spacing, share, low, table, point, hashed, n, met):
    """Add point p as spot n if its coarse cell is in the sample, was not met before, and counts.

    It counts with probability area / spacing^2, with the area in it of the plane through p with this normal. Returns
    how many spots there are, and how many cells were met.
    """
    px, py, pz = p
    edge = EDGE * spacing
    x, y, z = px / edge + PHASE, py / edge + PHASE, pz / edge + PHASE
    i, j, k = np.int64(np.floor(x)), np.int64(np.floor(y)), np.int64(np.floor(z))
    a, b, c, cell_hash = i - low[0], j - low[1], k - low[2], hash_cell(i, j, k)
    within_reach = 0 <= a < SPAN and 0 <= b < SPAN and 0 <= c < SPAN
    if cell_hash >= share or not within_reach or not is_new(table, key_of(a, b, c), True):
        return n, met
    area = EDGE * EDGE * area_in_cell(normal, x - i, y - j, z - k)
    if fraction(np.uint32(cell_hash ^ np.uint32(0x9E3779B9))) >= area:
        return n, met + 1
    point[n, 0], point[n, 1], point[n, 2], hashed[n] = px, py, pz, cell_hash
    return n + 1, met + 1
