"""Compiled loops over the observations of voxels: in the orders in which they could have come.

Voxels of the same OP go through the same random orders, each beginning with its observations in an order of its own,
which depends on its location and the seed only: the same seed gives the same numbers for any number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from semstab.backends.shared.beliefs import js_term, plogp_of
from semstab.backends.shared.keys import mix
from semstab.backends.shared.score_loops import DOUBLES
from semstab.backends.shared.score_loops import LANES as EIGHT
from semstab.core.compiled import CHUNKS, compiled, serial

ENUMERATED = 5
"""Up to this OP all T! orders are gone through; 5! = 120."""

ROUNDING = 1e-9
"""Sums of the same terms in another order differ by less."""

LANES = 128
"""Orders that are drawn together."""

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""What the states of splitmix64 are apart."""

TURNS = 8
"""A random order begins at so many observations, as far apart as can be, and goes round: what comes first differs."""


@intrinsic
def _plogp_of_eight(_typing: Any, values: Any, _at: Any) -> Any:
    """values[at : at + 8] = p log2 p of each, by vector instructions, which the compiler has for no library's log."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        eight = builder.bitcast(builder.gep(array.data, [arguments[1]]), DOUBLES.as_pointer())
        builder.store(plogp_of(context, builder, builder.load(eight, align=8)), eight, align=8)
        return context.get_dummy_value()

    return types.void(values, types.intp), generate


@serial
def _drifts(x, A, T, order, lanes, drift):
    """The sum of drifts, bits, of observations x (A, T) in each of `lanes` orders (T, lanes), to drift (LANES,).

    A step's drift is H(m) - (H(p) + H(q)) / 2 with the mean m of the beliefs p and q before and after: each belief but
    the first and last is one after, then one before.
    """
    wide = -(-lanes // EIGHT) * EIGHT
    seen, q, m = np.empty(LANES), np.zeros(LANES), np.zeros(LANES)
    drift[:wide] = 0.0
    for a in range(A):
        seen[:wide] = 0.0
        for t in range(T):
            before, after, weight = 1.0 / max(t, 1), 1.0 / (t + 1), 0.5 if t == 0 or t == T - 1 else 1.0
            for lane in range(lanes):
                p = seen[lane] * before
                seen[lane] += x[a, order[t, lane]]
                q[lane] = seen[lane] * after
                m[lane] = 0.5 * (p + q[lane])
            for lane in range(0, wide, EIGHT):
                _plogp_of_eight(q, lane)
            if t == 0:
                drift[:wide] += weight * q[:wide]
                continue
            for lane in range(0, wide, EIGHT):
                _plogp_of_eight(m, lane)
            for lane in range(wide):
                drift[lane] += weight * q[lane] - m[lane]


@compiled(fastmath={"reassoc", "contract"})
def _trends(x, A, T, age, lanes, moment, trend):
    """|| sum_t (t - mean t) s_t ||^2 in each of `lanes` orders, to trend (LANES,).

    age (T, LANES) is t - mean t of each observation; moment (LANES,) is work space. As ages add up to 0, what most
    observations have of a class, all or nothing, can be left out of each.
    """
    trend[:lanes] = 0.0
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
def _dense(log, first, T, number, at, x):
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
def seen_trends(chunk, first, T, log, K, trend):
    """|| sum_t (t - mean t) s_t ||^2 of each voxel's observations as they came, to trend (n,)."""
    starts, label, weight = log
    moment = np.zeros(K)
    for i in range(chunk, T.shape[0], CHUNKS):
        for t in range(T[i]):
            for e in range(starts[first[i] + t], starts[first[i] + t + 1]):
                moment[label[e]] += (t - 0.5 * (T[i] - 1)) * weight[e]
        for e in range(starts[first[i]], starts[first[i] + T[i]]):
            trend[i] += moment[label[e]] ** 2
            moment[label[e]] = 0.0


@serial
def _work_space(T, entries, K):
    """Work space for voxels of OP up to T (n,) and so many entries: x, number, order, age, moment, value, at."""
    longest, classes = 1, max(1, min(K, entries))
    for i in range(T.shape[0]):
        longest = max(longest, T[i])
    order, age, at = np.empty((longest, LANES), np.int64), np.empty((longest, LANES)), np.arange(longest)
    return np.empty((classes, longest)), np.full(K, -1), order, age, np.empty(LANES), np.empty(LANES), at


