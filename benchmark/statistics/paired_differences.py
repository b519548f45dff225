"""Values of models at the locations that all saw twice, and their differences, with intervals and their scope.

Numbers of the sums by frame and cube of space are for this scene flown again; others, as SBD, are for these frames.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64, Mask
from semstab.data.contrast import ComparedObservations, Ignored, ModelComparison, PairedDifference
from semstab.data.events import Events
from semstab.data.information import by_group
from semstab.data.measures import ENTROPY, Quantity, mean, measures
from semstab.data.statistics import UNDEFINED, UNKNOWN, Estimate, Interval, LabelledPairs
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError, DataError
from semstab.metrics.agreement import observations, require_same_grid, rows_of
from semstab.statistics.accumulate import Cubes, cluster_sums_of, sums_of_spots
from semstab.statistics.agreement import ALPHA, ONE_HOT, PSA, VOXEL_ALPHA, psa
from semstab.statistics.cluster_sums import ClusterSums, Statistic, chance_of, mean_functional
from semstab.statistics.cluster_sums import value as value_of
from semstab.statistics.correctness import ACCURACY, join_truth
from semstab.statistics.intervals import difference, estimate, scope_of
from semstab.statistics.observations import SpotObservations, same_spots

Rows = Int64

SUMMED = (VOXEL_ALPHA, PSA, ENTROPY, ACCURACY)
"""Measures that follow from the sums; their VSS is of locations seen three times, and they have no SBD."""


@dataclass(frozen=True, eq=False)
class OnCommonLocations:
    """Models at the same locations (n, 3): the sums of each map there, and the cubes of space that hold them.

    Attributes:
        known: Measures that follow from the sums of these maps.
    """

    sums: Mapping[str, ClusterSums]
    cubes: Cubes
    known: frozenset[Quantity]

    @classmethod
    def of(
        cls, tables: Tables, rows: Sequence[Rows], truth: VoxelTable | None, logs: Mapping[str, Events]
    ) -> OnCommonLocations | None:
        """Return these rows of each table; None where there are none."""
        if not len(rows[0]):
            return None
        first = next(iter(tables.values()))
        cubes = Cubes.of(first.rows(rows[0]), where=np.ones(len(rows[0]), np.bool_))
        sums = {}
        for (name, table), own in zip(tables.items(), rows, strict=True):
            where = np.zeros(len(table), dtype=np.bool_)
            where[own] = True
            log = None if name not in logs else observations(logs[name], np.flatnonzero(where[logs[name].voxel]))
            some = rows_of(table, where)
            label = None if truth is None else join_truth(some, truth).label
            sums[name] = cluster_sums_of(some, log, label, edge=cubes.edge)
        return cls(sums, cubes, frozenset(SUMMED) - ({ACCURACY} if truth is None else set()))

    def value(self, measure: Quantity, name: str, columns: Float64, statistic: Statistic) -> Estimate:
        """Return the value of one model; the statistic is of the sums of columns (n, C)."""
        if measure in self.known:
            sums = self.sums[name]
            return estimate(sums, measure.key, scope=scope_of(sums, key=measure.key)).ends
        return self.cubes.estimate(columns, statistic).ends

    def difference(self, measure: Quantity, a: str, b: str, columns: Mapping[str, Float64], of: Statistic) -> Interval:
        """Return the difference of model a less model b."""
        if measure in self.known:
            scope = scope_of(self.sums[a], key=measure.key)
            return difference(self.sums[a], self.sums[b], measure.key, scope=scope)
        C = columns[a].shape[1]
        both = np.concatenate([columns[a], columns[b]], axis=1)
        return self.cubes.estimate(both, lambda sums: of(sums[..., :C]) - of(sums[..., C:]), (-2.0, 2.0), "plain")


def differences(
    columns: Mapping[Quantity, Mapping[str, Float64]],
    statistics: Mapping[Quantity, Statistic],
    common: OnCommonLocations | None,
    spots: Mapping[str, ClusterSums],
) -> tuple[PairedDifference, ...]:
    """Return the differences of each measure and pair of models; only alpha is tested, from the sums of spots."""
    result = [
        _row(ALPHA, a, b, difference(spots[a], spots[b], ALPHA.key), tested=True)
        for a, b in itertools.combinations(spots, 2)
    ]
    for measure, own in columns.items():
        for a, b in itertools.combinations(own, 2):
            interval = UNKNOWN if common is None else common.difference(measure, a, b, own, statistics[measure])
            result.append(_row(measure, a, b, interval, tested=False))
    return _claimed(result)


def _row(measure: Quantity, a: str, b: str, interval: Interval, *, tested: bool) -> PairedDifference:
    p = interval.p_value if tested else float("nan")
    return PairedDifference(measure.key, a, b, interval.ends, p, float("nan"), interval.scope, interval.undecided)


# --- Claims -----------------------------------------------------------------------------------------------------------


def claimed_together(comparisons: Sequence[ModelComparison]) -> tuple[ModelComparison, ...]:
    """Return scenes of one study with the p-values of all differences that may be claimed, corrected together."""
    rows = _claimed([row for result in comparisons for row in result.paired.differences])
    ends = np.cumsum([0, *(len(result.paired.differences) for result in comparisons)])
    return tuple(
        dataclasses.replace(result, paired=dataclasses.replace(result.paired, differences=rows[low:high]))
        for result, (low, high) in zip(comparisons, itertools.pairwise(ends.tolist()), strict=True)
    )


def _claimed(rows: Sequence[PairedDifference]) -> tuple[PairedDifference, ...]:
    """Return rows with p-values corrected for the number of those that may be claimed."""
    corrected = holm([float("nan") if row.undecided else row.p_value for row in rows])
    return tuple(dataclasses.replace(row, p_holm=p) for row, p in zip(rows, corrected, strict=True))


def holm(p: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number.

    Rejecting those <= q limits the chance of any false rejection to q (Holm 1979).

    >>> [round(value, 2) for value in holm([0.01, 0.04, 0.03])]
    [0.03, 0.06, 0.06]
    """
    corrected = [float("nan")] * len(p)
    tested = sorted((value, i) for i, value in enumerate(p) if not np.isnan(value))
    highest = 0.0
    for rank, (value, i) in enumerate(tested):
        highest = max(highest, min(1.0, value * (len(tested) - rank)))
        corrected[i] = highest
    return corrected


