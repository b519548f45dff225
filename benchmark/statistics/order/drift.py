"""Is there drift in the order of a place's observations, or only their disagreement in whatever order it came?

SBD is never 0 where observations disagree, and falls with OP whatever the model does: later observations move a mean
less. So it is compared with what a random order of the very same observations gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError
from semstab.model.measures import Quantity, sbd
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.agreement import ONE_HOT

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

ROUNDING = 1e-9
FLIP_RATE = Quantity(key="flip_rate", title="Flip rate", better="lower", needs="events")

NULL_DRAWS = 16
"""Random orders of a voxel's observations whose mean drift is its null, where that is not known exactly."""

MOST_DRAWS, ENOUGH_HITS = 1999, 20
"""Random orders of a voxel that is tested: at most, and how many in a tail settle its p-value."""

CLEAR, LIKELY = 1e-4, 0.02
"""P-values of the trend from its mean and variance over orders stand from LIKELY on; those from CLEAR on are computed
from random orders; a lower one becomes the lowest that these could give."""

DRIFT_SAMPLE = 5_000
"""At most so many voxels are tested for an unusual SBD."""

ROUNDED = 12
"""Bits of p-values that are kept: so few different ones are told apart that they can be counted."""

TESTABLE = 6
"""Lowest OP of the voxels that are tested one by one: of fewer one-hot labels no order is rare enough."""


@dataclass(frozen=True, eq=False)
class VoxelDrift:
    """The order of observations of each voxel (n,); NaN where undefined.

    null         SBD expected when the same observations come in random order, bits; OP >= 2
    excess       SBD - null, bits: below 0 where the belief moves late or only once, above 0 where it moves early
    p_value      of an SBD this far from what random orders give, either way; where observations disagree, above
                 OP 5 of a random sample of these voxels
    trend        share of the disagreement that goes one way in time: R^2 of the evidence on the number of the
                 observation; OP >= 3, where observations disagree
    trend_null   its expectation in random order, 1 / (OP - 1)
    trend_p      of a trend this large in random order
    """

    null: Float64
    excess: Float64
    p_value: Float64
    trend: Float64
    trend_null: Float64
    trend_p: Float64


@dataclass(frozen=True, eq=False)
class PValues:
    """P-values of many voxels, which add up over the parts of a map: rounded up to ROUNDED bits, and how often each.

    value  (v,) ascending; count (v,)
    """

    value: Float64
    count: Int64

    @classmethod
    def of(cls, p: Float64) -> PValues:
        """Those that are no NaN, which is not a test."""
        value, count = np.unique(_rounded_up(p[~np.isnan(p)]), return_counts=True)
        return cls(value, count.astype(np.int64))

    @classmethod
    def merged(cls, parts: Sequence[PValues]) -> PValues:
        """Those of a map from its parts."""
        value, of = np.unique(np.concatenate([part.value for part in parts]), return_inverse=True)
        count = np.bincount(of, weights=np.concatenate([part.count for part in parts]), minlength=len(value))
        return cls(value, count.astype(np.int64))

    def adjusted(self, p: Float64) -> Float64:
        """What `benjamini_hochberg` makes of some of them (n,); NaN stays."""
        q = self._adjusted()
        found = np.full(len(p), np.nan)
        tested = ~np.isnan(p)
        found[tested] = q[np.searchsorted(self.value, _rounded_up(p[tested]))]
        return found

    def found(self, rate: float) -> int:
        """How many are below that rate when they are adjusted."""
        return int(self.count[self._adjusted() <= rate].sum())

    def _adjusted(self) -> Float64:
        raised = self.value * self.count.sum() / np.cumsum(self.count)
        lowest: Float64 = np.minimum.accumulate(raised[::-1])[::-1]
        return np.minimum(lowest, 1.0)


