"""Compiled passes that tell whether views see spots, have them hidden, or see through them.

The depth of a view is kept in blocks of pixels: the nearest and the farthest depth of each, as codes of a logarithm.
"""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import helper, serial
from semstab.statistics.loops.surface import in_sensor, inverse

STEP, LOWEST = 0.0006, -7.0
"""Step of a code in the logarithm of depth, and the logarithm, of metres, of code 1: from a millimetre to 300 km."""

HOLE, LARGEST = 0x8000, 0x7FFF
"""The bit of the nearest depth of a block that has a pixel without depth; and the largest code, 0 being no depth."""

UNKNOWN, SEEN, HIDDEN, THROUGH = 0, 1, 2, 3
"""Votes of a view on a spot: it does not tell, shows the surface there, a nearer one, or only what lies behind."""

SIDES = 3
"""Parts of an image's side; a vote is stored as its kind plus 4 times the number of the part in which the spot is."""


@helper
def code_of(depth):
    """Return the code of a depth in metres."""
    return min(max(np.int64((np.log(depth) - LOWEST) / STEP + 0.5), np.int64(0)) + 1, LARGEST)


@helper
def take_extremes(rows, nearest, farthest, most):
    """Take the nearest and the farthest depth of each column of four rows, and `most`: the same, endless at a hole."""
    first, second, third, fourth = rows
    endless, none = nearest.dtype.type(np.inf), nearest.dtype.type(0.0)
    for a in range(len(nearest)):
        p = first[a] if first[a] > none else endless
        q = second[a] if second[a] > none else endless
        r = third[a] if third[a] > none else endless
        s = fourth[a] if fourth[a] > none else endless
        nearest[a] = min(nearest[a], p, q, r, s)
        most[a] = max(most[a], p, q, r, s)
        p, q = p if p < endless else none, q if q < endless else none
        r, s = r if r < endless else none, s if s < endless else none
        farthest[a] = max(farthest[a], p, q, r, s)


@serial
def blocks_of_image(depth, stride, low, high, most, near, far):
    """Write the codes of the nearest and the farthest depth in blocks of stride x stride pixels.

    Blocks that the image's edge cuts are left out; a pixel without valid depth makes a hole. low, high, most (W,) are
    room for the extremes of columns, so that rows are read one after the other, four at once.
    """
    none, endless = depth.dtype.type(0.0), depth.dtype.type(np.inf)
    width = near.shape[1] * stride
    for row in range(near.shape[0]):
        low[:], high[:], most[:] = endless, none, none
        top, last = row * stride, (row + 1) * stride - 1
        for b in range(top, last + 1, 4):
            rows = depth[b], depth[min(b + 1, last)], depth[min(b + 2, last)], depth[min(b + 3, last)]
            take_extremes(rows, low[:width], high[:width], most[:width])
        for column in range(near.shape[1]):
            nearest, farthest, farthest_or_hole = endless, none, none
            for a in range(column * stride, (column + 1) * stride):
                nearest, farthest = min(nearest, low[a]), max(farthest, high[a])
                farthest_or_hole = max(farthest_or_hole, most[a])
            near[row, column] = far[row, column] = 0
            if none < farthest and nearest < endless:
                near[row, column], far[row, column] = code_of(np.float64(nearest)), code_of(np.float64(farthest))
            if farthest_or_hole == endless:
                near[row, column] |= HOLE


@serial
def on_one_surface(point, T, camera, depth, reach, most, near_by, firm):
    """Write for each point (n, 3) of an image's surface whether the pixels around it are of this surface.

    All pixels up to `reach` to each side have depth. Their inverse depth differs by at most `most`, relative; or more
    than half of them, at an edge, differ from the point by at most `near_by`. A pixel at an edge often has a depth
    between both surfaces, at which there is nothing, and which few pixels around have.
    """
    fx, fy, cx, cy = camera
    for i in range(len(point)):
        right, down, z = in_sensor(point[i, 0], point[i, 1], point[i, 2], T)
        column, row = np.int64(np.floor(right / z * fx + cx + 0.5)), np.int64(np.floor(down / z * fy + cy + 0.5))
        low, high, same = np.inf, 0.0, 0
        for b in range(row - reach, row + reach + 1):
            for a in range(column - reach, column + reach + 1):
                there = inverse(depth, b, a)
                low, high = min(low, there), max(high, there)
                same += abs(there * z - 1.0) <= near_by
        firm[i] = low > 0.0 and (high - low <= most * low or 2 * same > (2 * reach + 1) ** 2)


