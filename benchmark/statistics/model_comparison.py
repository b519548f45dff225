"""Several backbones' maps of one scene beside each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.errors import ConfigError
from semstab.metrics.agreement import require_same_grid, shared_rows
from semstab.model.contrast import BackboneComparison, MapCoverage, Paired, Rank, Ranking, Standardised
from semstab.model.events import Events
from semstab.model.measures import Quantity, dominant, measures
from semstab.model.results import RECURRENT
from semstab.model.statistics import UNDEFINED, Estimate
from semstab.model.voxels import VoxelTable
from semstab.statistics.accumulate import CubeSums
from semstab.statistics.agreement import ALPHA, ALPHA_BETWEEN, PSA, alpha_columns, alpha_of, between_of, ratio_of
from semstab.statistics.cluster_sums import Statistic
from semstab.statistics.correctness import ACCURACY, join_truth
from semstab.statistics.observations import CellObservations
from semstab.statistics.paired_differences import (
    EDGES,
    OnCommonLocations,
    SharedObservations,
    Tables,
    common_weights,
    compared_observations,
    differences,
    standardised_of,
    stratum_counts,
    stratum_sums,
    thin_share,
    voxelwise,
)

# Which backbone is more stable? Compared on the same places, at the same number of observations, with intervals.


def coverage(tables: Tables) -> tuple[MapCoverage, ...]:
    """Coverage of each backbone's map; common_share is the part of its voxels that all maps hold."""
    return coverage_of(tuple(tables), [held(tables)])


def held(tables: Tables) -> Int64:
    """Return (M, 6): each map's (part's) voxels, observations, repeated and recurrent voxels, common ones, own ones."""
    common = len(shared_rows(*tables.values())[0])
    rows = []
    for name, table in tables.items():
        elsewhere = np.zeros(len(table), dtype=np.bool_)
        for other in (t for n, t in tables.items() if n != name):
            elsewhere[shared_rows(table, other)[0]] = True
        often = [np.count_nonzero(table.op >= least) for least in (2, RECURRENT)]
        rows.append([len(table), table.op.sum(dtype=np.int64), *often, common, np.count_nonzero(~elsewhere)])
    return np.array(rows, dtype=np.int64)


def coverage_of(names: Sequence[str], parts: Sequence[Int64]) -> tuple[MapCoverage, ...]:
    """Coverage of the maps by what their parts have, see `held`."""
    return tuple(
        MapCoverage(
            backbone=name,
            voxels=n,
            observations=observations,
            mean_op=observations / n if n else math.nan,
            repeated=repeated,
            recurrent=recurrent,
            common_share=common / n if n else math.nan,
            alone=alone,
        )
        for name, (n, observations, repeated, recurrent, common, alone) in zip(
            names, np.sum(parts, axis=0).tolist(), strict=True
        )
    )


def compared(*, truth: bool) -> tuple[Quantity, ...]:
    """All that is compared, in the order of the tables; what needs ground truth only where there is some."""
    quantities = (ALPHA_BETWEEN, PSA, ALPHA, *measures(), ACCURACY)
    return tuple(quantity for quantity in quantities if truth or quantity.needs != "truth")


# --- On the same places -----------------------------------------------------------------------------------------------


def repeated_rows(tables: Tables) -> list[Int64]:
    """Rows of the voxels that every map saw twice or more, one array a map, in the same order of voxels."""
    rows = shared_rows(*tables.values())
    again = np.all([table.op[r] >= 2 for table, r in zip(tables.values(), rows, strict=True)], axis=0)
    return [r[again] for r in rows]


