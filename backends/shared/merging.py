"""Compiled loops from the entries of an image's bands to observations, one a voxel.

Voxels are cut into partitions by a hash of their key. Every sum runs in one fixed order: the same frame gives the same
numbers for any number of threads.
"""

from __future__ import annotations

import numba as nb
import numpy as np
from numba.core import types
from numba.extending import overload

from semstab.backends.shared.hashing import PARTITIONS, mix, partition_of
from semstab.runtime.compiled import compiled, parallel


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


def _value(score, halves):
    """A score as a number; of half precision by its bits, since compiled code knows no such type."""


@overload(_value)
def _value_of(score, halves):  # noqa: ARG001 - it says by types what `_value` is
    if isinstance(score, types.Integer):
        return lambda score, halves: halves[score]
    return lambda score, halves: np.float64(score)


HALVES = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float64)
"""The value of each half-precision number, by its bits."""


@compiled(fastmath={"reassoc", "contract"})
def _add_scores(scores, halves, values, sums):
    """Add the scores (K,) of a pixel, scaled to sum 1."""
    total = 0.0
    for k in range(scores.shape[0]):
        values[k] = _value(scores[k], halves)
        total += values[k]
    scale = 1.0 / total
    for k in range(scores.shape[0]):
        sums[k] += values[k] * scale


@parallel
def sum_scores(scores, halves, where, rows, base, sums):
    """Add each pixel's normalised scores to its entry."""
    H, W, K = scores.shape
    for band in nb.prange(base.shape[0] - 1):
        values = np.empty(K)
        for v in range(band * rows, min(H, (band + 1) * rows)):
            for u in range(W):
                if where[v, u] >= 0:
                    _add_scores(scores[v, u], halves, values, sums[base[band] + where[v, u]])


@parallel
def merge_scores(order, edges, voxel, bounds, stride, base, sums, key, pixels, out_key, out_pixels, weights):
    """Add up the entries of each voxel."""
    K = sums.shape[1]
    for p in nb.prange(PARTITIONS):
        low, first = edges[p], bounds[p]
        for v in range(bounds[p + 1] - first):
            out_key[first + v] = key[low + v]
            out_pixels[first + v] = pixels[low + v]
        for i in range(low, edges[p + 1]):
            band = order[i] // stride
            e = base[band] + order[i] - band * stride
            for k in range(K):
                weights[first + voxel[i], k] += sums[e, k]
