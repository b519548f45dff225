"""Coarse cells of space: their hashes, the table of those that have a spot, and spots that are added to it."""

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

PHASE = 25 / 64
"""Part of its edge by which coarse cells are moved from the origin, near the golden section, so that floors and walls
of models do not lie in their faces; a multiple of the 64ths in which a log tells places, see `SpotObservations`."""


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


@helper
def cell_of(x, y, z, edge):
    """Return the coarse cell of a point; no face of a cell lies in a plane such as z = 0, where floors lie."""
    return (
        np.int64(np.floor(x / edge + PHASE)), np.int64(np.floor(y / edge + PHASE)),
        np.int64(np.floor(z / edge + PHASE)),
    )  # fmt: skip


@serial
def fill(point, edge, low, table):
    """Add the coarse cells of points (n, 3) to a table."""
    for i in range(len(point)):
        a, b, c = cell_of(point[i, 0], point[i, 1], point[i, 2], edge)
        is_new(table, key_of(a - low[0], b - low[1], c - low[2]), True)


@helper
def add_spot(px, py, pz, edge, share, low, table, point, hashed, n):
    """Add a point as spot n if its coarse cell is in the sample and has none; return how many spots there are."""
    i, j, k = cell_of(px, py, pz, edge)
    a, b, c, cell_hash = i - low[0], j - low[1], k - low[2], hash_cell(i, j, k)
    within_reach = 0 <= a < SPAN and 0 <= b < SPAN and 0 <= c < SPAN
    if cell_hash >= share or not within_reach or not is_new(table, key_of(a, b, c), True):
        return n
    point[n, 0], point[n, 1], point[n, 2], hashed[n] = px, py, pz, cell_hash
    return n + 1
