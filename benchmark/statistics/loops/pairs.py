"""Compiled passes over pairs: of observations, from which a correlogram follows, and of classes that share a voxel."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import helper, serial


@serial
def agreement(log, a, b):
    """Return s . s' of observations a and b; log is (starts, label, weight), labels ascending within an observation."""
    starts, label, weight = log
    i, j, agreed = starts[a], starts[b], 0.0
    while i < starts[a + 1] and j < starts[b + 1]:
        if label[i] == label[j]:
            agreed += weight[i] * weight[j]
        i, j = i + (label[i] <= label[j]), j + (label[j] <= label[i])
    return agreed


@serial
def add_pairs(first, second, bins, cluster, log, square, sums):
    """Add pairs (m,) of observations to `sums` (bins, clusters, 4 + K), in each of a pair's bins (m, axes).

    Either observation adds s . s', 1, ||s||^2, s and its squared distance from the spot, square (n,), to its cluster;
    cluster (n,) is that of each observation, log is (starts, label, weight) of all of them.
    """
    starts, label, weight = log
    for pair in range(first.shape[0]):
        agreed = agreement(log, first[pair], second[pair])
        for one in (first[pair], second[pair]):
            squared_norm, of = agreement(log, one, one), cluster[one]
            for axis in range(bins.shape[1]):
                k = bins[pair, axis]
                sums[k, of, 0] += agreed
                sums[k, of, 1] += 1.0
                sums[k, of, 2] += squared_norm
                for e in range(starts[one], starts[one + 1]):
                    sums[k, of, 3 + label[e]] += weight[e]
                sums[k, of, sums.shape[2] - 1] += square[one]


@serial
def add_feature_pairs(first, second, start, bins, cluster, agreed, self_products, along, sums):
    """Add pairs (m,) of observations to `sums` (bins, clusters, 5), in each of a pair's bins (m, axes).

    agreed (m,) is the cosine of a pair, own the squared length of each observation. along (n, bins) is its part along
    the sum of a bin, of observation `start` and those that follow.
    """
    for pair in range(first.shape[0]):
        for one in (first[pair], second[pair]):
            of = cluster[one]
            for axis in range(bins.shape[1]):
                k = bins[pair, axis]
                sums[k, of, 0] += agreed[pair]
                sums[k, of, 1] += 1.0
                sums[k, of, 2] += self_products[one]
                sums[k, of, 3] += along[one - start, k]


@serial
def add_class_pairs(evidence, op, weight_of, sums):
    """Add to `sums` (K, K), above its diagonal, how much two classes share a voxel, times its weight (n,).

    It is the product of the classes' shares of the voxel's evidence (starts, label, weight), whose sum is OP (n,).
    """
    starts, label, weight = evidence
    for i in range(op.shape[0]):
        if weight_of[i] == 0.0:
            continue
        for a in range(starts[i], starts[i + 1]):
            share = weight_of[i] * (weight[a] / op[i])
            for b in range(a + 1, starts[i + 1]):
                sums[label[a], label[b]] += share * (weight[b] / op[i])


@serial
def add_coincidences(bounds, log, half, pairs):
    """Add to `pairs` (2, K, K) how often two observations of a spot are of two classes, as alpha weighs it.

    Each observation is paired with the T - 1 others of its spot, which count 1 together (Krippendorff 2011); bounds
    (n + 1,) are the first observations of spots, log is (starts, label, weight) of all of them, and half (n,) is 0 or 1
    for each spot. One view alone makes no pair.
    """
    starts, label, weight = log
    total, met = np.zeros(pairs.shape[1]), np.empty(pairs.shape[1], np.int64)
    for spot in range(len(bounds) - 1):
        T, many = bounds[spot + 1] - bounds[spot], 0
        if T < 2:
            continue
        for one in range(bounds[spot], bounds[spot + 1]):
            for a in range(starts[one], starts[one + 1]):
                if total[label[a]] == 0.0:
                    met[many] = label[a]
                    many += 1
                total[label[a]] += weight[a]
                for b in range(starts[one], starts[one + 1]):  # no observation is paired with itself
                    pairs[half[spot], label[a], label[b]] -= weight[a] * weight[b] / (T - 1)
        for i in range(many):
            for j in range(many):
                pairs[half[spot], met[i], met[j]] += total[met[i]] * total[met[j]] / (T - 1)
        for i in range(many):
            total[met[i]] = 0.0


@serial
def add_similarity(bounds, log, cube, group, groups, products, columns, sums):
    """Add how similar the observations of a spot are to `sums` (cubes * groups, C), as `add_influences` adds agreement.

    products (K, K) are z_a . z_b of the classes' points. `columns` are those of the sums of observations with the
    others of their spot, of observations with themselves, and of the first of spots that two views saw.
    """
    starts, label, weight = log
    total, met = np.zeros(products.shape[0]), np.empty(products.shape[0], np.int64)
    for spot in range(len(bounds) - 1):
        first, end, many = bounds[spot], bounds[spot + 1], 0
        T = end - first
        if T < 2 or cube[spot] < 0:
            continue
        for e in range(starts[first], starts[end]):
            if total[label[e]] == 0.0:
                met[many] = label[e]
                many += 1
            total[label[e]] += weight[e]
        alike = 0.0
        for i in range(many):
            for j in range(many):
                alike += total[met[i]] * total[met[j]] * products[met[i], met[j]]
        for one in range(first, end):
            alike -= _with_itself(starts, label, weight, one, products)
        alike /= T * (T - 1.0)
        spread = 2.0 * (T - 1.0) / (T - 2.0) if T > 2 else 0.0
        for one in range(first, end):
            squared_norm, of_all = _with_itself(starts, label, weight, one, products), 0.0
            for e in range(starts[one], starts[one + 1]):
                for i in range(many):
                    of_all += weight[e] * total[met[i]] * products[label[e], met[i]]
            row = cube[spot] * groups + group[one]
            sums[row, columns[0]] += alike + spread * ((of_all - squared_norm) / (T - 1.0) - alike)
            sums[row, columns[1]] += squared_norm
            if T == 2:
                sums[row, columns[2]] += alike
        for i in range(many):
            total[met[i]] = 0.0


@helper
def _with_itself(starts, label, weight, one, products):
    """Return the product of an observation's point with itself."""
    squared_norm = 0.0
    for a in range(starts[one], starts[one + 1]):
        for b in range(starts[one], starts[one + 1]):
            squared_norm += weight[a] * weight[b] * products[label[a], label[b]]
    return squared_norm
