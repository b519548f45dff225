"""What of a map's statistics needs the log of its observations, as sums over its parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.model.evidence import STRETCH, Evidence, stretches
from semstab.model.measures import Beliefs, Voxels
from semstab.model.statistics import RuleOutcome
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.agreement import ratio_of
from semstab.statistics.correctness import judged_where, rule_means_of, rule_sums
from semstab.statistics.kinds import Kinds
from semstab.statistics.map_sums import Maps
from semstab.statistics.order import fusion_rules
from semstab.statistics.order.drift import TESTABLE, Flips, VoxelDrift, drift_p, trend_columns, varying
from semstab.statistics.order.p_values import PValues
from semstab.statistics.patterns import Alike
from semstab.statistics.ranks import ordered
from semstab.statistics.sampling import PlaceSums
from semstab.statistics.scene_drift import OrderTest, order_test, sampled

Float64 = npt.NDArray[np.float64]
FALSE_DISCOVERIES = 0.05
"""Rate at which voxels are named that trend, or drift unusually."""


@dataclass(frozen=True, eq=False)
class LogSums:
    """Those of a map.

    places  over the cubes of its voxels with OP >= 2: flips, and the trend beyond that in random order
    trend   (3,) see `trend_columns`
    p       of the trends of the voxels that are tested one by one
    rules   (R, 2 + C) for each rule of fusion the voxels that it relabels, all of them, and `rule_sums`
    table, events  the voxels whose orders stand for all, with their observations: see `drawn`
    """

    places: PlaceSums
    trend: Float64
    p: PValues
    rules: Float64
    table: VoxelTable
    events: Events

    @classmethod
    def of(
        cls,
        kinds: Kinds,
        drift: VoxelDrift,
        changes: Flips,
        seed: int,
    ) -> LogSums:
        """Of a map with its log, from what is known of one voxel of each kind."""
        every, (table, seen, _, places) = kinds.every, vars(kinds.one).values()
        assert every.log is not None
        vary = varying(table, seen)[0]
        rows, trend = trend_columns(table, drift)
        means = {
            "flip_rate": changes.rate,
            "flip_null": changes.null,
            "flip_excess": changes.rate - changes.null,
            "frames_since": changes.since,
        }
        trends = places.rows(rows).sums(trend)
        excess = np.stack([trends[:, 0] - trends[:, 1], trends[:, 2]], axis=1)
        return cls(
            PlaceSums(places.cell, places.edge, places.means(means) | {"trend_excess": excess}),
            trends.sum(axis=0),
            PValues.of(np.where(table.op >= TESTABLE, drift.trend_p, np.nan)),
            _rules(kinds),
            *sampled(every.table, every.log.events, seed, vary if kinds.of is None else vary[kinds.of]),
        )

    @classmethod
    def merged(cls, parts: Sequence[LogSums], seed: int) -> LogSums:
        """Those of a map from its parts."""
        table, events = (
            VoxelTable.joined([part.table for part in parts]),
            Events.joined([part.events for part in parts]),
        )
        return cls(
            PlaceSums.merged([part.places for part in parts]),
            np.sum([part.trend for part in parts], axis=0),
            PValues.merged([part.p for part in parts]),
            np.sum([part.rules for part in parts], axis=0),
            *(sampled(table, events, seed) if len(parts) > 1 else (table, events)),
        )

    def rule_outcomes(self) -> tuple[RuleOutcome, ...]:
        """Means over the voxels with OP >= 2 under each rule."""
        return tuple(
            RuleOutcome(rule, rule_means_of(own[2:]), float(ratio_of(own[:2])))
            for rule, own in zip(fusion_rules.RULES, self.rules, strict=True)
        )

    def tested(self, seed: int) -> tuple[OrderTest, Float64]:
        """What the orders of the sampled voxels say of all, and the p-value of the SBD of each of them (n,)."""
        return order_test(self.table, self.events, seed=seed), drift_p(self.table, self.events, seed=seed)


def log_maps(drift: VoxelDrift, changes: Flips) -> Maps:
    """What a part's log says of each voxel; drift_p of those that are not sampled."""
    return {
        "drift_p": drift.p_value,
        "trend": drift.trend,
        "trend_p": drift.trend_p,
        "flip_rate": changes.rate,
        "frames_since_flip": changes.since,
    }


def _rules(kinds: Kinds) -> Float64:
    """(R, 2 + C), over the voxels with OP >= 2, by their patterns, some after the others."""
    _, *others = fusion_rules.RULES  # the map's own rule is the first
    (table, _, truth, _), patterns = vars(kinds.one).values(), kinds.patterns
    assert patterns.log is not None
    again = patterns.table.op >= 2
    total, seen, number = np.zeros(()), np.flatnonzero(again), np.cumsum(again) - 1
    rows = np.flatnonzero(table.op >= 2)
    at = number[rows if patterns.of is None else patterns.of[rows]]
    if len(seen) > STRETCH:
        at, order = ordered(at)
        rows = rows[order]
    for some in stretches(len(seen)):
        own, one = seen[some], slice(None)
        if len(seen) > STRETCH:
            one = slice(*np.searchsorted(at, [some.start, some.stop]))
        of = patterns.table.rows(own)
        part, voxels = Voxels(of.op, of.evidence, of.drift_sum), of.voxels
        usual = fusion_rules.labels(part.evidence)
        by_rule: list[Beliefs] = [part]
        by_rule += fusion_rules.fuse_all(patterns.log, others, evidence=part.evidence, rows=own)
        alike = None
        if truth is not None:
            alike = Alike.of(part.evidence, at[one] - some.start, table, rows[one], truth.label[rows[one]])
        sums = []
        for fused in by_rule:
            belief = Evidence.of(fused.evidence).measured()
            relabelled = voxels.sum(where=fusion_rules.labels(belief) != usual)
            sums.append([relabelled, voxels.sum(), *rule_sums(Voxels(of.op, belief, fused.drift_sum), voxels)])
            if alike is not None:
                sums[-1] += [*judged_where(alike.judged(belief), alike.truth >= 0)]
        total = total + np.array(sums)
    return total
