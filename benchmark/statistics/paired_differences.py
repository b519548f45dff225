"""Values of backbones on the places that all saw twice, and their differences, with intervals and what these answer.

What the sums by frame and cube of space know is said for this scene flown again; the rest, as SBD, for these frames.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.errors import ConfigError
from semstab.metrics.agreement import observations, require_same_grid, rows_of
from semstab.model.contrast import BackboneComparison, PairedDifference
from semstab.model.events import Events
from semstab.model.information import by_group
from semstab.model.measures import ENTROPY, Quantity, measures
from semstab.model.statistics import UNDEFINED, UNKNOWN, Estimate, Interval
from semstab.model.voxels import VoxelTable
from semstab.statistics.accumulate import Cubes, CubeSums, cluster_sums_of
from semstab.statistics.agreement import ALPHA, ALPHA_BETWEEN, PSA, psa, ratio_of
from semstab.statistics.cluster_sums import ClusterSums, Statistic
from semstab.statistics.correctness import ACCURACY, join_truth
from semstab.statistics.intervals import difference, estimate, scope_of

Rows = Int64

SUMMED = (ALPHA_BETWEEN, PSA, ALPHA, ENTROPY, ACCURACY)
"""What the sums tell; of VSS they have that of places seen three times, of SBD nothing."""


@dataclass(frozen=True, eq=False)
class OnCommonLocations:
    """Backbones on the same places (n, 3): the sums of each map there, and the cubes of space that hold them.

    known  what the sums of these maps tell
    """

    sums: Mapping[str, ClusterSums]
    cubes: Cubes
    known: frozenset[Quantity]

    @classmethod
    def of(
        cls,
        tables: Mapping[str, VoxelTable],
        rows: Sequence[Rows],
        truth: VoxelTable | None,
        logs: Mapping[str, Events],
        *,
        reduced: bool,
    ) -> OnCommonLocations | None:
        """Of these rows of each table; None where there are none.

        Where observations were `reduced` to a class, alpha between frames is not that of the sums.
        """
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
        unknown = ({ACCURACY} if truth is None else set()) | ({ALPHA_BETWEEN} if reduced else set())
        return cls(sums, cubes, frozenset(SUMMED) - unknown)

    def value(self, measure: Quantity, name: str, columns: Float64, statistic: Statistic) -> Estimate:
        """Of one backbone; columns (n, C) are those that the statistic is of."""
        if measure in self.known:
            sums = self.sums[name]
            return estimate(sums, measure.key, scope=scope_of(sums)).ends
        bounds = (-1.0, 1.0) if measure in (ALPHA, ALPHA_BETWEEN) else (0.0, 1.0)
        return self.cubes.estimate(columns, statistic, bounds, "agreement" if bounds[0] else None).ends

    def difference(self, measure: Quantity, a: str, b: str, columns: Mapping[str, Float64], of: Statistic) -> Interval:
        """Of backbone a less backbone b."""
        if measure in self.known:
            return difference(self.sums[a], self.sums[b], measure.key, scope=scope_of(self.sums[a]))
        C = columns[a].shape[1]
        both = np.concatenate([columns[a], columns[b]], axis=1)
        return self.cubes.estimate(both, lambda sums: of(sums[..., :C]) - of(sums[..., C:]), (-2.0, 2.0), "plain")

    def tested(self, primary: Quantity, a: str, b: str) -> Interval:
        """The difference of the primary measure, for this scene flown again."""
        return difference(self.sums[a], self.sums[b], primary.key)


def differences(
    primary: Quantity,
    columns: Mapping[Quantity, Mapping[str, Float64]],
    statistics: Mapping[Quantity, Statistic],
    common: OnCommonLocations | None,
) -> tuple[PairedDifference, ...]:
    """Of each measure and pair of backbones; only the primary measure is tested."""
    found = []
    for measure, own in columns.items():
        for a, b in itertools.combinations(own, 2):
            if common is None:
                interval = UNKNOWN
            elif measure == primary:
                interval = common.tested(primary, a, b)
            else:
                interval = common.difference(measure, a, b, own, statistics[measure])
            found.append(_row(measure, a, b, interval, tested=measure == primary))
    return _claimed(found)


def _row(measure: Quantity, a: str, b: str, found: Interval, *, tested: bool) -> PairedDifference:
    p = found.p_value if tested else float("nan")
    return PairedDifference(measure.key, a, b, found.ends, p, float("nan"), found.scope, found.undecided)


# --- What is claimed --------------------------------------------------------------------------------------------------


def claimed_together(comparisons: Sequence[BackboneComparison]) -> tuple[BackboneComparison, ...]:
    """Scenes of one study: p-values of all that may be claimed in any of them, corrected together."""
    rows = _claimed([row for found in comparisons for row in found.paired.differences])
    ends = np.cumsum([0, *(len(found.paired.differences) for found in comparisons)])
    return tuple(
        dataclasses.replace(found, paired=dataclasses.replace(found.paired, differences=rows[low:high]))
        for found, (low, high) in zip(comparisons, itertools.pairwise(ends.tolist()), strict=True)
    )


def _claimed(rows: Sequence[PairedDifference]) -> tuple[PairedDifference, ...]:
    """With p-values corrected for the number of those that may be claimed; where nothing may there is none."""
    corrected = holm([float("nan") if row.undecided else row.p_value for row in rows])
    return tuple(dataclasses.replace(row, p_holm=p) for row, p in zip(rows, corrected, strict=True))


def holm(p: Sequence[float]) -> list[float]:
    """P-values corrected for their number: rejecting those <= q keeps the chance of any false one at q (Holm 1979).

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
"""A stratum overlaps hardly where some map has fewer voxels in it, or a smaller part of what another map has."""


