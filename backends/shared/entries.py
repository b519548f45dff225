"""The compiled loop that finds the entries of an image: distinct pairs of voxel and label, with their pixels.

The image is cut into bands of rows. How many there are depends on the image only, never on the number of threads.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.backends.shared.keys import PARTITIONS, mix, partition_of
from semstab.backends.shared.pixel_keys import AHEAD, keep_columns, keys_of_row, touch
from semstab.core.compiled import parallel, serial


@serial
def _runs(keys, labels, changes, starts):
    """First pixels of the runs of equal key and label in a row, closed by the row's length; returns how many runs.

    Two loops without branches, of which the first one vectorises: a run ends where nobody can predict it.
    """
    W = keys.shape[0]
    changes[0] = 1
    for u in range(1, W):
        changes[u] = (keys[u] != keys[u - 1]) | (labels[u] != labels[u - 1])
    n = 0
    for u in range(W):
        starts[n] = u
        n += changes[u]
    starts[n] = W
    return n


@parallel
def find_entries(
    depth, labels, ray_x, ray_y, T, size, origin, columns, rays, margin, ignore, rows, room, row_keys,
    row_changes, row_runs, slots, key, label, count, entries, lost, highest, spread,
):  # fmt: skip
    """Distinct (voxel, label) pairs of each band with their pixel counts, in order of appearance.

    Where a band has more than `room` of them, its number in `entries` is -1, and its rest is left undone.
    """
    H = depth.shape[0]
    ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
    for band in nb.prange(entries.shape[0]):
        thread = nb.get_thread_id()
        slot, changes = slots[thread], row_changes[thread]
        keys, keys_above = row_keys[thread, 0], row_keys[thread, 1]
        starts, above = row_runs[thread, 0], row_runs[thread, 1]
        found, found_above = row_runs[thread, 2], row_runs[thread, 3]
        own = slice(band * room, (band + 1) * room)
        key_of, label_of, count_of = key[own], label[own], count[own]
        mask = 1023
        slot[: mask + 1] = -1
        n = runs = 0
        for v in range(band * rows, min(H, (band + 1) * rows)):
            runs_above = runs
            lost[band] += keys_of_row(
                depth[v], labels[v], ray_x, ray_y[v], T, size, ox, oy, oz, ignore, rays, margin, keys
            )
            if columns.shape[0]:
                keep_columns(keys, columns)
            runs = _runs(keys, labels[v], changes, starts)
            n, mask = _enter_row(
                labels[v], labels[v - 1], keys, keys_above, runs, starts, runs_above, above, found, found_above,
                slot, mask, key_of, label_of, count_of, n,
            )  # fmt: skip
            if n < 0:
                break
            keys, keys_above = keys_above, keys
            starts, above = above, starts
            found, found_above = found_above, found
        entries[band] = n
        for e in range(n):
            highest[band] = max(highest[band], label_of[e])
            spread[band, partition_of(key_of[e])] += 1


@serial
def _enter_row(
    labels, labels_above, keys, keys_above, runs, starts, runs_above, above, found, found_above,
    slot, mask, key, label, count, n,
):  # fmt: skip
    """Enter the runs of a row; returns the band's entries then, -1 where it has no room, and the mask of its table.

    A run's entry is looked for among those of the row above before it is looked up in the table.
    """
    j = 0
    for i in range(runs):
        u, end = starts[i], starts[i + 1]
        k = keys[u]
        e = np.int64(-1)
        if k >= 0:
            lab = np.int64(labels[u])
            if runs_above > 0:
                while above[j + 1] <= u:
                    j += 1
                if keys_above[u] == k and labels_above[u] == labels[u]:
                    e = np.int64(found_above[j])
                elif keys_above[end - 1] == k and labels_above[end - 1] == labels[u]:
                    while above[j + 1] < end:
                        j += 1
                    e = np.int64(found_above[j])
            if e < 0:
                at = np.int64(mix(k + (lab << 44)) & np.uint64(mask))
                while slot[at] >= 0 and not (key[slot[at]] == k and label[slot[at]] == lab):
                    at = (at + 1) & mask
                e = np.int64(slot[at])
            if e < 0:
                if n == key.shape[0]:
                    return np.int64(-1), mask
                e = np.int64(n)
                slot[at] = e
                key[e], label[e], count[e] = k, lab, 0
                n += 1
                if 2 * n > mask:
                    mask = 2 * mask + 1
                    _refill(slot, mask, key, label, n)
            count[e] += end - u
        found[i] = e
    return n, mask


@serial
def _refill(slot, mask, key, label, n):
    slot[: mask + 1] = -1
    for e in range(n):
        at = np.int64(mix(key[e] + (np.int64(label[e]) << 44)) & np.uint64(mask))
        while slot[at] >= 0:
            at = (at + 1) & mask
        slot[at] = e


# Compiled loops from the entries of an image's bands to observations, one a voxel.
#
# Voxels are cut into partitions by a hash of their key. Every sum runs in one fixed order: the same frame gives the
# same numbers for any number of threads.


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
