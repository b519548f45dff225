"""Does a scene drift? Stretches of time are put into other orders, the same for all voxels.

Frames that follow each other err alike, for reasons that are no drift: so they stay together, in stretches as long as
errors are seen to last, and what is tested is whether the stretches could have come in any order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.model.events import Events
from semstab.model.evidence import row_chunks
from semstab.model.measures import mean, sbd
from semstab.model.voxels import VoxelTable
from semstab.statistics.drift import VoxelDrift, streams, trend_columns, varying
from semstab.statistics.variance import longest_effect

CERTAIN, MOST_SPANS = 0.95, 128
"""How certain it must be that errors last no longer, and by how many spans of time that is looked at."""

SAMPLE, ORDERS = 30_000, 499
"""About so many observations are put into so many orders."""

MOST_STRETCHES, LEAST_STRETCHES, LEAST_SPAN = 12, 6, 4
"""Stretches of time, at most and at least, and in how many of them a voxel must be seen to be put to the test."""


@dataclass(frozen=True)
class SceneDrift:
    """The order of observations over all voxels, tested by putting stretches of time into random orders.

    sbd, null    means over the voxels with OP >= 2, bits
    p_value      of a mean SBD this far from what random orders of the stretches give, either way; NaN where errors last
                 so long that there are fewer than LEAST_STRETCHES, or no place was seen in LEAST_SPAN of them
    trend        share of all disagreement, over voxels with OP >= 3, that goes one way in time; null: in random order
    trend_p      of a trend this large
    stretches    of time that were put in other orders
    voxels       whose observations tell, a random sample
    """

    sbd: float
    null: float
    p_value: float
    trend: float
    trend_null: float
    trend_p: float
    stretches: int
    voxels: int


@dataclass(frozen=True)
class OrderTest:
    """What of `SceneDrift` follows from a sample of the voxels."""

    p_value: float
    trend_p: float
    stretches: int
    voxels: int


def scene_drift(
    table: VoxelTable, events: Events, drift: VoxelDrift, *, seed: int = 0, frame_orders: int = ORDERS
) -> SceneDrift:
    """Test whether stretches of time are exchangeable, in `frame_orders` random orders.

    What neighbouring voxels have in common in a frame stays in common, and so does what frames of one stretch have.
    `drift` is what `voxel_drift` says of the same map.
    """
    test = order_test(table, events, seed=seed, frame_orders=frame_orders)
    one_way, by_chance, all_of_it = trend_columns(table, drift)[1].sum(axis=0)
    return SceneDrift(
        sbd=mean(sbd(table)),
        null=mean(drift.null),
        p_value=test.p_value,
        trend=one_way / all_of_it if all_of_it else math.nan,
        trend_null=by_chance / all_of_it if all_of_it else math.nan,
        trend_p=test.trend_p,
        stretches=test.stretches,
        voxels=test.voxels,
    )


def order_test(table: VoxelTable, events: Events, *, seed: int = 0, frame_orders: int = ORDERS) -> OrderTest:
    """Put the stretches of time of a sample of a map's observations into random orders."""
    of = _sampled(table, events, seed)
    tested, drifted, trended = of.orders(seed, frame_orders)
    known = len(tested) > 0
    total_drift, total_trend = _total(sbd(of.table)[tested]), _total(_trends(of.table, of.events)[tested])
    p_value = min(1.0, 2 * min(_tail(-drifted, -total_drift), _tail(drifted, total_drift)))
    return OrderTest(
        p_value if known else math.nan,
        _tail(trended, total_trend) if known and total_trend > 0 else math.nan,
        of.stretches,
        len(tested),
    )


