"""Compiled loops over the rows of a voxel table: sums by cube and by class, beliefs beside the true classes."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import CHUNKS, serial


@serial
def add_classes(of, evidence, op, by_look, by_place):
    """Add the evidence (starts, label, weight) of voxels to (G, K) by their cube of (n,), -1 is none; and that / OP."""
    starts, label, weight = evidence
    for i in range(of.shape[0]):
        if of[i] >= 0:
            share = 1.0 / op[i]
            for e in range(starts[i], starts[i + 1]):
                own = weight[e]
                by_look[of[i], label[e]] += own
                by_place[of[i], label[e]] += share * own


@serial
def add_class_sums(evidence, op, exact, first, last, log, sums):
    """Add to sums (5, K), over voxels with OP >= 2: evidence, that / OP, disagreement, that * OP, squares.

    Where exact (n,) holds the evidence is the sum of its squares too, else the log tells, in which a voxel has the rows
    from first (n,) to before last (n,). Classes that nobody saw in a voxel are no disagreement there.
    """
    starts, label, weight = evidence
    squares = np.zeros(sums.shape[1])
    for i in range(op.shape[0]):
        T = np.float64(op[i])
        if T < 2.0:
            continue
        if not exact[i]:
            for e in range(log[0][first[i]], log[0][last[i]]):
                squares[log[1][e]] += log[2][e] * log[2][e]
        for entry in range(starts[i], starts[i + 1]):
            k, own = label[entry], weight[entry]
            square = own if exact[i] else squares[k]
            apart = 2.0 * ((T - 1.0) * own - own * own + square) / (T * (T - 1.0))
            sums[0, k] += own
            sums[1, k] += own / T
            sums[2, k] += apart
            sums[3, k] += T * apart
            sums[4, k] += square
            squares[k] = 0.0


@serial
def majorities(evidence, share, found):
    """The class (n,) that has more than this share of a row's evidence, at least a half; -1 where none has."""
    starts, label, weight = evidence
    for i in range(found.shape[0]):
        first, end = starts[i], starts[i + 1]
        total, best = 0.0, first
        for e in range(first, end):
            total += weight[e]
            best = e if weight[e] > weight[best] else best
        found[i] = label[best] if first < end and weight[best] / total > share else -1


@serial
def square_errors(evidence, rest, K, truth, errors):
    """Squared distance (n,) of each belief from certainty of the true class (n,); rest as in `concentrate`."""
    starts, label, weight = evidence
    for i in range(truth.shape[0]):
        unseen, others = (rest[i] if rest.shape[0] else 0.0), K - (starts[i + 1] - starts[i])
        total, error, hit = others * unseen, 0.0, False
        for e in range(starts[i], starts[i + 1]):
            total += weight[e] if weight[e] != 0.0 else unseen
        for e in range(starts[i], starts[i + 1]):
            p = (weight[e] if weight[e] != 0.0 else unseen) / total
            if label[e] == truth[i]:
                p, hit = p - 1.0, True
            error += p * p
        p = unseen / total
        if others > 0:
            error += (others - 1) * p * p + (p * p if hit else (p - 1.0) * (p - 1.0))
        errors[i] = error


@serial
def add_judged(group, label, predicted, confidence, error, bins, sums):
    """Add to the row of sums (G, 3 + 3 bins + 3 K) of each voxel's group (n,), -1 is none: see `judged_sums`."""
    K = (sums.shape[1] - 3 - 3 * bins) // 3
    for i in range(group.shape[0]):
        g = group[i]
        if g < 0:
            continue
        right = 1.0 if predicted[i] == label[i] else 0.0
        at = 3 + min(max(np.int64(np.ceil(confidence[i] * bins - 1e-9)) - 1, 0), bins - 1)
        kind = 3 + 3 * bins
        sums[g, 0] += 1.0
        sums[g, 1] += right
        sums[g, 2] += error[i]
        sums[g, at] += 1.0
        sums[g, at + bins] += confidence[i]
        sums[g, at + 2 * bins] += right
        sums[g, kind + label[i]] += right
        sums[g, kind + K + label[i]] += 1.0
        sums[g, kind + 2 * K + predicted[i]] += 1.0