# Maps at the same number of observations: means as they would be if all had one distribution of OP.

Tables = Mapping[str, VoxelTable]

EDGES = (2, 3, 4, 5, 7, 10, 15, 20, 30, 50)
"""Upper edges of the strata of OP that comparisons are standardised by; OP = 1 is left out."""

LEAST_VOXELS, LEAST_OVERLAP = 50, 0.1
"""A stratum hardly overlaps where some map has fewer voxels in it, or a smaller share of another map's voxels."""


def voxelwise() -> dict[Quantity, Callable[[VoxelTable], Float64]]:
    """Return the compared measures that have one value per voxel (n,), NaN where undefined."""
    return {PSA: psa, **{measure: measure.of for measure in measures()}}


def stratum_counts(tables: Tables, edges: Sequence[int] = EDGES) -> Int64:
    """Return (M, S) voxels of each map, or of its part in one region, in each stratum of OP."""
    return np.stack([np.bincount(_stratum(t, edges), minlength=len(edges) + 2)[1:] for t in tables.values()])


def common_weights(counts: Int64) -> Float64:
    """Return the common distribution of OP: shares (S,) of the strata among the voxels with OP >= 2 of all maps.

    A stratum that is empty in some map has weight 0: there is nothing to compare it with.
    """
    pooled = np.where((counts > 0).all(axis=0), counts.sum(axis=0), 0)
    total = pooled.sum()
    return pooled / total if total else np.zeros(counts.shape[1])


def thin_share(counts: Int64, weights: Float64) -> float:
    """Return the weight of strata in which some map has few voxels, or a small share of another map's voxels."""
    few = (counts < LEAST_VOXELS).any(axis=0)
    few |= counts.min(axis=0) < LEAST_OVERLAP * counts.max(axis=0)
    return float(weights[few].sum())


def standardised(
    tables: Tables, measure: Quantity, *, edges: Sequence[int] = EDGES, weights: Float64 | None = None
) -> dict[str, Estimate]:
    """Return a measure's mean in each map at the common distribution of OP (direct standardisation).

    sum_s w_s m_s with m_s the mean in stratum s; each map counts with all its voxels with OP >= 2.
    """
    require_same_grid(*tables.values())
    weights = common_weights(stratum_counts(tables, edges)) if weights is None else weights
    return {name: standardised_of(stratum_sums(table, edges), weights)[measure.key] for name, table in tables.items()}


