"""Compiled loops from the labels of a frame to its observations, by tiles of the image.

A pixel is one word: its voxel, counted from 2^15 below the camera's along each axis, and its label, 16 bits each; -1
where it does not count. Pixels become runs of equal words along rows, runs of a tile entries in a small table that
gives way on a collision, and entries are sorted and added up by partition of the map. All sums are of integers: the
order in which they are made does not show.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.backends.shared.hashing import PARTITIONS, partition_of
from semstab.backends.shared.pixels.keys import HALF
from semstab.backends.shared.pixels.pixel_keys import BLOCK, exact_keys_of_row
from semstab.runtime.compiled import compiled, parallel, serial

NEAR = 1 << 15
"""Words reach that many voxels to either side of the camera."""

ROWS, COLUMNS = 16, 128
"""Pixels of a tile."""

TABLE_BITS = 11
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
SHIFT = np.uint64(64 - TABLE_BITS)


@compiled(fastmath={"contract"})
def _words_fused(depth, labels, ignore, ray_a, ray_b, ray_c, a0, b0, c0, ta, tb, tc, margin, out):
    """The words of pixels; and any doubt, see `keys_fused`."""
    inner = 0.5 - margin
    doubt = outside = 0
    for u in range(depth.shape[0]):
        d = np.float64(depth[u])
        ok = (d > 0.0) & (d < np.inf) & (labels[u] != ignore)
        d = d if ok else 0.0
        a = d * (ray_a[u] + a0) + ta
        b = d * (ray_b[u] + b0) + tb
        c = d * (ray_c[u] + c0) + tc
        whole_a, whole_b, whole_c = np.floor(a), np.floor(b), np.floor(c)
        doubt |= (abs(a - whole_a - 0.5) > inner) | (abs(b - whole_b - 0.5) > inner) | (abs(c - whole_c - 0.5) > inner)
        i, j, k = np.int64(np.int32(whole_a)), np.int64(np.int32(whole_b)), np.int64(np.int32(whole_c))
        outside |= i | j | k
        out[u] = ((i << 48) | (j << 32) | (k << 16) | np.int64(labels[u])) if ok else -1
    return doubt | (outside >> 16)


@serial
def _words_of_row(depth, labels, ray_x, ray_y, T, size, origin, corner, ignore, rays, margin, keys, out):
    """The words of a row; returns whether a pixel is out of their reach, or out of that of the packed keys."""
    a0 = (T[0, 1] * ray_y + T[0, 2]) / size
    b0 = (T[1, 1] * ray_y + T[1, 2]) / size
    c0 = (T[2, 1] * ray_y + T[2, 2]) / size
    ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
    ta = T[0, 3] / size - ox + (HALF - corner[0])
    tb = T[1, 3] / size - oy + (HALF - corner[1])
    tc = T[2, 3] / size - oz + (HALF - corner[2])
    lost = 0
    for first in range(0, depth.shape[0], BLOCK):
        to = min(first + BLOCK, depth.shape[0])
        d, lab, words = depth[first:to], labels[first:to], out[first:to]
        ray_a, ray_b, ray_c = rays[0, first:to], rays[1, first:to], rays[2, first:to]
        if _words_fused(d, lab, ignore, ray_a, ray_b, ray_c, a0, b0, c0, ta, tb, tc, margin, words):
            lost |= exact_keys_of_row(d, lab, ray_x[first:to], ray_y, T, size, ox, oy, oz, ignore, keys)
            for u in range(to - first):
                i, j, k = _from_corner(keys[u], corner)
                lost |= (keys[u] >= 0) & (((i | j | k) >> 16) != 0)
                words[u] = ((i << 48) | (j << 32) | (k << 16) | np.int64(lab[u])) if keys[u] >= 0 else -1
    return lost


@serial
def _keep_columns(words, columns, corner):
    """Take out the words outside of columns, given as packed keys count."""
    for u in range(words.shape[0]):
        i, j = ((words[u] >> 48) & 0xFFFF) + corner[0], ((words[u] >> 32) & 0xFFFF) + corner[1]
        inside = (i >= columns[0]) & (i < columns[1]) & (j >= columns[2]) & (j < columns[3])
        words[u] = words[u] if inside else -1


@serial
def _from_corner(key, corner):
    mask = 2 * HALF - 1
    return (key >> 42) - corner[0], ((key >> 21) & mask) - corner[1], (key & mask) - corner[2]


@serial
def _coordinates(word):
    return (word >> 48) & 0xFFFF, (word >> 32) & 0xFFFF, (word >> 16) & 0xFFFF


@serial
def _key_of(a, b, c, corner):
    return ((a + corner[0]) << 42) | ((b + corner[1]) << 21) | (c + corner[2])


@serial
def _runs_of_row(word, changes, run_word, run_end):
    """Runs of equal words: the word of each and where it ends. Two loops without branches; the first is vectorised."""
    last = word.shape[0] - 1
    for u in range(last):
        changes[u] = word[u] != word[u + 1]
    changes[last] = 1
    n = 0
    for u in range(last + 1):
        run_word[n] = word[u]
        run_end[n] = u + 1
        n += changes[u]


@serial
def _enter_tile(run_word, run_end, run, begin, rows, stop, table, table_count, word, count, n):
    """Runs that begin before column `stop` into the table; what gives way is an entry. Returns how many there are."""
    for v in range(rows):
        i, u = run[v], begin[v]
        while u < stop:
            w, end = run_word[v, i], run_end[v, i]
            at = np.int64((np.uint64(w) * GOLDEN) >> SHIFT)
            there, so_far = table[at], table_count[at]
            word[n], count[n] = there, so_far
            same = there == w
            n += not same
            table[at] = w
            table_count[at] = (so_far if same else 0) + (end - u)
            u = end
            i += 1
        run[v], begin[v] = i, u
    return n


@serial
def _flush(table, table_count, word, count, n):
    for at in range(table.shape[0]):
        word[n], count[n] = table[at], table_count[at]
        n += table[at] != -1
        table[at] = -1
    return n


@parallel
def find_words(
    depth, labels, ray_x, ray_y, T, size, origin, corner, columns, rays, margin, ignore, room, row_word, row_keys,
    row_changes, run_word, run_end, run, tables, table_counts, word, count, partition, entries, lost, spread, low, high,
):  # fmt: skip
    """Entries of each band of ROWS rows: words with counts, some of them twice; their extent and spread by partition.

    Where a band has more than `room` of them, its number in `entries` is -1, and its rest is left undone. `lost`: a
    pixel is out of reach of the words. low, high (bands, 4): of the coordinates, and of the label.
    """
    H, W = depth.shape
    for band in nb.prange(entries.shape[0]):
        thread = nb.get_thread_id()
        table, table_count = tables[thread], table_counts[thread]
        of_run, begin = run[thread, 0], run[thread, 1]
        rows = min(H, (band + 1) * ROWS) - band * ROWS
        for v in range(rows):
            y = band * ROWS + v
            lost[band] |= _words_of_row(
                depth[y], labels[y], ray_x, ray_y[y], T, size, origin, corner, ignore, rays, margin, row_keys[thread],
                row_word[thread],
            )  # fmt: skip
            if columns.shape[0]:
                _keep_columns(row_word[thread], columns, corner)
            _runs_of_row(row_word[thread], row_changes[thread], run_word[thread, v], run_end[thread, v])
            of_run[v] = begin[v] = 0
        own_word = word[band * room : (band + 1) * room]
        own_count = count[band * room : (band + 1) * room]
        n = np.int64(0)
        for stop in range(COLUMNS, W + COLUMNS, COLUMNS):
            if n + (COLUMNS + 1) * ROWS + table.shape[0] > room:
                n = np.int64(-1)
                break
            n = _enter_tile(
                run_word[thread], run_end[thread], of_run, begin, rows, min(stop, W), table, table_count,
                own_word, own_count, n,
            )  # fmt: skip
        if n < 0:
            table[:] = -1
            entries[band] = -1
        else:
            n = _flush(table, table_count, own_word, own_count, n)
            entries[band] = _describe(
                own_word, own_count, n, corner, partition[band * room : (band + 1) * room], spread[band], low[band],
                high[band],
            )  # fmt: skip


@serial
def _describe(word, count, n, corner, partition, spread, low, high):
    """Leave out what does not count; partitions, spread and extent of what is left, whose number is returned."""
    low[:], high[:] = 1 << 20, -1
    m = 0
    for e in range(n):
        w = word[e]
        if w != -1:
            a, b, c = _coordinates(w)
            p = partition_of(_key_of(a, b, c, corner))
            word[m], count[m], partition[m] = w, count[e], p
            spread[p] += 1
            low[0], low[1], low[2] = min(low[0], a), min(low[1], b), min(low[2], c)
            high[0], high[1], high[2], high[3] = (
                max(high[0], a), max(high[1], b), max(high[2], c), max(high[3], w & 0xFFFF),
            )  # fmt: skip
            m += 1
    return m


@parallel
def scatter_words(word, count, partition, room, entries, offset, low, shift, out_word, out_count):
    """Entries by partition, their words packed to the frame's extent: bits `shift` upwards hold a, b, c, then label."""
    for band in nb.prange(entries.shape[0]):
        cursor = offset[:, band].copy()
        for e in range(band * room, band * room + entries[band]):
            a, b, c = _coordinates(word[e])
            at = cursor[partition[e]]
            cursor[partition[e]] = at + 1
            out_word[at] = (
                ((a - low[0]) << shift[0]) | ((b - low[1]) << shift[1]) | ((c - low[2]) << shift[2])
                | (word[e] & 0xFFFF)
            )  # fmt: skip
            out_count[at] = count[e]


