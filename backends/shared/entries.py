"""The compiled loop that finds the entries of an image: distinct pairs of voxel and label, with their pixels.

The image is cut into bands of rows. How many there are depends on the image only, never on the number of threads.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.backends.shared.hashing import mix, partition_of
from semstab.backends.shared.pixel_keys import keys_of_row
from semstab.compiled import parallel, serial


@serial
def _runs(keys, labels, soft, changes, starts):
    """First pixels of the runs of equal key and label in a row, closed by the row's length; returns how many runs.

    Two loops without branches, of which the first one vectorises: a run ends where nobody can predict it.
    """
    W = keys.shape[0]
    changes[0] = 1
    for u in range(1, W):
        changes[u] = (keys[u] != keys[u - 1]) | ((labels[u] != labels[u - 1]) & (not soft))
    n = 0
    for u in range(W):
        starts[n] = u
        n += changes[u]
    starts[n] = W
    return n


@parallel
def find_entries(
    depth, labels, ray_x, ray_y, T, size, origin, rays, margin, ignore, soft, rows, room, row_keys,
    row_changes, row_runs, slots, key, label, count, where, entries, lost, highest, spread,
):  # fmt: skip
    """Distinct (voxel, label) pairs of each band with their pixel counts, in order of appearance.

    Where a band has more than `room` of them, its number in `entries` is -1, and its rest is left undone. A run's entry
    is looked for among those of the row above before it is looked up in the table.
    """
    H, W = depth.shape
    ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
    for band in nb.prange(entries.shape[0]):
        thread = nb.get_thread_id()
        slot, changes = slots[thread], row_changes[thread]
        keys, keys_above = row_keys[thread, 0], row_keys[thread, 1]
        starts, above = row_runs[thread, 0], row_runs[thread, 1]
        found, found_above = row_runs[thread, 2], row_runs[thread, 3]
        runs_above = 0
        first = band * room
        mask = 1023
        slot[: mask + 1] = -1
        n = 0
        full = False
        for v in range(band * rows, min(H, (band + 1) * rows)):
            if full:
                break
            lost[band] += keys_of_row(
                depth[v], labels[v], ray_x, ray_y[v], T, size, ox, oy, oz, ignore, rays, margin, keys
            )
            runs = _runs(keys, labels[v], soft, changes, starts)
            j = 0
            for i in range(runs):
                u, end = starts[i], starts[i + 1]
                k = keys[u]
                e = np.int64(-1)
                if k >= 0:
                    lab = np.int64(0) if soft else np.int64(labels[v, u])
                    if runs_above > 0:
                        while above[j + 1] <= u:
                            j += 1
                        if keys_above[u] == k and (soft or labels[v - 1, u] == labels[v, u]):
                            e = np.int64(found_above[j])
                        elif keys_above[end - 1] == k and (soft or labels[v - 1, end - 1] == labels[v, u]):
                            while above[j + 1] < end:
                                j += 1
                            e = np.int64(found_above[j])
                    if e < 0:
                        at = np.int64(mix(k + (lab << 44)) & np.uint64(mask))
                        while slot[at] >= 0 and not (key[first + slot[at]] == k and label[first + slot[at]] == lab):
                            at = (at + 1) & mask
                        e = np.int64(slot[at])
                    if e < 0 and n == room:
                        full = True
                        break
                    if e < 0:
                        e = n
                        slot[at] = e
                        key[first + e] = k
                        label[first + e] = lab
                        count[first + e] = 0
                        highest[band] = max(highest[band], lab)
                        n += 1
                        if 2 * n > mask:
                            mask = 2 * mask + 1
                            _refill(slot, mask, key, label, first, n)
                    count[first + e] += end - u
                found[i] = e
                if soft:
                    where[v * W + u : v * W + end] = e
            keys, keys_above = keys_above, keys
            starts, above = above, starts
            found, found_above = found_above, found
            runs_above = runs
        entries[band] = -1 if full else n
        for e in range(n):
            spread[band, partition_of(key[first + e])] += 1


@serial
def _refill(slot, mask, key, label, first, n):
    slot[: mask + 1] = -1
    for e in range(n):
        at = np.int64(mix(key[first + e] + (np.int64(label[first + e]) << 44)) & np.uint64(mask))
        while slot[at] >= 0:
            at = (at + 1) & mask
        slot[at] = e
