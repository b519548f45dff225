"""Compiled loop over the orders of stretches of time, the same for all voxels of a scene."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import serial
from semstab.statistics.loops.orders import LANES, dense, drifts, room, trends


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
