"""Compiled loops from the labels of a frame to entries, by tiles of the image, or stretches of a scan.

A pixel is one word: its voxel, counted from 2^15 below the camera's voxel along each axis, and its label, 16 bits each;
-1 for a pixel that does not count. Pixels become runs of equal words along rows. Runs of a tile become entries in a
small table, which gives way on a collision; `merge_loops` sorts entries and adds them up.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from semstab.backends.shared.keys import HALF, partition_of
from semstab.backends.shared.pixel_keys import bits_of, exact_keys_of_points, exact_keys_of_row, touch
from semstab.core.compiled import compiled, helper, parallel, serial

LANES = 8
"""Words that a stretch is a multiple of, and room that its runs need."""


@compiled(forceinline=True)
def runs_of(word, run_word, run_end):
    """Write the words of runs, and where each ends; return the number of runs.

    A run ends with a word that differs from the one that follows; the last word ends none. Each word is written where
    the last run would end, to be written over unless it does: no branch guesses where that is. All arrays are int64.
    """
    n = 0
    for u in range(word.shape[0] - 1):
        run_word[n], run_end[n] = word[u], u + 1
        n += word[u] != word[u + 1]
    return n


NEAR = 1 << 15
REACH = 2 * NEAR
"""Words reach `NEAR` voxels to either side of the camera."""

FRACTION = 36
"""Bits of a coordinate's fraction in a number from `REACH` to twice that."""

FROM = 0x40F0 << 48
"""The bits of `REACH` as a number."""

ROWS, COLUMNS = 32, 128
"""Pixels of a tile."""

POINTS = 1 << 14
"""Points of a band of a scan."""

TABLE_BITS = 11

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
SHIFT = np.uint64(64 - TABLE_BITS)


@compiled(helper=True, fastmath={"contract"}, forceinline=True)
def _words_fused(depth, labels, ignore, ray_a, ray_b, ray_c, a0, b0, c0, ta, tb, tc, face, out):
    """Return the words of pixels; and any doubt, see `keys_fused`.

    Coordinates are counted from -2^16, half the width of a face included (`face_terms`). If a coordinate is within
    reach, the bits of its number are the bits of 2^16, with the coordinate and a binary fraction in their positions.
    """
    doubt = outside = 0
    for u in range(depth.shape[0]):
        d = np.float64(depth[u])
        ok = (d > 0.0) & (d < np.inf) & (labels[u] != ignore)
        d = d if ok else 0.0
        a: Any = bits_of(d * (ray_a[u] + a0) + ta)
        b: Any = bits_of(d * (ray_b[u] + b0) + tb)
        c: Any = bits_of(d * (ray_c[u] + c0) + tc)
        doubt |= ok & (((a & face) == 0) | ((b & face) == 0) | ((c & face) == 0))
        outside |= (a ^ FROM) | (b ^ FROM) | (c ^ FROM)
        i, j, k = (a << 12) & (-1 << 48), (b >> 4) & (0xFFFF << 32), (c >> 20) & (0xFFFF << 16)
        out[u] = (i | j | k | np.int64(labels[u])) if ok else -1
    return doubt | ((outside >> 52) != 0)


@compiled(fastmath={"contract"})
def _split(points, x, y, z):
    """Write the coordinates of points (n, 3) as rows: strides of three keep loops from becoming vector instructions."""
    for u in range(points.shape[0]):
        x[u], y[u], z[u] = points[u, 0], points[u, 1], points[u, 2]


@compiled(helper=True, fastmath={"contract"}, forceinline=True)
def _words_of_points_fused(x, y, z, depth, labels, ignore, M, ta, tb, tc, face, out):
    """Return the words of points of a scan, and any doubt, as `_words_fused` of pixels; M (3, 3) is R / r."""
    a0, a1, a2, b0, b1, b2 = M[0, 0], M[0, 1], M[0, 2], M[1, 0], M[1, 1], M[1, 2]
    c0, c1, c2 = M[2, 0], M[2, 1], M[2, 2]
    doubt = outside = 0
    for u in range(depth.shape[0]):
        ok = (depth[u] > np.float32(0)) & (depth[u] < np.float32(np.inf)) & (labels[u] != ignore)
        px = np.float64(x[u]) if ok else 0.0
        py = np.float64(y[u]) if ok else 0.0
        pz = np.float64(z[u]) if ok else 0.0
        a: Any = bits_of(px * a0 + (py * a1 + (pz * a2 + ta)))
        b: Any = bits_of(px * b0 + (py * b1 + (pz * b2 + tb)))
        c: Any = bits_of(px * c0 + (py * c1 + (pz * c2 + tc)))
        doubt |= ok & (((a & face) == 0) | ((b & face) == 0) | ((c & face) == 0))
        outside |= (a ^ FROM) | (b ^ FROM) | (c ^ FROM)
        i, j, k = (a << 12) & (-1 << 48), (b >> 4) & (0xFFFF << 32), (c >> 20) & (0xFFFF << 16)
        out[u] = (i | j | k | np.int64(labels[u])) if ok else -1
    return doubt | ((outside >> 52) != 0)