@serial
def draw_streams(index, seed, streams):
    """A random stream of each voxel (n,) from its index (n, 3) and the seed."""
    for i in range(index.shape[0]):
        state = seed
        for axis in range(3):
            state = mix(state ^ np.uint64(index[i, axis]))
        streams[i] = state


@serial
def _shuffle(order, T, state):
    """A random order of T observations, to order (T,), from the stream (splitmix64) whose state (1,) it advances."""
    for t in range(T):
        state[0] += GOLDEN
        other = np.int64(((mix(state[0]) >> np.uint64(32)) * np.uint64(t + 1)) >> np.uint64(32))
        order[t] = order[other]
        order[other] = t


@serial
def _draw_orders(order, age, T, seed):
    """Random orders (T, LANES), and t - mean t of each observation in random orders: the inverse of one is one."""
    for t in range(T):
        for lane in range(LANES):
            drawn = mix(seed + np.uint64(t * LANES + lane) * GOLDEN) >> np.uint64(32)
            other = np.int64((drawn * np.uint64(t + 1)) >> np.uint64(32))
            order[t, lane] = order[other, lane]
            order[other, lane] = t
    age[:T] = order[:T] - 0.5 * (T - 1)


@serial
def test_all_orders(chunk, voxels, first, T, log, K, entries, order, age, null, p):
    """Voxels of these numbers (r,), all of OP T <= ENUMERATED, in all of their orders.

    order (T, T!) is the number of the observation that comes at each step, in the first order as they came; age
    (T, T!) is t - mean t of each observation. null (n,) takes the mean sum of drifts; p (n, 3) the shares of the orders
    whose sum of drifts is as low, and as high, and whose trend is as high.
    """
    lanes, at, number = order.shape[1], np.arange(T), np.full(K, -1)
    x, moment, value = np.empty((max(1, min(K, entries)), T)), np.empty(LANES), np.empty(LANES)
    for j in range(chunk, voxels.shape[0], CHUNKS):
        i = voxels[j]
        A = _dense(log, first[i], T, number, at, x)
        _drifts(x, A, T, order, lanes, value)
        null[i] = value[:lanes].mean()
        p[i, 0] = (value[:lanes] <= value[0] + ROUNDING).mean()
        p[i, 1] = (value[:lanes] >= value[0] - ROUNDING).mean()
        if T > 2:
            _trends(x, A, T, age, lanes, moment, value)
            p[i, 2] = (value[:lanes] >= value[0] - ROUNDING * (1.0 + value[0])).mean()


