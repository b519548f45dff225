"""Compiled loops from the entries of an image's bands to observations, one a voxel.

Voxels are cut into partitions by a hash of their key. Every sum runs in one fixed order: the same frame gives the same
numbers for any number of threads.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.backends.shared.hashing import PARTITIONS, mix, partition_of
from semstab.backends.shared.prefetch import AHEAD, touch
from semstab.runtime.compiled import parallel


@parallel
def scatter(key, stride, entries, offset, order):
    """Entries by partition, and within one by band and order of appearance."""
    for band in nb.prange(entries.shape[0]):
        cursor = offset[:, band].copy()
        for e in range(band * stride, band * stride + entries[band]):
            p = partition_of(key[e])
            order[cursor[p]] = e
            cursor[p] += 1


@parallel
def group(key, count, order, edges, voxel, out_key, out_pixels, out_size, found):
    """Number the voxels of each partition; count each one's entries and pixels."""
    for p in nb.prange(PARTITIONS):
        low, high = edges[p], edges[p + 1]
        mask = 15
        while mask < 2 * (high - low):
            mask = 2 * mask + 1
        slot = np.full(mask + 1, -1, dtype=np.int32)
        n = 0
        for i in range(low, high):
            soon = order[min(i + AHEAD, high - 1)]
            touch(key, soon)
            touch(count, soon)
            k = key[order[i]]
            at = np.int64(mix(k) & np.uint64(mask))
            while slot[at] >= 0 and out_key[low + slot[at]] != k:
                at = (at + 1) & mask
            if slot[at] < 0:
                slot[at] = n
                out_key[low + n] = k
                out_pixels[low + n] = 0
                out_size[low + n] = 0
                n += 1
            v = np.int64(slot[at])
            voxel[i] = v
            out_pixels[low + v] += count[order[i]]
            out_size[low + v] += 1
        found[p] = n


@parallel
def sort_labels(label, count, order, edges, voxel, size, found, out_label, out_weight, kept):
    """The entries of each voxel together, ascending by label, equal labels added up; `size` becomes the number left."""
    for p in nb.prange(PARTITIONS):
        low, n = edges[p], found[p]
        cursor = np.empty(n + 1, dtype=np.int64)
        cursor[0] = low
        for v in range(n):
            cursor[v + 1] = cursor[v] + size[low + v]
            size[low + v] = 0
        for i in range(low, edges[p + 1]):
            v = voxel[i]
            begin, lab = cursor[v], label[order[i]]
            j = begin + size[low + v]
            while j > begin and out_label[j - 1] > lab:
                j -= 1
            if j > begin and out_label[j - 1] == lab:
                out_weight[j - 1] += count[order[i]]
                continue
            for moved in range(begin + size[low + v], j, -1):
                out_label[moved] = out_label[moved - 1]
                out_weight[moved] = out_weight[moved - 1]
            out_label[j] = lab
            out_weight[j] = count[order[i]]
            size[low + v] += 1
        total = 0
        for v in range(n):
            for e in range(size[low + v]):
                out_label[low + total] = out_label[cursor[v] + e]
                out_weight[low + total] = out_weight[cursor[v] + e]
                total += 1
        kept[p] = total


@parallel
def compact(
    edges, bounds, entry_bounds, key, pixels, size, label, weight, out_key, out_pixels, start, out_label, out_weight
):
    """Close the gaps between partitions."""
    for p in nb.prange(PARTITIONS):
        low, first, entry = edges[p], bounds[p], entry_bounds[p]
        for v in range(bounds[p + 1] - first):
            out_key[first + v] = key[low + v]
            out_pixels[first + v] = pixels[low + v]
            start[first + v] = entry
            entry += size[low + v]
        for e in range(entry_bounds[p + 1] - entry_bounds[p]):
            out_label[entry_bounds[p] + e] = label[low + e]
            out_weight[entry_bounds[p] + e] = weight[low + e]
    start[bounds[PARTITIONS]] = entry_bounds[PARTITIONS]
