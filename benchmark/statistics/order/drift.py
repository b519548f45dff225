"""Is there drift in the order of a place's observations, or only their disagreement in whatever order it came?

SBD is never 0 where observations disagree, and falls with OP whatever the model does: later observations move a mean
less. So it is compared with what a random order of the very same observations gives.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from semstab.core.types import Float64, Int32, Int64, Mask, UInt16, UInt64
from semstab.errors import ConfigError
from semstab.model.events import Events
from semstab.model.measures import Quantity, sbd
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ONE_HOT
from semstab.statistics.ranks import ranked

FLIP_RATE = Quantity(key="flip_rate", title="Flip rate", better="lower", needs="events")

NULL_DRAWS = 8
"""Random orders of a voxel's observations whose mean drift is its null, where that is not known exactly: turns of one,
which differ in what comes first, as much as it can, and so tell as much as some 13 others do."""

MOST_DRAWS, ENOUGH_HITS = 1999, 10
"""Random orders of a voxel that is tested: at most, and how many in a tail settle its p-value."""

DRIFT_SAMPLE = 5_000
"""At most so many voxels are tested for an unusual SBD."""

TESTABLE = 6
"""Lowest OP of the voxels that are tested one by one: of fewer one-hot labels no order is rare enough."""


@dataclass(frozen=True, eq=False)
class VoxelDrift:
    """The order of observations of each voxel (n,); NaN where undefined.

    null         SBD expected when the same observations come in random order, bits; OP >= 2
    p_value      of an SBD this far from what random orders give, either way; where observations disagree, above
                 OP 5 of a random sample of these voxels
    trend        share of the disagreement that goes one way in time: R^2 of the evidence on the number of the
                 observation; OP >= 3, where observations disagree
    trend_p      of a trend this large in random order
    table        of the voxels
    """

    null: Float64
    p_value: Float64
    trend: Float64
    trend_p: Float64
    table: VoxelTable

    @property
    def excess(self) -> Float64:
        """SBD - null, bits: below 0 where the belief moves late or only once, above 0 where it moves early."""
        return sbd(self.table) - self.null

    @property
    def trend_null(self) -> Float64:
        """The trend's expectation in random order, 1 / (OP - 1)."""
        return np.where(np.isnan(self.trend), np.nan, 1 / np.maximum(self.table.op - 1, 1))


@dataclass(frozen=True, eq=False)
class Flips:
    """Changes of the predicted class between successive observations of a voxel (n,); NaN where undefined.

    rate   share of the steps from one observation to the next at which the class changes; OP >= 2
    null   its expectation in random order: the share of all pairs of observations that differ
    since  frames from the last change to the last observation; NaN where the class never changed
    """

    rate: Float64
    null: Float64
    since: Float64


def expected_sbd(table: VoxelTable) -> Float64:
    """SBD (n,) expected in random order, bits, exactly, from the counts of one-hot observations alone.

    NaN where OP < 2, where a frame's pixels in the voxel disagree, or where OP exceeds 256.
    """
    from semstab.statistics.loops import chunks, one_hot

    T, longest = table.op, one_hot.LONGEST_TABLE
    known = (T >= 2) & (longest >= T) & (np.abs(table.self_sum - T) <= ONE_HOT * T)
    count = np.zeros((longest + 1, longest + 1))
    one_hot.seen_counts(table.evidence.entries, T, known, count)
    pairs, part = np.nonzero(count), count[count > 0]
    drifts = one_hot.one_hot_drifts(int(T.max(initial=2, where=known)))
    chunks.in_chunks(one_hot.expected_one_hot, *pairs, _log_factorials(longest + 1), drifts, part)
    count[pairs], expected = part, np.full(len(table), np.nan)
    one_hot.add_expected(table.evidence.entries, T, known, count, expected)
    return expected