def stratum_sums(table: VoxelTable, edges: Sequence[int] = EDGES) -> ClusterSums:
    """Return the sums of each quantity over the voxels of each cube and stratum, then how many (G, 2 S)."""
    stratum, S, cubes = _stratum(table, edges), len(edges) + 1, Cubes.of(table)
    group = np.where(cubes.at >= 0, cubes.at * S + stratum - 1, -1)
    quantities = voxelwise()
    both = by_group(group, [formula(table) for formula in quantities.values()], cubes.count * S)
    sums, counts = (own.T.reshape(len(quantities), cubes.count, S) for own in both)
    named = zip(quantities, sums, counts, strict=True)
    return cubes.named({quantity.key: np.hstack(own) for quantity, *own in named})


def standardised_of(sums: ClusterSums, weights: Float64) -> dict[str, Estimate]:
    """Return each quantity's mean at these weights, by key, from `stratum_sums`.

    Its interval is that of a ratio of sums with the same influences: a voxel's value counts by how far it is from the
    mean of its stratum.
    """
    S, result = len(weights), {}
    for key in sums.layout:
        own = sums[key]
        total, count = own[:, :S].sum(axis=0), own[:, S:].sum(axis=0)
        used = (weights > 0) & (count > 0)
        if not used.any():
            result[key] = UNDEFINED
            continue
        each = np.where(used, weights, 0.0) / weights[used].sum() / np.where(used, count, 1)
        mean_of = total / np.where(used, count, 1)
        size = own[:, S:] @ each
        value = float(each @ total)
        above = own[:, :S] @ each - own[:, S:] @ (each * mean_of)
        columns = {key: np.stack([above + value * size, size], axis=1)}
        result[key] = estimate(ClusterSums.of_cubes(sums.cell, sums.edge, columns), mean_functional(key)).ends
    return result


def _stratum(table: VoxelTable, edges: Sequence[int]) -> Int64:
    """Return (n,) 0 for OP = 1, else 1 to len(edges) + 1."""
    if list(edges) != sorted(set(edges)) or not edges or edges[0] < 2:
        raise ConfigError(f"edges = {list(edges)}: upper bounds of OP must ascend from 2 or more")
    return np.where(table.op >= 2, np.searchsorted(edges, table.op) + 1, 0)


# Models on the observations that all of them made, and how their order depends on those that some left out.


@dataclass(frozen=True, eq=False)
class CommonObservations:
    """Models of one scene with their common observations.

    Attributes:
        shared: For each model the answers for spots and views to which all models gave a label, at the same pixels.
        ignoring: For each model the answers that any model gave, with one more class, the last, for those that the
            model left without a label.
        missing: Share of these answers that the model left without a label.
    """

    shared: tuple[SpotObservations, ...]
    ignoring: tuple[SpotObservations, ...]
    missing: tuple[float, ...]


def common_observations(models: Sequence[SpotObservations]) -> CommonObservations:
    """Return the common observations of samples.

    Where the pixel beside has no label of one model, its second answer is of another pixel than that of the others, or
    there is none: such observations are not common, since alpha would differ though all labels are the same.

    Raises:
        DataError: If they differ in K.
    """
    if len({sample.K for sample in models}) > 1:
        raise DataError("samples with different classes cannot be compared; fuse both alike")
    models = same_spots(models)
    of, first = _numbered(models)
    labelled, silent, near, far = np.zeros((4, len(models), len(first)))
    for k, (own, sample) in enumerate(zip(of, models, strict=True)):
        labelled[k] = np.bincount(own[sample.label < sample.K], minlength=len(first))
        silent[k] = np.bincount(own[sample.label == sample.K], minlength=len(first))
        near[k], far[k] = (np.bincount(own, squares, len(first)) for squares in (sample.near, sample.far))
    elsewhere = (near == near[0]).all(axis=0) & (far != far[0]).any(axis=0)
    common: Mask = (labelled > 0).all(axis=0) & (silent == 0).all(axis=0) & ~elsewhere
    most = labelled.max(axis=0)
    asked = SpotObservations.stacked(models).only(first)
    shared, ignoring = [], []
    for sample, own, seen in zip(models, of, labelled, strict=True):
        shared.append(sample.only(common[own]))
        ignoring.append(_filled(sample.labelled(), asked, most - seen))
    total = most.sum()
    missing = tuple(float(1 - seen.sum() / total) if total else math.nan for seen in labelled)
    return CommonObservations(tuple(shared), tuple(ignoring), missing)


