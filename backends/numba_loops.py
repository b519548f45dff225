"""Compiled loops over the partitions of the numba backend's map; each is updated by one thread at a time.

The `next` of a voxel's record tells the position of its evidence: `ALONE`, of one class, in the record itself; from 0
on, more of it hangs on the record as a chain of nodes that begins there; below `ALONE`, in the dense row
`DENSE - next`. Then the record holds the dominant class as its label, and the sum of p log2 p as its value.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from semstab.backends.shared.beliefs import observe_few, observe_row, plogp
from semstab.backends.shared.keys import PARTITIONS, bounds_of, mix, partition_of
from semstab.backends.shared.pixel_keys import AHEAD, touch
from semstab.core.compiled import compiled, helper, parallel, serial
from semstab.data.measures import RECURRENT

ALONE, DENSE = -1, -2

SLOT = np.dtype([("key", np.int64), ("row", np.int64)])


def record_types(evidence: Any) -> tuple[np.dtype[Any], np.dtype[Any]]:
    """Return the types of a voxel's record and of a node of its chain, for evidence of that float type."""
    record = [
        ("key", np.int64), ("pixels", np.int64), ("drift_sum", np.float64), ("self_sum", np.float64),
        ("frame_entropy_sum", np.float64), ("value", evidence), ("next", np.int32), ("op", np.int32),
        ("first_frame", np.int32), ("last_frame", np.int32), ("label", np.uint16),
    ]  # fmt: skip
    node = [("value", evidence), ("next", np.int32), ("label", np.uint16)]
    return np.dtype(record, align=True), np.dtype(node, align=True)


@serial
def most_slots(used, bounds):
    """Return the slots of a partition that may be in use once the voxels within these bounds are there, at most."""
    most = np.int64(0)
    for p in range(PARTITIONS):
        most = max(most, used[p] + bounds[p + 1] - bounds[p])
    return most


@parallel
def look_up(key, bounds, slots, used, row, slot):
    """Look up the row of each voxel; new ones enter the hash and are numbered -1, -2, ... within their partition.

    Returns the first new voxel of each partition (PARTITIONS + 1,).
    """
    new = np.empty(PARTITIONS, np.int64)
    mask = np.uint64(slots.shape[1] - 1)
    for p in nb.prange(PARTITIONS):
        n = 0
        mine, last = slots[p], bounds[p + 1]
        for v in range(bounds[p], last):
            touch(mine, np.int64(mix(key[min(v + 2 * AHEAD, last - 1)]) & mask))
            at = np.int64(mix(key[v]) & mask)
            while mine[at].row != -1 and mine[at].key != key[v]:
                at = (at + 1) & np.int64(mask)
            slot[v] = at
            if mine[at].row == -1:
                n += 1
                mine[at].key = key[v]
                mine[at].row = -1 - n
                row[v] = -n
            else:
                row[v] = mine[at].row
        new[p] = n
        used[p] += n
    return bounds_of(new)


@parallel
def rehash(old, new):
    """Enter the voxels of the slots into new ones, empty and more."""
    for p in nb.prange(PARTITIONS):
        for i in range(old.shape[1]):
            if old[p, i].row >= 0:
                _enter_one(old[p, i].key, old[p, i].row, new[p])


@serial
def enter(records, slots):
    """Enter the voxels of the records into empty slots."""
    for row in range(records.shape[0]):
        _enter_one(records[row].key, row, slots[partition_of(records[row].key)])


@compiled(helper=True, forceinline=True)
def _enter_one(key, row, slots):
    mask = np.uint64(slots.shape[0] - 1)
    at = np.int64(mix(key) & mask)
    while slots[at].row != -1:
        at = (at + 1) & np.int64(mask)
    slots[at].key, slots[at].row = key, row


@serial
def make_nodes(ranges, bounds, start, used):
    """Give each partition room for a node an entry; the rest of its last stretch is used first.

    Returns how many nodes are given away then; `used` were before.
    """
    for p in range(PARTITIONS):
        room = ranges[p]
        if room[0] == room[1]:
            room[0], room[1] = room[2], room[3]
            room[2] = room[3] = 0
        entries = start[bounds[p + 1]] - start[bounds[p]]
        if (room[1] - room[0]) + (room[3] - room[2]) < entries:
            room[2], room[3] = used, used + max(256, 2 * entries)
            used = room[3]
    return used


@serial
def begin(record, key, label, frame):
    """Begin a voxel that no frame has seen before."""
    record.key, record.label, record.next = key, label, ALONE
    record.value = record.drift_sum = record.self_sum = record.frame_entropy_sum = 0.0
    record.pixels = record.op = 0
    record.first_frame = record.last_frame = frame


@helper
def observe_dense(record, evidence, sums, pixels, out):
    """Add one observation to a voxel with a dense row; see `observe_row`."""
    observe_row(evidence, sums, pixels, record.op, record.label, np.float64(record.value), out)
    record.label, record.value = np.uint16(out[4]), out[7]