def voxelwise() -> dict[Quantity, Callable[[VoxelTable], Float64]]:
    """What is compared and has one value a voxel (n,), NaN where undefined."""
    return {PSA: psa, **{measure: measure.of for measure in measures()}}


def stratum_counts(tables: Tables, edges: Sequence[int] = EDGES) -> Int64:
    """(M, S) voxels of each map, or of its part in one region, in each stratum of OP."""
    return np.stack([np.bincount(_stratum(t, edges), minlength=len(edges) + 2)[1:] for t in tables.values()])


def common_weights(counts: Int64) -> Float64:
    """The common distribution of OP: shares (S,) of the strata among the voxels with OP >= 2 of all maps together.

    A stratum that is empty in some map has weight 0: there is nothing to compare it with.
    """
    pooled = np.where((counts > 0).all(axis=0), counts.sum(axis=0), 0)
    total = pooled.sum()
    return pooled / total if total else np.zeros(counts.shape[1])


def thin_share(counts: Int64, weights: Float64) -> float:
    """The part of the weights in strata of which some map has few voxels, or a small part of what another has."""
    few = (counts < LEAST_VOXELS).any(axis=0)
    few |= counts.min(axis=0) < LEAST_OVERLAP * counts.max(axis=0)
    return float(weights[few].sum())


def standardised(
    tables: Tables, measure: Quantity, *, edges: Sequence[int] = EDGES, weights: Float64 | None = None
) -> dict[str, Estimate]:
    """A measure's mean in each map, as it would be if all had the common distribution of OP (direct standardisation).

    sum_s w_s m_s with m_s the mean in stratum s; each map counts with all its voxels with OP >= 2.
    """
    require_same_grid(*tables.values())
    weights = common_weights(stratum_counts(tables, edges)) if weights is None else weights
    return {name: standardised_of(stratum_sums(table, edges), weights)[measure.key] for name, table in tables.items()}


def stratum_sums(table: VoxelTable, edges: Sequence[int] = EDGES) -> CubeSums:
    """Of each quantity the sums over the voxels of each cube and stratum, then how many (G, 2 S)."""
    stratum, S, cubes = _stratum(table, edges), len(edges) + 1, Cubes.of(table)
    group = np.where(cubes.at >= 0, cubes.at * S + stratum - 1, -1)
    quantities = voxelwise()
    both = by_group(group, [formula(table) for formula in quantities.values()], cubes.count * S)
    sums, counts = (own.T.reshape(len(quantities), cubes.count, S) for own in both)
    named = zip(quantities, sums, counts, strict=True)
    return CubeSums(cubes.cell, cubes.edge, {quantity.key: np.hstack(own) for quantity, *own in named})


def standardised_of(sums: CubeSums, weights: Float64) -> dict[str, Estimate]:
    """Each quantity's mean at these weights, by key, from `stratum_sums`.

    Its interval is that of a ratio of sums with the same influences: a voxel's value counts by how far it is from the
    mean of its stratum.
    """
    S, found = len(weights), {}
    for key, own in sums.sums.items():
        total, count = own[:, :S].sum(axis=0), own[:, S:].sum(axis=0)
        used = (weights > 0) & (count > 0)
        if not used.any():
            found[key] = UNDEFINED
            continue
        each = np.where(used, weights, 0.0) / weights[used].sum() / np.where(used, count, 1)
        mean_of = total / np.where(used, count, 1)
        size = own[:, S:] @ each
        value = float(each @ total)
        above = own[:, :S] @ each - own[:, S:] @ (each * mean_of)
        columns = {key: np.stack([above + value * size, size], axis=1)}
        found[key] = CubeSums(sums.cell, sums.edge, columns).estimate(key, ratio_of).ends
    return found


def _stratum(table: VoxelTable, edges: Sequence[int]) -> Int64:
    """(n,) 0 for OP = 1, else 1 to len(edges) + 1."""
    if list(edges) != sorted(set(edges)) or not edges or edges[0] < 2:
        raise ConfigError(f"edges = {list(edges)}: upper bounds of OP must ascend from 2 or more")
    return np.where(table.op >= 2, np.searchsorted(edges, table.op) + 1, 0)
