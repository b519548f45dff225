"""Comparison of several models' maps of one scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64, Mask
from semstab.data.contrast import MapCoverage, ModelComparison, Paired, Rank, Ranking, Standardised
from semstab.data.events import Events
from semstab.data.measures import Quantity, dominant, measures
from semstab.data.results import RECURRENT
from semstab.data.statistics import CONFIDENCE, UNDEFINED, Estimate
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError
from semstab.metrics.agreement import require_same_grid, shared_rows
from semstab.statistics.agreement import ALPHA, PSA, VOXEL_ALPHA, alpha_columns, alpha_of, ratio_of
from semstab.statistics.cluster_sums import (
    FUNCTIONALS,
    ClusterSums,
    Statistic,
    alpha_of_spots,
    columns_of,
    distinct_rows,
)
from semstab.statistics.correctness import ACCURACY, join_truth
from semstab.statistics.drift import streams
from semstab.statistics.intervals import estimate, scope_of
from semstab.statistics.observations import SpotObservations
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

# Stability of models is compared at the same locations and number of observations, with intervals.


def coverage(tables: Tables) -> tuple[MapCoverage, ...]:
    """Return coverage of each model's map; common_share is the part of its voxels that all maps hold."""
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
    """Return coverage of the maps by what their parts have, see `held`."""
    return tuple(
        MapCoverage(
            model=name,
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
    """Return all compared measures, in the order of the tables, without `truth` only those that need none."""
    quantities = (ALPHA, PSA, *measures(), VOXEL_ALPHA, ACCURACY)
    return tuple(quantity for quantity in quantities if truth or quantity.needs != "truth")


# --- At the same locations --------------------------------------------------------------------------------------------


def repeated_rows(tables: Tables) -> list[Int64]:
    """Return rows of the voxels that every map saw twice or more, one array per map, in the same order of voxels."""
    rows = shared_rows(*tables.values())
    again = np.all([table.op[r] >= 2 for table, r in zip(tables.values(), rows, strict=True)], axis=0)
    return [r[again] for r in rows]


def paired(
    tables: Tables,
    truth: VoxelTable | None = None,
    *,
    logs: Mapping[str, Events] | None = None,
    spots: Mapping[str, ClusterSums] | None = None,
    seed: int = 0,
) -> Paired:
    """Compare models by alpha of common observations, and voxel by voxel where all of them observed at least twice.

    Only alpha is tested, for this scene flown again; the other differences describe. Ranks come from resamples of the
    cubes of space, the same ones for every measure.

    Args:
        tables: The maps.
        truth: The map of the ground truth labels; without it there is no accuracy.
        logs: The logs of the tables: with them other numbers are for this scene flown again, else for these frames.
        spots: Sums of each model's common observations; without them there is no alpha.
        seed: Seed of the resamples.
    """
    rows = repeated_rows(tables)
    columns, statistics = _columns(tables, rows, truth)
    common = OnCommonLocations.of(tables, rows, truth, logs or {})
    of_spots = spots or {}
    values: dict[str, dict[str, Estimate]] = {}
    if of_spots:
        values[ALPHA.key] = {
            name: estimate(sums, ALPHA.key, scope=scope_of(sums)).ends for name, sums in of_spots.items()
        }
    for measure, statistic in statistics.items():
        own = columns[measure]
        values[measure.key] = {
            name: UNDEFINED if common is None else common.value(measure, name, own[name], statistic) for name in tables
        }
    rankings = [_ranking(ALPHA, _alpha_of_spots, _by_cube(of_spots), seed)] if of_spots else []
    for measure, statistic in statistics.items():
        sums = {name: np.zeros((0, own.shape[1])) if common is None else common.cubes.sums(own)
                for name, own in columns[measure].items()}  # fmt: skip
        rankings.append(_ranking(measure, statistic, sums, seed))
    paired_rows = differences(columns, statistics, common, of_spots)
    cubes = 0 if common is None else common.cubes.count
    return Paired(ALPHA.key, len(rows[0]), cubes, values, paired_rows, tuple(rankings))


def _by_cube(spots: Mapping[str, ClusterSums]) -> dict[str, Float64]:
    """Return sums (G, 2 C) over the cubes that hold spots of any model, of first and second answers side by side."""
    parts = {name: [own for own in (sums.near, sums.far) if own is not None] for name, sums in spots.items()}
    cubes, row = distinct_rows(np.concatenate([own.cell for each in parts.values() for own in each]))
    ends, result = iter(np.split(row, np.cumsum([len(own.cell) for each in parts.values() for own in each]))), {}
    for name, each in parts.items():
        sums = []
        for own in each:
            columns = np.hstack([columns_of(own, FUNCTIONALS[ALPHA.key]), own["square"], own["agreeing_beyond"]])
            sums.append(np.zeros((len(cubes), columns.shape[1])))
            np.add.at(sums[-1], next(ends), columns)
        result[name] = np.hstack(sums)
    return result


def _alpha_of_spots(sums: Float64) -> Float64:
    """Return alpha (...,) from sums (..., 2 C) of first and of second answers."""
    return alpha_of_spots(*np.split(sums, 2, axis=-1))


def _columns(
    tables: Tables, rows: Sequence[Int64], truth: VoxelTable | None
) -> tuple[dict[Quantity, dict[str, Float64]], dict[Quantity, Statistic]]:
    """Return by measure of voxels each model's columns on the common ones, and the statistic of their sums."""
    quantities = [quantity for quantity in compared(truth=truth is not None) if quantity is not ALPHA]
    statistics: dict[Quantity, Statistic] = {
        quantity: alpha_of if quantity is VOXEL_ALPHA else ratio_of for quantity in quantities
    }
    columns: dict[Quantity, dict[str, Float64]] = {measure: {} for measure in statistics}
    for measure, values in voxelwise().items():
        own = [values(table)[r] for table, r in zip(tables.values(), rows, strict=True)]
        known = ~np.isnan(own).any(axis=0)
        columns[measure] = {
            name: np.stack([np.where(known, value, 0.0), known], axis=1)
            for name, value in zip(tables, own, strict=True)
        }
    for (name, table), r in zip(tables.items(), rows, strict=True):
        columns[VOXEL_ALPHA][name] = alpha_columns(table)[r]
        if truth is not None:
            true = join_truth(table, truth)
            right = np.stack([true.known & (dominant(table) == true.label), true.known], axis=1)
            columns[ACCURACY][name] = right[r].astype(np.float64)
    return columns, statistics


def _ranking(measure: Quantity, statistic: Statistic, sums: Mapping[str, Float64], seed: int) -> Ranking:
    """Return the ranking by the sums (G, C) of each model over cubes, and by resamples of these."""
    count, drawn = len(next(iter(sums.values()))), np.zeros((1, 0))
    if count:
        drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=REPLICATES).astype(float)
    values = {name: float(statistic(own.sum(axis=0))) for name, own in sums.items()}
    resampled = np.stack([measure.sign * statistic(drawn @ own) for own in sums.values()])
    ranks = 1 + (resampled[None] < resampled[:, None]).sum(axis=1)
    ranks = ranks[:, ~np.isnan(resampled).any(axis=0)]
    order = sorted(values, key=lambda name: (math.isnan(values[name]), measure.sign * values[name]))
    rows = []
    for position, name in enumerate(order, start=1):
        own = ranks[list(sums).index(name)]
        tail = round((1 - CONFIDENCE) / 2, 9)
        low, high = np.quantile(own, [tail, 1 - tail], method="inverted_cdf") if own.size else (1, len(sums))
        best = float(np.mean(own == 1)) if own.size else math.nan
        rows.append(Rank(name, values[name], position, int(low), int(high), best))
    return Ranking(measure.key, tuple(rows))


SCHEMA = 2

REPLICATES = 2000
"""Resamples of the cubes of space that ranks come from."""


@dataclass(frozen=True, eq=False)
class Region:
    """Several models' maps of a scene, or a part of it, their logs, and the ground truth; share: of all voxels."""

    tables: Tables
    events: Mapping[str, Events] | None = None
    truth: VoxelTable | None = None
    share: float = 1.0


Regions = Callable[[], Iterable[Region]]
"""A function that yields the regions of a scene at each call: none stays in memory."""


def compare_models(
    tables: Tables,
    events: Mapping[str, Events] | None = None,
    truth: VoxelTable | None = None,
    *,
    observations: Mapping[str, SpotObservations] | None = None,
    scene: str = "",
    seed: int = 0,
) -> ModelComparison:
    """Compare several models' maps of one scene; at least two.

    - `coverage`: the content of each map
    - `standardised`: means at a common distribution of OP, each map with all its voxels; none if only
      some maps are of labels
    - `paired`: values, differences and rankings: alpha of the observations that all made, with the same weights, where
      there are samples of them (`Sampler`); other measures on the voxels that all saw twice or more
    - `observations`: these observations, and how the order depends on those left out; None without samples

    Raises:
        ConfigError: For fewer than two maps.
        DataError: If they differ in K or voxel size.
    """
    if len(tables) < 2:
        raise ConfigError(f"there are {len(tables)} models to compare; give two or more")
    whole = Region(tables, events, truth)
    return compare_regions(lambda: [whole], observations=observations, scene=scene, seed=seed)


def compare_regions(
    regions: Regions,
    *,
    observations: Mapping[str, SpotObservations] | None = None,
    mixed: bool = False,
    scene: str = "",
    seed: int = 0,
) -> ModelComparison:
    """Compare maps region by region, see `compare_models`; mixed: some are of labels and some of scores."""
    first = next(iter(regions()))
    names = tuple(first.tables)
    require_same_grid(*first.tables.values())
    shared = None if observations is None else compared_observations({name: observations[name] for name in names})
    held_there, counts, strata = [], list[Int64](), dict[str, list[ClusterSums]]()
    for region in regions():
        held_there.append(held(region.tables))
        counts.append(stratum_counts(region.tables))
        for name, table in region.tables.items():
            strata.setdefault(name, []).append(stratum_sums(table))
    observed = np.sum(counts, axis=0)
    weights = common_weights(observed)
    means = {name: standardised_of(ClusterSums.joined(parts), weights) for name, parts in strata.items()}
    keys = () if mixed else voxelwise()  # means of labels and means of scores are not comparable
    everywhere = {quantity.key: {name: own[quantity.key] for name, own in means.items()} for quantity in keys}
    return ModelComparison(
        scene=scene,
        schema=SCHEMA,
        seed=seed,
        models=names,
        coverage=coverage_of(names, held_there),
        standardised=Standardised(EDGES, tuple(weights.tolist()), thin_share(observed, weights), everywhere),
        paired=_paired(regions, shared, seed),
        observations=None if shared is None else shared.compared,
    )


def _paired(regions: Regions, shared: SharedObservations | None, seed: int) -> Paired:
    """Compare on common observations, and on the common voxels with all observations of each map."""
    common = common_voxels(regions)
    spots = None if shared is None else shared.sums
    return paired(common.tables, common.truth, logs=common.events, spots=spots, seed=seed)


MOST = 1 << 22
"""Most voxels in memory at a time: of more common voxels a sample is compared."""


def share_of(voxels: int) -> float:
    """Return the largest power of 1/2 that leaves at most MOST of so many voxels."""
    return 1.0 if voxels <= MOST else 2.0 ** -math.ceil(math.log2(voxels / MOST))


def in_share(table: VoxelTable, share: float) -> Mask:
    """Return the mask (n,) of voxels in the sample that is this share of all, by a hash of their index."""
    if share >= 1:
        return np.ones(len(table), np.bool_)
    drawn: Mask = streams(table, slice(None), 0) >> np.uint64(11) < np.uint64(share * 2**53)
    return drawn


def common_voxels(regions: Regions) -> Region:
    """Return the voxels that every map saw twice or more, with logs and ground truth, or a sample of very many."""
    count = sum(len(repeated_rows(region.tables)[0]) for region in regions())
    share, parts = share_of(count), list[Region]()
    for region in regions():
        tables, logs, rows = {}, {}, repeated_rows(region.tables)
        drawn = in_share(next(iter(region.tables.values())).rows(rows[0]), share)
        for (name, table), own in zip(region.tables.items(), rows, strict=True):
            tables[name] = table.rows(own[drawn])
            if region.events is not None:
                logs[name] = region.events[name].rows(own[drawn])
        first, truth = next(iter(tables.values())), region.truth
        true = None if truth is None else truth.rows(shared_rows(truth, first)[0])
        parts.append(Region(tables, logs or None, true))
    tables = {name: VoxelTable.joined([each.tables[name] for each in parts]) for name in parts[0].tables}
    events = [each.events for each in parts if each.events is not None]
    truths = [each.truth for each in parts if each.truth is not None]
    return Region(
        tables,
        {name: Events.joined([each[name] for each in events]) for name in tables} if events else None,
        VoxelTable.joined(truths) if truths else None,
        share,
    )
