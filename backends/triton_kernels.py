"""The Triton kernels behind `triton_launch`, which says what their arguments are.

Pixels enter a hash of the view's own by atomic maxima: a key takes a slot from a smaller one, which moves on to the
next. Where all have settled, each key lies in a slot that depends on the set of keys only (Shun and Blelloch 2014,
Phase-concurrent hash tables for determinism, SPAA), so that voxels are numbered alike run after run, without a sort.
A slot's key only ever grows, so that a value read too early sends nobody the wrong way.
"""

from __future__ import annotations

import triton
import triton.language as tl

from semstab.backends import torch_eager, torch_storage
from semstab.backends.shared import keys
from semstab.model.results import RECURRENT

NONE = tl.constexpr(torch_eager.NONE)
LOST = tl.constexpr(torch_eager.LOST)
EMPTY = tl.constexpr(torch_storage.EMPTY)
HALF = tl.constexpr(keys.HALF)
NEVER = tl.constexpr(-3)
THIRD_OBSERVATION = tl.constexpr(RECURRENT)


@triton.jit
def _mix(key):
    """The finaliser of splitmix64, as `eager.mix`."""
    x = key.to(tl.uint64)
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB
    return (x ^ (x >> 31)).to(tl.int64)


# --- Pixels to voxels -------------------------------------------------------------------------------------------------


