"""Compiled loops over the observations of voxels, in the orders in which they could have come.

Many orders go side by side, one in each lane, so that logarithms are vector instructions. Voxels of the same OP go
through the same random orders, each beginning with its observations in an order of its own, which depends on its place
and the seed only: the same seed gives the same numbers for any number of threads, and for any parts of a map.
"""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.beliefs import js_term
from semstab.backends.shared.keys import mix
from semstab.core.compiled import CHUNKS, compiled, serial
from semstab.statistics.loops.logarithm import EIGHT, add_step

ENUMERATED = 5
"""Up to this OP all T! orders are gone through; 5! = 120."""

ROUNDING = 1e-9
"""Sums of the same terms in another order differ by less."""

LANES = 128
"""Orders that go side by side, at most."""

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""What the states of splitmix64 are apart."""

TURNS = 8
"""A random order begins at so many places, as far apart as can be, and goes round: what comes first differs."""


# --- Orders, side by side ---------------------------------------------------------------------------------------------


@serial
def drifts(x, A, T, order, lanes, work, drift):
    """The sum of drifts, bits, in each of `lanes` orders, to drift (LANES,).

    x (A, T) are the observations, order (T, LANES) the number of the observation that comes at each step; work space is
    (2 A, LANES). A step's drift is H(m) - (H(p) + H(q)) / 2 with the mean m of the beliefs p and q before and after:
    each belief but the first and last is one after, then one before.
    """
    wide = -(-lanes // EIGHT) * EIGHT
    work[:A, :wide] = 0.0
    drift[:wide] = 0.0
    for t in range(T):
        soon = t % (LANES // wide)
        if soon == 0:  # well before they are read: what was stored as numbers is not at hand as a vector
            for a in range(A):
                for step in range(min(LANES // wide, T - t)):
                    for lane in range(lanes):
                        work[A + a, step * wide + lane] = x[a, order[t + step, lane]]
        whole = 0.5 if t == 0 or t == T - 1 else 1.0
        mixed = 1.0 if t > 0 else 0.0
        before, after = 1.0 / max(t, 1), 1.0 / (t + 1)
        for a in range(A):
            more = (A + a) * LANES + soon * wide
            for lane in range(0, lanes, EIGHT):
                add_step(drift, lane, work, a * LANES + lane, work, more + lane, before, after, mixed, whole)


@compiled(fastmath={"reassoc", "contract"})
def trends(x, A, T, age, lanes, work, trend):
    """|| sum_t (t - mean t) s_t ||^2 in each of `lanes` orders, to trend (LANES,).

    age (T, LANES) is t - mean t of each observation; work space is (1, LANES). As these add up to 0, what most
    observations have of a class, all or nothing, can be left out of each.
    """
    trend[:lanes] = 0.0
    moment = work[0]
    for a in range(A):
        moment[:lanes] = 0.0
        others = 0
        for j in range(T):
            others += (x[a, j] == 1.0) - (x[a, j] == 0.0)
        usual = 1.0 if others > 0 else 0.0
        for j in range(T):
            share = x[a, j] - usual
            if share != 0.0:
                for lane in range(lanes):
                    moment[lane] += share * age[j, lane]
        for lane in range(lanes):
            trend[lane] += moment[lane] * moment[lane]


@serial
def dense(log, first, T, number, at, x):
    """A voxel's T observations as columns `at` (T,) of x (A, T); returns A, how many classes it ever saw.

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
def room(T, entries, K):
    """Work space for voxels of OP up to T (n,) and so many entries: x, work, number, order, age, value."""
    longest, classes = 1, max(1, min(K, entries))
    for i in range(T.shape[0]):
        longest = max(longest, T[i])
    x, work, number = np.empty((classes, longest)), np.zeros((2 * classes, LANES)), np.full(K, -1)
    return x, work, number, np.empty((longest, LANES), np.int64), np.empty((longest, LANES)), np.empty(LANES)