def paired(
    tables: Tables,
    truth: VoxelTable | None = None,
    *,
    logs: Mapping[str, Events] | None = None,
    whole: Tables | None = None,
    primary: Quantity = ALPHA_BETWEEN,
    seed: int = 0,
) -> Paired:
    """Compare backbones voxel by voxel where all of them observed at least twice.

    truth is the map of the ground truth labels; without it there is no accuracy. Only the primary measure is tested,
    alpha or alpha between frames, for this scene flown again where the logs of the tables are given, else for these
    frames; the other differences describe. Ranks come from resamples of the cubes of space, the same ones for every
    measure. `whole` are the same tables before observations were reduced to a class, where they were: alpha between
    frames is that of these.
    """
    rows = repeated_rows(tables)
    columns, statistics = _columns(tables, rows, truth, whole or tables)
    common = OnCommonLocations.of(tables, rows, truth, logs or {}, reduced=whole is not None and primary == ALPHA)
    values: dict[str, dict[str, Estimate]] = {}
    for measure, statistic in statistics.items():
        own = columns[measure]
        values[measure.key] = {
            name: UNDEFINED if common is None else common.value(measure, name, own[name], statistic) for name in tables
        }
    count = 0 if common is None else common.cubes.count
    drawn = np.zeros((1, 0))
    if count:
        drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=REPLICATES).astype(float)
    rankings = []
    for measure, statistic in statistics.items():
        sums = {name: np.zeros((0, own.shape[1])) if common is None else common.cubes.sums(own)
                for name, own in columns[measure].items()}  # fmt: skip
        rankings.append(_ranking(measure, statistic, sums, drawn))
    paired_rows = differences(primary, columns, statistics, common)
    return Paired(primary.key, len(rows[0]), count, values, paired_rows, tuple(rankings))


def _columns(
    tables: Tables, rows: Sequence[Int64], truth: VoxelTable | None, whole: Tables
) -> tuple[dict[Quantity, dict[str, Float64]], dict[Quantity, Statistic]]:
    """By measure: each backbone's columns on the common voxels, and what makes the measure of their sums."""
    quantities = compared(truth=truth is not None)
    alphas: dict[Quantity, Statistic] = {ALPHA: alpha_of, ALPHA_BETWEEN: between_of}
    statistics = {quantity: alphas.get(quantity, ratio_of) for quantity in quantities}
    columns: dict[Quantity, dict[str, Float64]] = {measure: {} for measure in statistics}
    for measure, values in voxelwise().items():
        own = [values(table)[r] for table, r in zip(tables.values(), rows, strict=True)]
        known = ~np.isnan(own).any(axis=0)
        columns[measure] = {
            name: np.stack([np.where(known, value, 0.0), known], axis=1)
            for name, value in zip(tables, own, strict=True)
        }
    for (name, table), r in zip(tables.items(), rows, strict=True):
        columns[ALPHA][name], columns[ALPHA_BETWEEN][name] = alpha_columns(table)[r], alpha_columns(whole[name])[r]
        if truth is not None:
            true = join_truth(table, truth)
            right = np.stack([true.known & (dominant(table) == true.label), true.known], axis=1)
            columns[ACCURACY][name] = right[r].astype(np.float64)
    return columns, statistics


def _ranking(measure: Quantity, statistic: Statistic, sums: Mapping[str, Float64], drawn: Float64) -> Ranking:
    """From the sums (G, C) of each backbone over cubes, and how often each cube is in each resample (R, G)."""
    values = {name: float(statistic(own.sum(axis=0))) for name, own in sums.items()}
    resampled = np.stack([measure.sign * statistic(drawn @ own) for own in sums.values()])
    ranks = 1 + (resampled[None] < resampled[:, None]).sum(axis=1)
    ranks = ranks[:, ~np.isnan(resampled).any(axis=0)]
    order = sorted(values, key=lambda name: (math.isnan(values[name]), measure.sign * values[name]))
    rows = []
    for place, name in enumerate(order, start=1):
        own = ranks[list(sums).index(name)]
        low, high = np.quantile(own, [0.025, 0.975], method="inverted_cdf") if own.size else (1, len(sums))
        best = float(np.mean(own == 1)) if own.size else math.nan
        rows.append(Rank(name, values[name], place, int(low), int(high), best))
    return Ranking(measure.key, tuple(rows))