@serial
def corner_of(T, size, origin):
    """Return the voxel from which words count (3,), as packed keys count."""
    corner = np.empty(3, np.int64)
    for axis in range(3):
        corner[axis] = np.int64(np.floor(T[axis, 3] / size)) - origin[axis] + (HALF - NEAR)
    return corner


@serial
def face_terms(margin):
    """Return half a voxel's face's width, within which a pixel is in doubt, and which bits of a fraction are 0 there.

    The margin is that of rounding (`_begin`); two more roundings are to 2^-36, and the width is a power of two.
    """
    width: Any = min(FRACTION, np.int64(np.ceil(np.log2(margin * 2.0**FRACTION + 2))))
    return 2.0 ** (width - FRACTION), (1 << FRACTION) - (2 << width) if width < FRACTION - 1 else 0


@serial
def _begin(T, size, origin, corner):
    """Return the sensor in voxels (3,), as fused words count from -2^16, and the bits of a face; see `face_terms`.

    The margin of a face bounds the voxels by which rounding can move a point. Of a point within reach no term is above
    8 reach + |t| / r voxels, and each of a dozen operations rounds its result by 2^-53 of that at most.
    """
    begin, farthest = np.empty(3), 0.0
    for axis in range(3):
        farthest = max(farthest, abs(T[axis, 3]))
    half, face = face_terms(2.0**-49 * (8.0 * REACH + farthest / size))
    for axis in range(3):
        begin[axis] = (T[axis, 3] / size - origin[axis]) + (REACH + half + HALF - corner[axis])
    return begin, face


@serial
def _rays(ray_x, ray_y, T, size, across):
    """Write the columns' rays (3, W), and return those of the rows (H, 3), in voxels a metre of depth."""
    down = np.empty((ray_y.shape[0], 3))
    for axis in range(3):
        for u in range(ray_x.shape[0]):
            across[axis, u] = T[axis, 0] * ray_x[u] / size
        for v in range(ray_y.shape[0]):
            down[v, axis] = (T[axis, 1] * ray_y[v] + T[axis, 2]) / size
    return down


@compiled(helper=True, forceinline=True)
def _words_of_stretch(
    depth, labels, ray_x, ray_y, T, size, origin, corner, ignore, ray_a, ray_b, ray_c, down, start, face, keys, out
):  # fmt: skip
    """Write the words of a stretch of a row; return whether a pixel is out of their reach, or of that of packed keys.

    - `ray_a`, `ray_b`, `ray_c` (n,), `down` (3,), `start` (3,): a pixel's coordinates are depth (ray + down) + start
    """
    lost = 0
    if _words_fused(
        depth, labels, ignore, ray_a, ray_b, ray_c, down[0], down[1], down[2], start[0], start[1], start[2], face, out
    ):
        ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
        lost = exact_keys_of_row(depth, labels, ray_x, ray_y, T, size, ox, oy, oz, ignore, keys)
        lost |= _words_of_keys(keys, labels, corner, out)
    return lost


@helper
def _words_of_keys(keys, labels, corner, out):
    """Write the words of packed keys and labels; return whether one is out of the reach of words."""
    lost = 0
    for u in range(labels.shape[0]):
        i, j, k = _from_corner(keys[u], corner)
        lost |= (keys[u] >= 0) & (((i | j | k) >> 16) != 0)
        out[u] = ((i << 48) | (j << 32) | (k << 16) | np.int64(labels[u])) if keys[u] >= 0 else -1
    return lost