# --- Random and all orders --------------------------------------------------------------------------------------------


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
    state[0] += GOLDEN
    return np.int64(((mix(state[0]) >> np.uint64(32)) * np.uint64(n)) >> np.uint64(32))


@serial
def _shuffle(order, T, state):
    """A random order of T observations, to order (T,)."""
    for t in range(T):
        other = _below(state, t + 1)
        order[t] = order[other]
        order[other] = t


@serial
def _draw_orders(order, age, T, seed, other):
    """Random orders (T, LANES), and t - mean t of each observation in random orders: the inverse of one is one."""
    for t in range(T):
        for lane in range(LANES):
            drawn = mix(seed + np.uint64(t * LANES + lane) * GOLDEN) >> np.uint64(32)
            other[lane] = np.int64((drawn * np.uint64(t + 1)) >> np.uint64(32))
        for lane in range(LANES):
            order[t, lane] = order[other[lane], lane]
            order[other[lane], lane] = t
    for t in range(T):
        for lane in range(LANES):
            age[t, lane] = order[t, lane] - 0.5 * (T - 1)


# --- Orders of one voxel ----------------------------------------------------------------------------------------------


@serial
def _shares(value, lanes, slack):
    """The shares of the values of all orders that are as low as the first, which came, and as high."""
    low = high = 0
    for lane in range(lanes):
        low += value[lane] <= value[0] + slack
        high += value[lane] >= value[0] - slack
    return low / lanes, high / lanes


