"""Is there drift in the order of observations, or only their disagreement in whatever order they came?

SBD is never 0 where observations disagree, and falls with OP whatever the model does: later observations move a mean
less. So it is compared with what a random order of the very same observations gives: for each voxel, and for the scene
as a whole, whose frames stay together in stretches of time, as frames that follow each other err alike.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.core.types import Float64, Int64, Mask, UInt16, UInt64
from semstab.errors import ConfigError
from semstab.model.events import Events
from semstab.model.evidence import Evidence, row_chunks
from semstab.model.measures import Quantity, sbd
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ONE_HOT
from semstab.statistics.variance import longest_effect

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
    from semstab.core.compiled import in_chunks
    from semstab.statistics.loops.orders import LONGEST_TABLE, expected_one_hot, one_hot_drifts

    T, evidence = table.op, table.evidence
    known = (T >= 2) & (LONGEST_TABLE >= T) & (np.abs(table.self_sum - T) <= ONE_HOT * T)
    entries = np.flatnonzero(np.repeat(known, np.diff(evidence.starts)))
    of = np.repeat(np.arange(len(table)), np.diff(evidence.starts))[entries]
    times = np.rint(evidence.weight[entries]).astype(np.int64)
    pairs, which = np.unique(times * (LONGEST_TABLE + 1) + T[of], return_inverse=True)
    part, drifts = np.zeros(len(pairs)), one_hot_drifts(int(T.max(initial=2, where=known)))
    log_factorials = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, LONGEST_TABLE + 1)))])
    in_chunks(expected_one_hot, *np.divmod(pairs, LONGEST_TABLE + 1), log_factorials, drifts, part)
    total = np.bincount(of, weights=part[which], minlength=len(table))
    return np.where(known, total / np.maximum(T - 1, 1), np.nan)


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
    from semstab.core.compiled import in_chunks
    from semstab.statistics.loops import orders as loops

    exact, vary = expected_sbd(table), varying(table)
    first, T, *log = _log_of(events, vary)
    own, base = streams(table, vary, seed), _random_bits(seed)
    seen, null = np.zeros(len(T)), np.zeros(len(T))
    enumerated, trend_tail, drift_tails = (np.full((len(T), tails), np.nan) for tails in (3, 1, 2))
    in_chunks(loops.seen_trends, first, T, *log[:2], seen)
    rank = np.argsort(T, kind="stable")
    bounds = np.searchsorted(T, np.arange(2, loops.ENUMERATED + 2), sorter=rank)
    for steps, (begin, end) in enumerate(itertools.pairwise(bounds), 2):
        order = np.ascontiguousarray(np.array(list(itertools.permutations(range(steps)))).T)
        age = np.argsort(order, axis=0) - 0.5 * (steps - 1)
        in_chunks(loops.test_all_orders, rank[begin:end], first, steps, *log, order, age, null, enumerated)
    rest = rank[bounds[-1] :]
    in_chunks(loops.mean_drifts, rest[np.isnan(exact[vary][rest])], first, T, *log, own, draws, null)
    shared = first, T, *log, own, base, seen
    in_chunks(loops.test_orders, rest, *shared, loops.LANES, most, enough, trend_tail)
    some = rest[lowest(own[rest], sample)]
    some = some[np.argsort(T[some], kind="stable")]
    in_chunks(loops.test_orders, some, *shared, loops.LANES // 2, most, enough, drift_tails)
    with np.errstate(invalid="ignore", divide="ignore"):
        trend = np.where(T > 2, seen / (T * (T * T - 1.0) / 12 * variation(table)[vary]), np.nan)
    expected = np.where(table.op >= 2, 0.0, np.nan)
    expected[vary] = null / (T - 1)
    return VoxelDrift(
        null=np.where(np.isnan(exact), expected, exact),
        p_value=_spread_out(np.minimum(1.0, 2 * np.fmin(enumerated[:, :2], drift_tails).min(axis=1)), vary),
        trend=_spread_out(trend, vary),
        trend_p=_spread_out(np.fmin(enumerated[:, 2], trend_tail[:, 0]), vary),
        table=table,
    )


def _log_of(events: Events, voxels: Any) -> tuple[Int64, Int64, tuple[Int64, UInt16, Float64], int, int]:
    """The first rows (n,) and the OP (n,) of some voxels, the entries of the log, K, and the most entries of one."""
    entries = events.evidence.entries
    first, last = events.starts[voxels], events.ends[voxels]
    return first, last - first, entries, events.K, int((entries[0][last] - entries[0][first]).max(initial=0))


def _random_bits(seed: int) -> np.uint64:
    return np.random.default_rng(seed).integers(2**64, dtype=np.uint64)


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
    """Return how often, and how long ago, the predicted class (argmax of s_bar, the lowest on ties) changed."""
    starts, label, weight = events.evidence.entries
    n, T = len(events.starts), events.ends - events.starts
    of = np.repeat(np.arange(len(events)), np.diff(starts))
    top = np.maximum.reduceat(weight, starts[:-1]) if len(of) else weight
    leads = np.flatnonzero(weight == top[of])
    voted = label[leads[np.flatnonzero(np.diff(of[leads], prepend=-1))]].astype(np.int64)
    changed = np.flatnonzero((np.diff(voted, prepend=-1) != 0) & (np.diff(events.voxel, prepend=-1) == 0))
    changes = np.bincount(events.voxel[changed], minlength=n)
    key, votes = np.unique(events.voxel * events.K + voted, return_counts=True)
    same = np.bincount(key // events.K, weights=votes * (votes - 1) / 2, minlength=n)
    since = np.full(n, np.nan)
    since[events.voxel[changed]] = (events.frame[events.ends - 1][events.voxel] - events.frame)[changed]
    with np.errstate(invalid="ignore", divide="ignore"):
        pairs = T * (T - 1) / 2
        return Flips(np.where(T > 1, changes / (T - 1), np.nan), np.where(T > 1, (pairs - same) / pairs, np.nan), since)


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
    orders.draw_streams(index, _random_bits(seed), drawn)
    return drawn


def _spread_out(values: Float64, where: Mask) -> Float64:
    """The values at the voxels that they belong to, NaN elsewhere."""
    out = np.full(len(where), np.nan)
    out[where] = values
    return out


# P-values of many voxels at once.

ROUNDED = 12
"""Bits to which the p-values of trends are rounded up before they are adjusted."""


def rounded_up(p: Float64) -> Float64:
    """Return p-values (n,) rounded up to ROUNDED bits, so that few different ones are told apart."""
    part, exponent = np.frexp(p)
    rounded: Float64 = np.ldexp(np.ceil(np.ldexp(part, ROUNDED)), exponent - ROUNDED)
    return rounded


def benjamini_hochberg(p: Float64) -> Float64:
    """Adjusted p-values of the same shape: rejecting those <= q keeps the false discovery rate at q (1995, JRSS B 57).

    NaN is not a test. It holds for independent tests and for those that depend positively (Benjamini and Yekutieli
    2001), as neighbouring voxels do.
    """
    adjusted, tested = np.full(p.shape, np.nan), ~np.isnan(p)
    value, of, count = np.unique(p[tested], return_inverse=True, return_counts=True)
    by_rank = value * count.sum() / np.cumsum(count)
    adjusted[tested] = np.minimum(np.minimum.accumulate(by_rank[::-1])[::-1], 1.0)[of]
    return adjusted


# --- The scene --------------------------------------------------------------------------------------------------------

CERTAIN, MOST_SPANS = 0.95, 128
"""How certain it must be that errors last no longer, and by how many spans of time that is looked at."""

SAMPLE, ORDERS = 30_000, 499
"""About so many observations are put into so many orders."""

IN_COMMON = 0.05
"""Two observations have nothing in common whose departures from their voxel's mean correlate by no more."""

