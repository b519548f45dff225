"""Compiled loops over the observations of voxels, in the orders in which they could have come.

Voxels go by chunks whose number does not depend on the number of threads, each voxel draws from a random stream of its
own, and every sum runs in one fixed order: the same seed gives the same numbers for any number of threads.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba as nb
import numpy as np

from semstab.backends.shared.beliefs import js_term, plogp
from semstab.backends.shared.hashing import mix
from semstab.runtime.compiled import serial

CHUNKS = 64
ENUMERATED = 5
"""Up to this OP all T! orders are gone through; 5! = 120."""

LONGEST_TABLE = 256
"""Up to this OP the drift of one-hot observations is looked up."""

ROUNDING = 1e-9
"""Sums of the same terms in another order differ by less."""


def in_chunks(loop: Any, *arguments: Any) -> None:
    """Run a compiled loop once for each chunk, in as many threads as numba may use.

    Such loops hold no lock. numba's own parallel form of them would take three times as long to compile.
    """
    with ThreadPoolExecutor(nb.get_num_threads()) as pool:
        for done in [pool.submit(loop, chunk, *arguments) for chunk in range(CHUNKS)]:
            done.result()


# --- One-hot observations: drift depends on counts only ---------------------------------------------------------------


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


# --- Observations, one after the other --------------------------------------------------------------------------------


@serial
def step_terms(longest):
    """Table (longest, 5) at [t] of 1 / t, log2 t, their mean with those of t + 1, and c log2 c of the mean c of 1 / t.

    Columns: 1 / t, 1 / (t + 1), (log2 t + log2(t + 1)) / 2, c = (1 / t + 1 / (t + 1)) / 2, c log2 c.
    """
    terms = np.zeros((longest, 5))
    for t in range(1, longest):
        terms[t, 0], terms[t, 1] = 1 / t, 1 / (t + 1)
        terms[t, 2] = 0.5 * (np.log2(t) + np.log2(t + 1))
        terms[t, 3] = 0.5 / t + 0.5 / (t + 1)
        terms[t, 4] = plogp(terms[t, 3])
    return terms


@serial
def load(log, first, T, number, starts, column, share):
    """Copy a voxel's T observations: the t-th has entries starts[t] to starts[t + 1].

    log is (starts, label, weight) of all observations. An entry has its class, numbered among the A that the voxel ever
    saw, and its share of the observation; number is work space (K,), all -1. Returns A, and whether all observations
    are one-hot and few enough for the table of drifts.
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
    return A, starts[T] == T and T <= LONGEST_TABLE


@serial
def blend(column, share, first, last, t, terms, total, plogs, spread):
    """Add entries first..last of a voxel's observation, of which t came before; returns the drift it causes, bits.

    The drift is H(m) - (H(p) + H(q)) / 2 with the mean m of the beliefs p and q before and after. By class, total takes
    the shares n and plogs n log2 n; spread is the sum of plogs, returned anew. Classes that are not in the new
    observation have the share c n of m, so that only those that are have to be looked at.
    """
    inverse, next_inverse = terms[t, 0], terms[t, 1]
    rest, rest_plogs, after, mixed = np.float64(t), spread, spread, 0.0
    for e in range(first, last):
        a = column[e]
        n = total[a]
        more = n + share[e]
        total[a] = more
        rest -= n
        rest_plogs -= plogs[a]
        after -= plogs[a]
        plogs[a] = plogp(more)
        after += plogs[a]
        if t > 0:
            mixed += plogp(0.5 * (n * inverse + more * next_inverse))
    if t == 0:
        return 0.0, after
    of_mean = mixed + terms[t, 3] * rest_plogs + rest * terms[t, 4]
    return 0.5 * (spread * inverse + after * next_inverse) - terms[t, 2] - of_mean, after


@serial
def _drift(order, voxel, drifts, terms, work):
    """The sum of drifts, bits, in that order; work space is (2, A)."""
    starts, column, share, T, A, one_hot = voxel
    total, plogs = work[0], work[1]
    total[:A] = 0.0
    plogs[:A] = 0.0
    drift = spread = 0.0
    if one_hot:
        for t in range(T):
            a = column[order[t]]
            drift += drifts[np.int64(total[a]), t]
            total[a] += 1.0
    else:
        for t in range(T):
            first, last = starts[order[t]], starts[order[t] + 1]
            step, spread = blend(column, share, first, last, t, terms, total, plogs, spread)
            drift += step
    return drift


