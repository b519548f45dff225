"""Compiled loop that finds the voxels of which all that is summed over a map is the same."""

from __future__ import annotations

import numpy as np

from semstab.runtime.compiled import serial

ROOM = 1 << 14
"""Places of a table of kinds, half of which are used: voxels beyond that stand for themselves."""


@serial
def tell_apart(evidence, K, op, longest, sums, at, truth, pixels, rows, voxels, together, of):
    """Which kind (n,) each voxel is of, and of each kind (k,) its first row, how many voxels and pixels it has.

    Voxels whose frames saw one class and nothing else are of one kind where class, OP, cube `at` (n,) and true class
    agree; each of the others is one of its own. sums are drift, ||s||^2 and entropy of the frames (n,); truth is empty
    where it is not known. Returns how many kinds there are, -1 where they are more than there is room for.
    """
    starts, label, weight = evidence
    drift, squares, entropy = sums
    keys, kinds, taken = np.full(ROOM, -1), np.empty(ROOM, np.int64), 0
    found, before, kind = 0, np.int64(-1), np.int64(-1)
    for i in range(op.shape[0]):
        e, T, key = starts[i], op[i], np.int64(-1)
        if starts[i + 1] - e == 1 and weight[e] == T and squares[i] == T and entropy[i] == 0.0 and drift[i] == 0.0:
            true = truth[i] if truth.shape[0] else -1
            key = (((at[i] + 1) * K + label[e]) * (longest + 1) + T) * (K + 1) + true + 1
        if key < 0 or key != before:
            before, kind, slot = key, np.int64(found), 0
            if key >= 0:
                slot = ((key ^ (key >> 15)) * 73856093 >> 5) & (ROOM - 1)
                while keys[slot] >= 0 and keys[slot] != key:
                    slot = (slot + 1) & (ROOM - 1)
                if keys[slot] == key:
                    kind = kinds[slot]
                elif 2 * taken < ROOM:
                    keys[slot], kinds[slot] = key, kind
                    taken += 1
                else:
                    before = np.int64(-1)
            if kind == found:
                if found == rows.shape[0]:
                    return -1
                rows[found], voxels[found], together[found] = i, 0.0, 0
                found += 1
        voxels[kind] += 1.0
        together[kind] += pixels[i]
        of[i] = kind
    return found
