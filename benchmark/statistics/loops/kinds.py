"""Compiled loop that finds the voxels of which all that is summed over a map is the same."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.keys import mix
from semstab.backends.shared.pixel_keys import touch
from semstab.core.compiled import serial

FACTORS = (np.uint64(0x9E3779B97F4A7C15), np.uint64(0xD1342543DE82EF95), np.uint64(0xAEF17502108EF2D9))
"""Odd numbers without a pattern."""

AT_ONCE = 256
"""Voxels whose places in the table of kinds are asked for before they are read."""

FIRST_ROOM = 1 << 12
"""Places of a table of kinds at first, a power of 2."""

TRIAL = 1 << 14
"""Where so many voxels have hardly fewer kinds, looking for more is given up."""


@serial
def hashed_with(key, value, place):
    """A hash of 128 bits with a value in its place: what differs in anything has another one, as far as can be."""
    x = (value + np.uint64(place) * FACTORS[0]) * FACTORS[1]
    x = (x ^ (x >> np.uint64(32))) * FACTORS[2]
    x ^= x >> np.uint64(29)
    return key[0] + x, key[1] + x * FACTORS[0] ^ (x >> np.uint64(31))


@serial
def _kind_of(key, keys, kinds):
    """Where a table of kinds, a power of 2, has the one with this key (2,) of keys (k, 2), or room for it."""
    slot = np.int64(key[0]) & (kinds.shape[0] - 1)
    while kinds[slot] >= 0 and (keys[kinds[slot], 0] != key[0] or keys[kinds[slot], 1] != key[1]):
        slot = (slot + 1) & (kinds.shape[0] - 1)
    return slot


@serial
def number_block(some, first, last, keys, kinds, rows, of, found):
    """Number the kinds of the voxels from the first to before the last, whose keys are in `some` (AT_ONCE, 2).

    keys (k, 2) and rows (k,) take the keys of the `found` ones and their first voxels, of (n,) each voxel's kind.
    Returns the table of kinds, larger where that was needed, and how many there are, -1 where there is no room or there
    are hardly fewer than voxels.
    """
    for i in range(first, last):
        touch(keys, max(kinds[np.int64(some[i - first, 0]) & (kinds.shape[0] - 1)], 0))
    for i in range(first, last):
        key = some[i - first]
        slot = _kind_of(key, keys, kinds)
        if kinds[slot] < 0:
            if found == rows.shape[0]:
                return kinds, -1
            keys[found], kinds[slot], rows[found] = key, found, i
            found += 1
        of[i] = kinds[slot]
    if last >= TRIAL and 16 * found > 15 * last:
        return kinds, -1
    if 2 * (found + AT_ONCE) > kinds.shape[0]:
        kinds = np.full(4 * kinds.shape[0], np.int32(-1))
        for kind in range(found):
            kinds[_kind_of(keys[kind], keys, kinds)] = kind
    return kinds, found


@serial
def tell_apart(op, sums, at, truth, evidence, log, bounds, frame, longest, pixels, rows, voxels, together, of):
    """Which kind (n,) each voxel is of, and of each kind (k,) its first row, its voxels and its pixels.

    Voxels of one kind agree in OP, sums (drift, ||s||^2 and entropy of the frames), cube `at` (n,), true class (n,) and
    evidence; with a log in all observations instead, and in the frames of these where they are two or more. Without a
    log bounds (n + 1,) are empty, truth where it is not known. Where the OP is above `longest` and there was more than
    one class, a voxel is of a kind of its own. Returns how many kinds there are, -1 where there is no room for them, or
    hardly fewer than voxels.
    """
    starts, _, weight = evidence
    drift, squares, entropy = sums
    of_drift, of_squares, of_entropy = drift.view(np.uint64), squares.view(np.uint64), entropy.view(np.uint64)
    known, logged, found = truth.shape[0] > 0, bounds.shape[0] > 0, 0
    ends, classes, weights = log if logged else evidence
    bits = weights.view(np.uint64)
    some, keys = np.empty((AT_ONCE, 2), np.uint64), np.empty((rows.shape[0], 2), np.uint64)
    kinds = np.full(FIRST_ROOM, np.int32(-1))
    for first in range(0, op.shape[0], AT_ONCE):
        last = min(first + AT_ONCE, op.shape[0])
        for i in range(first, last):
            T, place = op[i], np.uint64(at[i] + 1) << np.uint64(32) | np.uint64(truth[i] + 1 if known else 0)
            key = hashed_with((np.uint64(T), np.uint64(0)), place, 0)
            if longest < T and (starts[i + 1] - starts[i] > 1 or weight[starts[i]] != T or squares[i] != T):
                key = hashed_with(key, np.uint64(i), 1)
            row, end = (bounds[i], bounds[i + 1]) if logged else (i, i + 1)
            if logged:
                for t in range(row, end):
                    count = np.uint64(ends[t + 1] - ends[t]) << np.uint64(32)
                    key = hashed_with(key, count | np.uint64(frame[t] if T > 1 else 0), 2 + t - row)
            else:
                key = hashed_with(hashed_with(hashed_with(key, of_drift[i], 2), of_squares[i], 3), of_entropy[i], 4)
            for e in range(ends[row], ends[end]):
                key = hashed_with(key, bits[e] * FACTORS[2] + np.uint64(classes[e]), ends[row] - 1 - e)
            some[i - first, 0], some[i - first, 1] = mix(key[0]), key[1]
            touch(kinds, np.int64(some[i - first, 0]) & (kinds.shape[0] - 1))
        kinds, found = number_block(some, first, last, keys, kinds, rows, of, found)
        if found < 0:
            return -1
        for i in range(first, last):
            voxels[of[i]] += 1.0
            together[of[i]] += pixels[i]
    return found
