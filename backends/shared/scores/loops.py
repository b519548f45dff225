"""Compiled loops from the scores of a frame to the sums of its voxels, by tiles of the image.

The image is cut into bands of `ROWS` rows, and each band into tiles so narrow that the sums of their voxels stay in a
core's cache. Scores are read from memory once, in the order in which they lie there; those of eight invalid pixels are
not. A voxel's pixels are added up band by band, in an order that depends on the image only: the same numbers for any
number of threads.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.backends.shared.hashing import PARTITIONS, mix, partition_of
from semstab.backends.shared.pixels.pixel_keys import keep_columns, keys_of_row
from semstab.backends.shared.pixels.run_vectors import runs_of_eight
from semstab.backends.shared.prefetch import touch
from semstab.backends.shared.scores.vectors import LANES, SOON, add_two, scale_eight
from semstab.runtime.compiled import parallel, serial

ROWS, COLUMNS = 16, 512
"""Pixels of a tile; its rows are those of a band."""

TABLE_BITS = 13
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
SHIFT = np.uint64(64 - TABLE_BITS)

AHEAD = 512
"""Scores that are asked for before their turn comes."""

LINE = 16
"""Of them, as many as a line of the cache holds in float32."""


@parallel
def sum_scores(
    depth, labels, scores, ending, K, ray_x, ray_y, T, size, origin, within, rays, margin, room, row_keys,
    tables, table_rows, stretches, scales, key, count, sums, entries, lost, spread,
):  # fmt: skip
    """The voxels of each band, some of them twice, with the sums of their pixels' scores, each scaled to sum 1.

    Where a band has more than `room` of them, its number in `entries` is -1, and its rest is left undone.

    labels   (W,) 0 wherever there is depth: scores have no ignore id
    scores   (H * W * K,), see `vectors`
    ending   the last scores of at least a tile's row, and room for as many: where reading goes beyond the image
    within   see `keep_columns`
    key      (bands * room,) packed voxels, their pixels in `count`, and their sums (bands * room * stride,) in `sums`
    lost     (bands,) whether a pixel with depth is out of reach
    spread   (bands, PARTITIONS) of the voxels by partition
    """
    H, W = depth.shape
    stride = -(-K // LANES) * LANES
    ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
    elsewhere = scores.shape[0] + (COLUMNS + LANES) * K - ending.shape[0]
    for band in nb.prange(entries.shape[0]):
        thread = nb.get_thread_id()
        keys, table = row_keys[thread], tables[thread]
        first, last = band * ROWS, min(H, (band + 1) * ROWS)
        for v in range(first, last):
            lost[band] |= keys_of_row(
                depth[v], labels, ray_x, ray_y[v], T, size, ox, oy, oz, 1, rays, margin, keys[v - first]
            )
            if within.shape[0]:
                keep_columns(keys[v - first], within)
        table[:] = -1
        own_key, own_count = key[band * room : (band + 1) * room], count[band * room : (band + 1) * room]
        own_sums = sums[band * room * stride : (band + 1) * room * stride]
        n = np.int64(0)
        for start in range(0, W, COLUMNS):
            stop = min(W, start + COLUMNS)
            words = stretches[thread, 0, : -(-(stop - start) // LANES) * LANES + LANES]
            for v in range(first, last):
                if n >= 0:
                    words[: stop - start] = keys[v - first, start:stop]
                    words[stop - start :] = -1
                    at = (v * W + start) * K
                    near = at + words.shape[0] * K > scores.shape[0]
                    n = _add_stretch(
                        ending if near else scores, at - elsewhere if near else at, K, stride, words, scales[thread],
                        stretches[thread, 1], stretches[thread, 2], table, table_rows[thread], own_key, own_count,
                        own_sums, n,
                    )  # fmt: skip
        entries[band] = n
        for e in range(n):
            spread[band, partition_of(own_key[e])] += 1


@serial
def _add_stretch(scores, at, K, stride, words, scale, run_word, run_end, table, table_row, key, count, sums, n):
    """Add a stretch of pixels to their voxels, of which there are n; how many then, or -1 where there is no room.

    scores, at  their scores begin at scores[at]
    words       their keys, and at least LANES times -1 behind the last one, up to a multiple of LANES; those of pixels
                without a prediction become -1
    """
    pixels = words.shape[0] - LANES
    for u in range(0, pixels, LANES):
        some = words[u] & words[u + 1] & words[u + 2] & words[u + 3]
        if (some & words[u + 4] & words[u + 5] & words[u + 6] & words[u + 7]) >= 0:
            for ahead in range(at + u * K + AHEAD, min(at + (u + LANES) * K + AHEAD, scores.shape[0]), LINE):
                touch(scores, ahead)
            scale_eight(scores, at + u * K, K, words, scale, u)
    runs = 0
    for u in range(0, pixels, LANES):
        runs = runs_of_eight(words, u, run_word, run_end, runs)
    begin = np.int64(0)
    for i in range(runs):
        k, end = run_word[i], run_end[i]
        if k >= 0:
            slot = np.int64((np.uint64(k) * GOLDEN) >> SHIFT)
            fresh = table[slot] != k
            if fresh:
                if n == key.shape[0]:
                    return np.int64(-1)
                table[slot], table_row[slot] = k, n
                key[n], count[n] = k, 0
                n += 1
            e = np.int64(table_row[slot])
            count[e] += end - begin
            while begin < end:
                add_two(scores, at, K, scale, begin, end, sums, e * stride, fresh)
                begin += 2
                fresh = False
        begin = end
    return n


@parallel
def scatter_rows(key, count, room, stride, entries, offset, out_key, out_pixels, out_row):
    """Entries by partition, and within one by band and order of appearance; `out_row` is the place of their sums."""
    for band in nb.prange(entries.shape[0]):
        cursor = offset[:, band].copy()
        for e in range(band * room, band * room + entries[band]):
            p = partition_of(key[e])
            at = cursor[p]
            cursor[p] = at + 1
            out_key[at], out_pixels[at], out_row[at] = key[e], count[e], e * stride


@parallel
def merge_rows(edges, key, pixels, row, again, first, sums, K, found):
    """Add up the entries of each voxel in place: in its first one, and in the sums of that; how many are `found`.

    again, first  work space: the sums of an entry of a voxel that has one already, and those of its first one
    """
    for p in nb.prange(PARTITIONS):
        low, high = edges[p], edges[p + 1]
        mask = 15
        while mask < 2 * (high - low):
            mask = 2 * mask + 1
        slot = np.full(mask + 1, -1, dtype=np.int32)
        n = low
        repeated = low
        for i in range(low, high):
            k = key[i]
            at = np.int64(mix(k) & np.uint64(mask))
            while slot[at] >= 0 and key[low + slot[at]] != k:
                at = (at + 1) & mask
            if slot[at] < 0:
                slot[at] = n - low
                key[n], pixels[n], row[n] = k, pixels[i], row[i]
                n += 1
            else:
                v = low + slot[at]
                pixels[v] += pixels[i]
                again[repeated], first[repeated] = row[i], row[v]
                repeated += 1
        for i in range(low, repeated):
            soon = min(i + SOON, repeated - 1)
            for k in range(0, K, LANES):
                touch(sums, again[soon] + k)
                touch(sums, first[soon] + k)
            to, added = sums[first[i] : first[i] + K], sums[again[i] : again[i] + K]
            for k in range(K):
                to[k] += added[k]
        found[p] = n - low
