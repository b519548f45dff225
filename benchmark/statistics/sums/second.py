"""The second look at a part of a map, once the first one at all parts has told what the whole map is like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.metrics.matching import shared_rows
from semstab.model.statistics import DriftTests
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ratio_of
from semstab.statistics.correctness import Truth, quadrant_sums, wrong_of_steady
from semstab.statistics.judging.ceiling import loss_sums
from semstab.statistics.judging.flipping import FlippingSums
from semstab.statistics.map_sums import Maps
from semstab.statistics.order.drift import TESTABLE
from semstab.statistics.order.p_values import benjamini_hochberg
from semstab.statistics.ranks import distinct_rows
from semstab.statistics.sampling import InfluenceSums, PlaceSums
from semstab.statistics.steady import Votes, steady
from semstab.statistics.sums.by_log import FALSE_DISCOVERIES
from semstab.statistics.sums.first import FirstSums

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SecondSums:
    """Sums over a map; quadrants with ground truth, losses with a ceiling."""

    flipping: FlippingSums
    quadrants: PlaceSums | None
    losses: Float64 | None

    @classmethod
    def merged(cls, parts: Sequence[SecondSums]) -> SecondSums:
        """Those of a map from its parts."""
        quadrants = [part.quadrants for part in parts if part.quadrants is not None]
        losses = [part.losses for part in parts if part.losses is not None]
        return cls(
            FlippingSums.merged([part.flipping for part in parts]),
            PlaceSums.added(quadrants) if quadrants else None,
            np.concatenate(losses) if losses else None,
        )


class Whole:
    """What the first look at all parts of a map tells of it: how likely places are stable, which orders are rare."""

    def __init__(self, first: FirstSums, seed: int = 0) -> None:
        self.first, self.seed = first, seed
        self.shares = first.votes.shares()
        self.loss_edge = None if first.limited is None else first.limited.edge()
        if first.log is not None:
            self.order, self._drift_p = first.log.tested(seed)
            self._drift_q = benjamini_hochberg(np.where(first.log.table.op >= TESTABLE, self._drift_p, np.nan))

    @property
    def influence(self) -> InfluenceSums:
        """The sums by frame and cube, with what is stable of them."""
        found, truth = self.first.own.influence, self.first.truth
        return found if truth is None else truth.stable.added_to(found, self._likely)

    def _likely(self, seen: Int64, most: Int64) -> Float64:
        pairs, of = distinct_rows(np.stack([seen, most], axis=1))  # many places have the same
        return Votes(pairs[:, 0], pairs[:, 1], np.ones(len(pairs), np.int64)).stable(self.shares)[of]

    def drift_tests(self) -> DriftTests:
        """Of a map with its log."""
        log = self.first.log
        assert log is not None
        one_way, by_chance, all_of_it = log.trend
        with np.errstate(invalid="ignore", divide="ignore"):
            trend, null = (float(part / all_of_it) if all_of_it else np.nan for part in (one_way, by_chance))
        return DriftTests(
            sbd_p=self.order.p_value,
            trend=trend,
            trend_null=null,
            trend_excess=log.places.estimate("trend_excess", ratio_of, (-1.0, 1.0)),
            trend_p=self.order.trend_p,
            stretches=self.order.stretches,
            voxels=self.order.voxels,
            tested_voxels=int(log.p.count.sum()),
            unusual_sbd_voxels=int(np.count_nonzero(self._drift_q <= FALSE_DISCOVERIES)),
            trending_voxels=log.p.found(FALSE_DISCOVERIES),
        )

    def maps(self, table: VoxelTable, maps: Maps) -> Maps:
        """Of a part, from what its first look says of each voxel (n,), what hangs on all: which orders are rare."""
        log = self.first.log
        if log is None:
            return {}
        rows, drawn = shared_rows(table, log.table)
        p, q = maps["drift_p"].copy(), np.full(len(table), np.nan)
        p[rows], q[rows] = self._drift_p[drawn], self._drift_q[drawn]
        tested = np.where(table.op >= TESTABLE, maps["trend_p"], np.nan)
        return {"drift_p": p, "drift_q": q, "trend_q": log.p.adjusted(tested)}


def second_look(
    table: VoxelTable, whole: Whole, truth: Truth | None = None, limit: VoxelTable | None = None
) -> tuple[SecondSums, Maps]:
    """The sums of a part, a table, and which of its voxels are stable, and wrong."""
    table = table.measured()
    stable, edge = steady(table, whole.shares), whole.first.own.places.edge
    maps: Maps = {"stable": stable}
    if truth is not None:
        maps["stable_wrong"] = wrong_of_steady(table, truth, stable)
    found = SecondSums(
        FlippingSums.of(table, stable, edge),
        None if truth is None else quadrant_sums(table, truth, stable, edge),
        None if limit is None or whole.loss_edge is None else loss_sums(table, limit, whole.loss_edge),
    )
    return found, maps