@serial
def _sort(word, count, word2, count2, bits, histogram):
    """Sort by the lowest `bits` bits, 8 at a time; returns whether the result is in the second pair of arrays."""
    flipped = False
    for shift in range(0, bits, 8):
        if flipped:
            source, source_count, target, target_count = word2, count2, word, count
        else:
            source, source_count, target, target_count = word, count, word2, count2
        histogram[:] = 0
        for i in range(source.shape[0]):
            histogram[(source[i] >> shift) & 255] += 1
        total = 0
        for digit in range(256):
            total, histogram[digit] = total + histogram[digit], total
        for i in range(source.shape[0]):
            digit = (source[i] >> shift) & 255
            at = histogram[digit]
            histogram[digit] = at + 1
            target[at], target_count[at] = source[i], source_count[i]
        flipped = not flipped
    return flipped


@parallel
def merge_words(word, count, word2, count2, edges, bits, label_bits, flipped, voxels, kept):
    """Sort each partition and add up equal words; numbers of voxels and of entries that are left."""
    for p in nb.prange(PARTITIONS):
        low, high = edges[p], edges[p + 1]
        flipped[p] = _sort(
            word[low:high], count[low:high], word2[low:high], count2[low:high], bits, np.empty(256, np.int64)
        )
        w, c = (word2[low:high], count2[low:high]) if flipped[p] else (word[low:high], count[low:high])
        n = v = 0
        voxel = np.int64(-1)
        for i in range(high - low):
            if n > 0 and w[i] == w[n - 1]:
                c[n - 1] += c[i]
                continue
            v += (w[i] >> label_bits) != voxel
            voxel = w[i] >> label_bits
            w[n], c[n] = w[i], c[i]
            n += 1
        voxels[p], kept[p] = v, n