@helper
def _observe_dense(record, evidence, s, label, weight, first, last, pixels, out):
    for e in range(first, last):
        s[label[e]] = weight[e]
    observe_dense(record, evidence, s, pixels, out)
    for e in range(first, last):
        s[label[e]] = 0.0


@compiled(helper=True, forceinline=True)
def _observe_voxel(record, nodes, ranges, s, few, node, label, weight, first, last, pixels, op, out):
    """Add one observation to a voxel that disagrees with itself, or with the frame; see `observe_row`.

    - `s`: work space with room for K values, all 0
    - `few`, `node`: work space for the evidence and the shares of the classes, see `observe_few`, and their nodes
    """
    evidence, shares = few[0], few[1]
    for e in range(first, last):
        s[label[e]] = weight[e] / pixels
    evidence[0], shares[0] = record.value, s[record.label]
    s[record.label] = 0.0
    most, dominant = evidence[0], np.int64(record.label)
    n, at = 1, np.int64(record.next)
    while at >= 0:
        k, value = np.int64(nodes[at].label), np.float64(nodes[at].value)
        evidence[n], shares[n], node[n] = value, s[k], at
        s[k] = 0.0
        leads = (value > most) | ((value == most) & (k < dominant))
        most, dominant = value if leads else most, k if leads else dominant
        n, at = n + 1, np.int64(nodes[at].next)
    for e in range(first, last):
        if s[label[e]] > 0.0:
            if ranges[0] == ranges[1]:
                ranges[0], ranges[1] = ranges[2], ranges[3]
                ranges[2] = ranges[3]
            node[n] = ranges[0]
            ranges[0] += 1
            nodes[node[n]].label, nodes[node[n]].next = label[e], ALONE
            if n == 1:
                record.next = node[n]
            else:
                nodes[node[n - 1]].next = node[n]
            shares[n], s[label[e]] = s[label[e]], 0.0
            n += 1
    observe_few(evidence, shares, n, op, most, out)
    out[3] = dominant
    record.value = evidence[0]
    most, dominant = evidence[0], np.int64(record.label)
    evidence[0] = shares[0] = 0.0
    for c in range(1, n):
        k, value = np.int64(nodes[node[c]].label), evidence[c]
        nodes[node[c]].value = value
        leads = (value > most) | ((value == most) & (k < dominant))
        most, dominant = value if leads else most, k if leads else dominant
        evidence[c] = shares[c] = 0.0
    out[4] = dominant


@compiled(helper=True, forceinline=True)
def _touch_ahead(v, last, row, records, nodes, dense):
    """Ask for the records of later voxels, which lie across two lines of the cache, and for the nodes that follow."""
    soon = max(row[min(v + 2 * AHEAD, last)], 0)
    touch(records, soon)
    touch(records, soon + 1)
    following = np.int64(records[max(row[min(v + AHEAD, last)], 0)].next)
    touch(nodes, max(following, 0))
    if dense.shape[0] > 1:
        touch(dense.reshape(-1), max(DENSE - following, 0) * dense.shape[1])


@parallel
def update(
    key, pixels, start, label, weight, bounds, frame, row, slot, voxels, base, slots, records, nodes, dense, ranges,
    sums, drift_of, dominant_before, dominant_after,
):  # fmt: skip
    """Add the frame's observations; sums (PARTITIONS, 4): changes of VSS and entropy, drift, recurrent voxels.

    voxels: of the map before it; base: the first new one of each partition. row, the last three: see `Changes`.
    """
    for p in nb.prange(PARTITIONS):
        s, few, node = np.zeros(dense.shape[1]), np.zeros((2, dense.shape[1])), np.zeros(dense.shape[1], np.int64)
        out = np.zeros(8)
        room = ranges[p]
        vss = entropy = drift = 0.0
        reached = 0
        for v in range(bounds[p], bounds[p + 1]):
            _touch_ahead(v, bounds[p + 1] - 1, row, records, nodes, dense)
            first, last = start[v], start[v + 1]
            r = row[v]
            if r < 0:
                r = voxels + base[p] - r - 1
                row[v] = r
                slots[p, slot[v]].row = r
                begin(records[r], key[v], label[first], frame)
            record = records[r]
            op = record.op
            if last - first == 1 and record.next == ALONE and record.label == label[first]:
                record.value += 1.0
                record.self_sum += 1.0
                vss += 1.0 if op == 0 else 0.0
                drift_of[v] = 0.0
                dominant_before[v] = dominant_after[v] = record.label
            else:
                if record.next <= DENSE:
                    _observe_dense(record, dense[DENSE - record.next], s, label, weight, first, last, pixels[v], out)
                else:
                    _observe_voxel(record, nodes, room, s, few, node, label, weight, first, last, pixels[v], op, out)
                vss += out[0]
                entropy += out[1]
                drift += out[2]
                record.drift_sum += out[2]
                drift_of[v] = out[2]
                dominant_before[v], dominant_after[v] = np.uint16(out[3]), np.uint16(out[4])
                record.self_sum += out[5]
                record.frame_entropy_sum += out[6]
            if op == 0:
                drift_of[v] = np.nan
                dominant_before[v] = dominant_after[v]
            record.op = op + 1
            record.pixels += pixels[v]
            record.first_frame = min(record.first_frame, frame)
            record.last_frame = max(record.last_frame, frame)
            reached += 1 if op + 1 == RECURRENT else 0
        sums[p, 0], sums[p, 1], sums[p, 2], sums[p, 3] = vss, entropy, drift, reached


