"""Compiled loops over the log of observations, voxel by voxel: its changes of class."""

from __future__ import annotations

import numpy as np

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
    votes, longest = np.zeros(K, np.int64), 0
    for i in range(chunk, changes.shape[0], CHUNKS):
        longest = max(longest, starts[i + 1] - starts[i])
    voted = np.empty(longest, np.int64)
    for i in range(chunk, changes.shape[0], CHUNKS):
        before, last, same = np.int64(-1), np.int64(-1), np.int64(0)
        for row in range(starts[i], starts[i + 1]):
            k = argmax(log, row)
            if before >= 0 and k != before:
                changes[i] += 1
                last = row
            same += votes[k]
            votes[k] += 1
            before = voted[row - starts[i]] = k
        T = starts[i + 1] - starts[i]
        differing[i] = T * (T - 1) // 2 - same
        if last >= 0:
            since[i] = frame[starts[i + 1] - 1] - frame[last]
        for t in range(T):
            votes[voted[t]] = 0