@serial
def measure_all_orders(chunk, voxels, first, T, log, K, entries, order, age, trend, null, p):
    """As `measure_voxels`, of voxels of these numbers (r,), all of OP T <= ENUMERATED, from all of their orders.

    order (T, T!) is the number of the observation that comes at each step, in the first order as they came; age
    (T, T!) is t - mean t of each observation.
    """
    classes, lanes = max(1, min(K, entries)), order.shape[1]
    x, work, number = np.empty((classes, T)), np.zeros((2 * classes, LANES)), np.full(K, -1)
    at, value = np.arange(T), np.empty(LANES)
    for j in range(chunk * voxels.shape[0] // CHUNKS, (chunk + 1) * voxels.shape[0] // CHUNKS):
        i = voxels[j]
        A = dense(log, first[i], T, number, at, x)
        drifts(x, A, T, order, lanes, work, value)
        null[i] = value[:lanes].mean()
        p[i, 0], p[i, 1] = _shares(value, lanes, ROUNDING)
        if T > 2:
            trends(x, A, T, age, lanes, work, value)
            trend[i] = value[0]
            p[i, 2] = _shares(value, lanes, ROUNDING * (1.0 + value[0]))[1]


@serial
def _groups(chunk, rank, T):
    """The voxels of a chunk, those of the same OP together; rank (n,) sorts all by OP."""
    first, last = chunk * rank.shape[0] // CHUNKS, (chunk + 1) * rank.shape[0] // CHUNKS
    groups = []
    for i in range(first + 1, last + 1):
        if i == last or T[rank[i]] != T[rank[i - 1]]:
            groups.append(rank[first:i].copy())
            first = i
    return groups


@serial
def _own_order(at, T, seed, state):
    """The order in which a voxel's observations go through the orders that all voxels of this OP go through."""
    state[0] = seed
    _shuffle(at, T, state)


@serial
def _trend(x, A, T, at):
    """|| sum_t (t - mean t) s_t ||^2 of the observations in columns `at`."""
    trend = 0.0
    for a in range(A):
        moment = 0.0
        for t in range(T):
            moment += (t - 0.5 * (T - 1)) * x[a, at[t]]
        trend += moment * moment
    return trend


@serial
def _tail(hits, tried, value, least, lanes, enough):
    """The p-value, NaN until there are `enough` hits, and the hits, values >= least, after `lanes` more orders.

    Enough of them settle it: as the share of the orders until then (Besag and Clifford 1991, Biometrika 78).
    """
    more = 0
    for lane in range(lanes):
        more += value[lane] >= least
    if hits + more < enough:
        return np.nan, hits + more
    lane = -1
    while hits < enough:
        lane += 1
        hits += value[lane] >= least
    return enough / (tried + lane + 1), hits


@serial
def _mean_drift(x, A, log, first, T, number, at, own, turned, draws, work, value):
    """The mean sum of drifts over turns of the order in which x has the observations, and of further random ones."""
    total = 0.0
    for drawn in range(0, draws, TURNS):
        if drawn:
            _shuffle(at, T, own)
            dense(log, first, T, number, at, x)
        lanes = min(TURNS, draws - drawn)
        drifts(x, A, T, turned, lanes, work, value)
        for lane in range(lanes):
            total += value[lane]
    return total / draws


@serial
def measure_voxels(chunk, rank, first, T, log, K, entries, seeds, seed, known, draws, most, enough, trend, null, p):
    """What each voxel's order gives, and what orders of its observations give.

    rank (n,) sorts the voxels by OP; first, T (n,) are their rows of the log, seeds (n,) their random streams, and
    `entries` is the most that one has. null (n,) takes the mean sum of drifts of `draws` random orders, TURNS of which
    are turns of one, unless it is `known` (n,), and p[:, 2] of (n, 3) comes from random orders until `enough` of them
    have a trend as high, or from the `most` that there are. trend (n,) takes what was seen.
    """
    x, work, number, order, age, value = room(T, entries, K)
    at, own, other = np.empty(x.shape[1], np.int64), np.empty(1, np.uint64), np.empty(LANES, np.int64)
    turned = np.empty((x.shape[1], TURNS), np.int64)
    for voxels in _groups(chunk, rank, T):
        steps = T[voxels[0]]
        base, left, tried = mix(seed ^ np.uint64(steps)), voxels.shape[0], 0
        hits = np.zeros(left, np.int64)
        for t in range(steps):
            for turn in range(TURNS):
                turned[t, turn] = (t + turn * steps // TURNS) % steps
        while left:
            lanes = min(LANES, most - tried)
            _draw_orders(order, age, steps, mix(base + np.uint64(tried)), other)
            open_ = 0
            for j in range(left):
                i = voxels[j]
                _own_order(at, steps, seeds[i], own)
                A = dense(log, first[i], steps, number, at, x)
                if tried == 0:
                    trend[i] = _trend(x, A, steps, at)
                trends(x, A, steps, age, lanes, work, value)
                least = trend[i] - ROUNDING * (1.0 + trend[i])
                p[i, 2], hits[j] = _tail(hits[j], tried, value, least, lanes, enough)
                if np.isnan(p[i, 2]):
                    p[i, 2] = (hits[j] + 1) / (tried + lanes + 1)
                    voxels[open_], hits[open_] = i, hits[j]
                    open_ += 1
                if tried == 0 and not known[i]:
                    null[i] = _mean_drift(x, A, log, first[i], steps, number, at, own, turned, draws, work, value)
            left, tried = open_ if tried + lanes < most else 0, tried + lanes


@serial
def test_drifts(chunk, rank, first, T, log, K, entries, seeds, seed, most, enough, p):
    """P-values (n,) of the sum of drifts of voxels, either way, from up to `most` random orders; see `measure_voxels`.

    Each tail is settled by `enough` orders, and the smaller one counts twice.
    """
    x, work, number, order, age, value = room(T, entries, K)
    at, own, other = np.empty(x.shape[1], np.int64), np.empty(1, np.uint64), np.empty(LANES, np.int64)
    for voxels in _groups(chunk, rank, T):
        steps = T[voxels[0]]
        base, left, tried = mix(seed ^ np.uint64(steps)), voxels.shape[0], 0
        hits, tails, seen = np.zeros((left, 2), np.int64), np.full((left, 2), np.nan), np.empty(left)
        number_of = np.arange(left)
        while left:
            lanes = min(LANES // 2, most - tried)
            _draw_orders(order, age, steps, mix(base + np.uint64(tried)), other)
            open_ = 0
            for j in number_of[:left]:
                i = voxels[j]
                _own_order(at, steps, seeds[i], own)
                A = dense(log, first[i], steps, number, at, x)
                if tried == 0:
                    drifts(x, A, steps, at.reshape(-1, 1), 1, work, value)
                    seen[j] = value[0]
                drifts(x, A, steps, order, lanes, work, value)
                for side in range(2):
                    if side:
                        value[:lanes] = -value[:lanes]
                    if np.isnan(tails[j, side]):
                        least = (-seen[j] if side else seen[j]) - ROUNDING
                        tails[j, side], hits[j, side] = _tail(hits[j, side], tried, value, least, lanes, enough)
                        if np.isnan(tails[j, side]) and tried + lanes >= most:
                            tails[j, side] = (hits[j, side] + 1) / (most + 1)
                p[i] = min(1.0, 2.0 * tails[j].min())
                if np.isnan(tails[j]).any():
                    number_of[open_] = j
                    open_ += 1
            left, tried = open_, tried + lanes


# Compiled loop over the orders of stretches of time, the same for all voxels of a scene.


@serial
def _in_order(rank, T, stretches, order, age, bounds, made, begins, came):
    """The observations of a voxel in each order of the stretches (S, lanes), which rank (T,) puts them into.

    bounds (S + 1,), made (T,), begins (S, LANES) and came (LANES,) are work space.
    """
    bounds[:] = 0
    for t in range(T):
        bounds[rank[t] + 1] += 1
    for s in range(bounds.shape[0] - 1):
        bounds[s + 1] += bounds[s]
    for t in range(T):
        made[bounds[rank[t]]] = t
        bounds[rank[t]] += 1  # now where the next stretch begins
    came[:] = 0
    for turn in range(stretches.shape[0]):
        for lane in range(stretches.shape[1]):
            s = stretches[turn, lane]
            begins[s, lane] = came[lane]
            came[lane] += bounds[s] - (bounds[s - 1] if s else 0)
    for s in range(stretches.shape[0]):
        first = bounds[s - 1] if s else 0
        for j in range(first, bounds[s]):
            for lane in range(stretches.shape[1]):
                t = begins[s, lane] + (j - first)
                age[made[j], lane] = t - 0.5 * (T - 1)
                order[t, lane] = made[j]


@serial
def permute_stretches(chunk, edges, first, T, log, K, entries, rank, orders, sums):
    """Statistics of the scene with its stretches of time in other orders, the same for all voxels.

    edges (CHUNKS + 1, 2) bounds each chunk's voxels and their observations; rank (m,) is the stretch of each
    observation of the voxels, one voxel after the other, orders (S, R) the stretches in each order; `entries` is the
    most that a voxel has. sums (CHUNKS, R, 2) takes, over voxels: the drift a step; the trend divided by
    sum_t (t - mean t)^2, over those with T > 2.
    """
    x, work, number, order, age, value = room(T, entries, K)
    natural, made = np.arange(x.shape[1]), np.empty(x.shape[1], np.int64)
    bounds, at = np.empty(orders.shape[0] + 1, np.int64), edges[chunk, 1]
    begins, came = np.empty((orders.shape[0], LANES), np.int64), np.empty(LANES, np.int64)
    for i in range(edges[chunk, 0], edges[chunk + 1, 0]):
        A = dense(log, first[i], T[i], number, natural, x)
        for r in range(0, orders.shape[1], LANES):
            lanes = min(LANES, orders.shape[1] - r)
            own = rank[at : at + T[i]]
            _in_order(own, T[i], orders[:, r : r + lanes], order, age, bounds, made, begins, came)
            drifts(x, A, T[i], order, lanes, work, value)
            for lane in range(lanes):
                sums[chunk, r + lane, 0] += value[lane] / (T[i] - 1)
            if T[i] > 2:
                trends(x, A, T[i], age, lanes, work, value)
                for lane in range(lanes):
                    sums[chunk, r + lane, 1] += value[lane] / (T[i] * (T[i] * T[i] - 1) / 12)
        at += T[i]


# Compiled loops over one-hot observations, whose drift depends on counts only.

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