@helper
def block_of(point, i, T, camera, stride, shape):
    """Return the row and the column of the block that a point falls into, and its depth; -1 if it is outside."""
    fx, fy, cx, cy = camera
    rows, columns = shape
    right, down, z = in_sensor(point[i, 0], point[i, 1], point[i, 2], T)
    if not z > 1e-9:
        return np.int64(-1), np.int64(-1), z
    u, v = right / z * fx + cx, down / z * fy + cy
    if not (-0.5 <= u < columns * stride and -0.5 <= v < rows * stride):
        return np.int64(-1), np.int64(-1), z
    row, column = np.int64(np.floor((v + 0.5) / stride)), np.int64(np.floor((u + 0.5) / stride))
    if row >= rows or column >= columns:
        return np.int64(-1), np.int64(-1), z
    return row, column, z


@serial
def vote(point, T, camera, stride, near, far, reach, gap, aside, near_by, votes):
    """Write the vote of a view on each point (n, 3), by the blocks of its depth.

    A view sees through a point if all depth in the point's own block is farther by more than `gap`, in codes, and all
    depth in the blocks up to `reach` from it by more than `aside`. Depth must be known in its own block and the 8
    around it. A view sees a point if depth in its own block is on both sides of it, but for `near_by` codes.
    """
    rows, columns = near.shape
    for i in range(len(point)):
        votes[i] = UNKNOWN
        row, column, depth = block_of(point, i, T, camera, stride, near.shape)
        if row < 0 or far[row, column] == 0:
            continue
        here, nearest = code_of(depth), np.int64(near[row, column] & LARGEST)
        part = np.uint8(4 * (SIDES * (SIDES * row // rows) + SIDES * column // columns))
        if here > far[row, column] + gap:
            votes[i] = HIDDEN + part
        elif here >= nearest - near_by:
            votes[i] = SEEN + part
        elif nearest > here + gap and is_farther(near, row, column, reach, here + aside):
            votes[i] = THROUGH + part


@helper
def is_farther(near, row, column, reach, code):
    """Return whether depth in the blocks up to `reach` from one is farther than a code, and known in the next ones."""
    rows, columns = near.shape
    for b in range(row - reach, row + reach + 1):
        for a in range(column - reach, column + reach + 1):
            is_next = abs(b - row) <= 1 and abs(a - column) <= 1
            if b < 0 or a < 0 or b >= rows or a >= columns:
                if is_next:
                    return False
                continue
            there = near[b, a]
            if there & HOLE and is_next:
                return False
            there &= LARGEST
            if 0 < there <= code:
                return False
    return True


@serial
def tally(votes, counted, counts, at_end, between):
    """Count the votes (V, n) of the views that count, in their order: seen, hidden, through (n, 3) of each spot.

    at_end (n,) are the views that see through a spot before the first one that sees it, or after the last, the larger
    number. `between` (2,) counts the votes whose neighbours in time, among those that see the spot or see through it,
    both see it, and those of them that see through it: a thing that is there before and after has not moved.
    """
    for i in range(votes.shape[1]):
        before, last = UNKNOWN, UNKNOWN
        until_seen = since_seen = 0
        for k in range(votes.shape[0]):
            kind = np.int64(votes[k, i] & 3)
            if kind == UNKNOWN or not counted[k]:
                continue
            counts[i, kind - 1] += 1
            if kind == HIDDEN:
                continue
            since_seen = since_seen + 1 if kind == THROUGH else 0
            until_seen = max(until_seen, since_seen) if counts[i, SEEN - 1] == 0 else until_seen
            if before == SEEN and kind == SEEN and last != UNKNOWN:
                between[0] += 1
                between[1] += last == THROUGH
            before, last = last, kind
        at_end[i] = max(until_seen, since_seen)