def voxel_drift(
    table: VoxelTable,
    events: Events,
    *,
    seed: int = 0,
    draws: int = NULL_DRAWS,
    most: int = MOST_DRAWS,
    enough: int = ENOUGH_HITS,
    sample: int = DRIFT_SAMPLE,
) -> VoxelDrift:
    """Compare each voxel's order of observations with random orders of them; events is the log behind the table.

    Null and p-values are exact for OP <= 5, where all orders are gone through. Above, the null is exact for one-hot
    evidence (`expected_sbd`), else the mean of `draws` random orders; p-values come from up to `most` random orders,
    fewer where `enough` of them are as extreme: those of the trend for every voxel, those of SBD for `sample` voxels
    drawn at random. So they are valid under the hypothesis that a voxel's observations are exchangeable.
    """
    if not (draws >= 1 and most >= 1 and enough >= 1):
        raise ConfigError(f"draws = {draws}, most = {most}, enough = {enough}: use 1 or more")
    orders, exact = _Orders.of(table, events, seed), expected_sbd(table)
    vary, T = orders.vary, orders.T
    seen, null, p = orders.measure(~np.isnan(exact[vary]), draws, most, enough)
    with np.errstate(invalid="ignore", divide="ignore"):
        trend = np.where(T > 2, seen / (T * (T * T - 1.0) / 12 * orders.variation[vary]), np.nan)
    p_value = np.minimum(1.0, 2 * p[:, :2].min(axis=1))
    some = orders.sampled(sample)
    p_value[some] = orders.test(some, most, enough)
    expected = np.where(table.op >= 2, 0.0, np.nan)
    expected[vary] = null / (T - 1)
    expected = np.where(np.isnan(exact), expected, exact)
    return VoxelDrift(
        null=expected,
        p_value=_spread_out(p_value, vary),
        trend=_spread_out(trend, vary),
        trend_p=_spread_out(np.where(T > 2, p[:, 2], np.nan), vary),
        table=table,
    )


@dataclass(frozen=True, eq=False)
class _Orders:
    """The observations of the voxels whose observations differ, in other orders.

    vary, variation  (N,) which of all voxels they are, and how far the observations of each are from their mean
    first, T  (n,) their first rows of the log and OP
    log       starts, label and weight of all observations
    streams   (n,) of each voxel's random stream, which depends on its place only
    seed      of the orders that voxels of the same OP go through
    """

    vary: Mask
    variation: Float64
    first: Int64
    T: Int64
    log: tuple[Int64, UInt16, Float64]
    K: int
    streams: UInt64
    seed: np.uint64

    @classmethod
    def of(cls, table: VoxelTable, events: Events, seed: int) -> _Orders:
        spread = variation(table)
        vary = spread > ONE_HOT * table.op
        T = table.op[vary].astype(np.int64)
        own = streams(table, vary, seed)
        base = np.random.default_rng(seed).integers(2**64, dtype=np.uint64)
        return cls(vary, spread, events.starts[vary], T, events.evidence.entries, table.K, own, base)

    @property
    def many(self) -> Mask:
        """(n,) whether there are too many orders to go through all of them."""
        from semstab.statistics.loops.few_looks import ENUMERATED

        above: Mask = self.T > ENUMERATED
        return above

    def part(self, which: Int64) -> _Orders:
        """The voxels of these numbers."""
        return replace(self, first=self.first[which], T=self.T[which], streams=self.streams[which])

    def sampled(self, count: int) -> Int64:
        """Numbers of so many voxels with many orders, by chance."""
        many = np.flatnonzero(self.many)
        return many[lowest(self.streams[many], count)]

    def measure(self, known: Mask, draws: int, most: int, enough: int) -> tuple[Float64, Float64, Float64]:
        """The trends seen and the null of the sums of drifts (n,) unless known (n,), and p-values (n, 3)."""
        from semstab.statistics.loops import chunks, few_looks, orders

        n = len(self.T)
        found = np.zeros(n), np.zeros(n), np.full((n, 3), np.nan)
        rank, *shared = self._shared()
        bounds = np.searchsorted(self.T, np.arange(2, few_looks.ENUMERATED + 2), sorter=rank)
        for T, (begin, end) in enumerate(itertools.pairwise(bounds), 2):
            orders_of = few_looks.orders_and_steps(T)
            log, K, entries = shared[2:5]
            chunks.in_chunks(few_looks.measure_few, rank[begin:end], self.first, T, log, K, entries, *orders_of, *found)
        if bounds[-1] < n:
            rank = rank[bounds[-1] :]
            chunks.in_chunks(orders.measure_voxels, rank, *shared, known, draws, most, enough, *found)
        return found

    def test(self, which: Int64, most: int, enough: int) -> Float64:
        """P-values (r,) of the drifts of the voxels of these numbers."""
        from semstab.statistics.loops import chunks, orders

        p, part = np.zeros(len(which)), self.part(which)
        chunks.in_chunks(orders.test_drifts, *part._shared(), most, enough, p)
        return p

    def _shared(self) -> tuple[Any, ...]:
        entries = self.log[0][self.first + self.T] - self.log[0][self.first]
        return (
            ranked(self.T),
            self.first,
            self.T,
            self.log,
            self.K,
            int(entries.max(initial=0)),
            self.streams,
            self.seed,
        )


