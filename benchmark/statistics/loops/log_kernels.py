"""Compiled loops over the log of observations, voxel by voxel: its changes of class, its squares, rules to fuse it."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.beliefs import js_term
from semstab.runtime.compiled import serial
from semstab.statistics.loops.chunks import CHUNKS


@serial
def argmax(log, row):
    """The class of an observation's largest weight, the lowest on ties."""
    at, label, weight = log
    best = at[row]
    for e in range(at[row] + 1, at[row + 1]):
        if weight[e] > weight[best] or (weight[e] == weight[best] and label[e] < label[best]):
            best = e
    return np.int64(label[best])


@serial
def count_flips(chunk, starts, frame, log, K, changes, differing, since):
    """By voxel (n,): changes of the predicted class, pairs of observations that differ in it, frames since then.

    starts (n + 1,) bounds its observations. since is left as it is where the class never changed.
    """
    votes = np.zeros(K, np.int64)
    for i in range(chunk, changes.shape[0], CHUNKS):
        before, last, same = np.int64(-1), np.int64(-1), np.int64(0)
        for row in range(starts[i], starts[i + 1]):
            k = argmax(log, row)
            if before >= 0 and k != before:
                changes[i] += 1
                last = row
            same += votes[k]
            votes[k] += 1
            before = k
        T = starts[i + 1] - starts[i]
        differing[i] = T * (T - 1) // 2 - same
        if last >= 0:
            since[i] = frame[starts[i + 1] - 1] - frame[last]
        for row in range(starts[i], starts[i + 1]):
            votes[argmax(log, row)] = 0


@serial
def sum_squares(chunk, starts, log, K, voxels, squares):
    """For each entry of the voxels' evidence, given as the log is: the sum over frames of its share's square (m,)."""
    place = np.full(K, -1)
    at, label, weight = log
    first, own, _ = voxels
    for i in range(chunk, first.shape[0] - 1, CHUNKS):
        for e in range(first[i], first[i + 1]):
            place[own[e]] = e
        for e in range(at[starts[i]], at[starts[i + 1]]):
            squares[place[label[e]]] += weight[e] * weight[e]


@serial
def count_classes(chunk, starts, log, K, count):
    """How many classes each voxel ever saw: count[1:] of (n + 1,)."""
    seen = np.full(K, -1)
    for i in range(chunk, starts.shape[0] - 1, CHUNKS):
        for e in range(log[0][starts[i]], log[0][starts[i + 1]]):
            k = log[1][e]
            count[i + 1] += 1 if seen[k] != i else 0
            seen[k] = i


@serial
def load(log, first, T, number, starts, column, share):
    """Copy a voxel's T observations: the t-th has entries starts[t] to starts[t + 1].

    log is (starts, label, weight) of all observations. An entry has its class, numbered among the A that the voxel ever
    saw, and its share of the observation; number is work space (K,), all -1. Returns A.
    """
    at, label, weight = log
    A = 0
    for t in range(T + 1):
        starts[t] = at[first + t] - at[first]
    for e in range(starts[T]):
        k = label[at[first] + e]
        if number[k] < 0:
            number[k] = A
            A += 1
        column[e] = number[k]
        share[e] = weight[at[first] + e]
    for e in range(starts[T]):
        number[label[at[first] + e]] = -1
    return A


@serial
def fuse_by_rule(chunk, starts, log, K, entries, rule, floor, own, drift_sum):
    """Fuse each voxel's observations: add them (rule 0), votes for their argmax (1), or their logarithms (2; mean: 3).

    Logarithms are of max(s, floor), normalised. own is (first, label, belief, rest): the belief after the last
    observation in the classes that the voxel saw, ascending, and in each of the others, which are all alike. drift_sum
    (n,) takes the sum of the Jensen-Shannon divergences of successive beliefs, bits.
    """
    first, label, belief, rest = own
    most = 0
    for i in range(starts.shape[0] - 1):
        most = max(most, starts[i + 1] - starts[i])
    number, at, column, share = (
        np.full(K, -1),
        np.empty(most + 1, np.int64),
        np.empty(entries, np.int64),
        np.empty(entries),
    )
    total, before, after, now = np.empty(K + 1), np.empty(K + 1), np.empty(K + 1), np.empty(K + 1)
    pooled = rule >= 2
    unanimous = np.full((most + 1, 3), np.nan)  # by T: drift, belief and rest where all say the same with certainty
    for i in range(chunk, starts.shape[0] - 1, CHUNKS):
        T = starts[i + 1] - starts[i]
        A = load(log, starts[i], T, number, at, column, share)
        same = A == 1 and share[: at[T]].min() == 1.0
        if same and not np.isnan(unanimous[T, 0]):
            drift_sum[i], belief[first[i]], rest[i] = unanimous[T, 0], unanimous[T, 1], unanimous[T, 2]
            label[first[i]] = log[1][log[0][starts[i]]]
            continue
        total[: A + 1] = 0.0
        others = K - A
        for t in range(T):
            now[: A + 1] = floor if pooled else 0.0
            if rule == 1:
                best = at[t]
                for e in range(at[t], at[t + 1]):
                    k, top = log[1][log[0][starts[i]] + e], log[1][log[0][starts[i]] + best]
                    if share[e] > share[best] or (share[e] == share[best] and k < top):
                        best = e
                now[column[best]] = 1.0
            else:
                for e in range(at[t], at[t + 1]):
                    now[column[e]] = max(share[e], floor) if pooled else share[e]
            norm = others * now[A]
            for a in range(A):
                norm += now[a]
            scale = 1.0 if rule == 2 else 1.0 / (t + 1)
            top = -np.inf
            for a in range(A + 1):
                total[a] += np.log(now[a] / norm) if pooled else now[a]
                if a < A or others:
                    top = max(top, total[a] * scale)
            norm = 0.0
            for a in range(A + 1):
                after[a] = np.exp(total[a] * scale - top) if pooled else total[a] * scale
                norm += after[a] * (others if a == A else 1)
            step = 0.0
            for a in range(A + 1):
                after[a] /= norm
                if t > 0:
                    step += js_term(before[a], after[a]) * (others if a == A else 1)
                before[a] = after[a]
            drift_sum[i] += min(max(step, 0.0), 1.0)
        rest[i] = after[A]
        if same:
            unanimous[T, 0], unanimous[T, 1], unanimous[T, 2] = drift_sum[i], after[0], after[A]
        for e in range(at[T]):
            k = np.int64(log[1][log[0][starts[i]] + e])
            number[k] = column[e]
        used = first[i]
        for e in range(at[T]):
            k = np.int64(log[1][log[0][starts[i]] + e])
            if number[k] >= 0:
                place = used
                while place > first[i] and label[place - 1] > k:
                    label[place], belief[place] = label[place - 1], belief[place - 1]
                    place -= 1
                label[place], belief[place] = k, after[number[k]]
                used += 1
                number[k] = -1
