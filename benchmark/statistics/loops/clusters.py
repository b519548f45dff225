"""The compiled pass over the log that adds up the contributions of each frame to each cube of space."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import CHUNKS, helper, serial

TIE = 1e-12
"""Sums of evidence that differ by no more are equal."""


@serial
def _observations(log, first, T, number, active, x, total, squares, squared_norms):
    """Write a voxel's observations by the classes that it ever saw, and return the number of these classes.

    log is (starts, label, weight) of all observations. x (T * A,) takes the evidence by observation and class, active
    (A,) the classes, ascending, total and squares (A,) the sums of evidence and of its squares, squared_norms (T,)
    those of each observation's squares; number (K,) is work space, all -1.
    """
    at, label, weight = log
    A = 0
    for e in range(at[first], at[first + T]):
        k = np.int64(label[e])
        if number[k] < 0:
            number[k], j = 0, A
            while j > 0 and active[j - 1] > k:
                active[j] = active[j - 1]
                j -= 1
            active[j] = k
            A += 1
    for j in range(A):
        number[active[j]], total[j], squares[j] = j, 0.0, 0.0
    x[: T * A] = 0.0
    for t in range(T):
        squared_norms[t] = 0.0
        for e in range(at[first + t], at[first + t + 1]):
            j, square = number[label[e]], weight[e] ** 2
            x[t * A + j] = weight[e]
            total[j] += weight[e]
            squares[j] += square
            squared_norms[t] += square
    for j in range(A):
        number[active[j]] = -1
    return A


@helper
def _label(total, active, A, fused):
    """Return the dominant class.

    It is that of the map, whose sums are rounded otherwise, or the lowest of equals.
    """
    best, top = 0, total[0]
    for j in range(A):
        if active[j] == fused:
            return j
    for j in range(1, A):
        more = total[j] > top
        best, top = (j if more else best), (total[j] if more else top)
    return best


@helper
def _label_without(total, x, observation, A):
    """Return the dominant class of the other observations."""
    best, top = 0, total[0] - x[observation]
    for j in range(1, A):
        rest = total[j] - x[observation + j]
        more = rest > top + TIE
        best, top = (j if more else best), (rest if more else top)
    return best


@helper
def _add_truth(sums, base, x, first, T, group, truth, likely, total, active, A, label, without, mean, columns):
    """Add the sums of right labels of a voxel: the fused label without one frame, and each observation by itself.

    mean (A,) is work space, columns are `FirstColumns`.
    """
    true, lead, most = -1, total[label], 0.0
    for j in range(A):
        true = j if active[j] == truth else true
        lead = min(lead, total[label] - total[j]) if j != label else lead
    for t in range(T):
        most = max(most, x[t * A + label])
    right, part, alike = (1.0 if label == true else 0.0), 1.0 / T, lead > most + TIE  # whichever is left out
    if not alike:
        mean[:A] = 0.0
        for t in range(T):
            without[t] = _label_without(total, x, t * A, A)
            mean[without[t]] += part
    share = part
    for t in range(T):
        r = base + group[first + t]
        right_share = right * share
        if not alike and true >= 0:
            right_share = (right + (T - 1) * (mean[true] - (without[t] == true))) * share
        sums[r, columns.known] += share
        sums[r, columns.right] += right_share
        sums[r, columns.observed] += 1.0
        if true >= 0:
            sums[r, columns.observed_right] += x[t * A + true]
        if T > 2:
            sums[r, columns.consistent] += likely * share
            sums[r, columns.consistent_wrong] += likely * (1.0 - right) * share
        if columns.class_known >= 0:
            sums[r, columns.class_known + truth] += share
            sums[r, columns.class_right + truth] += right_share
            if alike:
                sums[r, columns.class_predicted + active[label]] += share
                continue
            for j in range(A):
                predicted = (label == j) + (T - 1) * (mean[j] - (without[t] == j))
                sums[r, columns.class_predicted + active[j]] += predicted * share


@serial
def _agreement(total, squares, T, A, certain, surprise, apart):
    """Return the agreement of two observations; write the surprise of each class and the distance of two observations.

    certain is the unit of surprise, log K.
    """
    agreed = 0.0
    for j in range(A):
        pairs = total[j] ** 2 - squares[j]
        agreed += pairs
        surprise[j] = -np.log(total[j] / T) / certain / T if total[j] > 0.0 else 0.0
        apart[j] = 2.0 * (total[j] / T - pairs / (T * (T - 1.0)))
    return agreed / (T * (T - 1.0))


@serial
def add_influences(chunk, order, bounds, rows, longest, log, K, group, fused, truth, likely, columns, groups, sums):
    """Add the observations of voxels, of which each has two or more, to `sums` (cells * groups, C) at `FirstColumns`.

    order (r,) has the voxels by cell, bounds (cells + 1,) where each cell's begin; rows (starts (n,) and ends) bound a
    voxel's rows of the log, `longest` at most; group (m,) is that of each row's frame. fused (n,) is its dominant class
    in the map, (0,) where that is not known; truth (n,) is its true class or -1, likely (n,) the
    probability that it is consistent.
    The pairwise agreement P of a location is shared out as P + 2 (T - 1) / (T - 2) (a_t - P), a_t being frame t's mean
    agreement with the others: the part of a frame is then its own quality, free of that of the frames it was
    compared with, and the shares add up to T P.
    """
    starts, ends = rows
    x, number, active = np.empty(longest * K), np.full(K, -1), np.empty(K, np.int64)
    total, squares, squared_norms, without = np.empty(K), np.empty(K), np.empty(longest), np.empty(longest, np.int64)
    mean, surprise, apart, certain = np.empty(K), np.empty(K), np.empty(K), np.log(K)
    for cell in range(chunk, bounds.shape[0] - 1, CHUNKS):
        for at in range(bounds[cell], bounds[cell + 1]):
            i = order[at]
            first, T, consistent = starts[i], ends[i] - starts[i], likely[i] if likely.shape[0] else 0.0
            A = _observations(log, first, T, number, active, x, total, squares, squared_norms)
            agreed, label = (
                _agreement(total, squares, T, A, certain, surprise, apart),
                _label(total, active, A, fused[i] if fused.shape[0] else -1),
            )
            spread = 2.0 * (T - 1.0) / (T - 2.0) if T > 2 else 0.0
            part, of_others = 1.0 / T, 1.0 / (T - 1.0)
            for t in range(T):
                r = cell * groups + group[first + t]
                with_others = surprised = 0.0
                for j in range(A):
                    k, s = active[j], x[t * A + j]
                    with_others += s * total[j]
                    sums[r, columns.evidence + k] += s
                    surprised += s * surprise[j]
                    if columns.class_apart >= 0:
                        mean_of_others = (total[j] - s) * of_others
                        differs = s + mean_of_others - 2.0 * s * mean_of_others
                        sums[r, columns.class_apart + k] += apart[j] + spread * (differs - apart[j])
                        sums[r, columns.class_own + k] += s**2
                share = agreed + spread * ((with_others - squared_norms[t]) * of_others - agreed)
                sums[r, columns.voxels] += part
                sums[r, columns.psa] += share * part
                sums[r, columns.observations] += 1.0
                sums[r, columns.agreeing] += share
                sums[r, columns.own] += squared_norms[t]
                sums[r, columns.entropy] += surprised
                if T == 2:
                    sums[r, columns.twice] += 1.0
                    sums[r, columns.twice_agreeing] += agreed
                else:
                    sums[r, columns.recurrent] += part
                    sums[r, columns.vss] += x[t * A + label] * part
            if columns.known >= 0 and truth[i] >= 0:
                _add_truth(
                    sums, cell * groups, x, first, T, group, truth[i], consistent, total, active, A, label, without,
                    mean, columns,
                )  # fmt: skip