FEW_PAIRS = 0.02
"""A bin with a smaller share of all pairs says nothing."""

MOST_STRETCHES, LEAST_STRETCHES, LEAST_SPAN = 12, 6, 4
"""Stretches of time, at most and at least, and in how many of them a voxel must be seen to be put to the test."""


@dataclass(frozen=True)
class OrderTest:
    """The order of observations over all voxels, tested by putting stretches of time into random orders.

    p_value    of a mean SBD this far from what random orders of the stretches give, either way; NaN where errors last
               so long that there are fewer than LEAST_STRETCHES, or no location was seen in LEAST_SPAN of them
    trend_p    of a share of all disagreement this large that goes one way in time, over voxels with OP >= 3
    stretches  of time that were put in other orders
    voxels     whose observations tell, a random sample
    lasting    frames that err alike
    """

    p_value: float
    trend_p: float
    stretches: int
    voxels: int
    lasting: int = 1


def order_test(table: VoxelTable, events: Events, *, seed: int = 0, frame_orders: int = ORDERS) -> OrderTest:
    """Put the stretches of time of a sample of a map's observations, about SAMPLE of them, into random orders.

    What neighbouring voxels have in common in a frame stays in common, and so does what frames of one stretch have.
    """
    from semstab.core.compiled import CHUNKS, in_chunks
    from semstab.statistics.loops import orders as loops

    rows = np.flatnonzero(varying(table))
    order = np.argsort(streams(table, rows, seed))
    drawn = np.sort(rows[order[: np.searchsorted(np.cumsum(table.op[rows][order]), SAMPLE) + 1]])
    table, events = table.rows(drawn), events.rows(drawn)
    frames, rank = np.unique(events.frame, return_inverse=True)
    common = _lasting(_departures(table, events), rank, len(frames))
    lasting = max(int(1 + 2 * common), persistence(table, events))
    stretches = min(MOST_STRETCHES, len(frames) // lasting)
    stretch = rank * stretches // max(len(frames), 1)
    changes = np.diff(stretch, prepend=-1) != 0
    changes[events.starts] = True
    span = np.bincount(events.voxel, weights=changes, minlength=len(table))
    some = (span >= LEAST_SPAN) & (stretches >= LEAST_STRETCHES)
    if not some.any():
        return OrderTest(math.nan, math.nan, stretches, 0, lasting)
    first, T, *log = _log_of(events, some)
    stretch = stretch[np.repeat(some, table.op)]
    as_seen = np.tile(np.arange(stretches), (frame_orders, 1))
    orders = np.ascontiguousarray(np.random.default_rng(seed).permuted(as_seen, axis=1).T)
    cuts = np.arange(CHUNKS + 1) * len(T) // CHUNKS
    edges, sums = np.stack([cuts, np.append(0, np.cumsum(T))[cuts]], axis=1), np.zeros((CHUNKS, frame_orders, 2))
    in_chunks(loops.permute_stretches, edges, first, T, *log, stretch, orders, sums)
    drifts, trends = sums.sum(axis=0).T
    trend = np.zeros(len(T))
    in_chunks(loops.seen_trends, first, T, *log[:2], trend)
    total_trend = float((trend / np.maximum(T * (T * T - 1.0) / 12, 1))[T > 2].sum())
    total_drift = float(sbd(table)[some].sum())
    p_value = min(1.0, 2 * min(_tail(-drifts, -total_drift), _tail(drifts, total_drift)))
    return OrderTest(p_value, _tail(trends, total_trend) if total_trend > 0 else math.nan, stretches, len(T), lasting)


def persistence(table: VoxelTable, events: Events) -> int:
    """Return for how many frames observations of a voxel have more in common than any two of it: 1 if none last.

    By the correlation of departures from the voxel's mean, over pairs that are 1, 2, 4, ... observations apart, in bins
    of frames. In random order it is -1 / (OP - 1), whatever the voxel's observations are. A belief that moves all along
    the flight lasts as long as the flight.
    """
    from scipy.sparse import csr_array

    rank, of, T = np.unique(events.frame, return_inverse=True)[1], events.voxel, table.op
    starts, label, weight = events.evidence.entries
    evidence = csr_array((weight, label.astype(np.int32), starts), shape=(len(events), events.K))
    squares, agrees = table.evidence.concentration.squares / T**2.0, np.zeros(len(events))
    for some in row_chunks(len(events), table.K):
        agrees[some] = (events.evidence[some] * table.evidence[of[some]]).sum(axis=1) / T[of[some]]
    spread = variation(table) / T
    common, among = np.zeros((2, 64))
    apart = 1
    while len(first := np.flatnonzero(of[apart:] == of[:-apart])):
        second, voxel = first + apart, of[first]
        together = evidence[first].multiply(evidence[second]).sum(axis=1) - agrees[first] - agrees[second]
        bins = np.log2(abs(rank[second] - rank[first])).astype(np.int64)
        excess = together + squares[voxel] + spread[voxel] / (T[voxel] - 1)
        common += np.bincount(bins, weights=excess, minlength=64)
        among += np.bincount(bins, weights=spread[voxel], minlength=64)
        apart *= 2
    lasting = np.flatnonzero((common > IN_COMMON * among) & (among > FEW_PAIRS * among.sum()))
    return 2 ** (int(lasting[-1]) + 2) if len(lasting) else 1


def in_stretches(events: Events, frames: int) -> Events:
    """Return the log of the means over stretches of so many frames: what a voxel's observations there say together."""
    from scipy.sparse import csr_array

    stretch, K = np.unique(events.frame, return_inverse=True)[1] // frames, events.K
    key = events.voxel.astype(np.int64) * (int(stretch.max(initial=0)) + 1) + stretch
    own, at, of, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    starts, label, weight = events.evidence.entries
    evidence = csr_array((weight, label.astype(np.int32), starts), shape=(len(events), K))
    joined = csr_array((1.0 / count[of], (of, np.arange(len(events)))), shape=(len(own), len(events))) @ evidence
    joined.sort_indices()
    return dataclasses.replace(
        events,
        voxel=events.voxel[at],
        frame=stretch[at].astype(np.int32),
        evidence=Evidence(joined.indptr.astype(np.int64), joined.indices.astype(np.uint16), joined.data, K),
        pixels=np.bincount(of, weights=events.pixels).astype(np.int32),
    )


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


def _tail(values: Float64, seen: float) -> float:
    """P-value of a value as high as the one seen, of which `values` are random draws."""
    slack = 1e-9 * (1 + abs(seen))
    return float((np.count_nonzero(values >= seen - slack) + 1) / (len(values) + 1))
