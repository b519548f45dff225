"""Which backbone is more stable? Compared on the same places, at the same number of observations, with intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.metrics.agreement import shared_rows
from semstab.model.contrast import MapCoverage, Paired, Rank, Ranking
from semstab.model.events import Events
from semstab.model.measures import Quantity, dominant, measures
from semstab.model.results import RECURRENT
from semstab.model.statistics import UNDEFINED, Estimate
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ALPHA, ALPHA_BETWEEN, PSA, alpha_columns, alpha_of, between_of, ratio_of
from semstab.statistics.blocks import LEAST_BLOCKS, REPLICATES, BlockBootstrap, Statistic, spatial_blocks
from semstab.statistics.correctness import ACCURACY, join_truth
from semstab.statistics.versus.differences import OnCommonPlaces, differences
from semstab.statistics.versus.standard import Tables, voxelwise


def coverage(tables: Tables) -> tuple[MapCoverage, ...]:
    """Coverage of each backbone's map; common_share is the part of its voxels that all maps hold."""
    return coverage_of(tuple(tables), [held(tables)])


def held(tables: Tables) -> Int64:
    """(M, 6) of each map, or of its part in one place: voxels, observations, repeated and recurrent voxels, common to
    all, in no other."""
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
    block_size: float | None = None,
    replicates: int = REPLICATES,
    least_blocks: int = LEAST_BLOCKS,
) -> Paired:
    """Compare backbones voxel by voxel where all of them observed at least twice.

    truth is the map of the ground truth labels; without it there is no accuracy. Only the primary measure is tested,
    alpha or alpha between frames, for the next flight where the logs of the tables are given, else for this map; the
    other differences describe. Ranks come from one bootstrap over blocks of space, of an edge of block_size metres.
    `whole` are the same tables before looks were reduced to a class, where they were: of them is alpha between frames.
    """
    rows = repeated_rows(tables)
    first = next(iter(tables.values()))
    blocks = spatial_blocks(first.index[rows[0]], first.voxel_size, size=block_size, least=least_blocks)
    bootstrap = BlockBootstrap(blocks, replicates=replicates, seed=seed)
    columns, statistics = _columns(tables, rows, truth, whole or tables)
    common = OnCommonPlaces.of(tables, rows, truth, logs or {}, reduced=whole is not None and primary == ALPHA)
    values: dict[str, dict[str, Estimate]] = {}
    for measure, statistic in statistics.items():
        own = columns[measure]
        values[measure.key] = {
            name: UNDEFINED if common is None else common.value(measure, name, own[name], statistic) for name in tables
        }
    rankings = tuple(_ranking(measure, of, columns[measure], bootstrap) for measure, of in statistics.items())
    paired_rows = differences(primary, columns, statistics, common)
    return Paired(primary.key, len(rows[0]), blocks.count, blocks.size, values, paired_rows, rankings)


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


def _ranking(
    measure: Quantity, statistic: Statistic, columns: Mapping[str, Float64], bootstrap: BlockBootstrap
) -> Ranking:
    values = {name: float(statistic(own.sum(axis=0))) for name, own in columns.items()}
    resampled = np.stack([measure.sign * bootstrap.replicates(own, statistic) for own in columns.values()])
    ranks = 1 + (resampled[None] < resampled[:, None]).sum(axis=1)
    ranks = ranks[:, ~np.isnan(resampled).any(axis=0)]
    order = sorted(values, key=lambda name: (math.isnan(values[name]), measure.sign * values[name]))
    rows = []
    for place, name in enumerate(order, start=1):
        own = ranks[list(columns).index(name)]
        low, high = np.quantile(own, [0.025, 0.975], method="inverted_cdf") if own.size else (1, len(columns))
        best = float(np.mean(own == 1)) if own.size else math.nan
        rows.append(Rank(name, values[name], place, int(low), int(high), best))
    return Ranking(measure.key, tuple(rows))