def _trends(table: VoxelTable, events: Events) -> Float64:
    """(n,) how much of a voxel's disagreement goes one way in time; NaN where fewer than three frames saw it."""
    T = table.op.astype(np.float64)
    age = np.arange(len(events)) - events.starts[events.voxel] - 0.5 * (T[events.voxel] - 1)
    evidence = events.evidence
    of = np.repeat(np.arange(len(events)), np.diff(evidence.starts))
    key, entry = np.unique(events.voxel[of] * table.K + evidence.label, return_inverse=True)
    moment = np.bincount(entry, weights=age[of] * evidence.weight, minlength=len(key))
    squares = np.bincount(key // table.K, weights=moment**2, minlength=len(table))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(T > 2, squares / (T * (T * T - 1) / 12), np.nan)


@dataclass(frozen=True, eq=False)
class _Sampled:
    """Voxels drawn at random from those whose observations differ.

    table, events  of these voxels
    stretch        (m,) of each of their observations; they are numbered in time
    stretches      how many there are
    """

    table: VoxelTable
    events: Events
    stretch: Int64
    stretches: int

    def orders(self, seed: int, count: int) -> tuple[Int64, Float64, Float64]:
        """Voxels that many stretches see, and the sums over them of SBD and of trends (R,), in random orders."""
        from semstab.core import compiled
        from semstab.statistics.loops import orders as stretches

        first, T = self.events.starts, self.table.op.astype(np.int64)
        changes = np.diff(self.stretch, prepend=-1) != 0
        changes[first] = True
        span = np.add.reduceat(changes, first) if len(T) else T
        some = (span >= LEAST_SPAN) & (self.stretches >= LEAST_STRETCHES)
        stretch = self.stretch[np.repeat(some, T)]
        first, T = first[some], T[some]
        at = np.concatenate([[0], np.cumsum(T)])
        as_seen = np.tile(np.arange(self.stretches), (count, 1))
        orders = np.ascontiguousarray(np.random.default_rng(seed).permuted(as_seen, axis=1).T)
        voxels = np.arange(compiled.CHUNKS + 1) * len(T) // compiled.CHUNKS
        edges, sums = np.stack([voxels, at[voxels]], axis=1), np.zeros((compiled.CHUNKS, count, 2))
        log = self.events.evidence.entries
        entries = int((log[0][first + T] - log[0][first]).max(initial=0))
        compiled.in_chunks(
            stretches.permute_stretches, edges, first, T, log, self.table.K, entries, stretch, orders, sums
        )
        drifted, trended = sums.sum(axis=0).T
        return np.flatnonzero(some), drifted, trended


def _sampled(table: VoxelTable, events: Events, seed: int) -> _Sampled:
    """So many voxels that they have about SAMPLE observations, with the stretches that frames are cut into."""
    rows = np.flatnonzero(varying(table))
    order = np.argsort(streams(table, rows, seed))
    enough = np.searchsorted(np.cumsum(table.op[rows][order]), SAMPLE) + 1
    chosen = np.sort(rows[order[:enough]])
    table, events = table.rows(chosen), events.rows(chosen)
    frames, rank = np.unique(events.frame, return_inverse=True)
    lasting = _lasting(_departures(table, events), rank, len(frames))
    stretches = min(MOST_STRETCHES, int(len(frames) / (1 + 2 * lasting)))
    return _Sampled(table, events, rank * stretches // max(len(frames), 1), stretches)


def _departures(table: VoxelTable, events: Events) -> Float64:
    """(m,) how much less an observation agrees with its voxel's mean than the voxel's observations do on average."""
    agrees, of = np.zeros(len(events)), events.voxel
    for some in row_chunks(len(events), table.K):
        at = of[some]
        agrees[some] = (events.evidence[some] * table.evidence[at]).sum(axis=1) / table.op[at]
    mean_of = np.bincount(of, weights=agrees) / np.maximum(np.bincount(of), 1)
    departures: Float64 = mean_of[of] - agrees
    return departures


def _lasting(departures: Float64, frame: Int64, frames: int) -> float:
    """For how many frames what departs in one may last in the next ones: the longest reach not excluded at 95 %."""
    if frames < 2:
        return 0.0
    size = np.bincount(frame, minlength=frames).astype(np.float64)
    series: Float64 = np.bincount(frame, weights=departures, minlength=frames).astype(np.float64)
    series = series - size / size.sum() * series.sum()
    span = -(-frames // MOST_SPANS)  # frames that are looked at as one, where there are many
    starts = np.arange(0, frames, span)
    sums: Float64 = np.add.reduceat(series, starts)
    sizes: Float64 = np.add.reduceat(size, starts)
    return span * longest_effect(sums / sizes, sizes, np.arange(len(starts), dtype=np.float64), CERTAIN)


def _total(values: Float64) -> float:
    """Their sum, where defined."""
    return float(np.nansum(values))


def _tail(values: Float64, seen: float) -> float:
    """P-value of a value as high as the one seen, of which `values` are random draws."""
    slack = 1e-9 * (1 + abs(seen))
    return float((np.count_nonzero(values >= seen - slack) + 1) / (len(values) + 1))
