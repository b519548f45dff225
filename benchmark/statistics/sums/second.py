"""The second look at a part of a map, once the first one at all parts has told what the whole map is like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.metrics.agreement import shared_rows
from semstab.model.statistics import DriftTests, Interval
from semstab.model.voxels import VoxelTable
from semstab.statistics.correctness import quadrant_sums, wrong_of_steady
from semstab.statistics.flipping import FlippingSums
from semstab.statistics.kinds import Kinds
from semstab.statistics.map_sums import Maps
from semstab.statistics.order.drift import TESTABLE
from semstab.statistics.order.p_values import PValues, benjamini_hochberg
from semstab.statistics.ranks import distinct_rows
from semstab.statistics.sampling import InfluenceSums, Places, PlaceSums
from semstab.statistics.steady import Votes, steady
from semstab.statistics.sums.by_log import FALSE_DISCOVERIES
from semstab.statistics.sums.first import FirstSums
from semstab.statistics.verdict import loss_sums


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


@dataclass(frozen=True, eq=False)
class RareOrders:
    """Whose order of observations is rare, of all voxels of a map.

    table  the voxels whose SBD was tested, p (n,) how likely it is by chance, q (n,) the same as false discoveries
    trend  p-values of the trends
    """

    table: VoxelTable
    p: Float64
    q: Float64
    trend: PValues

    def maps(self, table: VoxelTable, maps: Maps) -> Maps:
        """Of a part, from what its first look says of each voxel (n,)."""
        rows, drawn = shared_rows(table, self.table)
        p, q = maps["drift_p"].copy(), np.full(len(table), np.nan)
        p[rows], q[rows] = self.p[drawn], self.q[drawn]
        tested = np.where(table.op >= TESTABLE, maps["trend_p"], np.nan)
        return {"drift_p": p, "drift_q": q, "trend_q": self.trend.adjusted(tested)}


@dataclass(frozen=True, eq=False)
class Overall:
    """What the second look at a part takes from all of them: little, so that it can be sent to who takes it.

    shares     how often the dominant class is seen, over all places: see `steady`
    edge       of the cubes of its places, metres
    loss_edge  of those of a ceiling, voxels; None without one
    true       whether ground truth is known
    orders     with a log
    """

    shares: Float64
    edge: float
    loss_edge: int | None
    true: bool
    orders: RareOrders | None

    def maps(self, table: VoxelTable, maps: Maps) -> Maps:
        """Of a part, from what its first look says of each voxel (n,), what hangs on all: which orders are rare."""
        return {} if self.orders is None else self.orders.maps(table, maps)


class Whole:
    """What the first look at all parts of a map tells of it: how likely places are stable, which orders are rare."""

    def __init__(self, first: FirstSums, seed: int = 0) -> None:
        self.first, self.seed = first, seed
        self.loss_edge = None if first.limited is None else first.limited.edge()
        orders = None
        if first.log is not None:
            self.order, p = first.log.tested(seed)
            q = benjamini_hochberg(np.where(first.log.table.op >= TESTABLE, p, np.nan))
            orders = RareOrders(first.log.table, p, q, first.log.p)
        self.overall = Overall(
            first.votes.shares(), first.own.places.edge, self.loss_edge, first.truth is not None, orders
        )

    @property
    def influence(self) -> InfluenceSums:
        """The sums by frame and cube, with what is stable of them."""
        found, truth = self.first.own.influence, self.first.truth
        return found if truth is None else truth.stable.added_to(found, self._likely)

    def _likely(self, seen: Int64, most: Int64) -> Float64:
        pairs, of = distinct_rows(np.stack([seen, most], axis=1))  # many places have the same
        return Votes(pairs[:, 0], pairs[:, 1], np.ones(len(pairs), np.int64)).stable(self.overall.shares)[of]

    def drift_tests(self, trend_excess: Interval) -> DriftTests:
        """Of a map with its log."""
        log, orders = self.first.log, self.overall.orders
        assert log is not None
        assert orders is not None
        one_way, by_chance, all_of_it = log.trend
        with np.errstate(invalid="ignore", divide="ignore"):
            trend, null = (float(part / all_of_it) if all_of_it else np.nan for part in (one_way, by_chance))
        return DriftTests(
            sbd_p=self.order.p_value,
            trend=trend,
            trend_null=null,
            trend_excess=trend_excess,
            trend_p=self.order.trend_p,
            stretches=self.order.stretches,
            voxels=self.order.voxels,
            tested_voxels=int(log.p.count.sum()),
            unusual_sbd_voxels=int(np.count_nonzero(orders.q <= FALSE_DISCOVERIES)),
            trending_voxels=log.p.found(FALSE_DISCOVERIES),
        )


def second_look(kinds: Kinds, overall: Overall, limit: VoxelTable | None = None) -> tuple[SecondSums, Maps]:
    """The sums of a part, and which voxels are stable, and wrong, of one of each of its kinds."""
    kinds = kinds.measured()
    table, truth = kinds.one.table, kinds.one.truth
    stable, edge = steady(table, overall.shares), overall.edge
    places = kinds.one.places if kinds.one.places.edge == edge else Places.of(table, edge)
    maps: Maps = {"stable": stable}
    if truth is not None:
        maps["stable_wrong"] = wrong_of_steady(table, truth, stable)
    found = SecondSums(
        FlippingSums.of(table, stable, places),
        None if truth is None else quadrant_sums(table, truth, stable, edge),
        None if limit is None or overall.loss_edge is None else loss_sums(kinds.every.table, limit, overall.loss_edge),
    )
    return found, maps
