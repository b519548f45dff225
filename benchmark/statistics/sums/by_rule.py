"""What the rules of fusion make of the looks at a map, as sums over its voxels with OP >= 2."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from semstab.model.evidence import STRETCH, Evidence, stretches
from semstab.model.measures import Voxels
from semstab.statistics.correctness import judged_where, rule_sums
from semstab.statistics.kinds import Kinds, Known
from semstab.statistics.order import fusion_rules
from semstab.statistics.patterns import Alike, Judging
from semstab.statistics.ranks import ordered

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

AT_ONCE = 1 << 15
"""Voxels whose beliefs are held against their true classes together: what stays in a core's cache costs no memory."""


def sums_by_rule(kinds: Kinds) -> Float64:
    """(R, 2 + C) for each rule the voxels that it relabels, all of them, and `rule_sums`, by patterns of looks."""
    _, *others = fusion_rules.RULES  # the map's own rule is the first
    patterns, total = kinds.patterns, np.zeros(())
    assert patterns.log is not None
    for own, rows, at in _some_patterns(kinds):
        table = patterns.table.rows(own)
        fused = fusion_rules.fuse_all(patterns.log, others, evidence=table.evidence, rows=own)
        drifts = [table.drift_sum, *(rule.drift_sum for rule in fused)]
        beliefs = [table.evidence, *(rule.evidence.measured() for rule in fused)]
        usual, *labels = (fusion_rules.labels(belief) for belief in beliefs)
        relabelled = [0.0, *(table.voxels.sum(where=label != usual) for label in labels)]
        counts = np.stack([relabelled, np.full(len(beliefs), table.voxels.sum())], axis=1)
        measured = zip(beliefs, drifts, strict=True)
        means = [rule_sums(Voxels(table.op, belief, drift), table.voxels) for belief, drift in measured]
        judged = [] if kinds.one.label is None else [_judged(beliefs, kinds.one, rows, at)]
        total = total + np.concatenate([counts, np.stack(means), *judged], axis=1)
    return total


def _some_patterns(kinds: Kinds) -> Iterator[tuple[Int64, Int64, Int64]]:
    """Some patterns (p,) with OP >= 2 after the others, the rows (n,) of the voxels that have one, and which (n,)."""
    of, again = kinds.patterns.of, kinds.patterns.table.op >= 2
    seen, rows = np.flatnonzero(again), np.flatnonzero(kinds.one.table.op >= 2)
    at = (np.cumsum(again) - 1)[rows if of is None else of[rows]]
    if len(seen) <= STRETCH:
        yield seen, rows, at
        return
    at, order = ordered(at)
    for some in stretches(len(seen)):
        own = slice(*np.searchsorted(at, [some.start, some.stop]))
        yield seen[some], rows[order[own]], at[own] - some.start


def _judged(beliefs: Sequence[Evidence], one: Known, rows: Int64, at: Int64) -> Float64:
    """(R, C) `judged_sums` of the voxels in rows (n,), which have these of the beliefs (p, K), at (n,), each time."""
    assert one.label is not None
    judging = [Judging.of(belief) for belief in beliefs]
    total = np.zeros(())
    for first in range(0, max(len(rows), 1), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        alike = Alike.of(beliefs[0], at[some], one.table, rows[some], one.label[rows[some]])
        total = total + np.stack([judged_where(alike.judged(own), alike.truth >= 0) for own in judging])
    return total