@triton.jit
def insert_pixels(
    depth, ray_x, ray_y, camera, keys, table, mask, overflow, width, PROBES: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """Write the pixels' packed keys and put them into the table: the protocol's order of operations, in float64.

    camera points to the pose (3, 4); the voxel size and the map's origin lie behind it (`camera_terms`).
    """
    u, v, inside, d, ok = _pixels(depth, width, BLOCK)
    d = d.to(tl.float64)
    x = tl.load(ray_x + u, mask=inside, other=0.0) * d
    y = tl.load(ray_y + v) * d
    i = _axis(camera, 0, x, y, d)
    j = _axis(camera, 1, x, y, d)
    k = _axis(camera, 2, x, y, d)
    key = _packed(i, j, k, ok)
    tl.store(keys + v.to(tl.int64) * width + u, key, mask=inside)
    _put(key, table, mask, overflow, PROBES)


@triton.jit
def _axis(camera, axis: tl.constexpr, x, y, d):
    """floor((((R0 x + R1 y) + R2 d) + t) / r) - origin."""
    row = camera + 4 * axis
    w = ((tl.load(row) * x + tl.load(row + 1) * y) + tl.load(row + 2) * d) + tl.load(row + 3)
    return tl.floor(w / tl.load(camera + 12)) - tl.load(camera + 13 + axis)


@triton.jit
def insert_pixels_single(
    depth, a, b, start, keys, table, mask, overflow, width, PROBES: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """The same in float32. The offset to the map's origin lies behind start (`camera_terms_single`)."""
    u, v, inside, d, ok = _pixels(depth, width, BLOCK)
    i = _axis_single(a, b, start, 0, d, u, v, inside, width)
    j = _axis_single(a, b, start, 1, d, u, v, inside, width)
    k = _axis_single(a, b, start, 2, d, u, v, inside, width)
    key = _packed(i, j, k, ok)
    tl.store(keys + v.to(tl.int64) * width + u, key, mask=inside)
    _put(key, table, mask, overflow, PROBES)


@triton.jit
def _axis_single(a, b, start, axis: tl.constexpr, d, u, v, inside, width):
    """floor(d (a + b) + start) + offset."""
    ray = tl.load(a + axis * width + u, mask=inside, other=0.0) + tl.load(b + axis * tl.num_programs(1) + v)
    return tl.floor(d * ray + tl.load(start + axis)) + tl.load(start + 3 + axis)


@triton.jit
def _pixels(depth, width, BLOCK: tl.constexpr):
    """Columns, row and depth of a block of pixels of one row, 0 where there is none, and which have one."""
    u = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    v = tl.program_id(1)
    inside = u < width
    d = tl.load(depth + v.to(tl.int64) * width + u, mask=inside, other=0.0)
    ok = (d > 0.0) & (d < float("inf"))
    return u, v, inside, tl.where(ok, d, 0.0), ok


@triton.jit
def _packed(i, j, k, ok):
    """21 bits an axis; NONE where a pixel has no depth, LOST where it is out of reach."""
    near = (i >= -HALF) & (i < HALF) & (j >= -HALF) & (j < HALF) & (k >= -HALF) & (k < HALF)
    i = tl.where(near, i, 0.0).to(tl.int64) + HALF
    j = tl.where(near, j, 0.0).to(tl.int64) + HALF
    k = tl.where(near, k, 0.0).to(tl.int64) + HALF
    key = tl.where(near, (i << 42) | (j << 21) | k, LOST)
    return tl.where(ok, key, NONE)


@triton.jit
def _put(key, table, mask, overflow, PROBES: tl.constexpr):
    """Put keys into the table, those that are none left out; a key moves on with what it pushes out of its slot."""
    todo = key >= 0
    at = _mix(key) & mask
    step = 0
    while (tl.max(todo.to(tl.int32), axis=0) > 0) & (step < PROBES):
        seen = tl.load(table + at, mask=todo, other=0)
        takes = todo & (seen < key)
        old = tl.atomic_max(table + at, key, mask=takes, sem="relaxed")
        took = takes & (old < key)
        settled = (seen == key) | (takes & (old == key)) | (took & (old == EMPTY))
        key = tl.where(took, old, key)
        todo = todo & ~settled
        at = tl.where(todo, (at + 1) & mask, at)
        step += 1
    tl.atomic_max(overflow + tl.zeros_like(at), todo.to(tl.int32), mask=todo, sem="relaxed")


@triton.jit
def list_keys(table, place, keys, slots, BLOCK: tl.constexpr):
    """The keys in use, each at its place."""
    slot = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    key = tl.load(table + slot, mask=slot < slots, other=EMPTY)
    used = key != EMPTY
    tl.store(keys + tl.load(place + slot, mask=used, other=1) - 1, key, mask=used)


@triton.jit
def number_pixels(keys, table, place, voxel, mask, pixels, BLOCK: tl.constexpr):
    """Each pixel's voxel: the place of its key."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    key = tl.load(keys + i, mask=i < pixels, other=NONE)
    at = _mix(key) & mask
    todo = key >= 0
    while tl.max(todo.to(tl.int32), axis=0) > 0:
        todo = todo & (tl.load(table + at, mask=todo, other=0) != key)
        at = tl.where(todo, (at + 1) & mask, at)
    number = tl.load(place + at, mask=key >= 0, other=0) - 1
    tl.store(voxel + i, tl.where(key >= 0, number, key.to(tl.int32)), mask=i < pixels)


# --- Evidence ---------------------------------------------------------------------------------------------------------


@triton.jit(do_not_specialize=["n"])
def add_labels(voxels, ids, sums, flags, pixels, n, ignore, K: tl.constexpr, BLOCK: tl.constexpr):
    """Add up pixels by voxel and label, a run of equal ones at a time.

    Between two runs, the one that ends gains its last pixel's position, and the next one loses it.
    """
    place = tl.arange(0, BLOCK)
    i = tl.program_id(0) * BLOCK + place
    here, voxel, label, given = _bin(voxels, ids, i, i < pixels, n, ignore, K)
    after, _, _, _ = _bin(voxels, ids, i + 1, (i + 1 < pixels) & (place + 1 < BLOCK), n, ignore, K)
    ends = here != after
    tl.atomic_add(sums + here, place + 1, mask=ends & (here >= 0), sem="relaxed")
    tl.atomic_add(sums + after, -(place + 1), mask=ends & (after >= 0), sem="relaxed")
    top = tl.max(tl.where(given, label, -1), axis=0)
    if top >= K:
        tl.atomic_max(flags, top, sem="relaxed")
    _flag(flags + 1, given & (voxel == LOST))


@triton.jit
def _flag(flag, found):
    """Set a flag where anything is found; seldom, since all programs set the same one."""
    if tl.max(found.to(tl.int32), axis=0) > 0:
        tl.atomic_max(flag, tl.full((), 1, tl.int64), sem="relaxed")


@triton.jit
def _bin(voxels, ids, i, inside, n, ignore, K: tl.constexpr):
    """Place of a pixel's voxel and label in (K, n), -1 where it counts nowhere; these, and whether it has both."""
    voxel = tl.load(voxels + i, mask=inside, other=NONE)
    label = tl.load(ids + i, mask=inside, other=0).to(tl.int64)
    given = inside & (label >= 0) & (label != ignore) & (voxel != NONE)
    place = tl.where(given & (voxel >= 0) & (label < K), label * n + voxel, -1)
    return place, voxel, label, given


@triton.jit(do_not_specialize=["n"])
def add_scores(
    voxels, values, stride_k, stride_p, sums, pixel_counts, flags, height, width, n, scale, K: tl.constexpr,
    SOFTMAX: tl.constexpr, DOUBLE: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr, CLASSES: tl.constexpr,
):  # fmt: skip
    """Normalise the scores of a tile of the image and add them up by voxel, going down its columns row by row.

    A column keeps the sums (CLASSES,) of the voxel that it is in, and hands them over where it leaves the voxel. The
    tile is (CLASSES, COLUMNS), so that a warp reads neighbours and a thread has a pixel's classes in its registers.
    """
    u = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    first = tl.program_id(1) * ROWS
    k = tl.arange(0, CLASSES)[:, None]
    number = tl.int64 if DOUBLE else tl.int32
    here = tl.full((COLUMNS,), NONE, tl.int32)
    units = tl.zeros((CLASSES, COLUMNS), number)
    count = tl.zeros((COLUMNS,), tl.int32)
    lost_any = tl.zeros((COLUMNS,), tl.int32)
    below = tl.zeros((COLUMNS,), tl.int32)
    for row in range(ROWS):
        v = first + row
        inside = u < tl.where(v < height, width, 0)
        at = u + v * width
        voxel = tl.load(voxels + at, mask=inside, other=NONE)
        cells = values + (at.to(tl.int64) * stride_p)[None, :] + k.to(tl.int64) * stride_k
        x = tl.load(cells, mask=inside[None, :] & (k < K), other=0.0)
        x = x.to(tl.float64) if DOUBLE else x.to(tl.float32)
        if SOFTMAX:
            x = tl.where(k < K, x, float("-inf"))
            x = tl.exp(x - tl.max(x, axis=0)[None, :])
        else:
            below = below | tl.max(((x < 0.0) & (x > float("-inf"))).to(tl.int32), axis=0)
        total = tl.sum(x, axis=0)
        usable = (total > 0.0) & (total < float("inf")) & (voxel != NONE)
        lost_any = lost_any | (usable & (voxel == LOST)).to(tl.int32)
        units_of_pixel = x * (scale / tl.where(usable, total, 1.0))[None, :] + 0.5
        leaves = voxel != here
        _hand_over(sums, pixel_counts, here, units, count, leaves & (here >= 0), k, K, n)
        units = tl.where(leaves[None, :], 0, units)
        units += tl.where(usable[None, :], tl.floor(units_of_pixel), 0.0).to(number)
        count = tl.where(leaves, 0, count) + usable.to(tl.int32)
        here = voxel
    _hand_over(sums, pixel_counts, here, units, count, here >= 0, k, K, n)
    _flag(flags + 1, lost_any > 0)
    _flag(flags + 2, below > 0)


@triton.jit
def _hand_over(sums, pixel_counts, voxel, units, count, mask, k, K: tl.constexpr, n):
    """Add the sums of columns to those of the voxels that they were in."""
    cells = sums + k.to(tl.int64) * n + voxel[None, :]
    tl.atomic_add(cells, units.to(tl.int64), mask=mask[None, :] & (k < K), sem="relaxed")
    tl.atomic_add(pixel_counts + voxel, count.to(tl.int64), mask=mask, sem="relaxed")


# --- The map ----------------------------------------------------------------------------------------------------------


@triton.jit(do_not_specialize=["n"])
def find_rows(slot_keys, slot_rows, keys, rows, mask, n, BLOCK: tl.constexpr):
    """The row of each key, or EMPTY: from its slot on, to the key or to a free slot."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    key = tl.load(keys + i, mask=i < n, other=EMPTY)
    at = _mix(key) & mask
    todo = i < n
    row = tl.full((BLOCK,), EMPTY, tl.int64)
    while tl.max(todo.to(tl.int32), axis=0) > 0:
        seen = tl.load(slot_keys + at, mask=todo, other=EMPTY)
        hit = todo & (seen == key)
        row = tl.where(hit, tl.load(slot_rows + at, mask=hit, other=0).to(tl.int64), row)
        todo = todo & (seen != key) & (seen != EMPTY)
        at = tl.where(todo, (at + 1) & mask, at)
    tl.store(rows + i, row, mask=i < n)


@triton.jit(do_not_specialize=["n", "first"])
def insert_rows(slot_keys, slot_rows, keys, rows, first, mask, n, BLOCK: tl.constexpr):
    """Claim a free slot for each key. Triton compares and swaps without a mask: who is done compares with NEVER."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    key = tl.load(keys + i, mask=i < n, other=EMPTY)
    row = tl.load(rows + i, mask=i < n, other=0).to(tl.int32)
    at = _mix(key) & mask
    todo = (key != EMPTY) & (row >= first)
    while tl.max(todo.to(tl.int32), axis=0) > 0:
        old = tl.atomic_cas(slot_keys + at, tl.where(todo, EMPTY, NEVER).to(tl.int64), key, sem="relaxed")
        placed = todo & (old == EMPTY)
        tl.store(slot_rows + at, row, mask=placed)
        todo = todo & (old != EMPTY)
        at = tl.where(todo, (at + 1) & mask, at)


@triton.jit(do_not_specialize=["n", "frame"])
def observe(
    rows, counts, seen_pixels, scale, evidence, ops, pixels, drift_sum, self_sum, frame_entropy_sum, first_frame,
    last_frame, sums, frame, n, K: tl.constexpr, BLOCK: tl.constexpr, CLASSES: tl.constexpr, SUMS: tl.constexpr,
):  # fmt: skip
    """Add one observation to a block of voxels, CLASSES at a time; sums (programs, SUMS) are those of `eager`."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    count = tl.load(seen_pixels + i, mask=i < n, other=0)
    seen = count > 0
    row = tl.load(rows + i, mask=seen, other=0)
    op = tl.load(ops + row, mask=seen, other=0)
    new = seen & (op == 0)
    times = op.to(tl.float64)
    weight = tl.maximum(count, 1).to(tl.float64) * scale
    zero = tl.zeros((BLOCK,), tl.float64)
    top_p, top_q, entropy_p, entropy_q, entropy_m, entropy_s, squares = zero, zero, zero, zero, zero, zero, zero
    for first in range(0, K, CLASSES):
        k = first + tl.arange(0, CLASSES)
        cell = seen[:, None] & (k < K)[None, :]
        s_bar = tl.load(counts + k.to(tl.int64)[None, :] * n + i[:, None], mask=cell, other=0).to(tl.float64)
        s_bar = s_bar / weight[:, None]
        cells = evidence + row[:, None] * K + k[None, :]
        before = tl.load(cells, mask=cell, other=0.0)
        after = (before.to(tl.float64) + s_bar).to(before.dtype)
        tl.store(cells, after, mask=cell)
        p = before.to(tl.float64) / tl.maximum(times, 1.0)[:, None]
        q = after.to(tl.float64) / (times + 1.0)[:, None]
        top_p = tl.maximum(top_p, tl.max(p, axis=1))
        top_q = tl.maximum(top_q, tl.max(q, axis=1))
        entropy_p += _entropy_bits(p)
        entropy_q += _entropy_bits(q)
        entropy_m += _entropy_bits((p + q) * 0.5)
        entropy_s += _entropy_bits(s_bar)
        squares += tl.sum(s_bar * s_bar, axis=1)
    divergence = entropy_m - (entropy_p + entropy_q) * 0.5
    drift = tl.where(seen & ~new, tl.minimum(tl.maximum(divergence, 0.0), 1.0), 0.0)
    tl.store(ops + row, op + 1, mask=seen)
    _add(pixels + row, count, seen)
    _add(drift_sum + row, drift, seen)
    _add(self_sum + row, squares, seen)
    _add(frame_entropy_sum + row, entropy_s, seen)
    lowest, highest = tl.load(first_frame + row, mask=seen, other=0), tl.load(last_frame + row, mask=seen, other=0)
    tl.store(first_frame + row, tl.where(new, frame, tl.minimum(lowest, frame)), mask=seen)
    tl.store(last_frame + row, tl.where(new, frame, tl.maximum(highest, frame)), mask=seen)
    out = sums + tl.program_id(0) * SUMS
    tl.store(out, tl.sum(count, axis=0).to(tl.float64))
    tl.store(out + 1, tl.sum(seen.to(tl.int32), axis=0).to(tl.float64))
    tl.store(out + 2, tl.sum(new.to(tl.int32), axis=0).to(tl.float64))
    tl.store(out + 3, tl.sum(drift, axis=0))
    tl.store(out + 4, tl.sum(top_q - top_p, axis=0))
    tl.store(out + 5, tl.sum(entropy_q - entropy_p, axis=0))
    tl.store(out + 6, tl.sum((seen & (op + 1 == THIRD_OBSERVATION)).to(tl.int32), axis=0).to(tl.float64))


@triton.jit
def _entropy_bits(p):
    """Shannon entropy of distributions (BLOCK, CLASSES), in bits."""
    return -tl.sum(tl.where(p > 0.0, p * tl.log2(tl.where(p > 0.0, p, 1.0)), 0.0), axis=1)


@triton.jit
def _add(cells, values, mask):
    tl.store(cells, tl.load(cells, mask=mask, other=0) + values, mask=mask)
