"""Compiled update of dense voxel columns with a frame's observations."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from semstab.backends.shared.beliefs import plogp, plogp_unseen
from semstab.backends.shared.keys import PARTITIONS, mix
from semstab.backends.shared.observations import BeliefChange, Change, Observed
from semstab.backends.shared.pixel_keys import AHEAD, touch
from semstab.core.compiled import parallel, serial
from semstab.core.types import Int32, Int64
from semstab.data.results import RECURRENT

WORD = 64
"""Classes whose bits are in one number of a row's mask."""


def mask_words(num_classes: int) -> int:
    """Return the numbers of a mask."""
    return -(-num_classes // WORD)


@intrinsic
def _lowest(_typing: Any, _mask: Any) -> Any:
    """Return the position of the lowest bit of an int64 that is not 0."""
    signature = types.int64(types.int64)
    return signature, lambda _, builder, __, given: builder.cttz(given[0], ir.Constant(ir.IntType(1), 1))


def update_rows(rows: Int64, seen: Observed, frame: int, **columns: Any) -> tuple[Change, BeliefChange]:
    """Add a frame's observations to rows of dense columns, in place.

    columns are evidence (N, K), classes (N, `mask_words`), whose bits tell which evidence is not 0, and the others of
    VoxelTable (N,), all 0 in rows not seen before. So a row costs the classes that it has seen, not K.

    Returns:
        The change of the map, and that of the belief of each row.
    """
    chunks = np.linspace(0, len(rows), PARTITIONS + 1).astype(np.int64)
    sums = np.zeros((PARTITIONS, 5))
    changed = BeliefChange.room(len(rows))
    _update_rows(
        rows, chunks, seen.start, seen.label, seen.weight, seen.pixels, frame, sums, columns["evidence"],
        columns["classes"], columns["op"], columns["drift_sum"], columns["pixels"], columns["first_frame"],
        columns["last_frame"], columns["self_sum"], columns["frame_entropy_sum"], *changed,
    )  # fmt: skip
    vss, entropy, drift, new, recurrent = sums.sum(axis=0)
    return Change.of((seen.pixels.sum(), len(rows), new, drift, vss, entropy, recurrent)), changed


@parallel
def _update_rows(
    rows, chunks, start, label, weight, seen_pixels, frame, sums, evidence, classes, op, drift_sum, pixels,
    first_frame, last_frame, self_sum, frame_entropy_sum, drift_of, class_before, class_after,
):  # fmt: skip
    K = evidence.shape[1]
    flat, masks = evidence.reshape(-1), classes.reshape(-1)
    words = classes.shape[1]
    for chunk in nb.prange(PARTITIONS):
        s = np.zeros(K)
        vss = entropy = drifted = 0.0
        new = recurrent = 0
        for i in range(chunks[chunk], chunks[chunk + 1]):
            later = min(i + AHEAD, chunks[chunk + 1] - 1)
            ahead = rows[later]
            touch(op, ahead)
            touch(flat, ahead * K + label[start[later]])
            touch(masks, ahead * words)
            touch(drift_sum, ahead)
            touch(pixels, ahead)
            touch(first_frame, ahead)
            touch(last_frame, ahead)
            touch(self_sum, ahead)
            touch(frame_entropy_sum, ahead)
            r = rows[i]
            T = op[r]
            for e in range(start[i], start[i + 1]):
                k = np.int64(label[e])
                share = weight[e] / seen_pixels[i]
                s[k] = share
                classes[r, k // WORD] |= np.int64(1) << (k % WORD)
                self_sum[r] += share * share
                frame_entropy_sum[r] -= plogp(share) if share != 1.0 else 0.0
            most_before = most_after = plogp_before = plogp_between = plogp_after = unseen = logarithms = 0.0
            before = after = np.int64(0)
            share_before, share_after = 1.0 / max(T, 1), 1.0 / (T + 1)
            for word in range(words):
                left = classes[r, word]
                while left != 0:
                    k = word * WORD + _lowest(left)
                    left &= left - 1
                    was, share = evidence[r, k], s[k]
                    value = was + share
                    evidence[r, k] = value
                    s[k] = 0.0
                    if was > most_before:
                        most_before, before = was, k
                    if value > most_after:
                        most_after, after = value, k
                    if share == 0.0:
                        unseen += value
                        logarithms += plogp(value)
                    elif was != T or share != 1.0:  # else a voxel of one class, whose belief stays
                        p, q = was * share_before, value * share_after
                        plogp_before += plogp(p)
                        plogp_between += plogp(0.5 * (p + q))
                        plogp_after += plogp(q)
            if unseen > 0.0:
                of_unseen = plogp_unseen(unseen, logarithms, np.int64(T))
                plogp_before += of_unseen[0]
                plogp_between += of_unseen[1]
                plogp_after += of_unseen[2]
            entropy += plogp_before - plogp_after
            drift = 0.0
            vss += most_after * share_after - most_before * share_before
            if T == 0:
                new += 1
                first_frame[r], last_frame[r] = frame, frame
            else:
                drift = min(max(0.5 * (plogp_before + plogp_after) - plogp_between, 0.0), 1.0)
                drifted += drift
                drift_sum[r] += drift
                first_frame[r], last_frame[r] = min(first_frame[r], frame), max(last_frame[r], frame)
            drift_of[i] = drift if T > 0 else np.nan
            class_before[i], class_after[i] = before if T > 0 else after, after
            op[r] = T + 1
            pixels[r] += seen_pixels[i]
            recurrent += 1 if T + 1 == RECURRENT else 0
        sums[chunk, 0], sums[chunk, 1], sums[chunk, 2] = vss, entropy, drifted
        sums[chunk, 3], sums[chunk, 4] = new, recurrent


# The blocks of voxels that the voxels of a frame lie in.


def blocks_of(index: Int64, resolution: int) -> tuple[Int32, Int64, Int32]:
    """Return the distinct blocks (m, 3) of voxels (n, 3), each voxel's block as a row, and its offset (x fastest)."""
    size = 1 << max(4, (2 * len(index)).bit_length())
    blocks, block = np.empty((len(index), 3), dtype=np.int32), np.empty(len(index), dtype=np.int64)
    offset, slots = np.empty(len(index), dtype=np.int32), np.full(size, -1, dtype=np.int32)
    n = _number(index, resolution, blocks, block, offset, slots)
    return blocks[:n], block, offset


@serial
def _number(index, r, blocks, block, offset, slots):
    """Number the blocks in order of appearance, and return how many there are."""
    mask = slots.shape[0] - 1
    n = 0
    for v in range(index.shape[0]):
        x, y, z = index[v, 0], index[v, 1], index[v, 2]
        a, b, c = x // r, y // r, z // r
        offset[v] = ((z - c * r) * r + (y - b * r)) * r + (x - a * r)
        at = np.int64(mix((a * 73856093) ^ (b * 19349663) ^ (c * 83492791)) & np.uint64(mask))
        while slots[at] >= 0:
            e = slots[at]
            if blocks[e, 0] == a and blocks[e, 1] == b and blocks[e, 2] == c:
                break
            at = (at + 1) & mask
        if slots[at] < 0:
            slots[at] = n
            blocks[n, 0], blocks[n, 1], blocks[n, 2] = a, b, c
            n += 1
        block[v] = slots[at]
    return n
