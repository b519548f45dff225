"""Several backbones' maps of one scene beside each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64
from semstab.errors import ConfigError
from semstab.metrics.agreement import require_same_grid, require_same_map, shared_rows
from semstab.model.contrast import BackboneComparison, Paired, RuleComparison, Standardised
from semstab.model.events import Events
from semstab.model.measures import Measure, Quantity, measures
from semstab.model.statistics import Estimate, RuleMeans
from semstab.model.voxels import VoxelTable
from semstab.statistics.correctness import ACCURACY, ECE, MIOU, join_truth, rule_means_of, rule_sums
from semstab.statistics.looks import CellObservations
from semstab.statistics.looks.common import decided
from semstab.statistics.looks.ignored import Shared, common_looks
from semstab.statistics.order import fusion_rules
from semstab.statistics.versus.comparison import coverage_of, held, paired, repeated_rows
from semstab.statistics.versus.standard import EDGES, Observed, Tables, standardised_of, stratum_sums, voxelwise

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class Region:
    """Several backbones' maps of a scene, or what each has in one place, their logs, and the ground truth there."""

    tables: Tables
    events: Mapping[str, Events] | None = None
    truth: VoxelTable | None = None


Regions = Callable[[], Iterable[Region]]
"""Those that make up a scene, as often as they are asked for: none is kept."""


def compare_backbones(
    tables: Tables,
    events: Mapping[str, Events] | None = None,
    truth: VoxelTable | None = None,
    *,
    looks: Mapping[str, CellObservations] | None = None,
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
    whole = Region(tables, events, truth)
    return compare_regions(lambda: [whole], looks=looks, scene=scene, seed=seed, block_size=block_size)


def compare_regions(
    regions: Regions,
    *,
    looks: Mapping[str, CellObservations] | None = None,
    scene: str = "",
    seed: int = 0,
    block_size: float | None = None,
) -> BackboneComparison:
    """What `compare_backbones` says of maps that are seen region by region; whole ones without samples of looks."""
    first = next(iter(regions()))
    names = tuple(first.tables)
    require_same_grid(*first.tables.values())
    shared = None if looks is None else common_looks({name: looks[name] for name in names})
    mixed = shared is not None and shared.found.decided
    held_there, seen = zip(*((held(own.tables), Observed.of(own.tables)) for own in regions()), strict=True)
    observed = Observed.merged(seen)
    weights = observed.weights()
    # means of labels beside means of scores would say nothing
    everywhere = {} if mixed else _standardised(regions, observed, weights, seed)
    return BackboneComparison(
        scene=scene,
        schema=SCHEMA,
        seed=seed,
        backbones=names,
        coverage=coverage_of(names, held_there),
        standardised=Standardised(EDGES, tuple(weights.tolist()), observed.thin(weights), everywhere),
        paired=_paired(regions, shared, seed, block_size),
        looks=None if shared is None else shared.found,
        fusion_rules=None if first.events is None else _by_rule(regions, mixed=mixed),
    )


def _standardised(regions: Regions, observed: Observed, weights: Float64, seed: int) -> dict[str, dict[str, Estimate]]:
    edges, sums, voxel_size = [occupied.edge() for occupied in observed.occupied], dict[str, list[Float64]](), 0.0
    for own in regions():
        for (name, table), edge in zip(own.tables.items(), edges, strict=True):
            sums.setdefault(name, []).append(stratum_sums(table, edge))
            voxel_size = table.voxel_size
    found = {
        name: standardised_of(parts, edge * voxel_size, weights, seed=seed)
        for (name, parts), edge in zip(sums.items(), edges, strict=True)
    }
    return {quantity.key: {name: own[quantity.key] for name, own in found.items()} for quantity in voxelwise()}


def _paired(regions: Regions, shared: Shared | None, seed: int, block_size: float | None) -> Paired:
    """On common looks where there are some, else on the common voxels with all looks of each map."""
    if shared is None:
        parts = list(regions())
        tables = {name: VoxelTable.joined([own.tables[name] for own in parts]) for name in parts[0].tables}
        truths = [own.truth for own in parts if own.truth is not None]
        truth = VoxelTable.joined(truths) if truths else None
        logs = _joined_logs(parts)
        return paired(tables, truth, logs=logs, seed=seed, block_size=block_size)
    tables = {name: log.table() for name, log in shared.logs.items()}
    return paired(
        tables,
        truth_at(regions, next(iter(tables.values()))),
        logs=shared.logs,
        whole={name: log.table() for name, log in shared.whole.items()},
        primary=shared.primary,
        seed=seed,
        block_size=block_size,
    )


def _joined_logs(parts: Sequence[Region]) -> dict[str, Events] | None:
    logs = [own.events for own in parts if own.events is not None]
    return {name: Events.joined([own[name] for own in logs]) for name in logs[0]} if logs else None


def truth_at(regions: Regions, places: VoxelTable) -> VoxelTable | None:
    """The ground truth's voxels that these are of; None without any."""
    found = [own.truth.rows(shared_rows(own.truth, places)[0]) for own in regions() if own.truth is not None]
    return VoxelTable.joined(found) if found else None


def _by_rule(regions: Regions, *, mixed: bool) -> RuleComparison:
    """Each rule's means on the common voxels with OP >= 2, and the order of the backbones that follows, best first."""
    sums: dict[str, dict[str, Float64]] = {rule: {} for rule in fusion_rules.RULES}
    voxels, known = 0, False
    for region in regions():
        assert region.events is not None
        rows, known = repeated_rows(region.tables), region.truth is not None
        voxels += len(rows[0])
        for (name, table), own in zip(region.tables.items(), rows, strict=True):
            log = decided(region.events[name]) if mixed else region.events[name]
            require_same_map(table, log)
            truth = None if region.truth is None else join_truth(table, region.truth)
            where = np.zeros(len(table))
            where[own] = 1.0
            for rule, found in sums.items():
                found[name] = found.get(name, 0.0) + rule_sums(fusion_rules.fuse(log, rule), where, truth)
    values = {rule: {name: rule_means_of(own) for name, own in found.items()} for rule, found in sums.items()}
    orders = {
        quantity.key: {rule: _order(quantity, take, found) for rule, found in values.items()}
        for quantity, take in _judged_by(known).items()
    }
    changes = {key: len(set(by_rule.values())) > 1 for key, by_rule in orders.items()}
    return RuleComparison(voxels, values, orders, changes)


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
