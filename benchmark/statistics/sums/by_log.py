"""What of a map's statistics needs the log of its observations, as sums over its parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64
from semstab.model.events import Events
from semstab.model.statistics import RuleOutcome
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ratio_of
from semstab.statistics.correctness import rule_means_of
from semstab.statistics.kinds import Kinds
from semstab.statistics.map_sums import Maps
from semstab.statistics.order import fusion_rules
from semstab.statistics.order.drift import TESTABLE, Flips, VoxelDrift, drift_p, trend_columns, varying
from semstab.statistics.order.p_values import PValues
from semstab.statistics.patterns import Patterns
from semstab.statistics.sampling import Places, PlaceSums
from semstab.statistics.scene_drift import OrderTest, order_test, sampled

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
    def of(cls, kinds: Kinds, rules: Float64, drift: VoxelDrift, changes: Flips, seed: int) -> LogSums:
        """Of a map with its log, from `sums_by_rule` and what is known of one voxel of each kind.

        `drift` is that of their patterns.
        """
        every, patterns, places = kinds.every, kinds.patterns, kinds.one.places
        assert every.log is not None
        assert patterns.log is not None
        trends = _trends(patterns, places, drift)
        excess = np.stack([trends[:, 0] - trends[:, 1], trends[:, 2]], axis=1)
        means = {
            "flip_rate": changes.rate,
            "flip_null": changes.null,
            "flip_excess": changes.rate - changes.null,
            "frames_since": changes.since,
        }
        vary = patterns.spread(varying(patterns.table, patterns.log)[0])
        return cls(
            PlaceSums(places.cell, places.edge, places.means(means) | {"trend_excess": excess}),
            trends.sum(axis=0),
            PValues.of(np.where(patterns.table.op >= TESTABLE, drift.trend_p, np.nan)),
            rules,
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


def _trends(patterns: Patterns, places: Places, drift: VoxelDrift) -> Float64:
    """(cells, 3) sums of `trend_columns` over the cubes of places, whose patterns drift so."""
    tell, trend = trend_columns(patterns.table, drift)
    number = np.full(len(patterns.table), -1, np.int32)
    number[tell] = np.arange(len(tell))
    of = patterns.spread(number)
    rows = np.flatnonzero(of >= 0)
    return places.rows(rows).sums(trend[of[rows]])


def log_maps(patterns: Patterns, drift: VoxelDrift, changes: Flips) -> Maps:
    """What a part's log says of each voxel, whose patterns drift so; drift_p of those that are not sampled."""
    return {
        "drift_p": patterns.spread(drift.p_value),
        "trend": patterns.spread(drift.trend),
        "trend_p": patterns.spread(drift.trend_p),
        "flip_rate": changes.rate,
        "frames_since_flip": changes.since,
    }