@serial
def mean_drifts(chunk, voxels, first, T, log, K, entries, seeds, draws, null):
    """The mean sum of drifts of `draws` random orders, TURNS of which are turns of one, to null (n,)."""
    x, number, turned, _, _, value, at = _work_space(T, entries, K)
    own = np.empty(1, np.uint64)
    for j in range(chunk, voxels.shape[0], CHUNKS):
        i = voxels[j]
        steps, total = T[i], 0.0
        for t in range(steps):
            for turn in range(TURNS):
                turned[t, turn] = (t + turn * steps // TURNS) % steps
        own[0] = seeds[i]
        for drawn in range(0, draws, TURNS):
            _shuffle(at, steps, own)
            A = _dense(log, first[i], steps, number, at, x)
            lanes = min(TURNS, draws - drawn)
            _drifts(x, A, steps, turned, lanes, value)
            total += value[:lanes].sum()
        null[i] = total / draws


@serial
def _groups(chunk, rank, T):
    """The voxels of a chunk, those of the same OP together; rank (r,) sorts all by OP."""
    first, last = chunk * rank.shape[0] // CHUNKS, (chunk + 1) * rank.shape[0] // CHUNKS
    groups = []
    for i in range(first + 1, last + 1):
        if i == last or T[rank[i]] != T[rank[i - 1]]:
            groups.append(rank[first:i].copy())
            first = i
    return groups


@serial
def test_orders(chunk, rank, first, T, log, K, entries, seeds, seed, seen, together, most, enough, tails):
    """P-values of voxels from up to `most` random orders, drawn `together` at a time, at most LANES.

    rank (r,) are the voxels that are tested, sorted by OP; first, T (n,) are their rows of the log, seeds (n,) their
    random streams, and `entries` is the most that one has. tails (n, 1) takes the share of the orders whose trend is as
    high as that seen (n,); tails (n, 2) the shares whose sum of drifts is as high, and as low, and `seen` is not read.
    A tail is settled by `enough` orders: as the share of the orders until then (Besag and Clifford 1991, Biometrika
    78). `tails` must be NaN before.
    """
    x, number, order, age, moment, value, at = _work_space(T, entries, K)
    own, sides, least = np.empty(1, np.uint64), tails.shape[1], np.empty(2)
    for voxels in _groups(chunk, rank, T):
        steps, tried, left = T[voxels[0]], 0, voxels.shape[0]
        base, hits, drift = mix(seed ^ np.uint64(steps)), np.zeros((left, sides), np.int64), np.empty(left)
        unsettled = np.arange(left)
        while left:
            lanes, remaining = min(together, most - tried), 0
            _draw_orders(order, age, steps, mix(base + np.uint64(tried)))
            for j in unsettled[:left]:
                i = voxels[j]
                own[0] = seeds[i]
                _shuffle(at, steps, own)
                A = _dense(log, first[i], steps, number, at, x)
                if sides == 1:
                    _trends(x, A, steps, age, lanes, moment, value)
                    least[0] = seen[i] - ROUNDING * (1.0 + seen[i])
                else:
                    if tried == 0:
                        _drifts(x, A, steps, at.reshape(-1, 1), 1, value)
                        drift[j] = value[0]
                    _drifts(x, A, steps, order, lanes, value)
                    least[0], least[1] = drift[j] - ROUNDING, -drift[j] - ROUNDING
                for side in range(sides):
                    lane, sign = 0, 1.0 - 2.0 * side
                    while lane < lanes and hits[j, side] < enough:
                        hits[j, side] += sign * value[lane] >= least[side]
                        lane += 1
                    if np.isnan(tails[i, side]) and hits[j, side] == enough:
                        tails[i, side] = enough / (tried + lane)
                    elif np.isnan(tails[i, side]) and tried + lanes == most:
                        tails[i, side] = (hits[j, side] + 1) / (most + 1)
                if np.isnan(tails[i]).any():
                    unsettled[remaining] = j
                    remaining += 1
            left, tried = remaining, tried + lanes


@serial
def permute_stretches(chunk, edges, first, T, log, K, entries, stretch, orders, sums):
    """Statistics of the scene with its stretches of time in other orders, the same for all voxels.

    edges (CHUNKS + 1, 2) bounds each chunk's voxels and their observations; stretch (m,) is that of each observation of
    the voxels, one voxel after the other, orders (S, R) the stretches in each order; `entries` is the most that a voxel
    has. sums (CHUNKS, R, 2) takes, over voxels: the drift a step; the trend divided by sum_t (t - mean t)^2, over those
    with T > 2.
    """
    x, number, order, age, moment, value, natural = _work_space(T, entries, K)
    at = edges[chunk, 1]
    for i in range(edges[chunk, 0], edges[chunk + 1, 0]):
        A, steps = _dense(log, first[i], T[i], number, natural, x), T[i]
        by_time = np.argsort(stretch[at : at + steps], kind="mergesort")
        bounds = np.searchsorted(stretch[at : at + steps][by_time], np.arange(orders.shape[0] + 1))
        for r in range(0, orders.shape[1], LANES):
            lanes = min(LANES, orders.shape[1] - r)
            for lane in range(lanes):
                t = 0
                for s in orders[:, r + lane]:
                    for j in by_time[bounds[s] : bounds[s + 1]]:
                        order[t, lane], age[j, lane] = j, t - 0.5 * (steps - 1)
                        t += 1
            _drifts(x, A, steps, order, lanes, value)
            sums[chunk, r : r + lanes, 0] += value[:lanes] / (steps - 1)
            if steps > 2:
                _trends(x, A, steps, age, lanes, moment, value)
                sums[chunk, r : r + lanes, 1] += value[:lanes] / (steps * (steps * steps - 1) / 12)
        at += steps


# Compiled loops over one-hot observations, whose drift depends on counts only.

LONGEST_TABLE = 256
"""Up to this OP the drift of one-hot observations is looked up."""


@serial
def one_hot_drifts(longest):
    """D_JS of the beliefs after t and t + 1 one-hot observations, bits, at [c, t] of a table (longest, longest).

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
