"""The compiled pass over the log that adds up what each frame contributed to each cube of space."""

from __future__ import annotations

import numpy as np

from semstab.runtime.compiled import serial
from semstab.statistics.loops.chunks import CHUNKS

(VOXELS, PSA, OBSERVATIONS, AGREEING, OWN, TWICE, TWICE_AGREEING, RECURRENT, VSS, ENTROPY) = range(10)
"""The columns that every map has, before those by class."""

DRIFT = 2
"""How many columns of drift follow those."""

(KNOWN, RIGHT, LOOKS, LOOKS_RIGHT, STABLE, STABLE_WRONG) = range(6)
"""The columns with ground truth, counted from the first of them."""

TIE = 1e-12
"""Sums of evidence that differ by no more are equal."""


@serial
def _classes_of(log, first, T, rows, total, squares, own, active):
    """A voxel's observations as dense rows (T, K), which are 0 before, their sums by class and those of squares.

    log is (starts, label, weight) of all observations. Returns how many classes the voxel ever saw: those in `active`,
    ascending; total and squares are of these only.
    """
    at, label, weight = log
    A = 0
    for t in range(T):
        own[t] = 0.0
        for e in range(at[first + t], at[first + t + 1]):
            k = np.int64(label[e])
            rows[t, k] = weight[e]
            own[t] += weight[e] ** 2
            j = A - 1
            while j >= 0 and active[j] > k:
                j -= 1
            if j < 0 or active[j] != k:
                for later in range(A, j + 1, -1):
                    active[later] = active[later - 1]
                active[j + 1] = k
                total[k] = squares[k] = 0.0
                A += 1
            total[k] += weight[e]
            squares[k] += weight[e] ** 2
    return A


@serial
def _cleared(log, first, T, rows):
    """Leave 0 where a voxel's observations were."""
    for t in range(T):
        for e in range(log[0][first + t], log[0][first + t + 1]):
            rows[t, log[1][e]] = 0.0


@serial
def _label(total, active, A):
    """The dominant class, the lowest of equals."""
    best = active[0]
    for j in range(1, A):
        if total[active[j]] > total[best]:
            best = active[j]
    return best


@serial
def _label_without(total, row, active, A):
    """The dominant class of the other observations."""
    best, most = active[0], total[active[0]] - row[active[0]]
    for j in range(1, A):
        rest = total[active[j]] - row[active[j]]
        if rest > most + TIE:
            best, most = active[j], rest
    return best


@serial
def _add_truth(sums, base, rows, first, T, many, group, truth, likely, total, active, A, without, mean, column, K):
    """What is right of so many voxels: of the fused label by leaving a frame out, of each look by itself.

    mean (K,) is room.
    """
    label = _label(total, active, A)
    right = 1.0 if label == truth else 0.0
    for j in range(A):
        mean[active[j]] = 0.0
    mean[truth] = 0.0
    part = 1.0 / T
    lead, most = total[label], 0.0
    for j in range(A):
        lead = min(lead, total[label] - total[active[j]]) if active[j] != label else lead
    for t in range(T):
        most = max(most, rows[t, label])
    settled = lead > most + TIE  # whichever is left out
    if settled:
        without[:T] = label
        mean[label] = 1.0
    else:
        for t in range(T):
            without[t] = _label_without(total, rows[t], active, A)
            mean[without[t]] += part
    for t in range(T):
        r = base + group[first + t]
        share = part * many
        own = (right + (T - 1) * (mean[truth] - (without[t] == truth))) * share
        sums[r, column + KNOWN] += share
        sums[r, column + RIGHT] += own
        sums[r, column + LOOKS] += many
        sums[r, column + LOOKS_RIGHT] += rows[t, truth] * many
        if T > 2:
            sums[r, column + STABLE] += likely * share
            sums[r, column + STABLE_WRONG] += likely * (1.0 - right) * share
        if K:
            sums[r, column + 6 + truth] += share
            sums[r, column + 6 + K + truth] += own
            predicted = column + 6 + 2 * K
            sums[r, predicted + label] += (1.0 + (T - 1) * (mean[label] - (without[t] == label))) * share
            for j in range(0 if settled else A):
                k = active[j]
                if k != label and mean[k] > 0.0:
                    sums[r, predicted + k] += (T - 1) * (mean[k] - (without[t] == k)) * share


@serial
def _agreement(total, squares, T, active, A, surprise, apart):
    """The agreement of two observations; of each class how surprising it is, and how far apart two of them are."""
    agreed = 0.0
    for j in range(A):
        k = active[j]
        pairs = total[k] ** 2 - squares[k]
        agreed += pairs
        surprise[k] = -np.log(total[k] / T) / np.log(surprise.shape[0]) / T if total[k] > 0.0 else 0.0
        apart[k] = 2.0 * (total[k] / T - pairs / (T * (T - 1.0)))
    return agreed / (T * (T - 1.0))


@serial
def _one_class(log, first, T):
    """The class that all of a voxel's observations are of, and of nothing else; -1 where there is none."""
    at, label, weight = log
    k = np.int64(label[at[first]])
    if at[first + T] - at[first] != T:
        return -1
    for e in range(at[first], at[first + T]):
        if label[e] != k or weight[e] != 1.0:
            return -1
    return k