def _rounded_up(p: Float64) -> Float64:
    part, exponent = np.frexp(p)
    rounded: Float64 = np.ldexp(np.ceil(np.ldexp(part, ROUNDED)), exponent - ROUNDED)
    return rounded


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
    from semstab.statistics.loops import kernels

    T = table.op.astype(np.int64)
    known = (T >= 2) & (T <= kernels.LONGEST_TABLE) & (np.abs(table.self_sum - T) <= ONE_HOT * T)
    entries = table.evidence.take(known)
    count, voxel = np.rint(entries.weight).astype(np.int64), np.repeat(np.arange(len(entries)), np.diff(entries.starts))
    base = kernels.LONGEST_TABLE + 1
    pairs, of = np.unique(count * base + T[known][voxel], return_inverse=True)
    part = np.zeros(len(pairs))
    drifts, _ = drift_tables(T[known])
    kernels.in_chunks(kernels.expected_one_hot, *np.divmod(pairs, base), _log_factorials(base), drifts, part)
    expected = np.bincount(voxel, weights=part[of], minlength=len(entries)) / (T[known] - 1)
    return _spread_out(expected, known)


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
    fewer where `enough` of them are as extreme: those of SBD for `sample` voxels drawn at random, those of the trend
    where its mean and variance over all orders, which are exact, say that it might be below 0.02. So they are valid, up
    to there, under the hypothesis that a voxel's observations are exchangeable.
    """
    if not (draws >= 1 and most >= 1 and enough >= 1):
        raise ConfigError(f"draws = {draws}, most = {most}, enough = {enough}: use 1 or more")
    vary, _, T = varying(table, events)
    orders = _Orders.of(table, events, vary, seed)
    null, p, variance = orders.measure(draws)
    spread = T * (T * T - 1.0) / 12 * variation(table)[vary]
    with np.errstate(invalid="ignore", divide="ignore"):
        trend = np.where(T > 2, orders.seen[:, 1] / spread, np.nan)
        trend_p = np.where(T > 2, p[:, 2], np.nan)
    p_value = np.minimum(1.0, 2 * p[:, :2].min(axis=1))
    many = np.flatnonzero(orders.enumerated < T)
    p_value[many] = np.nan
    drawn = many[np.argsort(orders.seeds[many])[:sample]]
    p_value[drawn] = orders.test(drawn, by_drift=True, most=most, enough=enough)
    trend_p[many] = np.maximum(_beta_tail(trend[many], variance[many] / spread[many] ** 2, T[many]), 1 / (most + 1))
    unsure = many[(trend_p[many] < LIKELY) & (trend_p[many] >= CLEAR)]
    trend_p[unsure] = orders.test(unsure, by_drift=False, most=most, enough=enough)
    expected = np.where(table.op >= 2, 0.0, np.nan)
    expected[vary] = null / (T - 1)
    exact = expected_sbd(table)
    expected = np.where(np.isnan(exact), expected, exact)
    return VoxelDrift(
        null=expected,
        excess=sbd(table) - expected,
        p_value=_spread_out(p_value, vary),
        trend=_spread_out(trend, vary),
        trend_null=_spread_out(np.where(T > 2, 1 / np.maximum(T - 1, 1), np.nan), vary),
        trend_p=_spread_out(trend_p, vary),
    )


@dataclass(frozen=True, eq=False)
class _Orders:
    """The observations of some voxels in other orders; arguments of the compiled loops.

    first, T  (n,) their first rows of the log and OP
    log       starts, label and weight of all observations
    seeds     (n,) of each voxel's random stream, which depends on its place only
    seen      (n, 2) its sum of drifts and its trend
    """

    first: Int64
    T: Int64
    log: tuple[Int64, npt.NDArray[np.uint16], Float64]
    K: int
    seeds: npt.NDArray[np.uint64]
    seen: Float64
    enumerated: int

    @classmethod
    def of(cls, table: VoxelTable, events: Events, where: npt.NDArray[np.bool_], seed: int) -> _Orders:
        from semstab.statistics.loops import kernels

        first, T = events.starts[where], table.op[where].astype(np.int64)
        seeds = streams(table.rows(where).index, seed)
        return cls(first, T, events.evidence.entries, table.K, seeds, np.zeros((len(T), 2)), kernels.ENUMERATED)

    def measure(self, draws: int) -> tuple[Float64, Float64, Float64]:
        """Fill `seen`; the null of the drifts (n,), p-values (n, 3) of few observations, the trend's variance."""
        from semstab.statistics.loops import kernels

        null, p, variance = np.zeros(len(self.T)), np.zeros((len(self.T), 3)), np.zeros(len(self.T))
        kernels.in_chunks(kernels.measure_voxels, *self._shared(), draws, self.seen, null, p, variance)
        return null, p, variance

    def test(self, which: Int64, *, by_drift: bool, most: int, enough: int) -> Float64:
        """P-values (r,) of the voxels of these numbers."""
        from semstab.statistics.loops import kernels

        p = np.zeros(len(which))
        kernels.in_chunks(kernels.permute_voxels, which, *self._shared(), by_drift, most, enough, self.seen, p)
        return p

    def _shared(self) -> tuple[Any, ...]:
        entries = self.log[0][self.first + self.T] - self.log[0][self.first]
        return self.first, self.T, self.log, self.K, int(entries.max(initial=0)), *drift_tables(self.T), self.seeds


