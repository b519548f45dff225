"""Compiled loops from the scores of a frame to the sums of its voxels, by tiles of the image.

The image is cut into bands of `ROWS` rows, and each band into tiles so narrow that the sums of their voxels stay in a
core's cache. Scores are read once, in the order in which they lie in memory; invalid pixels' are not. A voxel's pixels
are added up band by band, in an order that depends on the image only: the same numbers for any number of threads.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.backends.shared.hashing import PARTITIONS, partition_of
from semstab.backends.shared.pixels.pixel_keys import keep_columns, keys_of_row
from semstab.backends.shared.prefetch import touch
from semstab.backends.shared.scores.vectors import LANES, add_scaled, total_of
from semstab.runtime.compiled import parallel, serial

ROWS, COLUMNS = 16, 128
"""Pixels of a tile; its rows are those of a band."""

TABLE_BITS = 11
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
SHIFT = np.uint64(64 - TABLE_BITS)

AHEAD = 512
"""Scores that are asked for before their turn comes."""


SOON = 8
"""Rows of sums likewise."""


@parallel
def sum_scores(
    depth, labels, scores, K, ray_x, ray_y, T, size, origin, within, rays, margin, room, row_keys, tables, table_rows,
    scales, key, count, sums, entries, lost, spread,
):  # fmt: skip
    """The voxels of each band, some of them twice, with the sums of their pixels' scores, each scaled to sum 1.

    Where a band has more than `room` of them, its number in `entries` is -1, and its rest is left undone.

    labels   (W,) 0 wherever there is depth: scores have no ignore id
    scores   (H * W * K,), see `score_vectors`
    within   see `keep_columns`
    key      (bands * room,) packed voxels, their pixels in `count`, and their sums (bands * room * stride,) in `sums`
    lost     (bands,) whether a pixel with depth is out of reach
    spread   (bands, PARTITIONS) of the voxels by partition
    """
    H, W = depth.shape
    stride = -(-K // LANES) * LANES
    ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
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
            for v in range(first, last):
                if n >= 0:
                    n = _add_stretch(
                        scores, v * W, keys[v - first], start, stop, K, stride, table, table_rows[thread],
                        scales[thread], own_key, own_count, own_sums, n,
                    )  # fmt: skip
        entries[band] = n
        for e in range(n):
            spread[band, partition_of(own_key[e])] += 1


@serial
def _add_stretch(scores, row, keys, start, stop, K, stride, table, table_row, scale, key, count, sums, n):
    """Add pixels `start` to before `stop` of a row to their voxels, of which there are n; how many then, or -1.

    row  the number of the row's first pixel in the image
    """
    for u in range(start, stop):
        if keys[u] >= 0:
            at = (row + u) * K
            touch(scores, min(at + AHEAD, scores.shape[0] - 1))
            total = total_of(scores, at, K)
            scale[u] = 1.0 / total
            keys[u] = keys[u] if 0.0 < total < np.inf else -1  # no prediction
    for u in range(start, stop):  # runs of equal keys are short: to look for their ends would take longer
        k = keys[u]
        if k < 0:
            continue
        slot = np.int64((np.uint64(k) * GOLDEN) >> SHIFT)
        if table[slot] != k:
            if n == key.shape[0]:
                return np.int64(-1)
            table[slot], table_row[slot] = k, n
            key[n], count[n] = k, 0
            sums[n * stride : (n + 1) * stride] = 0.0
            n += 1
        e = np.int64(table_row[slot])
        count[e] += 1
        add_scaled(scores, (row + u) * K, K, scale[u], sums, e * stride)
    return n


@parallel
def merge_sums(order, edges, voxel, bounds, key, pixels, sums, K, stride, out_key, out_pixels, out_row):
    """Add up the entries of each voxel in the sums of its first one, whose place among the sums is `out_row`."""
    for p in nb.prange(PARTITIONS):
        low, first = edges[p], bounds[p]
        for v in range(bounds[p + 1] - first):
            out_key[first + v], out_pixels[first + v], out_row[first + v] = key[low + v], pixels[low + v], -1
        for i in range(low, edges[p + 1]):
            touch(sums, order[min(i + SOON, edges[p + 1] - 1)] * stride)
            v, there = first + voxel[i], order[i] * stride
            if out_row[v] < 0:
                out_row[v] = there
            else:
                to, added = sums[out_row[v] : out_row[v] + K], sums[there : there + K]
                for k in range(K):
                    to[k] += added[k]