def lowest(numbers: UInt64, count: int) -> Int64:
    """Which of numbers (n,) are the lowest so many, ascending."""
    few = np.argpartition(numbers, count)[:count] if count < len(numbers) else np.arange(len(numbers))
    return few[np.argsort(numbers[few])]


def trend_columns(table: VoxelTable, drift: VoxelDrift) -> tuple[Int64, Float64]:
    """The rows (r,) of the voxels that tell of a trend, and (r, 3) of each.

    By its sum: the disagreement that goes one way in time, that in random order, and all of it.
    """
    rows = np.flatnonzero(~np.isnan(drift.trend))
    parts = (drift.trend[rows], 1 / (table.op[rows] - 1.0), np.ones(len(rows)))
    return rows, np.stack(parts, axis=1) * variation(table)[rows, None]


def flips(events: Events) -> Flips:
    """How often, and how long ago, the predicted class (argmax of s_bar, the lowest on ties) changed."""
    return flips_of(events, *changes(events))


def changes(events: Events) -> tuple[Float64, Float64, Int32]:
    """Of `flips` what does not hang on frames: rate and null (n,), and how many looks (n,) follow the last change."""
    from semstab.statistics.loops import chunks, log_kernels

    (rate, null), since = np.empty((2, len(events.starts))), np.empty(len(events.starts), np.int32)
    log, rows = events.evidence, (events.starts, events.ends)
    chunks.in_chunks(log_kernels.count_flips, *rows, log.entries, log.K, rate, null, since)
    return rate, null, since


def flips_of(events: Events, rate: Float64, null: Float64, since: Int32) -> Flips:
    """Those of a log, from its `changes`."""
    from semstab.statistics.loops import log_kernels

    frames = np.empty(len(rate))
    log_kernels.count_frames(events.ends, events.frame, since, frames)
    return Flips(rate, null, frames)


def variation(table: VoxelTable) -> Float64:
    """(n,) how far a voxel's observations are from their mean: sum over frames of ||s_t - mean||^2."""
    spread: Float64 = table.evidence.concentration.squares / table.op
    np.subtract(table.self_sum, spread, out=spread)
    return np.maximum(spread, 0.0, out=spread)


def varying(table: VoxelTable) -> Mask:
    """(n,) whether the observations of a voxel differ; the others cannot drift."""
    vary: Mask = variation(table) > ONE_HOT * table.op
    return vary


def streams(table: VoxelTable, rows: Any, seed: int) -> UInt64:
    """A random number (r,) of each of some voxels that depends on its index and the seed only."""
    from semstab.statistics.loops import orders

    index = np.stack([table.ix[rows], table.iy[rows], table.iz[rows]], axis=1)
    drawn = np.empty(len(index), np.uint64)
    orders.draw_streams(index, np.random.default_rng(seed).integers(2**64, dtype=np.uint64), drawn)
    return drawn


def _log_factorials(count: int) -> Float64:
    """log 0!, log 1!, ..., (count,)."""
    logs: Float64 = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, count)))])
    return logs


def _spread_out(values: Float64, where: Mask) -> Float64:
    """The values at the voxels that they belong to, NaN elsewhere."""
    out = np.full(len(where), np.nan)
    out[where] = values
    return out
