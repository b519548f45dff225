"""Compiled loops over the observations of voxels: the orders in which they could have come, and rules to fuse them.

Voxels go by chunks whose number does not depend on the number of threads, each voxel draws from a random stream of its
own, and every sum runs in one fixed order: the same seed gives the same numbers for any number of threads.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba as nb
import numpy as np

from semstab.backends.shared.beliefs import js_term
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
def shrinking_drifts(longest):
    """Table (longest,) at [t] of what a class adds that had one of t observations and is not in the next one."""
    drifts = np.zeros(longest)
    for t in range(1, longest):
        drifts[t] = js_term(1 / t, 1 / (t + 1))
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
def _load(evidence, first, T, starts, column, share):
    """Copy a voxel's T observations as entries that are not 0: the t-th has starts[t] to starts[t + 1].

    An entry has its class, numbered among the A that the voxel ever saw, and its share of the observation. Returns A,
    the number of entries, and whether all observations are one-hot and few enough for the table of drifts.
    """
    K = evidence.shape[1]
    number = np.full(K, -1)
    A = entries = 0
    for t in range(T):
        starts[t] = entries
        for k in range(K):
            if evidence[first + t, k] > 0.0:
                if number[k] < 0:
                    number[k] = A
                    A += 1
                column[entries] = number[k]
                share[entries] = evidence[first + t, k]
                entries += 1
    starts[T] = entries
    return A, entries, entries == T and T <= LONGEST_TABLE


@serial
def _blend(column, share, first, last, t, weight, shrink, total, moment):
    """Add entries first..last of a voxel's observation, the t-th, counted from 0; returns the drift it causes, bits.

    total and moment take, by class, the shares and `weight` times them. A class that is not in the new observation only
    shrinks, by t / (t + 1): `shrink` is what that adds for each observation of it, so that only the classes of the new
    observation have to be looked at.
    """
    drift, others = 0.0, np.float64(t)
    for entry in range(first, last):
        a = column[entry]
        before = total[a]
        total[a] = before + share[entry]
        moment[a] += weight * share[entry]
        if t > 0:
            others -= before
            drift += js_term(before / t, total[a] / (t + 1))
    return drift + others * shrink


@serial
def _measure(order, voxel, drifts, shrinks, work, out):
    """The sum of drifts, bits, and the trend || sum_t (t - mean t) s_t ||^2 in that order; work space is (2, A)."""
    starts, column, share, T, A, one_hot = voxel
    total, moment = work
    total[:A] = 0.0
    moment[:A] = 0.0
    middle = 0.5 * (T - 1)
    drift = trend = 0.0
    if one_hot:
        for t in range(T):
            a = column[order[t]]
            drift += drifts[np.int64(total[a]), t]
            total[a] += 1.0
            moment[a] += t - middle
    else:
        for t in range(T):
            first, last = starts[order[t]], starts[order[t] + 1]
            drift += _blend(column, share, first, last, t, t - middle, shrinks[t], total, moment)
    for a in range(A):
        trend += moment[a] * moment[a]
    out[0] = drift
    out[1] = trend


# --- Orders of one voxel ----------------------------------------------------------------------------------------------


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
def _try(order, voxel, drifts, shrinks, seen, work, hits):
    """Count an order towards the tails: a drift as low, one as high, a trend as high as seen; returns its drift."""
    out = work[2]
    _measure(order, voxel, drifts, shrinks, work[:2], out)
    hits[0] += 1 if out[0] <= seen[0] + ROUNDING else 0
    hits[1] += 1 if out[0] >= seen[0] - ROUNDING else 0
    hits[2] += 1 if out[1] >= seen[1] - ROUNDING * (1.0 + seen[1]) else 0
    return out[0]


@serial
def _try_all(order, voxel, drifts, shrinks, seen, work, hits, p):
    """The p-values over all T! orders, exactly; returns the mean drift."""
    total = 0.0
    tried = 0
    more = True
    while more:
        total += _try(order, voxel, drifts, shrinks, seen, work, hits)
        tried += 1
        more = _next_order(order, voxel[3])
    for tail in range(3):
        p[tail] = hits[tail] / tried
    return total / tried


@serial
def _try_some(order, voxel, drifts, shrinks, seen, work, hits, p, state, least, most, enough):
    """The p-values from random orders; returns the mean drift of the first `least` of them.

    A tail that has met `enough` orders is settled: its p-value is their share of the orders tried until then. The
    others take all `most` orders (Besag and Clifford 1991, Biometrika 78).
    """
    total = 0.0
    tried = open_tails = 0
    p[:] = 0.0
    while tried < least or (tried < most and open_tails > 0):
        _shuffle(order, voxel[3], state)
        drift = _try(order, voxel, drifts, shrinks, seen, work, hits)
        tried += 1
        if tried <= least:
            total += drift
        open_tails = 0
        for tail in range(3):
            if hits[tail] == enough and p[tail] == 0.0:
                p[tail] = enough / tried
            open_tails += 1 if p[tail] == 0.0 else 0
    for tail in range(3):
        if p[tail] == 0.0:
            p[tail] = (hits[tail] + 1) / (tried + 1)
    return total / least


@serial
def permute_voxels(chunk, first, T, evidence, drifts, shrinks, seeds, least, most, enough, seen, null, p):
    """Compare each voxel's order of observations with all orders of them, or with random ones where T > ENUMERATED.

    first, T (n,) are its rows of evidence (m, K), seeds (n,) its random stream. seen (n, 2) takes its sum of drifts and
    its trend, null (n,) the mean sum of drifts over orders, p (n, 3) the p-values of `_try`'s tails.
    """
    K = evidence.shape[1]
    longest = T.max() if T.shape[0] else 0
    starts, order = np.empty(longest + 1, dtype=np.int64), np.empty(longest, dtype=np.int64)
    column, share = np.empty(longest * K, dtype=np.int64), np.empty(longest * K)
    work = np.empty((3, max(K, 2)))
    hits, state = np.empty(3, dtype=np.int64), np.empty(1, dtype=np.uint64)
    for i in range(chunk, T.shape[0], CHUNKS):
        A, _, one_hot = _load(evidence, first[i], T[i], starts, column, share)
        voxel = starts, column, share, T[i], A, one_hot
        for t in range(T[i]):
            order[t] = t
        _measure(order, voxel, drifts, shrinks, work[:2], seen[i])
        hits[:] = 0
        if T[i] <= ENUMERATED:
            null[i] = _try_all(order, voxel, drifts, shrinks, seen[i], work, hits, p[i])
        else:
            state[0] = seeds[i]
            null[i] = _try_some(order, voxel, drifts, shrinks, seen[i], work, hits, p[i], state, least, most, enough)


# --- Orders of the frames ---------------------------------------------------------------------------------------------


@serial
def _gather(first, T, evidence, rank, frames):
    """The observations of some voxels, numbered voxel by voxel, and which of them each frame made.

    Returns starts, slot and share as `_load` does, slots being counted on from voxel to voxel; the voxel of each
    observation; whether a voxel is one-hot; the bounds of its slots; bounds and numbers of each frame's observations.
    """
    K = evidence.shape[1]
    observations = T.sum()
    size = 0
    for i in range(T.shape[0]):
        for row in range(first[i], first[i] + T[i]):
            for k in range(K):
                size += 1 if evidence[row, k] > 0.0 else 0
    starts, slot, share = np.zeros(observations + 1, np.int64), np.empty(size, np.int64), np.empty(size)
    voxel, made = np.empty(observations, np.int64), np.empty(observations, np.int64)
    one_hot, slots = np.empty(T.shape[0], np.bool_), np.zeros(T.shape[0] + 1, np.int64)
    bounds = np.zeros(frames + 1, np.int64)
    at = entries = 0
    for i in range(T.shape[0]):
        A, added, one_hot[i] = _load(evidence, first[i], T[i], starts[at:], slot[entries:], share[entries:])
        slots[i + 1] = slots[i] + A
        for entry in range(entries, entries + added):
            slot[entry] += slots[i]
        for t in range(T[i]):
            starts[at + t] += entries
            voxel[at + t] = i
            bounds[rank[first[i] + t] + 1] += 1
        at += T[i]
        entries += added
    starts[at] = entries
    bounds = np.cumsum(bounds)
    free = bounds.copy()
    at = 0
    for i in range(T.shape[0]):
        for row in range(first[i], first[i] + T[i]):
            made[free[rank[row]]] = at
            free[rank[row]] += 1
            at += 1
    return starts, slot, share, voxel, one_hot, slots, bounds, made


@serial
def permute_frames(chunk, first, T, evidence, rank, orders, drifts, shrinks, sums):
    """Statistics of the scene with its frames in other orders, the same for all voxels.

    rank (m,) is the frame of each observation, orders (R, F) the frames in each order. sums (CHUNKS, R, 2) takes, over
    voxels: the drift a step; the trend divided by sum_t (t - mean t)^2, over those with T > 2. The frames are gone
    through in their order and tell all voxels what they saw, so that nothing has to be sorted.
    """
    some = slice(chunk * T.shape[0] // CHUNKS, (chunk + 1) * T.shape[0] // CHUNKS)
    first, T = first[some], T[some]
    starts, slot, share, voxel, one_hot, slots, bounds, made = _gather(first, T, evidence, rank, orders.shape[1])
    total, moment, seen = np.empty(slots[-1]), np.empty(slots[-1]), np.empty(T.shape[0], np.int64)
    for r in range(orders.shape[0]):
        total[:] = 0.0
        moment[:] = 0.0
        seen[:] = 0
        for place in range(orders.shape[1]):
            frame = orders[r, place]
            for j in range(bounds[frame], bounds[frame + 1]):
                at = made[j]
                i = voxel[at]
                t, weight, first_entry = seen[i], seen[i] - 0.5 * (T[i] - 1), starts[at]
                seen[i] = t + 1
                if one_hot[i]:
                    a = slot[first_entry]
                    drift = drifts[np.int64(total[a]), t]
                    total[a] += 1.0
                    moment[a] += weight
                else:
                    drift = _blend(slot, share, first_entry, starts[at + 1], t, weight, shrinks[t], total, moment)
                sums[chunk, r, 0] += drift / (T[i] - 1)
        for i in range(T.shape[0]):
            if T[i] > 2:
                trend = 0.0
                for a in range(slots[i], slots[i + 1]):
                    trend += moment[a] * moment[a]
                sums[chunk, r, 1] += trend / (T[i] * (T[i] * T[i] - 1) / 12)


# --- Fusion rules -----------------------------------------------------------------------------------------------------


@serial
def fuse_by_rule(chunk, starts, evidence, pooled, mean, belief, drift_sum):
    """Fuse each voxel's observations by adding them, or their logarithms where `pooled`; `mean` divides by how many.

    starts (n + 1,) bounds its rows of evidence (m, K). belief (n, K) takes the belief after the last observation,
    drift_sum (n,) the sum of the Jensen-Shannon divergences of successive beliefs, bits.
    """
    K = evidence.shape[1]
    total, before, after = np.empty(K), np.empty(K), np.empty(K)
    for i in range(chunk, belief.shape[0], CHUNKS):
        total[:] = 0.0
        drift = 0.0
        for row in range(starts[i], starts[i + 1]):
            count = row - starts[i] + 1
            for k in range(K):
                total[k] += np.log(evidence[row, k]) if pooled else evidence[row, k]
            scale = 1.0 / count if mean or not pooled else 1.0
            top = total.max() * scale
            norm = 0.0
            for k in range(K):
                after[k] = np.exp(total[k] * scale - top) if pooled else total[k] * scale
                norm += after[k]
            step = 0.0
            for k in range(K):
                after[k] /= norm
                if count > 1:
                    step += js_term(before[k], after[k])
                before[k] = after[k]
            drift += min(max(step, 0.0), 1.0)
        drift_sum[i] = drift
        belief[i] = after