@serial
def _add_agreed(sums, base, k, first, T, many, group, truth, likely, column, K, by_class):
    """Add so many voxels whose observations are all of class k: they agree, and leaving one out changes none.

    column is the first with ground truth, where that is known; K classes.
    """
    share, right = many / T, 1.0 if k == truth else 0.0
    for t in range(first, first + T):
        r = base + group[t]
        sums[r, VOXELS] += share
        sums[r, PSA] += share
        sums[r, OBSERVATIONS] += many
        sums[r, AGREEING] += many
        sums[r, OWN] += many
        sums[r, ENTROPY + 1 + k] += many
        if by_class:
            sums[r, ENTROPY + 1 + 2 * K + k] += many
        if T == 2:
            sums[r, TWICE] += many
            sums[r, TWICE_AGREEING] += many
        else:
            sums[r, RECURRENT] += share
            sums[r, VSS] += share
        if truth >= 0:
            sums[r, column + KNOWN] += share
            sums[r, column + RIGHT] += share * right
            sums[r, column + LOOKS] += many
            sums[r, column + LOOKS_RIGHT] += right * many
            if T > 2:
                sums[r, column + STABLE] += likely * share
                sums[r, column + STABLE_WRONG] += likely * share * (1.0 - right)
            if by_class:
                sums[r, column + 6 + truth] += share
                sums[r, column + 6 + K + truth] += share * right
                sums[r, column + 6 + 2 * K + k] += share


@serial
def add_influences(
    chunk, order, bounds, voxels, starts, longest, log, K, group, truth, likely, by_class, with_truth, groups, sums
):
    """Add the observations of voxels, of which each has two or more, to `sums` (cells * groups, C).

    order (r,) has the voxels by cell, bounds (cells + 1,) where each cell's begin; each stands for voxels (n,). starts
    (n + 1,) bound a voxel's rows of the log, `longest` at most, and of group (m,), truth (n,) is its true class or -1,
    likely (n,) how likely it is stable, which is left open where that is empty. A place's
    pairwise agreement P is shared out among its frames as P + 2 (T - 1) / (T - 2) (a_t - P), a_t being frame t's mean
    agreement with the others: what is left of a frame is then its own quality, free of that of the frames it was held
    against, and the shares add up to T P.
    """
    rows = np.zeros((longest, K))
    total, squares, active = np.empty(K), np.empty(K), np.empty(K, np.int64)
    own, without, mean = np.empty(longest), np.empty(longest, np.int64), np.empty(K)
    surprise, apart = np.empty(K), np.empty(K)
    first_truth = ENTROPY + 1 + (3 * K if by_class else K) + DRIFT
    for cell in range(chunk, bounds.shape[0] - 1, CHUNKS):
        for at in range(bounds[cell], bounds[cell + 1]):
            i = order[at]
            first, T, steady = starts[i], starts[i + 1] - starts[i], likely[i] if likely.shape[0] else 0.0
            k, many = _one_class(log, first, T), voxels[i]
            if k >= 0:
                known = truth[i] if with_truth else -1
                _add_agreed(sums, cell * groups, k, first, T, many, group, known, steady, first_truth, K, by_class)
                continue
            A = _classes_of(log, first, T, rows, total, squares, own, active)
            best, agreed = _label(total, active, A), _agreement(total, squares, T, active, A, surprise, apart)
            spread = 2.0 * (T - 1.0) / (T - 2.0) if T > 2 else 0.0
            part, of_others = many / T, 1.0 / (T - 1.0)
            for t in range(T):
                r = cell * groups + group[first + t]
                with_others = surprised = 0.0
                for j in range(A):
                    k = active[j]
                    s = rows[t, k]
                    with_others += s * total[k]
                    sums[r, ENTROPY + 1 + k] += s * many
                    surprised += s * surprise[k]
                    if by_class:
                        others = (total[k] - s) * of_others
                        differs = s + others - 2.0 * s * others
                        sums[r, ENTROPY + 1 + K + k] += (apart[k] + spread * (differs - apart[k])) * many
                        sums[r, ENTROPY + 1 + 2 * K + k] += s**2 * many
                share = agreed + spread * ((with_others - own[t]) * of_others - agreed)
                sums[r, VOXELS] += part
                sums[r, PSA] += share * part
                sums[r, OBSERVATIONS] += many
                sums[r, AGREEING] += share * many
                sums[r, OWN] += own[t] * many
                sums[r, ENTROPY] += surprised * many
                if T == 2:
                    sums[r, TWICE] += many
                    sums[r, TWICE_AGREEING] += agreed * many
                else:
                    sums[r, RECURRENT] += part
                    sums[r, VSS] += rows[t, best] * part
            if with_truth and truth[i] >= 0:
                _add_truth(
                    sums, cell * groups, rows, first, T, many, group, truth[i], steady, total, active, A, without, mean,
                    first_truth, K if by_class else 0,
                )  # fmt: skip
            _cleared(log, first, T, rows)


@serial
def add_kinds(kind, voxels, first, bounds, group, groups, total):
    """Add 1 / T for each of the T looks at voxels of kinds (n,) that there is room for, from the first on.

    At (kind - first) * groups + group; each stands for voxels (n,), bounds (n + 1,) are of its rows of group (m,).
    """
    last = first + total.shape[0] // groups
    for i in range(kind.shape[0]):
        if first <= kind[i] < last:
            share, at = voxels[i] / (bounds[i + 1] - bounds[i]), (kind[i] - first) * groups
            for row in range(bounds[i], bounds[i + 1]):
                total[at + group[row]] += share
