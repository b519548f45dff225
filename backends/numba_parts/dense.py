"""Compiled loops that add soft scores to the numba backend's map: to dense rows of evidence, one a voxel."""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.backends.numba_parts.loops import ALONE, DENSE, begin, observe_dense
from semstab.backends.shared.beliefs import plogp
from semstab.backends.shared.hashing import PARTITIONS
from semstab.backends.shared.prefetch import AHEAD, touch
from semstab.model.results import RECURRENT
from semstab.runtime.compiled import parallel, serial


@parallel
def count_rows(row, bounds, records, needed):
    """How many of the frame's voxels have no dense row yet, by partition."""
    for p in nb.prange(PARTITIONS):
        n = 0
        for v in range(bounds[p], bounds[p + 1]):
            touch(records, max(row[min(v + AHEAD, bounds[p + 1] - 1)], 0))
            n += row[v] < 0 or records[max(row[v], 0)].next > DENSE
        needed[p] = n


@parallel
def update_dense(
    key, pixels, seen, seen_sums, bounds, frame, row, slot, base, dense_base, slots, records, nodes, dense, sums,
    drift_of, dominant_before, dominant_after,
):  # fmt: skip
    """Add the frame's observations, whose voxels get dense rows from `dense_base` of their partition on.

    seen, seen_sums  row and sums of `ObservedScores`; the others as in `update`
    """
    stride = dense.shape[1]
    flat = dense.reshape(-1)
    for p in nb.prange(PARTITIONS):
        out = np.zeros(8)
        vss = entropy = drift = 0.0
        reached = 0
        free = dense_base[p]
        for v in range(bounds[p], bounds[p + 1]):
            _touch_ahead(v, bounds[p + 1] - 1, row, records, flat, stride, seen, seen_sums)
            r = row[v]
            if r < 0:
                r = base[p] - r - 1
                row[v] = r
                slots[p, slot[v]].row = r
                begin(records[r], key[v], 0, frame)
            record = records[r]
            if record.next > DENSE:
                _unroll(record, nodes, dense[free])
                record.next = DENSE - free
                free += 1
            op = record.op
            observe_dense(record, dense[DENSE - record.next], seen_sums[seen[v] : seen[v] + stride], pixels[v], out)
            vss += out[0]
            entropy += out[1]
            drift += out[2]
            record.drift_sum += out[2]
            record.self_sum += out[5]
            record.frame_entropy_sum += out[6]
            drift_of[v] = out[2] if op > 0 else np.nan
            dominant_before[v], dominant_after[v] = np.uint16(out[3 if op > 0 else 4]), np.uint16(out[4])
            record.op = op + 1
            record.pixels += pixels[v]
            record.first_frame = min(record.first_frame, frame)
            record.last_frame = max(record.last_frame, frame)
            reached += 1 if op + 1 == RECURRENT else 0
        sums[p, 0], sums[p, 1], sums[p, 2], sums[p, 3] = vss, entropy, drift, reached


@serial
def _touch_ahead(v, last, row, records, flat, stride, seen, seen_sums):
    later = max(row[min(v + AHEAD, last)], 0)
    touch(records, later)
    touch(records, later + 1)
    soon = min(v + AHEAD // 2, last)
    place = max(DENSE - np.int64(records[max(row[soon], 0)].next), 0) * stride
    for k in range(0, stride, 8):
        touch(seen_sums, seen[soon] + k)
        touch(flat, place + k)


@serial
def _unroll(record, nodes, evidence):
    """The evidence of a voxel without a dense row into an unused one; its nodes are not used again."""
    evidence[:] = 0.0
    if record.op == 0:
        return
    evidence[record.label] = record.value
    at = np.int64(record.next)
    while at > ALONE:
        evidence[nodes[at].label] = nodes[at].value
        at = np.int64(nodes[at].next)
    record.label = np.argmax(evidence)
    total = 0.0
    for k in range(evidence.shape[0]):
        total += plogp(evidence[k] / record.op)
    record.value = total