@serial
def add_pairs(evidence, op, weights, pairs):
    """Add to pairs (K, K), above the diagonal, how often two looks at a voxel are of two classes; NaN is no weight."""
    starts, label, weight = evidence
    for i in range(op.shape[0]):
        if starts[i + 1] - starts[i] > 1 and weights[i] > 0.0:
            for a in range(starts[i], starts[i + 1]):
                share = weights[i] * (weight[a] / op[i])
                for b in range(a + 1, starts[i + 1]):
                    pairs[label[a], label[b]] += share * (weight[b] / op[i])


@serial
def label_near(evidence, rest, K, near, found):
    """The lowest class (n,) whose belief is within `near` of the largest; rest as in `concentrate`."""
    starts, label, weight = evidence
    for i in range(found.shape[0]):
        first, end = starts[i], starts[i + 1]
        unseen, others = (rest[i] if rest.shape[0] else 0.0), K - (end - first)
        total, top, gap = others * unseen, (unseen if others > 0 else 0.0), 0
        for e in range(first, end):
            w = weight[e] if weight[e] != 0.0 else unseen
            total, top = total + w, max(top, w)
            gap += 1 if label[e] == gap else 0  # the lowest class without an entry
        least = top / total - near
        best = gap if others > 0 and unseen / total >= least else K
        for e in range(first, end):
            if label[e] < best and (weight[e] if weight[e] != 0.0 else unseen) / total >= least:
                best = label[e]
        found[i] = best


@serial
def add_apart(of, evidence, op, shares, apart):
    """Add to (G, K) by the voxels' cubes (n,), -1 is none: one-hot evidence, and how far apart looks are in a class.

    The latter counts for each look: 2 ((T - 1) e - e^2 + squares) / (T - 1).
    """
    starts, label, weight = evidence
    for i in range(of.shape[0]):
        if of[i] >= 0:
            for e in range(starts[i], starts[i + 1]):
                own, others = weight[e], op[i] - 1.0
                shares[of[i], label[e]] += own
                apart[of[i], label[e]] += 2.0 * (others * own - own * own + own) / others


@serial
def weight_of(evidence, wanted, found):
    """The evidence (n,) of one class of each voxel, 0 where it has none."""
    starts, label, weight = evidence
    for i in range(wanted.shape[0]):
        found[i] = 0.0
        for e in range(starts[i], starts[i + 1]):
            if label[e] == wanted[i]:
                found[i] = weight[e]


# Compiled loops over the log of observations, voxel by voxel: its changes of class.


@serial
def argmax(log, row):
    """The class of an observation's largest weight, the lowest on ties."""
    at, label, weight = log
    best = at[row]
    for e in range(at[row] + 1, at[row + 1]):
        if weight[e] > weight[best] or (weight[e] == weight[best] and label[e] < label[best]):
            best = e
    return np.int64(label[best])


@serial
def count_flips(chunk, starts, ends, log, K, rate, null, since):
    """By voxel (n,): the share of steps at which the predicted class changes, of pairs that differ, and looks since.

    starts and ends (n,) bound its observations. NaN where there is no pair, -1 where there is no change to count from.
    """
    begin, end = chunk * rate.shape[0] // CHUNKS, (chunk + 1) * rate.shape[0] // CHUNKS
    votes, longest = np.zeros(K, np.int64), 0
    for i in range(begin, end):
        longest = max(longest, ends[i] - starts[i])
    voted = np.empty(longest, np.int64)
    for i in range(begin, end):
        rate[i] = null[i] = np.nan
        since[i], T = -1, ends[i] - starts[i]
        if T < 2:
            continue
        before, same, changes = np.int64(-1), np.int64(0), 0
        for row in range(starts[i], ends[i]):
            k = argmax(log, row)
            if before >= 0 and k != before:
                changes += 1
                since[i] = ends[i] - 1 - row
            same += votes[k]
            votes[k] += 1
            before = voted[row - starts[i]] = k
        pairs = T * (T - 1) // 2
        rate[i], null[i] = changes / (T - 1), (pairs - same) / pairs
        for t in range(T):
            votes[voted[t]] = 0