@helper
def _keep_columns(words, columns, corner):
    """Take out the words outside of columns, given as packed keys count."""
    for u in range(words.shape[0]):
        i, j = ((words[u] >> 48) & 0xFFFF) + corner[0], ((words[u] >> 32) & 0xFFFF) + corner[1]
        inside = (i >= columns[0]) & (i < columns[1]) & (j >= columns[2]) & (j < columns[3])
        words[u] = words[u] if inside else -1


@helper
def _from_corner(key, corner):
    mask = 2 * HALF - 1
    return (key >> 42) - corner[0], ((key >> 21) & mask) - corner[1], (key & mask) - corner[2]


@serial
def coordinates(word):
    """Return the coordinates of a word, 16 bits each."""
    return (word >> 48) & 0xFFFF, (word >> 32) & 0xFFFF, (word >> 16) & 0xFFFF


@helper
def key_of(a, b, c, corner):
    """Return the packed key of a word's coordinates."""
    return ((a + corner[0]) << 42) | ((b + corner[1]) << 21) | (c + corner[2])


@compiled(helper=True, forceinline=True)
def _enter_runs(word, run_word, run_end, table, table_count, entry, count, n):
    """Put runs of a stretch of words into the table; those that give way become entries, whose number is returned."""
    runs = runs_of(word, run_word, run_end)
    begin = 0
    for i in range(runs):
        w, end = run_word[i], run_end[i]
        at = np.int64((np.uint64(w) * GOLDEN) >> SHIFT)
        there, so_far = table[at], table_count[at]
        entry[n], count[n] = there, so_far
        same = there == w
        n += not same
        table[at] = w
        table_count[at] = (so_far if same else 0) + (end - begin)
        begin = end
    return n


@helper
def _flush(table, table_count, word, count, n):
    for at in range(table.shape[0]):
        word[n], count[n] = table[at], table_count[at]
        n += table[at] != -1
        table[at] = -1
    return n