@serial
def _trend(order, voxel, moment):
    """|| sum_t (t - mean t) s_t ||^2 in that order; work space is (A,)."""
    starts, column, share, T, A, _ = voxel
    moment[:A] = 0.0
    for t in range(T):
        for e in range(starts[order[t]], starts[order[t] + 1]):
            moment[column[e]] += (t - 0.5 * (T - 1)) * share[e]
    trend = 0.0
    for a in range(A):
        trend += moment[a] * moment[a]
    return trend


# --- Orders of one voxel ----------------------------------------------------------------------------------------------


@serial
def draw_streams(index, seed, streams):
    """A random stream of each voxel (n,) from its index (n, 3) and the seed."""
    for i in range(index.shape[0]):
        state = seed
        for axis in range(3):
            state = mix(state ^ np.uint64(index[i, axis]))
        streams[i] = state


@serial
def _below(state, n):
    """A random integer in [0, n) from the stream (splitmix64) whose state (1,) it moves on."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    return np.int64(((mix(state[0]) >> np.uint64(32)) * np.uint64(n)) >> np.uint64(32))


@serial
def _shuffle(order, T, state):
    for t in range(T - 1, 0, -1):
        other = _below(state, t + 1)
        order[t], order[other] = order[other], order[t]


@serial
def _next_order(order, T):
    """Step to the lexicographically next order; False after the last."""
    i = T - 2
    while i >= 0 and order[i] >= order[i + 1]:
        i -= 1
    if i < 0:
        return False
    j = T - 1
    while order[j] <= order[i]:
        j -= 1
    order[i], order[j] = order[j], order[i]
    i, j = i + 1, T - 1
    while i < j:
        order[i], order[j] = order[j], order[i]
        i, j = i + 1, j - 1
    return True


@serial
def _try_all(order, voxel, terms, seen, work, p):
    """The p-values over all T! orders of a drift as low, one as high, a trend as high; returns the mean drift.

    A step's drift depends on which observations came before, not on their order: it is computed once for each set.
    """
    starts, column, share, T, A, _ = voxel
    steps = np.zeros((1 << T, T))
    for before in range(1, 1 << T):
        work[0, :A] = 0.0
        work[1, :A] = 0.0
        spread, t = 0.0, 0
        for j in range(T):
            if before >> j & 1:
                _, spread = blend(column, share, starts[j], starts[j + 1], t, terms, work[0], work[1], spread)
                t += 1
        for j in range(T):
            if not before >> j & 1:
                work[2, :A], work[3, :A] = work[0, :A], work[1, :A]
                drift, _ = blend(column, share, starts[j], starts[j + 1], t, terms, work[2], work[3], spread)
                steps[before, j] = drift
    total = 0.0
    tried = 0
    p[:] = 0.0
    more = True
    while more:
        before, drift = 0, 0.0
        for t in range(T):
            drift += steps[before, order[t]]
            before |= 1 << order[t]
        total += drift
        p[0] += 1 if drift <= seen[0] + ROUNDING else 0
        p[1] += 1 if drift >= seen[0] - ROUNDING else 0
        p[2] += 1 if _trend(order, voxel, work[0]) >= seen[1] - ROUNDING * (1.0 + seen[1]) else 0
        tried += 1
        more = _next_order(order, T)
    p /= tried
    return total / tried


@serial
def _trend_variance(voxel, scatter):
    """The variance of the trend over all orders, exactly; scatter is work space (A, A), all 0, and is left so.

    With x_i the observations less their mean, w_i = i - (T - 1) / 2 and G = (x_i . x_j), the trend is
    sum_ij G_ij w_i w_j; its second moment sums E[w_i w_j w_k w_l] over the ways in which the four can coincide. Rows of
    G and the w sum to 0, which leaves trace G, sum_i G_ii^2 and sum_ij G_ij^2 = ||scatter||^2.
    """
    starts, column, share, T, A, _ = voxel
    mean = np.zeros(A)
    for e in range(starts[T]):
        mean[column[e]] += share[e] / T
    length = 0.0
    for a in range(A):
        length += mean[a] * mean[a]
    D = D2 = F = 0.0
    for t in range(T):
        own = length
        for e in range(starts[t], starts[t + 1]):
            own += share[e] * (share[e] - 2.0 * mean[column[e]])
            for other in range(starts[t], starts[t + 1]):
                scatter[column[e], column[other]] += share[e] * share[other]
        D += own
        D2 += own * own
    for a in range(A):
        for b in range(A):
            entry = scatter[a, b] - T * mean[a] * mean[b]
            F += entry * entry
            scatter[a, b] = 0.0
    p2 = T * (T * T - 1.0) / 12
    p4 = p2 * (3.0 * T * T - 7) / 20
    pairs = T * (T - 1.0)
    second = (p4 / T + 4 * p4 / pairs) * D2 + (p2 * p2 - p4) / pairs * (D * D + 2 * F - 3 * D2)
    second += (2 * p4 - p2 * p2) / (pairs * (T - 2)) * (12 * D2 - 2 * D * D - 4 * F)
    second += (3 * p2 * p2 - 6 * p4) / (pairs * (T - 2) * (T - 3)) * (D * D + 2 * F - 6 * D2)
    return second - (p2 * D / (T - 1)) ** 2


@serial
def _room(T, entries, K):
    """Work space for voxels of at most T observations and so many entries."""
    work = np.empty((4, max(K, 2)))
    return np.empty(T + 1, np.int64), np.empty(T, np.int64), np.empty(entries, np.int64), np.empty(entries), work


@serial
def measure_voxels(chunk, first, T, log, K, entries, drifts, terms, seeds, draws, seen, null, p, variance):
    """What each voxel's order gives, and what orders of its observations give on average.

    first, T (n,) are its rows of the log, seeds (n,) its random stream, `entries` is the most that one has. seen (n, 2)
    takes its sum of drifts and its trend, null (n,) the mean sum of drifts over orders: all where T <= ENUMERATED,
    which also gives the p-values (n, 3), else `draws` random ones, none where the counts tell. variance (n,) takes that
    of the trend over all orders, for T > ENUMERATED.
    """
    starts, order, column, share, work = _room(T.max() if T.shape[0] else 0, entries, K)
    most = min(K, entries)  # classes that one voxel can have
    number, state, scatter = np.full(K, -1), np.empty(1, dtype=np.uint64), np.zeros((most, most))
    for i in range(chunk, T.shape[0], CHUNKS):
        A, one_hot = load(log, first[i], T[i], number, starts, column, share)
        voxel = starts, column, share, T[i], A, one_hot
        for t in range(T[i]):
            order[t] = t
        seen[i, 0] = _drift(order, voxel, drifts, terms, work)
        seen[i, 1] = _trend(order, voxel, work[0])
        if T[i] <= ENUMERATED:
            null[i] = _try_all(order, voxel, terms, seen[i], work, p[i])
            continue
        variance[i] = _trend_variance(voxel, scatter)
        state[0] = seeds[i]
        for _ in range(0 if one_hot else draws):
            _shuffle(order, T[i], state)
            null[i] += _drift(order, voxel, drifts, terms, work) / draws


@serial
def permute_voxels(chunk, which, first, T, log, K, entries, drifts, terms, seeds, by_drift, most, enough, seen, p):
    """P-values of some voxels from random orders of their observations: by the drift, in either tail, or by the trend.

    which (r,) are their numbers in first, T, seeds, seen as in `measure_voxels`. A tail that has met `enough` orders as
    extreme is settled: its p-value is their share of the orders tried until then; one that has not takes all `most`
    orders (Besag and Clifford 1991, Biometrika 78). p (r,) takes the trend's, or twice the drift's smaller one.
    """
    starts, order, column, share, work = _room(T.max() if T.shape[0] else 0, entries, K)
    number, state, hits, tail = np.full(K, -1), np.empty(1, dtype=np.uint64), np.empty(2, np.int64), np.empty(2)
    for at in range(chunk, which.shape[0], CHUNKS):
        i = which[at]
        A, one_hot = load(log, first[i], T[i], number, starts, column, share)
        voxel = starts, column, share, T[i], A, one_hot
        for t in range(T[i]):
            order[t] = t
        state[0] = seeds[i]
        target = seen[i, 0] if by_drift else seen[i, 1]
        slack = ROUNDING if by_drift else ROUNDING * (1.0 + target)
        hits[:] = 0
        tail[:] = 0.0 if by_drift else 1.0
        tail[1] = 0.0
        tried = 0
        while tried < most and tail.min() == 0.0:
            _shuffle(order, T[i], state)
            value = _drift(order, voxel, drifts, terms, work) if by_drift else _trend(order, voxel, work[0])
            tried += 1
            hits[0] += 1 if value <= target + slack else 0
            hits[1] += 1 if value >= target - slack else 0
            for side in range(2):
                if hits[side] == enough and tail[side] == 0.0:
                    tail[side] = enough / tried
        for side in range(2):
            if tail[side] == 0.0:
                tail[side] = (hits[side] + 1) / (tried + 1)
        p[at] = min(1.0, 2.0 * tail.min()) if by_drift else tail[1]


# --- Orders of the frames ---------------------------------------------------------------------------------------------


@serial
def _gather(first, T, log, K, rank, groups):
    """The observations of some voxels, numbered voxel by voxel, and which of them each group of frames made.

    Returns starts, slot and share as `load` does, slots being counted on from voxel to voxel; the voxel of each
    observation; whether a voxel is one-hot; the bounds of its slots; bounds and numbers of each group's observations.
    """
    observations, size = T.sum(), 0
    for i in range(T.shape[0]):
        size += log[0][first[i] + T[i]] - log[0][first[i]]
    number = np.full(K, -1)
    starts, slot, share = np.zeros(observations + 1, np.int64), np.empty(size, np.int64), np.empty(size)
    voxel, made = np.empty(observations, np.int64), np.empty(observations, np.int64)
    one_hot, slots = np.empty(T.shape[0], np.bool_), np.zeros(T.shape[0] + 1, np.int64)
    bounds = np.zeros(groups + 1, np.int64)
    at = entries = 0
    for i in range(T.shape[0]):
        A, one_hot[i] = load(log, first[i], T[i], number, starts[at:], slot[entries:], share[entries:])
        slots[i + 1] = slots[i] + A
        added = starts[at + T[i]]
        for entry in range(entries, entries + added):
            slot[entry] += slots[i]
        for t in range(T[i]):
            starts[at + t] += entries
            voxel[at + t] = i
            bounds[rank[at + t] + 1] += 1
        at += T[i]
        entries += added
    starts[at] = entries
    bounds = np.cumsum(bounds)
    free = bounds.copy()
    for at in range(observations):
        made[free[rank[at]]] = at
        free[rank[at]] += 1
    return starts, slot, share, voxel, one_hot, slots, bounds, made


@serial
def permute_frames(chunk, edges, first, T, log, K, rank, orders, drifts, terms, sums):
    """Statistics of the scene with its groups of frames in other orders, the same for all voxels.

    edges (CHUNKS + 1, 2) bounds each chunk's voxels and their observations; rank (m,) is the group of each observation
    of the voxels, one voxel after the other, orders (R, G) the groups in each order. sums (CHUNKS, R, 2) takes, over
    voxels: the drift a step; the trend divided by sum_t (t - mean t)^2, over those with T > 2. The groups are gone
    through in their order and tell all voxels what they saw, so that nothing has to be sorted.
    """
    first, T = first[edges[chunk, 0] : edges[chunk + 1, 0]], T[edges[chunk, 0] : edges[chunk + 1, 0]]
    rank = rank[edges[chunk, 1] : edges[chunk + 1, 1]]
    starts, slot, share, voxel, one_hot, slots, bounds, made = _gather(first, T, log, K, rank, orders.shape[1])
    total, plogs, moment = np.empty(slots[-1]), np.empty(slots[-1]), np.empty(slots[-1])
    spread, seen = np.empty(T.shape[0]), np.empty(T.shape[0], np.int64)
    for r in range(orders.shape[0]):
        total[:] = 0.0
        plogs[:] = 0.0
        moment[:] = 0.0
        spread[:] = 0.0
        seen[:] = 0
        for place in range(orders.shape[1]):
            group = orders[r, place]
            for j in range(bounds[group], bounds[group + 1]):
                at = made[j]
                i = voxel[at]
                t, weight = seen[i], seen[i] - 0.5 * (T[i] - 1)
                seen[i] = t + 1
                for e in range(starts[at], starts[at + 1]):
                    moment[slot[e]] += weight * share[e]
                if one_hot[i]:
                    a = slot[starts[at]]
                    drift = drifts[np.int64(total[a]), t]
                    total[a] += 1.0
                else:
                    drift, spread[i] = blend(slot, share, starts[at], starts[at + 1], t, terms, total, plogs, spread[i])
                sums[chunk, r, 0] += drift / (T[i] - 1)
        for i in range(T.shape[0]):
            if T[i] > 2:
                trend = 0.0
                for a in range(slots[i], slots[i + 1]):
                    trend += moment[a] * moment[a]
                sums[chunk, r, 1] += trend / (T[i] * (T[i] * T[i] - 1) / 12)
