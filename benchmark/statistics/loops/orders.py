"""Compiled loops over the observations of voxels: in the orders in which they could have come.

A random order depends on the voxel's location and the seed only: the same numbers for any number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from semstab.backends.shared.beliefs import js_term, plogp_of
from semstab.backends.shared.keys import mix
from semstab.backends.shared.score_loops import DOUBLES
from semstab.core.compiled import CHUNKS, helper, serial

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""The distance between successive states of splitmix64."""

TURNS = 8
"""The number of observations at which random orders begin, as far apart as possible; each order goes round."""


@intrinsic
def _plogp_of_eight(_typing: Any, values: Any, _at: Any) -> Any:
    """Replace values[at : at + 8] by p log2 p of each, by vector instructions.

    The compiler has no such instructions for the logarithm of any library.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        eight = builder.bitcast(builder.gep(array.data, [arguments[1]]), DOUBLES.as_pointer())
        builder.store(plogp_of(context, builder, builder.load(eight, align=8)), eight, align=8)
        return context.get_dummy_value()

    return types.void(values, types.intp), generate


@helper
def _drifts(x, A, T, drift):
    """Write the sums of drifts, bits, of observations x (A, T) in the turns of their order to drift (TURNS,).

    A step's drift is H(m) - (H(p) + H(q)) / 2 with the mean m of the beliefs p and q before and after: each belief but
    the first and last is one after, then one before.
    """
    cumulative, q, m = np.empty(TURNS), np.empty(TURNS), np.empty(TURNS)
    drift[:] = 0.0
    for a in range(A):
        cumulative[:] = 0.0
        for t in range(T):
            before, after, weight = 1.0 / max(t, 1), 1.0 / (t + 1), 0.5 if t == 0 or t == T - 1 else 1.0
            for turn in range(TURNS):
                p = cumulative[turn] * before
                cumulative[turn] += x[a, (t + turn * T // TURNS) % T]
                q[turn] = cumulative[turn] * after
                m[turn] = 0.5 * (p + q[turn])
            _plogp_of_eight(q, 0)
            _plogp_of_eight(m, 0)
            for turn in range(TURNS):
                drift[turn] += weight * q[turn] - (m[turn] if t else 0.0)


@serial
def _dense(log, first, T, number, at, x):
    """Write a voxel's T observations as columns `at` (T,) of x (A, T); return A, the number of classes it ever saw.

    log is (starts, label, weight) of all observations; number is work space (K,), all -1.
    """
    starts, label, weight = log
    A = 0
    for t in range(T):
        for e in range(starts[first + t], starts[first + t + 1]):
            k = label[e]
            if number[k] < 0:
                number[k] = A
                x[A, :T] = 0.0
                A += 1
            x[number[k], at[t]] = weight[e]
    for e in range(starts[first], starts[first + T]):
        number[label[e]] = -1
    return A


@serial
def draw_streams(index, seed, streams):
    """Write a random number of each voxel (n,) from its index (n, 3) and the seed."""
    for i in range(index.shape[0]):
        state = seed
        for axis in range(3):
            state = mix(state ^ np.uint64(index[i, axis]))
        streams[i] = state


@helper
def _shuffle(order, T, state):
    """Write a random order of T observations to order (T,), by splitmix64, whose state (1,) it advances."""
    for t in range(T):
        state[0] += GOLDEN
        other = np.int64(((mix(state[0]) >> np.uint64(32)) * np.uint64(t + 1)) >> np.uint64(32))
        order[t] = order[other]
        order[other] = t


@serial
def mean_drifts(chunk, voxels, first, T, log, K, entries, seeds, null):
    """Write the mean drift per step in TURNS orders, turns of one random order, of these voxels (r,) to null (n,).

    first, T (n,) are the voxels' rows of the log, seeds (n,) their random streams; `entries` is the most that one has.
    """
    longest = 1
    for i in voxels:
        longest = max(longest, T[i])
    x, number, at = np.empty((max(1, min(K, entries)), longest)), np.full(K, -1), np.empty(longest, np.int64)
    value, state = np.empty(TURNS), np.empty(1, np.uint64)
    for j in range(chunk, voxels.shape[0], CHUNKS):
        i = voxels[j]
        state[0] = seeds[i]
        _shuffle(at, T[i], state)
        A = _dense(log, first[i], T[i], number, at, x)
        _drifts(x, A, T[i], value)
        null[i] = value.mean() / (T[i] - 1)


# Compiled loops over one-hot observations, whose drift depends on counts only.

LONGEST_TABLE = 256
"""Largest OP at which the drift of one-hot observations is looked up."""


@serial
def one_hot_drifts(longest):
    """Return D_JS of the beliefs after t and t + 1 one-hot observations, bits, at [c, t] of a table (longest, longest).

    The new class was seen c times among the t. The other classes' shares all shrink by the factor t / (t + 1), so only
    how many they are in all matters.
    """
    drifts = np.zeros((longest, longest))
    for t in range(1, longest):
        for c in range(t + 1):
            drifts[c, t] = js_term(c / t, (c + 1) / (t + 1)) + (t - c) * js_term(1 / t, 1 / (t + 1))
    return drifts


@serial
def expected_one_hot(chunk, n, T, log_factorial, drifts, out):
    """Return the part of the expected sum of drifts that a class causes with n of T one-hot observations.

    At step t + 1 it comes with probability n / T, and c of its other n - 1 observations are then among the t before it
    with the hypergeometric probability C(n-1, c) C(T-n, t-c) / C(T-1, t).
    """
    for i in range(chunk, n.shape[0], CHUNKS):
        num_others, rest = n[i] - 1, T[i] - n[i]
        total = 0.0
        for t in range(1, T[i]):
            ways = log_factorial[T[i] - 1] - log_factorial[t] - log_factorial[T[i] - 1 - t]
            for c in range(max(0, t - rest), min(num_others, t) + 1):
                log_p = log_factorial[num_others] - log_factorial[c] - log_factorial[num_others - c] - ways
                log_p += log_factorial[rest] - log_factorial[t - c] - log_factorial[rest - t + c]
                total += np.exp(log_p) * drifts[c, t]
        out[i] = n[i] / T[i] * total
