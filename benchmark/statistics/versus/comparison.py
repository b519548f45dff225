"""Which backbone is more stable? Compared on the same places, at the same number of observations, with intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError
from semstab.metrics.matching import require_same_grid, shared_rows
from semstab.model.measures import Quantity, dominant, measures
from semstab.model.results import RECURRENT
from semstab.model.statistics import UNDEFINED, Estimate
from semstab.model.statistics.comparison import MapCoverage, Paired, Rank, Ranking
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.agreement import (
    ALPHA,
    ALPHA_BETWEEN,
    PSA,
    alpha_columns,
    alpha_of,
    between_of,
    psa,
    ratio_of,
)
from semstab.statistics.blocks import (
    LEAST_BLOCKS,
    REPLICATES,
    BlockBootstrap,
    Statistic,
    spatial_blocks,
)
from semstab.statistics.correctness import ACCURACY, join_truth
from semstab.statistics.versus.differences import OnCommonPlaces, differences

Float64 = npt.NDArray[np.float64]
Tables = Mapping[str, VoxelTable]

EDGES = (2, 3, 4, 5, 7, 10, 15, 20, 30, 50)
"""Upper edges of the strata of OP that comparisons are standardised by; OP = 1 is left out."""

LEAST_VOXELS, LEAST_OVERLAP = 50, 0.1
"""A stratum overlaps hardly where some map has fewer voxels in it, or a smaller part of what another map has."""


def coverage(tables: Tables) -> tuple[MapCoverage, ...]:
    """Coverage of each backbone's map; common_share is the part of its voxels that all maps hold."""
    common = len(shared_rows(*tables.values())[0])
    rows = []
    for name, table in tables.items():
        elsewhere = np.zeros(len(table), dtype=np.bool_)
        for other in (t for n, t in tables.items() if n != name):
            elsewhere[shared_rows(table, other)[0]] = True
        n, observations = len(table), int(table.op.sum(dtype=np.int64))
        rows.append(
            MapCoverage(
                backbone=name,
                voxels=n,
                observations=observations,
                mean_op=observations / n if n else math.nan,
                repeated=int(np.count_nonzero(table.op >= 2)),
                recurrent=int(np.count_nonzero(table.op >= RECURRENT)),
                common_share=common / n if n else math.nan,
                alone=int(np.count_nonzero(~elsewhere)),
            )
        )
    return tuple(rows)


def voxelwise() -> dict[Quantity, Callable[[VoxelTable], Float64]]:
    """What is compared and has one value a voxel (n,), NaN where undefined."""
    return {PSA: psa, **{measure: measure.of for measure in measures()}}


def compared(*, truth: bool) -> tuple[Quantity, ...]:
    """All that is compared, in the order of the tables; what needs ground truth only where there is some."""
    quantities = (ALPHA_BETWEEN, PSA, ALPHA, *measures(), ACCURACY)
    return tuple(quantity for quantity in quantities if truth or quantity.needs != "truth")


# --- At the same number of observations -------------------------------------------------------------------------------


def standard_weights(tables: Tables, edges: Sequence[int] = EDGES) -> Float64:
    """The common distribution of OP: shares (S,) of the strata among the voxels with OP >= 2 of all maps together.

    A stratum that is empty in some map has weight 0: there is nothing to compare it with.
    """
    counts = np.stack([np.bincount(_stratum(table, edges), minlength=len(edges) + 2)[1:] for table in tables.values()])
    pooled = np.where((counts > 0).all(axis=0), counts.sum(axis=0), 0)
    total = pooled.sum()
    return pooled / total if total else np.zeros(counts.shape[1])


def thin(tables: Tables, weights: Float64, edges: Sequence[int] = EDGES) -> float:
    """The part of the weights in strata of OP of which some map has few voxels, or a small part of what another has."""
    counts = np.stack([np.bincount(_stratum(table, edges), minlength=len(edges) + 2)[1:] for table in tables.values()])
    few = (counts < LEAST_VOXELS).any(axis=0) | (counts.min(axis=0) < LEAST_OVERLAP * counts.max(axis=0))
    return float(weights[few].sum())


def standardised(
    tables: Tables, measure: Quantity, *, edges: Sequence[int] = EDGES, seed: int = 0, weights: Float64 | None = None
) -> dict[str, Estimate]:
    """A measure's mean in each map, as it would be if all had the common distribution of OP (direct standardisation).

    sum_s w_s m_s with m_s the mean in stratum s; each map counts with all its voxels with OP >= 2.
    """
    require_same_grid(*tables.values())
    w = standard_weights(tables, edges) if weights is None else weights
    S = len(w)

    def weighted(sums: Float64) -> Float64:
        with np.errstate(invalid="ignore", divide="ignore"):
            means = sums[..., :S] / sums[..., S:]
        used = (w > 0) & (sums[..., S:].real > 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            value: Float64 = np.where(used, w * means, 0.0).sum(axis=-1) / np.where(used, w, 0.0).sum(axis=-1)
        return value

    estimates = {}
    for name, table in tables.items():
        columns = np.zeros((len(table), 2 * S))
        stratum = _stratum(table, edges)
        values = voxelwise()[measure](table)
        again = np.flatnonzero((stratum > 0) & ~np.isnan(values))
        columns[again, stratum[again] - 1] = values[again]
        columns[again, S + stratum[again] - 1] = 1.0
        bootstrap = BlockBootstrap(spatial_blocks(table.index, table.voxel_size), seed=seed)
        estimates[name] = bootstrap.estimate(columns, weighted, (0.0, 1.0))
    return estimates


def _stratum(table: VoxelTable, edges: Sequence[int]) -> npt.NDArray[np.int64]:
    """(n,) 0 for OP = 1, else 1 to len(edges) + 1."""
    if list(edges) != sorted(set(edges)) or not edges or edges[0] < 2:
        raise ConfigError(f"edges = {list(edges)}: upper bounds of OP must ascend from 2 or more")
    return np.where(table.op >= 2, np.searchsorted(edges, table.op) + 1, 0)


# --- On the same places -----------------------------------------------------------------------------------------------


def repeated_rows(tables: Tables) -> list[npt.NDArray[np.int64]]:
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
    tables: Tables, rows: Sequence[npt.NDArray[np.int64]], truth: VoxelTable | None, whole: Tables
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
