"""Compiled loops over the log of observations, voxel by voxel: its changes of class."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import serial
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
def count_flips(chunk, starts, ends, log, K, rate, null, since):
    """By voxel (n,): the share of steps at which the predicted class changes, of pairs that differ, and looks since.

    starts and ends (n,) bound its observations. NaN where there is no pair, -1 where there is no change to count from.
    """
    begin, end = chunk * rate.shape[0] // CHUNKS, (chunk + 1) * rate.shape[0] // CHUNKS
    votes, longest = np.zeros(K, np.int64), 0
    for i in range(begin, end):
        longest = max(longest, ends[i] - starts[i])
    voted = np.empty(longest, np.int64)
    for i in range(begin, end):
        rate[i] = null[i] = np.nan
        since[i], T = -1, ends[i] - starts[i]
        if T < 2:
            continue
        before, same, changes = np.int64(-1), np.int64(0), 0
        for row in range(starts[i], ends[i]):
            k = argmax(log, row)
            if before >= 0 and k != before:
                changes += 1
                since[i] = ends[i] - 1 - row
            same += votes[k]
            votes[k] += 1
            before = voted[row - starts[i]] = k
        pairs = T * (T - 1) // 2
        rate[i], null[i] = changes / (T - 1), (pairs - same) / pairs
        for t in range(T):
            votes[voted[t]] = 0


@serial
def count_frames(ends, frame, since, frames):
    """By voxel (n,): the frames from so many looks before its last one on until that, NaN for -1."""
    for i in range(ends.shape[0]):
        last = ends[i] - 1
        frames[i] = frame[last] - frame[last - since[i]] if since[i] >= 0 else np.nan