@serial
def read_records(records, order, key, op, pixels, first_frame, last_frame, drift_sum, self_sum, frame_entropy_sum):
    """Read these records' key and columns (n,), in order, in one pass."""
    for i in range(order.shape[0]):
        record = records[order[i]]
        key[i], op[i], pixels[i] = record.key, record.op, record.pixels
        first_frame[i], last_frame[i] = record.first_frame, record.last_frame
        drift_sum[i], self_sum[i] = record.drift_sum, record.self_sum
        frame_entropy_sum[i] = record.frame_entropy_sum


@parallel
def count_chain(records, nodes, dense, order, count):
    """Count the classes that the records in that order have evidence of: count[1:] of (n + 1,)."""
    for i in nb.prange(order.shape[0]):
        at = np.int64(records[order[i]].next)
        if at <= DENSE:
            classes = 0
            for k in range(dense.shape[1]):
                classes += dense[DENSE - at, k] != 0.0
            count[i + 1] = classes
            continue
        count[i + 1] = 1
        while at >= 0:
            count[i + 1] += 1
            at = np.int64(nodes[at].next)


@parallel
def read_chain(records, nodes, dense, order, starts, label, weight):
    """Read these records' evidence in order as entries; starts (n + 1,) is the first of each, ascending by class."""
    for i in nb.prange(order.shape[0]):
        last = starts[i]
        record = records[order[i]]
        if record.next <= DENSE:
            row = dense[DENSE - record.next]
            for k in range(row.shape[0]):
                if row[k] != 0.0:
                    label[last], weight[last] = k, row[k]
                    last += 1
            continue
        label[last], weight[last] = record.label, record.value
        at = np.int64(record.next)
        while at >= 0:
            k, value = nodes[at].label, nodes[at].value
            last += 1
            e = last
            while e > starts[i] and label[e - 1] > k:
                label[e], weight[e] = label[e - 1], weight[e - 1]
                e -= 1
            label[e], weight[e] = k, value
            at = np.int64(nodes[at].next)


@serial
def place_observations(
    rank, index, row, seen_pixels, entries, seen_label, seen_weight, slot, entry, frame, pixels, starts, label, weight
):  # fmt: skip
    """Write a frame's observations where each voxel's next one goes."""
    e = 0
    for i in range(row.shape[0]):
        voxel = rank[row[i]]
        at, to = slot[voxel], entry[voxel]
        slot[voxel] += 1
        entry[voxel] += entries[i]
        frame[at], pixels[at], starts[at] = index, seen_pixels[i], to
        for k in range(entries[i]):
            label[to + k] = seen_label[e + k]
            weight[to + k] = seen_weight[e + k] / seen_pixels[i]
        e += entries[i]


# Compiled loops that add soft scores to the numba backend's map: to dense rows of evidence, one a voxel.


@parallel
def update_dense(
    key, pixels, offset, frame_sums, bounds, frame, row, slot, voxels, base, dense_base, slots, records, nodes, dense,
    sums, drift_of, dominant_before, dominant_after,
):  # fmt: skip
    """Add the frame's observations, whose voxels get dense rows from `dense_base` of their partition on.

    - `offset`, `frame_sums`: where its sums begin, and sums of `ObservedScores`; the others as in `update`
    """
    stride = dense.shape[1]
    flat = dense.reshape(-1)
    for p in nb.prange(PARTITIONS):
        out = np.zeros(8)
        vss = entropy = drift = 0.0
        reached = 0
        free = dense_base[p]
        for v in range(bounds[p], bounds[p + 1]):
            _touch_ahead_dense(v, bounds[p + 1] - 1, row, records, flat, stride, offset, frame_sums)
            r = row[v]
            if r < 0:
                r = voxels + base[p] - r - 1
                row[v] = r
                slots[p, slot[v]].row = r
                begin(records[r], key[v], 0, frame)
            record = records[r]
            if record.next > DENSE:
                _unroll(record, nodes, dense[free])
                record.next = DENSE - free
                free += 1
            op = record.op
            observe_dense(
                record, dense[DENSE - record.next], frame_sums[offset[v] : offset[v] + stride], pixels[v], out
            )
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


@helper
def _touch_ahead_dense(v, last, row, records, flat, stride, offset, frame_sums):
    later = max(row[min(v + AHEAD, last)], 0)
    touch(records, later)
    touch(records, later + 1)
    soon = min(v + AHEAD // 2, last)
    start = max(DENSE - np.int64(records[max(row[soon], 0)].next), 0) * stride
    for k in range(0, stride, 8):
        touch(frame_sums, offset[soon] + k)
        touch(flat, start + k)


@helper
def _unroll(record, nodes, evidence):
    """Write the evidence of a voxel without a dense row into an unused one; its nodes are not used again."""
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
