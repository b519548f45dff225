"""What the rules of fusion make of the looks at a map, as sums over its voxels with OP >= 2."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, Int64
from semstab.model.evidence import stretches
from semstab.model.measures import Voxels
from semstab.statistics.correctness import rule_sums
from semstab.statistics.kinds import Kinds
from semstab.statistics.order import fusion_rules
from semstab.statistics.patterns import judged_alike
from semstab.statistics.ranks import ordered

TOGETHER = 1 << 15
"""Patterns whose beliefs are held at once."""


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
        true, one = kinds.one.label, kinds.one.table
        judged = [] if true is None else [judged_alike(beliefs, at, one, rows, true[rows])]
        total = total + np.concatenate([counts, np.stack(means), *judged], axis=1)
    return total


def _some_patterns(kinds: Kinds) -> Iterator[tuple[Int64, Int64, Int32]]:
    """Some patterns (p,) with OP >= 2 after the others, the rows (n,) of the voxels that have one, and which (n,)."""
    of, again = kinds.patterns.of, kinds.patterns.table.op >= 2
    seen, rows = np.flatnonzero(again), np.flatnonzero(kinds.one.table.op >= 2)
    at: npt.NDArray[np.integer] = np.cumsum(again, dtype=np.int32)[rows if of is None else of[rows]]
    at -= 1
    if len(seen) <= TOGETHER:
        yield seen, rows, at.astype(np.int32, copy=False)
        return
    if of is not None:
        at, order = ordered(at)
        rows = rows[order]
    for some in stretches(len(seen), TOGETHER):
        own = slice(*np.searchsorted(at, [some.start, some.stop]))
        yield seen[some], rows[own], (at[own] - some.start).astype(np.int32)
