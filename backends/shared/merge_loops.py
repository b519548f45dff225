"""Compiled loops from the entries of a frame's labels to its observations, by partition of the map.

Entries are words with counts, see `tile_loops`. All sums are of integers: the order in which they are made does not
show.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.backends.shared.keys import PARTITIONS, bounds_of
from semstab.backends.shared.tile_loops import coordinates, key_of
from semstab.core.compiled import helper, parallel, serial

DIGIT_BITS = 10


@serial
def offsets_of(spread):
    """Return where entries go in order of partition, then band, from their numbers `spread` (bands, PARTITIONS).

    Returns the first of each band in each partition (bands, PARTITIONS), and of each partition, and the end.
    """
    offset, edges = np.empty_like(spread), np.empty(PARTITIONS + 1, np.int64)
    so_far = np.int64(0)
    for p in range(PARTITIONS):
        edges[p] = so_far
        for band in range(spread.shape[0]):
            offset[band, p] = so_far
            so_far += spread[band, p]
    edges[PARTITIONS] = so_far
    return offset, edges


@serial
def _layout(low, high):
    """Return how words are packed to the extent of all bands (bands, 4): lowest a, b, c and 0, and positions (4,).

    Label, c, b and a take as many bits as they need, upwards; the positions are those of a, b and c, and of the end.
    """
    lowest, shift, bits = np.empty(4, np.int64), np.empty(4, np.int64), 0
    for part in range(3, -1, -1):
        least, most = low[0, part], high[0, part]
        for band in range(low.shape[0]):
            least, most = min(least, low[band, part]), max(most, high[band, part])
        lowest[part], shift[part] = least, bits
        width = 1
        while (most - least) >> width > 0:
            width += 1
        bits += width
    shift[3] = bits
    return lowest, shift


@helper
def _sort(word, count, word2, count2, bits, histogram):
    """Sort by the lowest `bits` bits, as many at a time as the histogram has room for; whether into the second pair."""
    flipped = False
    passes = -(-bits // DIGIT_BITS)
    width = -(-bits // passes)
    digits = 1 << width
    for shift in range(0, bits, width):
        if flipped:
            source, source_count, target, target_count = word2, count2, word, count
        else:
            source, source_count, target, target_count = word, count, word2, count2
        histogram[:digits] = 0
        for i in range(source.shape[0]):
            histogram[(source[i] >> shift) & (digits - 1)] += 1
        total = 0
        for digit in range(digits):
            total, histogram[digit] = total + histogram[digit], total
        for i in range(source.shape[0]):
            digit = (source[i] >> shift) & (digits - 1)
            at = histogram[digit]
            histogram[digit] = at + 1
            target[at], target_count[at] = source[i], source_count[i]
        flipped = not flipped
    return flipped


@parallel
def merge_words(band_word, band_count, partition, room, entries, spread, low, high, word, count, word2, count2):
    """Order the bands' entries by partition and word, and add up equal ones.

    Returns the first entry of each partition, and whether it is in the second pair; the first of its voxels and of its
    entries when the gaps are closed; and how words are packed, see `_layout`.
    """
    offset, edges = offsets_of(spread)
    lowest, shift = _layout(low, high)
    for band in nb.prange(entries.shape[0]):
        cursor = offset[band]
        for e in range(band * room, band * room + entries[band]):
            a, b, c = coordinates(band_word[e])
            at = cursor[partition[e]]
            cursor[partition[e]] = at + 1
            word[at] = (
                ((a - lowest[0]) << shift[0]) | ((b - lowest[1]) << shift[1]) | ((c - lowest[2]) << shift[2])
                | (band_word[e] & 0xFFFF)
            )  # fmt: skip
            count[at] = band_count[e]
    flipped = np.empty(PARTITIONS, np.bool_)
    voxels, left = np.empty(PARTITIONS, np.int64), np.empty(PARTITIONS, np.int64)
    for p in nb.prange(PARTITIONS):
        start, end = edges[p], edges[p + 1]
        histogram = np.empty(1 << DIGIT_BITS, np.int32)
        flipped[p] = _sort(word[start:end], count[start:end], word2[start:end], count2[start:end], shift[3], histogram)
        w, c = (word2[start:end], count2[start:end]) if flipped[p] else (word[start:end], count[start:end])
        n = v = 0
        voxel = np.int64(-1)
        for i in range(end - start):
            if n > 0 and w[i] == w[n - 1]:
                c[n - 1] += c[i]
                continue
            v += (w[i] >> shift[2]) != voxel
            voxel = w[i] >> shift[2]
            w[n], c[n] = w[i], c[i]
            n += 1
        voxels[p], left[p] = v, n
    return edges, flipped, bounds_of(voxels), bounds_of(left), lowest, shift


@parallel
def emit_voxels(
    word, count, word2, count2, edges, flipped, bounds, entry_bounds, lowest, shift, corner, key, pixels, start, label,
    weight,
):  # fmt: skip
    """Write the observations: close the gaps between partitions, and unpack the words."""
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
                key[v] = key_of(
                    (packed >> shift[0]) + lowest[0], ((packed >> shift[1]) & b_mask) + lowest[1],
                    ((packed >> shift[2]) & c_mask) + lowest[2], corner,
                )  # fmt: skip
                pixels[v] = 0
                start[v] = e
            pixels[v] += number
            label[e] = packed & label_mask
            weight[e] = number
    start[bounds[PARTITIONS]] = entry_bounds[PARTITIONS]
