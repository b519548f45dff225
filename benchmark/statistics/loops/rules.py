"""Compiled loops that fuse the observations of voxels by several rules, many voxels side by side."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import CHUNKS, compiled, serial
from semstab.statistics.loops.logarithm import EIGHT, add_plogp

LANES = 64
"""Voxels of the same OP that go side by side, at most."""

LOWEST = -1000.0
"""Powers of two below are none."""

AVERAGING, MAJORITY, PRODUCT, GEOMETRIC = range(4)


@serial
def count_classes(chunk, starts, ends, log, K, count):
    """How many classes each voxel ever saw: count[1:] of (n + 1,)."""
    seen = np.full(K, -1)
    for i in range(chunk, starts.shape[0], CHUNKS):
        for e in range(log[0][starts[i]], log[0][ends[i]]):
            k = log[1][e]
            count[i + 1] += 1 if seen[k] != i else 0
            seen[k] = i


@serial
def list_classes(chunk, starts, ends, log, K, first, label):
    """The classes that each voxel ever saw, ascending: label[first[i] : first[i + 1]]."""
    seen = np.full(K, -1)
    for i in range(chunk, starts.shape[0], CHUNKS):
        used = first[i]
        for e in range(log[0][starts[i]], log[0][ends[i]]):
            k = log[1][e]
            if seen[k] != i:
                seen[k] = i
                place = used
                while place > first[i] and label[place - 1] > k:
                    label[place] = label[place - 1]
                    place -= 1
                label[place] = k
                used += 1


@compiled(fastmath={"reassoc", "contract", "nnan"})
def _beliefs(total, lanes, of, scale, pooled, after, logs, norm):
    """The beliefs after (A + 1, lanes) that follow from sums total (A + 1, lanes); logs (lanes,) is their sum q log2 q.

    The sums are of evidence, or of its binary logarithms where they are pooled; of (A + 1, lanes) is how many classes
    each row stands for, norm (2, lanes) is work space.
    """
    logs[:lanes] = 0.0
    if not pooled:
        for a in range(total.shape[0]):
            for lane in range(lanes):
                after[a, lane] = total[a, lane] * scale
            for lane in range(0, lanes, EIGHT):
                add_plogp(logs, lane, of, a * LANES + lane, after, a * LANES + lane)
        return
    top, norm = norm[0], norm[1]
    top[:lanes] = total[0, :lanes]
    norm[:lanes] = 0.0
    for a in range(1, total.shape[0]):
        for lane in range(lanes):
            top[lane] = max(top[lane], total[a, lane])
    for a in range(total.shape[0]):
        for lane in range(lanes):
            z = (total[a, lane] - top[lane]) * scale
            power = np.exp2(max(z, LOWEST))
            after[a, lane] = power
            norm[lane] += of[a, lane] * power
            logs[lane] += of[a, lane] * power * z
    top[:] = -1.0
    for lane in range(0, lanes, EIGHT):
        add_plogp(logs, lane, top, lane, norm, lane)
    for lane in range(lanes):
        norm[lane] = 1.0 / norm[lane]
        logs[lane] *= norm[lane]
    for a in range(total.shape[0]):
        for lane in range(lanes):
            after[a, lane] *= norm[lane]


@compiled(fastmath={"reassoc", "contract", "nnan"})
def _add_drift(before, after, of, lanes, logs_before, logs, drift, work):
    """Add the Jensen-Shannon divergence of beliefs before and after (A + 1, lanes), bits, to drift (lanes,).

    work (2, lanes) is work space.
    """
    mean, mixed = work[0], work[1]
    mixed[:] = 0.0
    for a in range(before.shape[0]):
        for lane in range(lanes):
            mean[lane] = 0.5 * (before[a, lane] + after[a, lane])
        for lane in range(0, lanes, EIGHT):
            add_plogp(mixed, lane, of, a * LANES + lane, mean, lane)
    for lane in range(lanes):
        drift[lane] += min(max(0.5 * (logs_before[lane] + logs[lane]) - mixed[lane], 0.0), 1.0)


@compiled(forceinline=True)
def _observe(e, end, label, weight, classes, a, floor, certain, totals, lane):
    """Add the log's entries from e to before `end`, an observation, to the sums by class of the voxel in a lane.

    classes[a:] are those that it saw, ascending, as an observation's are. totals (3, A + 1, lanes) are sums of
    evidence, of votes for the largest, the lowest on ties, and of log2(max(s, floor) / floor), which is 0 for what is
    not seen: that evidence is not normalised changes no belief. certain is -log2 floor, or 0 where none are needed.
    """
    own = best = 0
    most = 0.0
    while e < end:
        while classes[a + own] != label[e]:
            own += 1
        share = weight[e]
        totals[AVERAGING, own, lane] += share
        if certain and share > floor:
            totals[PRODUCT, own, lane] += certain + (np.log2(share) if share < 1.0 else 0.0)
        if share > most:
            most, best = share, own
        e += 1
    totals[MAJORITY, best, lane] += 1.0


@serial
def fuse_by_rules(chunk, rank, starts, ends, log, K, first, classes, most, rules, floor, belief, rest, drift_sum, bits):
    """Fuse each voxel's observations by each of the rules (R,).

    starts, ends (n,) bound their rows of the log. rank (n,) sorts them by OP and how many classes they saw, at most
    `most`: classes[first[i] : first[i + 1]]. belief (R, m) takes the beliefs in these after the last observation, rest
    (R, n) that in each of the others, which are all alike, drift_sum (R, n) the sum of the Jensen-Shannon divergences
    of successive beliefs, bits (R, n) the entropy of the last one, in bits both.
    """
    at, label, weight = log
    certain = -np.log2(floor) if rules.max() >= PRODUCT else 0.0
    totals, of = np.empty((3, most + 1, LANES)), np.empty((most + 1, LANES))
    before, after = np.zeros((rules.shape[0], most + 1, LANES)), np.zeros((most + 1, LANES))
    logs_before, logs = np.empty((rules.shape[0], LANES)), np.empty(LANES)
    drift, norm = np.empty((rules.shape[0], LANES)), np.zeros((2, LANES))
    row, own = np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    begin, end = chunk * rank.shape[0] // CHUNKS, (chunk + 1) * rank.shape[0] // CHUNKS
    while begin < end:
        voxels = rank[begin : min(begin + LANES, end)]
        T, lanes = ends[voxels[0]] - starts[voxels[0]], 0
        while lanes < voxels.shape[0] and ends[voxels[lanes]] - starts[voxels[lanes]] == T:
            row[lanes], own[lanes] = starts[voxels[lanes]], first[voxels[lanes]]
            lanes += 1
        A = first[voxels[lanes - 1] + 1] - own[lanes - 1]  # the last one saw the most classes
        totals[:, : A + 1] = 0.0
        of[: A + 1] = 0.0
        for lane in range(lanes):
            seen = first[voxels[lane] + 1] - own[lane]
            of[:seen, lane] = 1.0
            of[A, lane] = K - seen
        drift[:] = 0.0
        for t in range(T):
            for lane in range(lanes):
                e = at[row[lane] + t]
                _observe(e, at[row[lane] + t + 1], label, weight, classes, own[lane], floor, certain, totals, lane)
            for r in range(rules.shape[0]):
                rule = rules[r]
                scale = 1.0 if rule == PRODUCT else 1.0 / (t + 1)
                _beliefs(totals[min(rule, PRODUCT), : A + 1], lanes, of, scale, rule >= PRODUCT, after, logs, norm)
                if t > 0:
                    _add_drift(before[r, : A + 1], after, of, lanes, logs_before[r], logs, drift[r], norm)
                before[r, : A + 1], logs_before[r] = after[: A + 1], logs
        for r in range(rules.shape[0]):
            for lane in range(lanes):
                i = voxels[lane]
                drift_sum[r, i], rest[r, i] = drift[r, lane], before[r, A, lane]
                bits[r, i] = max(-logs_before[r, lane], 0.0)
                for a in range(first[i + 1] - first[i]):
                    belief[r, first[i] + a] = before[r, a, lane]
        begin += lanes
