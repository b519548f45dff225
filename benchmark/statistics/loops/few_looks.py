"""Compiled loops over voxels seen so few times that all orders of their observations are gone through, eight at a time.

What the drift of an order adds up is known of sets of observations: a step leads from one set to that with one more.
There are far fewer steps than orders have together, and each is computed once, side by side for eight voxels.
"""

from __future__ import annotations

import functools
import itertools

import numpy as np

from semstab.core.compiled import compiled, serial
from semstab.core.types import Int64
from semstab.statistics.loops.chunks import CHUNKS
from semstab.statistics.loops.logarithm import EIGHT, add_plogp

ENUMERATED = 5
"""Up to this OP all T! orders are gone through; 5! = 120."""

ROUNDING = 1e-9
"""Sums of the same terms in another order differ by less."""


@functools.cache
def orders_and_steps(T: int) -> tuple[Int64, Int64, Int64]:
    """All orders (T!, T) of T observations, as they came first; steps (E, 2); those that each order takes (T!, T - 1).

    A step leads from a set of observations that is not empty to that with one more: numbers with their bits.
    """
    orders = np.array(list(itertools.permutations(range(T))))
    sets = np.cumsum(1 << orders, axis=1)
    steps, taken = np.unique(sets[:, :-1] << T | sets[:, 1:], return_inverse=True)
    return orders, np.stack([steps >> T, steps & ((1 << T) - 1)], axis=1), taken.reshape(len(orders), T - 1)


@serial
def dense_eight(log, first, T, voxels, begin, end, number, x):
    """The T observations of up to eight voxels, voxels[begin:end], as x (T, A, 8); returns the largest A.

    log is (starts, label, weight) of all observations, first (n,) the voxels' first rows of it; number is work space
    (K,), all -1. Classes that a voxel never saw are 0; where there are fewer voxels the last one comes again.
    """
    starts, label, weight = log
    most = 0
    for lane in range(EIGHT):
        row, A = first[voxels[min(begin + lane, end - 1)]], 0
        for t in range(T):
            for e in range(starts[row + t], starts[row + t + 1]):
                k = label[e]
                if number[k] < 0:
                    if most == A:
                        for s in range(T):
                            for other in range(EIGHT):
                                x[s, A, other] = 0.0
                        most += 1
                    number[k] = A
                    A += 1
                x[t, number[k], lane] = weight[e]
        for e in range(starts[row], starts[row + T]):
            number[label[e]] = -1
    return most


@compiled(fastmath={"contract"})
def drifts_of_steps(x, A, T, steps, belief, logs, mean, drift):
    """The drift, bits, of each step (E, 2) between sets of the observations x (T, A, 8), to drift (E, 8).

    It is H(m) - (H(p) + H(q)) / 2 with the mean m of the beliefs p and q before and after. belief, logs (2^T, 8) and
    mean (E, 8) are work space.
    """
    ones = np.ones(EIGHT)
    for lane in range(EIGHT):
        belief[0, lane] = 0.0
        for some in range(1 << T):
            logs[some, lane] = 0.0
        for s in range(steps.shape[0]):
            drift[s, lane] = 0.0
    for a in range(A):
        for t in range(T):
            for before in range(1 << t):
                for lane in range(EIGHT):
                    belief[before | 1 << t, lane] = belief[before, lane] + x[t, a, lane]
        for some in range(1, 1 << T):
            many = 0
            for t in range(T):
                many += some >> t & 1
            part = 1.0 / many
            for lane in range(EIGHT):
                belief[some, lane] *= part
        for some in range(1, 1 << T):
            add_plogp(logs, some * EIGHT, ones, 0, belief, some * EIGHT)
        for s in range(steps.shape[0]):
            for lane in range(EIGHT):
                mean[s, lane] = 0.5 * (belief[steps[s, 0], lane] + belief[steps[s, 1], lane])
        for s in range(steps.shape[0]):
            add_plogp(drift, s * EIGHT, ones, 0, mean, s * EIGHT)
    for s in range(steps.shape[0]):
        for lane in range(EIGHT):
            drift[s, lane] = 0.5 * (logs[steps[s, 0], lane] + logs[steps[s, 1], lane]) - drift[s, lane]