def _numbered(models: Sequence[SpotObservations]) -> tuple[list[Int64], Int64]:
    """Return the number of each answer's observation, alike in all models, and one answer of each observation."""
    views = max((len(sample.views) for sample in models), default=1)
    key = np.concatenate([sample.spot.astype(np.int64) * views + sample.view for sample in models])
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    return np.split(of, np.cumsum([len(sample) for sample in models])[:-1]), first


def _filled(sample: SpotObservations, asked: SpotObservations, ignored: Float64) -> SpotObservations:
    """Return a model's answers, with a further class for the answers that it `ignored` (n,) of each observation."""
    further = asked.only(np.repeat(np.arange(len(asked)), ignored.astype(np.int64)))
    none = np.full(len(further), sample.K, np.uint16)
    further = dataclasses.replace(further, label=none, neighbour=none, beyond=none)
    return dataclasses.replace(SpotObservations.stacked([sample, further]), K=sample.K + 1, classes=())


def psa_bounds(log: Events) -> tuple[float, float]:
    """Return the least and the largest mean PSA, whatever the observations of the last class would have been.

    Manski (1990, American Economic Review 80): pairs of observations of which one is missing agree never, or always.
    """
    low, known = (_pairs(log, each) for each in (log.evidence[:, :-1], 1 - log.evidence[:, -1:]))
    missing = 1 - known
    high = low + np.where(missing > ONE_HOT, missing, 0.0)  # rounding leaves nothing out
    return (float(low.mean()), float(high.mean())) if len(low) else (math.nan, math.nan)


def pairs_labelled(log: Events) -> float:
    """Return the share of the pairs of two views of a spot of which neither is the last class, spots by their views."""
    op = np.bincount(log.voxel)
    return (
        float(np.average(_pairs(log, 1 - log.evidence[:, -1:]), weights=op[op >= 2])) if (op >= 2).any() else math.nan
    )


def _pairs(log: Events, shares: Float64) -> Float64:
    """Return the mean of s . s' (v,) over the pairs of observations of each spot with two or more, shares (m, C)."""
    starts = log.starts
    T = np.diff(np.append(starts, len(log))).astype(np.float64)
    again = T >= 2
    total = np.add.reduceat(shares, starts, axis=0)[again] if len(T) else np.zeros((0, shares.shape[1]))
    own = np.add.reduceat((shares**2).sum(axis=1), starts)[again] if len(T) else np.zeros(0)
    products: Float64 = ((total**2).sum(axis=1) - own) / (T * (T - 1))[again]
    return products


@dataclass(frozen=True, eq=False)
class SharedObservations:
    """Sums of each model's common observations, their logs, and the comparison itself."""

    sums: Mapping[str, ClusterSums]
    logs: Mapping[str, Events]
    compared: ComparedObservations


def compared_observations(samples: Mapping[str, SpotObservations]) -> SharedObservations:
    """Return the observations that all models made, and how their order depends on those that some left out."""
    names = list(samples)
    both = common_observations([samples[name] for name in names])
    shared, ignoring = (dict(zip(names, each, strict=True)) for each in (both.shared, both.ignoring))
    logs = {name: own.observations() for name, own in shared.items()}
    sums: dict[str, ClusterSums] = {}
    edge: float | None = None
    for name, own in shared.items():
        sums[name] = sums_of_spots(own, edge)
        near = sums[name].near
        edge = None if near is None else near.edge
    ignored = []
    for name, missing in zip(names, both.missing, strict=True):
        log, whole = ignoring[name].observations(), sums_of_spots(samples[name])
        chance = math.nan if whole.near is None else chance_of(whole.near)
        pairs = LabelledPairs(pairs_labelled(log), chance)
        ignored.append(Ignored(name, missing, *psa_bounds(log), pairs.of_all(min(value_of(whole, ALPHA.key), 1.0))))
    first = next(iter(logs.values()))
    bounds = {row.model: (row.psa_low, row.psa_high) for row in ignored}
    by_psa = sorted(names, key=lambda name: -mean(psa(logs[name].table())))
    compared = ComparedObservations(
        spots=len(first.ix),
        observations=len(first),
        ignored=tuple(ignored),
        order=tuple(sorted(names, key=lambda name: -value_of(sums[name], ALPHA.key))),
        order_ignored=tuple(row.model for row in sorted(ignored, key=lambda row: -row.alpha)),
        bounded=all(bounds[better][0] >= bounds[worse][1] for better, worse in itertools.pairwise(by_psa)),
    )
    return SharedObservations(sums, logs, compared)
