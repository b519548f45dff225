"""Values of backbones on the places that all saw twice, and their differences, with intervals and what these answer.

What the sums by frame and cube of space know is said for the next flight; the rest, as SBD, for this map.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.metrics.agreement import observations, rows_of
from semstab.model.contrast import BackboneComparison, PairedDifference
from semstab.model.events import Events
from semstab.model.measures import ENTROPY, Quantity
from semstab.model.statistics import UNKNOWN, Estimate, Interval
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ALPHA, ALPHA_BETWEEN, PSA
from semstab.statistics.blocks import Statistic
from semstab.statistics.correctness import ACCURACY, join_truth
from semstab.statistics.sampling import InfluenceSums, Places, difference, estimate, influence_sums, question_of

Rows = Int64

SUMMED = (ALPHA_BETWEEN, PSA, ALPHA, ENTROPY, ACCURACY)
"""What the sums tell; of VSS they have that of places seen three times, of SBD nothing."""


@dataclass(frozen=True, eq=False)
class OnCommonPlaces:
    """Backbones on the same places (n, 3): the sums of each map there, and the cubes of space that hold them.

    known  what the sums of these maps tell
    """

    sums: Mapping[str, InfluenceSums]
    places: Places
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
    ) -> OnCommonPlaces | None:
        """Of these rows of each table; None where there are none.

        Where looks were `reduced`, alpha between frames is not that of the sums.
        """
        if not len(rows[0]):
            return None
        first = next(iter(tables.values()))
        places = Places.of(first.rows(rows[0]), where=np.ones(len(rows[0]), np.bool_))
        sums = {}
        for (name, table), own in zip(tables.items(), rows, strict=True):
            where = np.zeros(len(table), dtype=np.bool_)
            where[own] = True
            log = None if name not in logs else observations(logs[name], np.flatnonzero(where[logs[name].voxel]))
            some = rows_of(table, where)
            label = None if truth is None else join_truth(some, truth).label
            sums[name] = influence_sums(some, log, label, edge=places.edge)
        unknown = ({ACCURACY} if truth is None else set()) | ({ALPHA_BETWEEN} if reduced else set())
        return cls(sums, places, frozenset(SUMMED) - unknown)

    def value(self, measure: Quantity, name: str, columns: Float64, statistic: Statistic) -> Estimate:
        """Of one backbone; columns (n, C) are those that the statistic is of."""
        if measure in self.known:
            sums = self.sums[name]
            return _ends(estimate(sums, measure.key, question=question_of(sums)))
        bounds = (-1.0, 1.0) if measure in (ALPHA, ALPHA_BETWEEN) else (0.0, 1.0)
        return _ends(self.places.estimate(columns, statistic, bounds, "agreement" if bounds[0] else None))

    def difference(self, measure: Quantity, a: str, b: str, columns: Mapping[str, Float64], of: Statistic) -> Interval:
        """Of backbone a less backbone b."""
        if measure in self.known:
            return difference(self.sums[a], self.sums[b], measure.key, question=question_of(self.sums[a]))
        C = columns[a].shape[1]
        both = np.concatenate([columns[a], columns[b]], axis=1)
        return self.places.estimate(both, lambda sums: of(sums[..., :C]) - of(sums[..., C:]), (-2.0, 2.0), "plain")

    def tested(self, primary: Quantity, a: str, b: str) -> Interval:
        """The difference of the primary measure, for the next flight."""
        return difference(self.sums[a], self.sums[b], primary.key)


def differences(
    primary: Quantity,
    columns: Mapping[Quantity, Mapping[str, Float64]],
    statistics: Mapping[Quantity, Statistic],
    common: OnCommonPlaces | None,
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
    return PairedDifference(measure.key, a, b, _ends(found), p, float("nan"), found.question, found.undecided)


def _ends(found: Interval) -> Estimate:
    return Estimate(found.value, found.low, found.high)


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