@compiled(fastmath={"contract"})
def trends_of_orders(x, A, T, orders, products, trend):
    """|| sum_t (t - mean t) s_t ||^2 of x (T, A, 8) in each order (n, T), to trend (n, 8); products (T, T, 8) is room.

    As t - mean t add up to 0, the first observation can be taken from each.
    """
    for t in range(T):
        for s in range(T):
            for lane in range(EIGHT):
                products[t, s, lane] = 0.0
    for a in range(A):
        for t in range(1, T):
            for s in range(1, t + 1):
                for lane in range(EIGHT):
                    own, other = x[t, a, lane] - x[0, a, lane], x[s, a, lane] - x[0, a, lane]
                    products[t, s, lane] += own * other
    place = np.empty(T)
    for i in range(orders.shape[0]):
        for t in range(T):
            place[orders[i, t]] = t - 0.5 * (T - 1)
        for lane in range(EIGHT):
            trend[i, lane] = 0.0
        for t in range(1, T):
            for s in range(1, t + 1):
                factor = place[t] * place[s] * (1.0 if s == t else 2.0)
                for lane in range(EIGHT):
                    trend[i, lane] += factor * products[t, s, lane]


@serial
def _share_out(value, found):
    """The mean of values (n, 8), and the shares that are as low as the first, as high, and so beside their size."""
    for lane in range(EIGHT):
        for c in range(4):
            found[c, lane] = 0.0
    for i in range(value.shape[0]):
        for lane in range(EIGHT):
            seen, own = value[0, lane], value[i, lane]
            found[0, lane] += own
            found[1, lane] += 1.0 if own <= seen + ROUNDING else 0.0
            found[2, lane] += 1.0 if own >= seen - ROUNDING else 0.0
            found[3, lane] += 1.0 if own >= seen - ROUNDING * (1.0 + seen) else 0.0
    for lane in range(EIGHT):
        for c in range(4):
            found[c, lane] /= value.shape[0]


@compiled(fastmath={"contract"})
def measure_few(chunk, voxels, first, T, log, K, entries, orders, steps, taken, trend, null, p):
    """What `measure_voxels` says, of the voxels of these numbers (r,), which all are of OP T <= ENUMERATED.

    null (n,) takes the mean sum of drifts of all orders, p (n, 3) the share of those with a sum as low, one as high, a
    trend as high, trend (n,) what was seen; orders, steps and taken are those of `orders_and_steps`.
    """
    x, number = np.empty((T, max(1, min(K, entries)), EIGHT)), np.full(K, -1)
    belief, logs, mean = np.empty((1 << T, EIGHT)), np.empty((1 << T, EIGHT)), np.empty((steps.shape[0], EIGHT))
    drift, products = np.empty((steps.shape[0], EIGHT)), np.empty((T, T, EIGHT))
    value, found = np.empty((orders.shape[0], EIGHT)), np.empty((4, EIGHT))
    last = (chunk + 1) * voxels.shape[0] // CHUNKS
    for begin in range(chunk * voxels.shape[0] // CHUNKS, last, EIGHT):
        end = min(begin + EIGHT, last)
        A = dense_eight(log, first, T, voxels, begin, end, number, x)
        drifts_of_steps(x, A, T, steps, belief, logs, mean, drift)
        for i in range(taken.shape[0]):
            for lane in range(EIGHT):
                value[i, lane] = drift[taken[i, 0], lane]
            for s in range(1, T - 1):
                for lane in range(EIGHT):
                    value[i, lane] += drift[taken[i, s], lane]
        _share_out(value, found)
        for j in range(begin, end):
            null[voxels[j]], p[voxels[j], 0], p[voxels[j], 1] = (
                found[0, j - begin],
                found[1, j - begin],
                found[2, j - begin],
            )
        if T > 2:
            trends_of_orders(x, A, T, orders, products, value)
            _share_out(value, found)
            for j in range(begin, end):
                trend[voxels[j]], p[voxels[j], 2] = value[0, j - begin], found[3, j - begin]
