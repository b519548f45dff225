"""Compiled loops over one-hot observations, whose drift depends on counts only."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.beliefs import js_term
from semstab.core.compiled import serial
from semstab.statistics.loops.chunks import CHUNKS

LONGEST_TABLE = 256
"""Up to this OP the drift of one-hot observations is looked up."""


@serial
def one_hot_drift(c, t):
    """D_JS of the beliefs after t and t + 1 one-hot observations, bits: the new class was seen c times among the t.

    The other classes' shares all shrink by the factor t / (t + 1), so only how many they are in all matters.
    """
    return js_term(c / t, (c + 1) / (t + 1)) + (t - c) * js_term(1 / t, 1 / (t + 1))


@serial
def one_hot_drifts(longest):
    """Table (longest, longest) of `one_hot_drift` at [c, t]."""
    drifts = np.zeros((longest, longest))
    for t in range(1, longest):
        for c in range(t + 1):
            drifts[c, t] = one_hot_drift(c, t)
    return drifts


@serial
def expected_one_hot(chunk, n, T, log_factorial, drifts, out):
    """The part of the expected sum of drifts that a class causes with n of T one-hot observations in random order.

    At step t + 1 it comes with probability n / T, and c of its other n - 1 observations are then among the t before it
    with the hypergeometric probability C(n-1, c) C(T-n, t-c) / C(T-1, t).
    """
    for i in range(chunk, n.shape[0], CHUNKS):
        others, rest = n[i] - 1, T[i] - n[i]
        total = 0.0
        for t in range(1, T[i]):
            ways = log_factorial[T[i] - 1] - log_factorial[t] - log_factorial[T[i] - 1 - t]
            for c in range(max(0, t - rest), min(others, t) + 1):
                log_p = log_factorial[others] - log_factorial[c] - log_factorial[others - c] - ways
                log_p += log_factorial[rest] - log_factorial[t - c] - log_factorial[rest - t + c]
                total += np.exp(log_p) * drifts[c, t]
        out[i] = n[i] / T[i] * total


@serial
def seen_counts(evidence, T, known, seen):
    """Mark in seen (longest + 1, longest + 1) the pairs n, T of classes of the voxels for which `known` (m,) holds."""
    starts, _, weight = evidence
    for i in range(T.shape[0]):
        if known[i]:
            for e in range(starts[i], starts[i + 1]):
                seen[np.int64(np.rint(weight[e])), T[i]] = 1.0


@serial
def add_expected(evidence, T, known, part, expected):
    """The mean drift (m,) of these voxels in random order, from that part (n, T) of its sum that each class causes."""
    starts, _, weight = evidence
    for i in range(T.shape[0]):
        if known[i]:
            total = 0.0
            for e in range(starts[i], starts[i + 1]):
                total += part[np.int64(np.rint(weight[e])), T[i]]
            expected[i] = total / (T[i] - 1)
