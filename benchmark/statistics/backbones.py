"""Several backbones' maps of one scene beside each other, as content for JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError
from semstab.measures import measures
from semstab.statistics import fusion_rules
from semstab.statistics.comparison import (
    EDGES,
    Tables,
    coverage,
    paired,
    repeated_rows,
    standard_weights,
    standardised,
    voxelwise,
)
from semstab.statistics.content import mean, plain
from semstab.statistics.correctness import ACCURACY, ECE, MIOU, Truth, correctness, join_truth
from semstab.statistics.matching import require_same_map
from semstab.voxels import Events, VoxelTable

SCHEMA = 1


def compare_backbones(
    tables: Tables,
    events: Mapping[str, Events] | None = None,
    truth: VoxelTable | None = None,
    *,
    seed: int = 0,
    block_size: float | None = None,
) -> dict[str, Any]:
    """Compare several backbones' maps of one scene, as content for JSON; at least two.

    coverage      what each map holds
    standardised  means at a common distribution of OP, each map with all its voxels
    paired        values, differences and rankings on the voxels that all saw twice or more
    fusion_rules  the same ranking under other fusion rules, from the events of all backbones; None without them
    Raises ConfigError for fewer than two maps, DataError where they differ in K or voxel size.
    """
    if len(tables) < 2:
        raise ConfigError(f"there are {len(tables)} backbones to compare; give two or more")
    weights = standard_weights(tables)
    everywhere = {m.key: standardised(tables, m, seed=seed, weights=weights) for m in voxelwise()}
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "seed": seed,
        "backbones": list(tables),
        "coverage": coverage(tables),
        "standardised": {"edges": list(EDGES), "weights": weights.tolist(), "values": everywhere},
        "paired": paired(tables, truth, seed=seed, block_size=block_size),
        "fusion_rules": None if events is None else _ranking_by_rule(tables, events, truth),
    }
    return {key: plain(value) for key, value in content.items()}


def _ranking_by_rule(tables: Tables, events: Mapping[str, Events], truth: VoxelTable | None) -> dict[str, Any]:
    """Each rule's means on the common voxels with OP >= 2, and the order of the backbones that follows, best first."""
    rows = repeated_rows(tables)
    values: dict[str, dict[str, dict[str, float]]] = {rule: {} for rule in fusion_rules.RULES}
    for (name, table), own in zip(tables.items(), rows, strict=True):
        require_same_map(table, events[name])
        known = None if truth is None else join_truth(table, truth)
        for rule in fusion_rules.RULES:
            values[rule][name] = _values(fusion_rules.fuse(events[name], rule), own, known)
    measures = next(iter(values[fusion_rules.RULES[0]].values()))
    orders = {measure: {rule: _order(found, measure) for rule, found in values.items()} for measure in measures}
    changes = {measure: len(set(map(tuple, by_rule.values()))) > 1 for measure, by_rule in orders.items()}
    return {"voxels": len(rows[0]), "values": values, "orders": orders, "order_changes": changes}


def _values(fused: fusion_rules.Fused, rows: npt.NDArray[np.int64], truth: Truth | None) -> dict[str, float]:
    values = {measure.key: mean(measure.of(fused)[rows]) for measure in measures()}
    if truth is not None:
        known = rows[truth.known[rows]]
        right = correctness(fused.belief[known], truth.label[known])
        values |= {"accuracy": right.accuracy, "miou": right.miou, "ece": right.ece}
    return values


def _order(values: Mapping[str, Mapping[str, float]], measure: str) -> list[str]:
    sign = next(q.sign for q in (*measures(), ACCURACY, MIOU, ECE) if q.key == measure)
    return sorted(values, key=lambda name: (math.isnan(values[name][measure]), sign * values[name][measure]))
