"""Compiled loops over the pixels of a frame and over its observations.

The image is cut into bands of rows, and the observed voxels into partitions by a hash of their key. How many there are
of either depends on the image only, never on the number of threads, and every sum runs in one fixed order: the same
frame gives the same numbers for any number of threads.
"""

from __future__ import annotations

import sys

import numba as nb
import numpy as np

PARTITIONS = 64
HALF = 1 << 20
"""Voxel indices are packed with 21 bits an axis: they reach 2^20 voxels to either side of the map's origin."""
BLOCK = 256
"""Pixels whose keys are computed again where one of them is in doubt."""

if sys.platform == "linux":  # the TBB that Open3D loads is too old for numba, which would say so each time
    nb.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]

serial = nb.njit(cache=True, error_model="numpy", nogil=True)
parallel = nb.njit(cache=True, error_model="numpy", nogil=True, parallel=True)


@serial
def mix(key):
    """The finaliser of splitmix64: every bit of the key moves every bit of the hash."""
    x = np.uint64(key)
    x ^= x >> np.uint64(30)
    x *= np.uint64(0xBF58476D1CE4E5B9)
    x ^= x >> np.uint64(27)
    x *= np.uint64(0x94D049BB133111EB)
    x ^= x >> np.uint64(31)
    return x


@serial
def partition_of(key):
    """The partition of a key: the top 6 bits of its hash."""
    return np.int64(mix(key) >> np.uint64(58))


@serial
def exact_keys_of_row(depth, labels, ray_x, ray_y, T, size, ox, oy, oz, ignore, out):
    """Packed keys of a row of pixels, -1 where a pixel does not count; returns 1 where one is out of reach, else 0.

    One loop without branches, which the compiler turns into vector instructions.
    """
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    low, high = -float(HALF), float(HALF - 1)
    lost = 0
    for u in range(depth.shape[0]):
        d = np.float64(depth[u])
        ok = (d > 0.0) & (d < np.inf) & (labels[u] != ignore)
        d = d if ok else 0.0
        x = ray_x[u] * d
        y = ray_y * d
        a = np.floor((((r00 * x + r01 * y) + r02 * d) + t0) / size) - ox
        b = np.floor((((r10 * x + r11 * y) + r12 * d) + t1) / size) - oy
        c = np.floor((((r20 * x + r21 * y) + r22 * d) + t2) / size) - oz
        near = (a >= low) & (a <= high) & (b >= low) & (b <= high) & (c >= low) & (c <= high)
        lost |= 1 if ok & (not near) else 0
        good = ok & near
        i = np.int64(np.int32(a if good else 0.0)) + HALF
        j = np.int64(np.int32(b if good else 0.0)) + HALF
        k = np.int64(np.int32(c if good else 0.0)) + HALF
        out[u] = ((i << 42) | (j << 21) | k) if good else -1
    return lost


@nb.njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract"})
def _keys_fused(depth, labels, ignore, ray_a, ray_b, ray_c, a0, b0, c0, ta, tb, tc, margin, out):
    """Packed keys of pixels at depth (ray + a0) + ta along each axis, -1 where one does not count; and any doubt.

    In doubt is a point out of reach, or within `margin` of a voxel's face: here it is rounded otherwise than by the
    protocol's expression, which has divisions, and may lie on the other side.
    """
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
        out[u] = ((i << 42) | (j << 21) | k) if ok else -1
    return doubt | (outside >> 21)


@serial
def keys_of_row(depth, labels, ray_x, ray_y, T, size, ox, oy, oz, ignore, rays, margin, out):
    """What `exact_keys_of_row` returns, with the same keys in less time; `frame_terms` makes rays and margin."""
    a0 = (T[0, 1] * ray_y + T[0, 2]) / size
    b0 = (T[1, 1] * ray_y + T[1, 2]) / size
    c0 = (T[2, 1] * ray_y + T[2, 2]) / size
    ta, tb, tc = T[0, 3] / size - ox + HALF, T[1, 3] / size - oy + HALF, T[2, 3] / size - oz + HALF
    lost = 0
    for first in range(0, depth.shape[0], BLOCK):
        to = min(first + BLOCK, depth.shape[0])
        d, lab, keys = depth[first:to], labels[first:to], out[first:to]
        ray_a, ray_b, ray_c = rays[0, first:to], rays[1, first:to], rays[2, first:to]
        if _keys_fused(d, lab, ignore, ray_a, ray_b, ray_c, a0, b0, c0, ta, tb, tc, margin, keys):
            lost |= exact_keys_of_row(d, lab, ray_x[first:to], ray_y, T, size, ox, oy, oz, ignore, keys)
    return lost


def frame_terms(ray_x, T, size):
    """Rays (3, W) of the columns along the world's axes, in voxels a metre of depth, and the margin of `_keys_fused`.

    The margin bounds what rounding can move a point by, voxels. Of a point within reach no term is above
    2^23 + |t| / r voxels, and each of a dozen operations rounds its result by 2^-53 of that at most.
    """
    rays = T[:3, :1] * ray_x / size
    return rays, 2.0**-49 * (8.0 * HALF + float(np.abs(T[:3, 3]).max()) / size)


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


@parallel
def sum_scores(scores, where, rows, base, sums):
    """Add each pixel's normalised scores to its entry."""
    H, W, K = scores.shape
    for band in nb.prange(base.shape[0] - 1):
        for v in range(band * rows, min(H, (band + 1) * rows)):
            for u in range(W):
                if where[v, u] >= 0:
                    e = base[band] + where[v, u]
                    total = 0.0
                    for k in range(K):
                        total += np.float64(scores[v, u, k])
                    for k in range(K):
                        sums[e, k] += np.float64(scores[v, u, k]) / total


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