SCHEMA = 1

REPLICATES = 2000
"""Resamples of the cubes of space that ranks come from."""


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
) -> BackboneComparison:
    """Compare several backbones' maps of one scene; at least two.

    coverage      what each map holds
    standardised  means at a common distribution of OP, each map with all its voxels; none of labels beside scores
    paired        values, differences and rankings on the voxels that all saw twice or more; where there are samples of
                  looks (`Sampler`), on the looks that all made, with the same weights
    looks         what these are, and what the order owes to what was left out; None without samples
    Raises ConfigError for fewer than two maps, DataError where they differ in K or voxel size.
    """
    if len(tables) < 2:
        raise ConfigError(f"there are {len(tables)} backbones to compare; give two or more")
    whole = Region(tables, events, truth)
    return compare_regions(lambda: [whole], looks=looks, scene=scene, seed=seed)


def compare_regions(
    regions: Regions, *, looks: Mapping[str, CellObservations] | None = None, scene: str = "", seed: int = 0
) -> BackboneComparison:
    """What `compare_backbones` says of maps that are seen region by region; whole ones without samples of looks."""
    first = next(iter(regions()))
    names = tuple(first.tables)
    require_same_grid(*first.tables.values())
    shared = None if looks is None else compared_observations({name: looks[name] for name in names})
    mixed = shared is not None and shared.found.decided
    held_there, counts, strata = [], list[Int64](), dict[str, list[CubeSums]]()
    for region in regions():
        held_there.append(held(region.tables))
        counts.append(stratum_counts(region.tables))
        for name, table in region.tables.items():
            strata.setdefault(name, []).append(stratum_sums(table))
    observed = np.sum(counts, axis=0)
    weights = common_weights(observed)
    means = {name: standardised_of(CubeSums.merged(parts), weights) for name, parts in strata.items()}
    keys = () if mixed else voxelwise()  # means of labels beside means of scores would say nothing
    everywhere = {quantity.key: {name: own[quantity.key] for name, own in means.items()} for quantity in keys}
    return BackboneComparison(
        scene=scene,
        schema=SCHEMA,
        seed=seed,
        backbones=names,
        coverage=coverage_of(names, held_there),
        standardised=Standardised(EDGES, tuple(weights.tolist()), thin_share(observed, weights), everywhere),
        paired=_paired(regions, shared, seed),
        observations=None if shared is None else shared.found,
    )


def _paired(regions: Regions, shared: SharedObservations | None, seed: int) -> Paired:
    """On common looks where there are some, else on the common voxels with all looks of each map."""
    if shared is None:
        parts = list(regions())
        tables = {name: VoxelTable.joined([own.tables[name] for own in parts]) for name in parts[0].tables}
        truths = [own.truth for own in parts if own.truth is not None]
        truth = VoxelTable.joined(truths) if truths else None
        logs = _joined_logs(parts)
        return paired(tables, truth, logs=logs, seed=seed)
    tables = {name: log.table() for name, log in shared.logs.items()}
    return paired(
        tables,
        truth_at(regions, next(iter(tables.values()))),
        logs=shared.logs,
        whole={name: log.table() for name, log in shared.whole.items()},
        primary=shared.primary,
        seed=seed,
    )


def _joined_logs(parts: Sequence[Region]) -> dict[str, Events] | None:
    logs = [own.events for own in parts if own.events is not None]
    return {name: Events.joined([own[name] for own in logs]) for name in logs[0]} if logs else None


def truth_at(regions: Regions, locations: VoxelTable) -> VoxelTable | None:
    """The ground truth's voxels that these are of; None without any."""
    result = [own.truth.rows(shared_rows(own.truth, locations)[0]) for own in regions() if own.truth is not None]
    return VoxelTable.joined(result) if result else None