@parallel
def find_words(
    depth, labels, ray_x, ray_y, T, size, origin, corner, columns, ignore, num_classes, room, rays, stretches, tables,
    table_counts, word, count, partition, entries, spread, low, high,
):  # fmt: skip
    """Find each band's entries: words with counts, some of them twice; their extent and spread by partition.

    Each band has `room` for them. low, high (bands, 4): of the coordinates, and of the label.

    Returns how many there are; -1 where a pixel is out of reach of the words, or its label is no class.
    """
    H, W = depth.shape
    begin, face = _begin(T, size, origin, corner)
    down = _rays(ray_x, ray_y, T, size, rays)
    for band in nb.prange(entries.shape[0]):
        thread = nb.get_thread_id()
        table, table_count = tables[thread], table_counts[thread]
        words, keys = stretches[thread, 0], stretches[thread, 1]
        run_word, run_end = stretches[thread, 2], stretches[thread, 3]
        own_word = word[band * room : (band + 1) * room]
        own_count = count[band * room : (band + 1) * room]
        n = lost = np.int64(0)
        for first in range(0, W, COLUMNS):
            to = min(first + COLUMNS, W)
            stretch_words = words[: -(-(to - first) // LANES) * LANES + 1]
            for y in range(band * ROWS, min(H, (band + 1) * ROWS)):
                for u in range(to, min(W, to + COLUMNS), 16):
                    touch(depth[y], u)
                touch(labels[y], min(W - 1, to))
                touch(labels[y], min(W - 1, to + 64))
                stretch_words[to - first :] = -1
                lost |= _words_of_stretch(
                    depth[y, first:to], labels[y, first:to], ray_x[first:to], ray_y[y], T, size, origin, corner,
                    ignore, rays[0, first:to], rays[1, first:to], rays[2, first:to], down[y], begin, face, keys,
                    stretch_words,
                )  # fmt: skip
                if columns.shape[0]:
                    _keep_columns(stretch_words, columns, corner)
                n = _enter_runs(stretch_words, run_word, run_end, table, table_count, own_word, own_count, n)
        entries[band] = _finish(
            table, table_count, own_word, own_count, n, lost, corner,
            partition[band * room : (band + 1) * room], spread[band], low[band], high[band],
        )  # fmt: skip
    return _total(entries, high, num_classes)


@helper
def _touch_points(points, depth, labels, first, end):
    """Ask for the stretch of points that comes next."""
    if first + COLUMNS <= end:
        for u in range(first, first + COLUMNS, 16):
            touch(points[u], 0)
            touch(points[u + 5], 1)
            touch(points[u + 10], 2)
            touch(depth, u)
        touch(labels, first)
        touch(labels, first + 64)


@parallel
def find_words_of_points(
    points, depth, labels, T, size, origin, corner, columns, M, ignore, num_classes, room, stretches, tables,
    table_counts, word, count, partition, entries, spread, low, high,
):  # fmt: skip
    """Find the entries of bands of `POINTS` points of a scan (N, 3), as `find_words` finds those of a band of rows."""
    begin, face = _begin(T, size, origin, corner)
    ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
    for band in nb.prange(entries.shape[0]):
        thread = nb.get_thread_id()
        table, table_count = tables[thread], table_counts[thread]
        words, keys = stretches[thread, 0], stretches[thread, 1]
        run_word, run_end = stretches[thread, 2], stretches[thread, 3]
        own_word = word[band * room : (band + 1) * room]
        own_count = count[band * room : (band + 1) * room]
        x, y, z = np.empty(COLUMNS, np.float32), np.empty(COLUMNS, np.float32), np.empty(COLUMNS, np.float32)
        n = lost = np.int64(0)
        end = min(depth.shape[0], (band + 1) * POINTS)
        for first in range(band * POINTS, end, COLUMNS):
            to = min(first + COLUMNS, end)
            stretch_words = words[: -(-(to - first) // LANES) * LANES + 1]
            stretch_words[to - first :] = -1
            some_points, some_depth, some_labels = points[first:to], depth[first:to], labels[first:to]
            _touch_points(points, depth, labels, to, end)
            _split(some_points, x, y, z)
            if _words_of_points_fused(
                x, y, z, some_depth, some_labels, ignore, M, begin[0], begin[1], begin[2], face, stretch_words
            ):  # fmt: skip
                lost |= exact_keys_of_points(some_points, some_depth, some_labels, T, size, ox, oy, oz, ignore, keys)
                lost |= _words_of_keys(keys, some_labels, corner, stretch_words)
            if columns.shape[0]:
                _keep_columns(stretch_words, columns, corner)
            n = _enter_runs(stretch_words, run_word, run_end, table, table_count, own_word, own_count, n)
        entries[band] = _finish(
            table, table_count, own_word, own_count, n, lost, corner,
            partition[band * room : (band + 1) * room], spread[band], low[band], high[band],
        )  # fmt: skip
    return _total(entries, high, num_classes)


@helper
def _finish(table, table_count, word, count, n, lost, corner, partition, spread, low, high):
    """Empty the table into a band's n entries; return the number of entries that remain, see `_describe`.

    Returns -1 if a pixel is `lost`.
    """
    n = _flush(table, table_count, word, count, n)
    n = _describe(word, count, n, corner, partition, spread, low, high)
    return -1 if lost else n


@serial
def _total(entries, high, num_classes):
    """Return the number of entries of all bands; -1 where one has lost a pixel, or has a label that is no class."""
    total = np.int64(0)
    for band in range(entries.shape[0]):
        if entries[band] < 0 or high[band, 3] >= num_classes:
            return np.int64(-1)
        total += entries[band]
    return total


@serial
def _describe(word, count, n, corner, partition, spread, low, high):
    """Leave out entries that do not count; partitions, spread and extent of what is left, whose number is returned."""
    low_a = low_b = low_c = np.int64(1 << 20)  # numbers, not rows of an array: they stay in registers
    high_a = high_b = high_c = most = np.int64(-1)
    spread[:] = 0
    m = 0
    for e in range(n):
        w = word[e]
        if w != -1:
            a, b, c = coordinates(w)
            p = partition_of(key_of(a, b, c, corner))
            word[m], count[m], partition[m] = w, count[e], p
            spread[p] += 1
            low_a, low_b, low_c = min(low_a, a), min(low_b, b), min(low_c, c)
            high_a, high_b, high_c, most = max(high_a, a), max(high_b, b), max(high_c, c), max(most, w & 0xFFFF)
            m += 1
    low[0], low[1], low[2], low[3] = low_a, low_b, low_c, 0
    high[0], high[1], high[2], high[3] = high_a, high_b, high_c, most
    return m
