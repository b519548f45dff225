"""Several backbones' maps of one scene beside each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from semstab.errors import ConfigError
from semstab.metrics.matching import require_same_map
from semstab.model.measures import Measure, Quantity, measures
from semstab.model.statistics import RuleMeans
from semstab.model.statistics.comparison import BackboneComparison, Paired, RuleComparison, Standardised
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.correctness import ACCURACY, ECE, MIOU, join_truth, rule_means
from semstab.statistics.looks import Looks
from semstab.statistics.looks.common import decided
from semstab.statistics.looks.ignored import Shared, common_looks
from semstab.statistics.order import fusion_rules
from semstab.statistics.versus.comparison import (
    EDGES,
    Tables,
    coverage,
    paired,
    repeated_rows,
    standard_weights,
    standardised,
    thin,
    voxelwise,
)

SCHEMA = 1


def compare_backbones(
    tables: Tables,
    events: Mapping[str, Events] | None = None,
    truth: VoxelTable | None = None,
    *,
    looks: Mapping[str, Looks] | None = None,
    scene: str = "",
    seed: int = 0,
    block_size: float | None = None,
) -> BackboneComparison:
    """Compare several backbones' maps of one scene; at least two.

    coverage      what each map holds
    standardised  means at a common distribution of OP, each map with all its voxels; none of labels beside scores
    paired        values, differences and rankings on the voxels that all saw twice or more; where there are samples of
                  looks (`Sampler`), on the looks that all made, with the same weights
    looks         what these are, and what the order owes to what was left out; None without samples
    fusion_rules  the same ranking under other fusion rules, from the events of all backbones; None without them
    Raises ConfigError for fewer than two maps, DataError where they differ in K or voxel size.
    """
    if len(tables) < 2:
        raise ConfigError(f"there are {len(tables)} backbones to compare; give two or more")
    weights = standard_weights(tables)
    shared = None if looks is None else common_looks({name: looks[name] for name in tables})
    mixed = shared is not None and shared.found.decided
    comparable = () if mixed else voxelwise()  # means of labels beside means of scores would say nothing
    everywhere = {m.key: standardised(tables, m, seed=seed, weights=weights) for m in comparable}
    if mixed and events is not None:
        events = {name: decided(events[name]) for name in tables}
    return BackboneComparison(
        scene=scene,
        schema=SCHEMA,
        seed=seed,
        backbones=tuple(tables),
        coverage=coverage(tables),
        standardised=Standardised(EDGES, tuple(weights.tolist()), thin(tables, weights), everywhere),
        paired=_paired(tables, events, truth, shared, seed, block_size),
        looks=None if shared is None else shared.found,
        fusion_rules=None if events is None else _by_rule(tables, events, truth),
    )


def _paired(
    tables: Tables,
    events: Mapping[str, Events] | None,
    truth: VoxelTable | None,
    shared: Shared | None,
    seed: int,
    block_size: float | None,
) -> Paired:
    """On common looks where there are some, else on the common voxels with all looks of each map."""
    if shared is None:
        return paired(tables, truth, logs=events, seed=seed, block_size=block_size)
    return paired(
        {name: log.table() for name, log in shared.logs.items()},
        truth,
        logs=shared.logs,
        whole={name: log.table() for name, log in shared.whole.items()},
        primary=shared.primary,
        seed=seed,
        block_size=block_size,
    )


def _by_rule(tables: Tables, events: Mapping[str, Events], truth: VoxelTable | None) -> RuleComparison:
    """Each rule's means on the common voxels with OP >= 2, and the order of the backbones that follows, best first."""
    rows = repeated_rows(tables)
    values: dict[str, dict[str, RuleMeans]] = {rule: {} for rule in fusion_rules.RULES}
    for (name, table), own in zip(tables.items(), rows, strict=True):
        require_same_map(table, events[name])
        known = None if truth is None else join_truth(table, truth)
        where = np.zeros(len(table), dtype=np.bool_)
        where[own] = True
        for rule in fusion_rules.RULES:
            values[rule][name] = rule_means(fusion_rules.fuse(events[name], rule), where, known)
    orders = {
        quantity.key: {rule: _order(quantity, take, found) for rule, found in values.items()}
        for quantity, take in _judged_by(truth is not None).items()
    }
    changes = {key: len(set(by_rule.values())) > 1 for key, by_rule in orders.items()}
    return RuleComparison(len(rows[0]), values, orders, changes)


def _judged_by(truth: bool) -> dict[Quantity, Callable[[RuleMeans], float]]:
    """What puts backbones into an order."""
    measured: dict[Quantity, Callable[[RuleMeans], float]] = {measure: _mean_of(measure) for measure in measures()}
    right: dict[Quantity, Callable[[RuleMeans], float]] = {
        ACCURACY: lambda row: row.accuracy,
        MIOU: lambda row: row.miou,
        ECE: lambda row: row.ece,
    }
    return measured | (right if truth else {})


def _mean_of(measure: Measure) -> Callable[[RuleMeans], float]:
    return lambda row: row[measure]


def _order(quantity: Quantity, take: Callable[[RuleMeans], float], found: Mapping[str, RuleMeans]) -> tuple[str, ...]:
    values = {name: take(row) for name, row in found.items()}
    return tuple(sorted(values, key=lambda name: (math.isnan(values[name]), quantity.sign * values[name])))