def drawn(table: VoxelTable, events: Events, observations: int, seed: int = 0) -> Int64:
    """The rows (r,) of the voxels whose orders stand for all: those of the lowest hashes whose observations differ.

    They are so many that they have that many observations, and those that `voxel_drift` tests for an unusual SBD. So
    what is drawn of a map is drawn of any part of it that holds it.
    """
    from semstab.statistics.loops import kernels

    vary, _, T = varying(table, events)
    order = np.argsort(streams(table.rows(vary).index, seed))
    enough = order[: np.searchsorted(np.cumsum(T[order]), observations) + 1]
    tested = order[T[order] > kernels.ENUMERATED][:DRIFT_SAMPLE]
    rows: Int64 = np.flatnonzero(vary)[np.union1d(enough, tested)]
    return rows


def _beta_tail(trend: Float64, variance: Float64, T: Int64) -> Float64:
    """P-value (n,) of a trend R^2 whose mean is 1 / (T - 1), as if it had a beta distribution of that variance."""
    from scipy.special import betaincc

    mean = 1 / (T - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        size = mean * (1 - mean) / variance - 1
    p: Float64 = betaincc(mean * size, (1 - mean) * size, np.clip(trend - ROUNDING, 0.0, 1.0))
    return np.where(size > 0, p, 1.0)


def trend_columns(table: VoxelTable, drift: VoxelDrift) -> Float64:
    """(n, 3): by its sum, the disagreement that goes one way in time, that in random order, and all of it."""
    known = ~np.isnan(drift.trend)
    parts = np.stack([drift.trend, drift.trend_null, np.ones(len(table))], axis=1) * variation(table)[:, None]
    return np.where(known[:, None], parts, 0.0)


def flips(events: Events) -> Flips:
    """How often, and how long ago, the predicted class (argmax of s_bar, the lowest on ties) changed."""
    from semstab.statistics.loops import kernels, log_kernels

    n, bounds = len(events.ix), np.append(events.starts, len(events))
    changes, differing, since = np.zeros(n), np.zeros(n), np.full(n, np.nan)
    kernels.in_chunks(
        log_kernels.count_flips,
        bounds,
        events.frame,
        events.evidence.entries,
        events.evidence.K,
        changes,
        differing,
        since,
    )
    op = np.diff(bounds).astype(np.float64)
    again = op >= 2
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = np.where(again, changes / (op - 1), np.nan)
        null = np.where(again, differing / (op * (op - 1) / 2), np.nan)
    return Flips(rate, null, since)


def benjamini_hochberg(p: Float64) -> Float64:
    """Adjusted p-values of the same shape: rejecting those <= q keeps the false discovery rate at q (1995, JRSS B 57).

    NaN is not a test. It holds for independent tests and for those that depend positively (Benjamini and Yekutieli
    2001), as neighbouring voxels do.
    """
    from scipy.stats import false_discovery_control

    adjusted = np.full(len(p), np.nan)
    tested = np.flatnonzero(~np.isnan(p))
    if len(tested):
        adjusted[tested] = false_discovery_control(p[tested])
    return adjusted


def variation(table: VoxelTable) -> Float64:
    """(n,) how far a voxel's observations are from their mean: sum over frames of ||s_t - mean||^2."""
    squares: Float64 = table.self_sum - table.evidence.rowwise(lambda e: (e**2).sum(axis=1)) / table.op
    return np.maximum(squares, 0.0)


def varying(table: VoxelTable, events: Events) -> tuple[npt.NDArray[np.bool_], Int64, Int64]:
    """The voxels (n,) whose observations differ, with their first rows and OP; the others cannot drift."""
    vary = variation(table) > ONE_HOT * table.op
    return vary, events.starts[vary], table.op[vary].astype(np.int64)


def drift_tables(T: Int64) -> tuple[Float64, Float64]:
    """What the kernels look up for voxels of up to that OP."""
    from semstab.statistics.loops import kernels

    longest = int(T.max(initial=2))
    return kernels.one_hot_drifts(min(longest, kernels.LONGEST_TABLE)), kernels.step_terms(longest)


def streams(index: npt.NDArray[np.int32], seed: int) -> npt.NDArray[np.uint64]:
    """A random number (n,) of each voxel that depends on its index (n, 3) and the seed only."""
    from semstab.statistics.loops import kernels

    drawn = np.empty(len(index), np.uint64)
    kernels.draw_streams(index, np.random.default_rng(seed).integers(2**64, dtype=np.uint64), drawn)
    return drawn


def _log_factorials(count: int) -> Float64:
    """log 0!, log 1!, ..., (count,)."""
    logs: Float64 = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, count)))])
    return logs


def _spread_out(values: Float64, where: npt.NDArray[np.bool_]) -> Float64:
    """The values at the voxels that they belong to, NaN elsewhere."""
    out = np.full(len(where), np.nan)
    out[where] = values
    return out