@parallel
def emit_voxels(
    word,
    count,
    word2,
    count2,
    edges,
    flipped,
    bounds,
    entry_bounds,
    low,
    shift,
    corner,
    key,
    pixels,
    start,
    label,
    weight,
):
    """The observations: close the gaps between partitions, and unpack the words."""
    label_mask = (np.int64(1) << shift[2]) - 1
    b_mask, c_mask = (np.int64(1) << (shift[0] - shift[1])) - 1, (np.int64(1) << (shift[1] - shift[2])) - 1
    for p in nb.prange(PARTITIONS):
        w, c = (word2[edges[p] :], count2[edges[p] :]) if flipped[p] else (word[edges[p] :], count[edges[p] :])
        v = bounds[p] - 1
        voxel = np.int64(-1)
        for e in range(entry_bounds[p], entry_bounds[p + 1]):
            packed, number = w[e - entry_bounds[p]], c[e - entry_bounds[p]]
            if packed >> shift[2] != voxel:
                voxel = packed >> shift[2]
                v += 1
                key[v] = _key_of(
                    (packed >> shift[0]) + low[0], ((packed >> shift[1]) & b_mask) + low[1],
                    ((packed >> shift[2]) & c_mask) + low[2], corner,
                )  # fmt: skip
                pixels[v] = 0
                start[v] = e
            pixels[v] += number
            label[e] = packed & label_mask
            weight[e] = number
    start[bounds[PARTITIONS]] = entry_bounds[PARTITIONS]