@serial
def count_frames(ends, frame, since, frames):
    """By voxel (n,): the frames from so many looks before its last one on until that, NaN for -1."""
    for i in range(ends.shape[0]):
        last = ends[i] - 1
        frames[i] = frame[last] - frame[last - since[i]] if since[i] >= 0 else np.nan


# Compiled loops over the voxels of a map that find the cubes of space which hold them.

ROOM = 1024
"""Places of a table of cubes."""


@serial
def _cube(index, scale):
    """That of a voxel's centre, along one axis."""
    return np.int64(np.floor((index + 0.5) * scale))


@serial
def _place(cell, table, used):
    """Where a cube stands in a table (ROOM, 3) of some, or would stand."""
    at = (cell[0] * 73856093 ^ cell[1] * 19349663 ^ cell[2] * 83492791) & (ROOM - 1)
    while used[at] and (table[at, 0] != cell[0] or table[at, 1] != cell[1] or table[at, 2] != cell[2]):
        at = (at + 1) & (ROOM - 1)
    return at


@serial
def _halved(table, used):
    """A table of the cubes twice as large that hold those of another, and how many they are."""
    halves, taken, count = np.empty_like(table), np.zeros_like(used), 0
    for at in range(ROOM):
        if used[at]:
            cell = (table[at, 0] >> 1, table[at, 1] >> 1, table[at, 2] >> 1)
            to = _place(cell, halves, taken)
            count += 0 if taken[to] else 1
            halves[to, 0], halves[to, 1], halves[to, 2] = cell
            taken[to] = True
    return halves, taken, count


@serial
def occupied(ix, iy, iz, some, scale, most):
    """How often cubes are doubled until at most `most` of them hold the voxels (n,) for which `some` (n,) holds.

    scale  of the first ones
    """
    table, used, count, doublings = np.empty((ROOM, 3), np.int64), np.zeros(ROOM, np.bool_), 0, 0
    before = (np.int64(0), np.int64(0), np.int64(0))
    for i in range(ix.shape[0]):
        if not some[i]:
            continue
        cell = _cube(ix[i], scale), _cube(iy[i], scale), _cube(iz[i], scale)
        if count > 0 and cell == before:
            continue
        before, at = cell, _place(cell, table, used)
        if used[at]:
            continue
        table[at, 0], table[at, 1], table[at, 2] = cell
        used[at] = True
        count += 1
        while count > most:
            table, used, count = _halved(table, used)
            doublings, scale = doublings + 1, 0.5 * scale
            before = (cell[0] >> 1, cell[1] >> 1, cell[2] >> 1)
            cell = before
    return doublings


@serial
def runs(ix, iy, iz, some, scale, cells, of):
    """Number the runs of voxels (n,) that are in one cube: of (n,), -1 where `some` (n,) does not hold.

    cells (r, 3) takes the cube of each run, as long as there is room. Returns how many runs there are.
    """
    count = 0
    before = (np.int64(0), np.int64(0), np.int64(0))
    for i in range(ix.shape[0]):
        of[i] = -1
        if not some[i]:
            continue
        cell = _cube(ix[i], scale), _cube(iy[i], scale), _cube(iz[i], scale)
        if count == 0 or cell != before:
            if count < cells.shape[0]:
                cells[count, 0], cells[count, 1], cells[count, 2] = cell
            before = cell
            count += 1
        of[i] = count - 1
    return count


@serial
def renumber(of, number):
    """Put the number of a run's cube in the place of the run's (n,)."""
    for i in range(of.shape[0]):
        if of[i] >= 0:
            of[i] = number[of[i]]
