"""Compiled passes over pairs of looks: how far they are apart and agree, and their sums by bin, cube and frames."""

from __future__ import annotations

import math

import numpy as np

from semstab.core.compiled import serial


@serial
def products(starts, label, weight, first, lag, out):
    """s . s' (m,) of the looks of these numbers, and those `lag` later, by the entries of their evidence."""
    for i in range(len(first)):
        a, b = starts[first[i]], starts[first[i] + lag]
        end_a, end_b = starts[first[i] + 1], starts[first[i] + lag + 1]
        total = 0.0
        while a < end_a and b < end_b:
            if label[a] == label[b]:
                total += weight[a] * weight[b]
            ahead_a, ahead_b = label[a] <= label[b], label[b] <= label[a]
            a, b = a + ahead_a, b + ahead_b
        out[i] = total


@serial
def distances(first, lag, rank, centre, ray, reach, time, cosine, ratio, baseline):
    """Of each pair (m,): steps between its frames, cosine of its directions, ratio of its ranges, and metres between.

    rank (n,) of each look's frame, centre (F, 3) of its camera, ray (n, 3) to it and reach (n,) of that
    """
    for i in range(len(first)):
        a, b = first[i], first[i] + lag
        p, q = rank[a], rank[b]
        time[i] = abs(q - p)
        cosine[i] = (ray[a, 0] * ray[b, 0] + ray[a, 1] * ray[b, 1] + ray[a, 2] * ray[b, 2]) / (reach[a] * reach[b])
        ratio[i] = max(reach[a], reach[b]) / min(reach[a], reach[b])
        x, y, z = centre[q, 0] - centre[p, 0], centre[q, 1] - centre[p, 1], centre[q, 2] - centre[p, 2]
        baseline[i] = math.sqrt(x * x + y * y + z * z)


@serial
def add_pairs(first, lag, bins, apart, cell, seen, limit, sums, limit_sums, pairs, distance):
    """Add pairs of looks, and those in the limit, to the sums of the bin that each is in along each axis.

    bins, apart  (m, A) the bin of each pair, and how far it is apart
    cell         (n,) the row of each look in the sums of a bin
    seen, limit  starts, label and weight of the entries of all looks, ||s||^2 (n,) of each, and s . s' (m,)
    sums         (bins, cells, 3 + K) of s . s' with the other look, of looks, of ||s||^2, and of s: what `between_of`
                 is a function of; limit_sums (bins, 3 + K), pairs and distance (bins,)
    """
    for i in range(len(first)):
        a, b = first[i], first[i] + lag
        for axis in range(bins.shape[1]):
            pairs[bins[i, axis]] += 1.0
            distance[bins[i, axis]] += apart[i, axis]
        for one in (a, b):
            add_look(sums[:, cell[one]], bins[i], one, i, seen)
            add_look(limit_sums, bins[i], one, i, limit)


@serial
def add_look(sums, bins, one, pair, looks):
    """Add a look of that number, in that pair, to these rows of the sums."""
    starts, label, weight, squares, product = looks
    for own in bins:
        sums[own, 0] += product[pair]
        sums[own, 1] += 1.0
        sums[own, 2] += squares[one]
    for entry in range(starts[one], starts[one + 1]):
        column, more = 3 + np.int64(label[entry]), weight[entry]
        for own in bins:
            sums[own, column] += more
