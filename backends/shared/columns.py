"""Compiled update of dense voxel columns with a frame's observations."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from semstab.backends.shared.beliefs import observe_few
from semstab.backends.shared.keys import PARTITIONS, mix
from semstab.backends.shared.observations import BeliefChange, Change, Observed
from semstab.backends.shared.pixel_keys import AHEAD, bits_of, touch
from semstab.backends.shared.score_loops import LANES
from semstab.core.compiled import compiled, parallel, serial
from semstab.core.types import Int32, Int64
from semstab.data.measures import RECURRENT

WORD = 64
"""Classes whose bits are in one number of a row's mask."""


def mask_words(num_classes: int) -> int:
    """Return the numbers of a mask."""
    return -(-num_classes // WORD)


@compiled(forceinline=True)
def lowest_bit(mask):
    """Return the position of the lowest bit of an int64 that is not 0: the exponent of that bit as a double."""
    return ((bits_of(np.float64(mask & -mask)) >> 52) & 0x7FF) - 1023


def update_rows(rows: Int64, observed: Observed, frame: int, **columns: Any) -> tuple[Change, BeliefChange]:
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
        rows, chunks, observed.start, observed.label, observed.weight, observed.pixels, frame, sums,
        columns["evidence"], columns["classes"], columns["op"], columns["drift_sum"], columns["pixels"],
        columns["first_frame"], columns["last_frame"], columns["self_sum"], columns["frame_entropy_sum"], *changed,
    )  # fmt: skip
    vss, entropy, drift, new, recurrent = sums.sum(axis=0)
    return Change.from_sums((observed.pixels.sum(), len(rows), new, drift, vss, entropy, recurrent)), changed


@compiled(helper=True, forceinline=True)
def _touch_evidence(flat, masks, r, K, words, label, first, end):
    """Ask for the evidence of a row: of the classes that it has seen, and of those that the frame has seen there."""
    for e in range(first, end):
        touch(flat, r * K + label[e])
    for word in range(words):
        left = masks[r * words + word]
        while left != 0:
            touch(flat, r * K + word * WORD + lowest_bit(left))
            left &= left - 1


@compiled(helper=True, forceinline=True)
def _observe_classes(evidence, classes, s, few, of, op, out):
    """Add one observation to the evidence (K,) of a row; see `observe_row`.

    - `classes`: the bits of the classes that the row or the frame has seen
    - `s`: s_bar of the frame (K,), which is 0 again in the end
    - `few`, `of`: work space, all 0, for the evidence and the shares of these classes, see `observe_few`, and which
    """
    some, shares = few[0], few[1]
    n, most, dominant = 0, -1.0, np.int64(0)
    for word in range(classes.shape[0]):
        left = classes[word]
        while left != 0:
            k = word * WORD + lowest_bit(left)
            left &= left - 1
            some[n], shares[n], of[n] = evidence[k], s[k], k
            s[k] = 0.0
            dominant, most = k if some[n] > most else dominant, max(some[n], most)
            n += 1
    observe_few(some, shares, n, op, most, out)
    out[3] = dominant
    most = -1.0
    for c in range(n):
        evidence[of[c]] = some[c]
        dominant, most = of[c] if some[c] > most else dominant, max(some[c], most)
        some[c] = shares[c] = 0.0
    out[4] = dominant


@parallel
def _update_rows(
    rows, chunks, start, label, weight, seen_pixels, frame, sums, evidence, classes, op, drift_sum, pixels,
    first_frame, last_frame, self_sum, frame_entropy_sum, drift_of, class_before, class_after,
):  # fmt: skip
    K = evidence.shape[1]
    room = -(-K // LANES) * LANES
    flat, masks = evidence.reshape(-1), classes.reshape(-1)
    words = classes.shape[1]
    for chunk in nb.prange(PARTITIONS):
        s, few, of, out = np.zeros(K), np.zeros((2, room)), np.zeros(room, np.int64), np.zeros(8)
        vss = entropy = drifted = 0.0
        new = recurrent = 0
        last = chunks[chunk + 1] - 1
        for i in range(chunks[chunk], chunks[chunk + 1]):
            later = min(i + AHEAD, last)
            ahead = rows[later]
            touch(masks, rows[min(i + 2 * AHEAD, last)] * words)
            _touch_evidence(flat, masks, ahead, K, words, label, start[later], start[later + 1])
            touch(op, ahead)
            touch(drift_sum, ahead)
            touch(pixels, ahead)
            touch(first_frame, ahead)
            touch(last_frame, ahead)
            touch(self_sum, ahead)
            touch(frame_entropy_sum, ahead)
            r, T = rows[i], op[rows[i]]
            for e in range(start[i], start[i + 1]):
                classes[r, label[e] // WORD] |= np.int64(1) << np.int64(label[e] % WORD)
            if start[i + 1] - start[i] == 1 and evidence[r, label[start[i]]] == T:  # of one class, as the frame has it
                evidence[r, label[start[i]]] += 1.0
                self_sum[r] += 1.0
                vss += 1.0 if T == 0 else 0.0
                drift_of[i] = 0.0
                class_before[i] = class_after[i] = label[start[i]]
            else:
                for e in range(start[i], start[i + 1]):
                    s[label[e]] = weight[e] / seen_pixels[i]
                _observe_classes(evidence[r], classes[r], s, few, of, np.int64(T), out)
                vss += out[0]
                entropy += out[1]
                drifted += out[2]
                drift_sum[r] += out[2]
                self_sum[r] += out[5]
                frame_entropy_sum[r] += out[6]
                drift_of[i] = out[2]
                class_before[i], class_after[i] = np.uint16(out[3]), np.uint16(out[4])
            if T == 0:
                new += 1
                drift_of[i] = np.nan
                class_before[i] = class_after[i]
                first_frame[r] = last_frame[r] = frame
            first_frame[r], last_frame[r] = min(first_frame[r], frame), max(last_frame[r], frame)
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
    shift = resolution.bit_length() - 1
    n = _number(index, resolution, shift if resolution == 1 << shift else -1, blocks, block, offset, slots)
    return blocks[:n], block, offset


@serial
def _number(index, r, shift, blocks, block, offset, slots):
    """Number the blocks in order of appearance, and return how many there are; a shift of 0 or more: r is 2^shift."""
    mask = slots.shape[0] - 1
    n = 0
    for v in range(index.shape[0]):
        x, y, z = index[v, 0], index[v, 1], index[v, 2]
        if shift >= 0:
            a, b, c = x >> shift, y >> shift, z >> shift
        else:
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
