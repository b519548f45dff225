"""Compiled loops over voxels whose looks differ in the names of their classes only."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.keys import mix
from semstab.backends.shared.pixel_keys import touch
from semstab.core.compiled import serial
from semstab.statistics.loops.kinds import AT_ONCE, FACTORS, FIRST_ROOM, hashed_with, number_block


@serial
def tell_patterns(op, sums, evidence, log, begins, lasts, K, longest, least, rows, of):
    """Which pattern (n,) each voxel has, and the first voxel (p,) of each.

    Voxels of one pattern agree in OP, sums (drift, ||s||^2 and entropy of the frames) and all observations, when each
    class goes by its rank among those that the voxel ever saw; where a weight is below `least`, by its name. Where the
    OP is above `longest` and there was more than one class, a voxel has a pattern of its own. Returns how many there
    are, -1 where there is no room for them, or hardly fewer than voxels.
    """
    starts, label, total = evidence
    ends, classes, weights = log
    drift, squares, entropy = sums
    of_drift, of_squares, of_entropy = drift.view(np.uint64), squares.view(np.uint64), entropy.view(np.uint64)
    bits, rank, found = weights.view(np.uint64), np.zeros(K, np.int64), 0
    some, keys = np.empty((AT_ONCE, 2), np.uint64), np.empty((rows.shape[0], 2), np.uint64)
    kinds = np.full(FIRST_ROOM, np.int32(-1))
    for first in range(0, op.shape[0], AT_ONCE):
        last = min(first + AT_ONCE, op.shape[0])
        for i in range(first, last):
            T, named = op[i], False
            for e in range(starts[i], starts[i + 1]):
                rank[label[e]] = e - starts[i]
            key = hashed_with((np.uint64(T), np.uint64(0)), of_drift[i], 0)
            key = hashed_with(hashed_with(key, of_squares[i], 1), of_entropy[i], 2)
            if longest < T and (starts[i + 1] - starts[i] > 1 or total[starts[i]] != T or squares[i] != T):
                key = hashed_with(key, np.uint64(i), 3)
            for t in range(begins[i], lasts[i]):
                key = hashed_with(key, np.uint64(ends[t + 1] - ends[t]), 4 + t - begins[i])
            before = ends[begins[i]] - 1
            for e in range(ends[begins[i]], ends[lasts[i]]):
                key = hashed_with(key, bits[e] * FACTORS[2] + np.uint64(rank[classes[e]]), before - e)
                named |= weights[e] < least
            if named:
                for e in range(starts[i], starts[i + 1]):
                    key = hashed_with(key, np.uint64(label[e]) << np.uint64(32), starts[i] - 1 - e)
            some[i - first, 0], some[i - first, 1] = mix(key[0]), key[1]
            touch(kinds, np.int64(some[i - first, 0]) & (kinds.shape[0] - 1))
        kinds, found = number_block(some, first, last, keys, kinds, rows, of, found)
        if found < 0:
            return -1
    return found


@serial
def spread_labels(evidence, dominant, of, starts, label, found):
    """The class (n,) of voxels, whose classes starts and label list, that `dominant` (p,) is of their pattern (n,).

    evidence (starts, label, weight) is that of the patterns.
    """
    of_pattern, classes, _ = evidence
    for i in range(of.shape[0]):
        e = of_pattern[of[i]]
        while classes[e] != dominant[of[i]]:
            e += 1
        found[i] = label[starts[i] + e - of_pattern[of[i]]]


@serial
def errors_of(beliefs, rest, dominant, K, top, errors):
    """How far beliefs (p,) are from certainty of each of their classes, and then of another, squared: errors (m + p,).

    rest is as in `concentrate`; top (p,) is which of its classes the dominant one is, -1 where it is another.
    """
    starts, label, weight = beliefs
    for i in range(top.shape[0]):
        begin, end = starts[i], starts[i + 1]
        unseen, others = (rest[i] if rest.shape[0] else 0.0), K - (end - begin)
        total, top[i] = others * unseen, -1
        for e in range(begin, end):
            total += weight[e] if weight[e] != 0.0 else unseen
            top[i] = e - begin if label[e] == dominant[i] else top[i]
        part = 1.0 / total
        other = unseen * part
        squares = others * other * other
        for e in range(begin, end):
            p = (weight[e] if weight[e] != 0.0 else unseen) * part
            errors[e + i] = p
            squares += p * p
        for e in range(begin, end):
            p = errors[e + i]
            errors[e + i] = max(squares - p * p, 0.0) + (p - 1.0) * (p - 1.0)
        errors[end + i] = max(squares - other * other, 0.0) + (other - 1.0) * (other - 1.0)


@serial
def add_alike(at, rows, truth, voxels, starts, labels, first, top, dominant, largest, errors, bins, sums):
    """Add voxels with R beliefs to sums (R, C), see `judged_sums`; nothing where the true class (n,) is -1.

    at (n,) is which of the beliefs, whose entries begin at first (p + 1,), a voxel has, rows (n,) where its own classes
    stand in starts and labels, and its number of voxels, one where these are empty. top and errors are
    those of `errors_of`, dominant and largest (R, p) the most likely class and the belief in it.
    """
    K = (sums.shape[1] - 3 - 3 * bins) // 3
    kind = 3 + 3 * bins
    for i in range(at.shape[0]):
        true, p, many = truth[i], at[i], voxels[rows[i]] if voxels.shape[0] else 1.0
        if true < 0:
            continue
        begin, end = starts[rows[i]], starts[rows[i] + 1]
        place = begin
        while place < end and labels[place] != true:
            place += 1
        place += first[p] + p - begin
        for r in range(sums.shape[0]):
            predicted = np.int64(labels[begin + top[r, p]] if top[r, p] >= 0 else dominant[r, p])
            right = many if predicted == true else 0.0
            at_bin = 3 + min(max(np.int64(np.ceil(largest[r, p] * bins - 1e-9)) - 1, 0), bins - 1)
            sums[r, 0] += many
            sums[r, 1] += right
            sums[r, 2] += many * errors[r, place]
            sums[r, at_bin] += many
            sums[r, at_bin + bins] += many * largest[r, p]
            sums[r, at_bin + 2 * bins] += right
            sums[r, kind + true] += right
            sums[r, kind + K + true] += many
            sums[r, kind + 2 * K + predicted] += many
