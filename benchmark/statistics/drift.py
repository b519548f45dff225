"""Is there drift in the order of a place's observations, or only their disagreement in whatever order it came?

SBD is never 0 where observations disagree, and falls with OP whatever the model does: later observations move a mean
less. So it is compared with what a random order of the very same observations gives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError
from semstab.model.measures import Quantity, mean, sbd
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.agreement import ONE_HOT

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

FLIP_RATE = Quantity(key="flip_rate", title="Flip rate", better="lower", needs="events")

LEAST_DRAWS, MOST_DRAWS, ENOUGH_HITS = 100, 1999, 20
"""Random orders of a voxel: at least, at most, and how many in a tail settle its p-value."""

FRAME_ORDERS = 499
TESTABLE = 6
"""Lowest OP of the voxels that are tested one by one: of fewer one-hot labels no order is rare enough."""


@dataclass(frozen=True, eq=False)
class VoxelDrift:
    """The order of observations of each voxel (n,); NaN where undefined.

    null         SBD expected when the same observations come in random order, bits; OP >= 2
    excess       SBD - null, bits: below 0 where the belief moves late or only once, above 0 where it moves early
    p_value      of an SBD this far from what random orders give, either way; where observations disagree
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


@dataclass(frozen=True)
class SceneDrift:
    """The order of observations over all voxels, tested by putting the frames into random orders.

    sbd, null    means over the voxels with OP >= 2, bits
    p_value      of a mean SBD this far from what random orders of the frames give, either way
    trend        share of all disagreement, over voxels with OP >= 3, that goes one way in time; null: in random order
    trend_p      of a trend this large
    """

    sbd: float
    null: float
    p_value: float
    trend: float
    trend_null: float
    trend_p: float


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
    from semstab.statistics import kernels

    T = table.op.astype(np.int64)
    known = (T >= 2) & (T <= kernels.LONGEST_TABLE) & (np.abs(table.self_sum - T) <= ONE_HOT * T)
    counts = np.rint(table.evidence[known]).astype(np.int64)
    voxel, label = np.nonzero(counts)
    base = kernels.LONGEST_TABLE + 1
    pairs, of = np.unique(counts[voxel, label] * base + T[known][voxel], return_inverse=True)
    part = np.zeros(len(pairs))
    drifts, _ = _drift_tables(T[known])
    kernels.in_chunks(kernels.expected_one_hot, *np.divmod(pairs, base), _log_factorials(base), drifts, part)
    expected = np.bincount(voxel, weights=part[of], minlength=len(counts)) / (T[known] - 1)
    return _spread_out(expected, known)


def voxel_drift(
    table: VoxelTable,
    events: Events,
    *,
    seed: int = 0,
    least: int = LEAST_DRAWS,
    most: int = MOST_DRAWS,
    enough: int = ENOUGH_HITS,
) -> VoxelDrift:
    """Compare each voxel's order of observations with random orders of them; events is the log behind the table.

    The null is exact for OP <= 5, where all orders are gone through, and for one-hot evidence (`expected_sbd`); else it
    is the mean of `least` random orders. P-values above OP 5 come from up to `most` random orders, fewer where `enough`
    of them are as extreme. They are valid at every voxel under the hypothesis that its observations are exchangeable.
    """
    from semstab.statistics import kernels

    if not (1 <= least <= most and enough >= 1):
        raise ConfigError(f"least = {least}, most = {most}, enough = {enough}: use 1 <= least <= most, enough >= 1")
    vary, first, T = _varying(table, events)
    seen, null, p = np.zeros((len(T), 2)), np.zeros(len(T)), np.zeros((len(T), 3))
    seeds = np.random.default_rng(seed).integers(2**64, size=len(table), dtype=np.uint64)[vary]
    kernels.in_chunks(
        kernels.permute_voxels, first, T, events.evidence, *_drift_tables(T), seeds, least, most, enough, seen, null, p
    )
    expected = np.where(table.op >= 2, 0.0, np.nan)
    expected[vary] = null / (T - 1)
    exact = expected_sbd(table)
    expected = np.where(np.isnan(exact), expected, exact)
    spread = T * (T * T - 1.0) / 12 * variation(table)[vary]
    with np.errstate(invalid="ignore", divide="ignore"):
        return VoxelDrift(
            null=expected,
            excess=sbd(table) - expected,
            p_value=_spread_out(np.minimum(1.0, 2 * p[:, :2].min(axis=1)), vary),
            trend=_spread_out(np.where(T > 2, seen[:, 1] / spread, np.nan), vary),
            trend_null=_spread_out(np.where(T > 2, 1 / (T - 1), np.nan), vary),
            trend_p=_spread_out(np.where(T > 2, p[:, 2], np.nan), vary),
        )


def scene_drift(
    table: VoxelTable, events: Events, drift: VoxelDrift, *, seed: int = 0, frame_orders: int = FRAME_ORDERS
) -> SceneDrift:
    """Test the scene as a whole: its frames in `frame_orders` random orders, the same order for all voxels.

    What neighbouring voxels have in common in a frame stays in common, so that the test holds its level however
    strongly voxels depend on each other. `drift` is what `voxel_drift` says of the same map.
    """
    from semstab.statistics import kernels

    vary, first, T = _varying(table, events)
    frames, rank = np.unique(events.frame, return_inverse=True)
    as_seen = np.tile(np.arange(len(frames)), (frame_orders, 1))
    orders = np.random.default_rng(seed).permuted(as_seen, axis=1)
    sums = np.zeros((kernels.CHUNKS, frame_orders, 2))
    kernels.in_chunks(kernels.permute_frames, first, T, events.evidence, rank, orders, *_drift_tables(T), sums)
    drifted, trended = sums.sum(axis=0).T
    moved = drift.trend * variation(table)
    p_value = min(1.0, 2 * min(_tail(-drifted, -_total(sbd(table)[vary])), _tail(drifted, _total(sbd(table)[vary]))))
    trend = trend_columns(table, drift).sum(axis=0)
    return SceneDrift(
        sbd=mean(sbd(table)),
        null=mean(drift.null),
        p_value=p_value if vary.any() else math.nan,
        trend=trend[0] / trend[2] if trend[2] else math.nan,
        trend_null=trend[1] / trend[2] if trend[2] else math.nan,
        trend_p=_tail(trended, _total(moved)) if trend[2] else math.nan,
    )


def trend_columns(table: VoxelTable, drift: VoxelDrift) -> Float64:
    """(n, 3): by its sum, the disagreement that goes one way in time, that in random order, and all of it."""
    known = ~np.isnan(drift.trend)
    parts = np.stack([drift.trend, drift.trend_null, np.ones(len(table))], axis=1) * variation(table)[:, None]
    return np.where(known[:, None], parts, 0.0)


def flips(events: Events) -> Flips:
    """How often, and how long ago, the predicted class (argmax of s_bar, the lowest on ties) changed."""
    label = events.evidence.argmax(axis=1)
    starts = events.starts
    op = np.diff(np.append(starts, len(events))).astype(np.float64)
    if not len(events):
        return Flips(op, op, op)
    changed = np.diff(label, prepend=label[0]) != 0
    changed[starts] = False
    ends = np.append(starts[1:], len(events)) - 1
    last = np.maximum.reduceat(np.where(changed, np.arange(len(events)), -1), starts)
    since = (events.frame[ends] - events.frame[last]).astype(np.float64)
    counts = np.zeros((len(starts), events.evidence.shape[1]))
    np.add.at(counts, (events.voxel, label), 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = np.where(op >= 2, np.add.reduceat(changed, starts, dtype=np.float64) / (op - 1), np.nan)
        null = np.where(op >= 2, 1 - (counts * (counts - 1)).sum(axis=1) / (op * (op - 1)), np.nan)
    return Flips(rate, null, np.where(last >= 0, since, np.nan))


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
    squares: Float64 = table.self_sum - (table.evidence**2).sum(axis=1) / table.op
    return np.maximum(squares, 0.0)


def _varying(table: VoxelTable, events: Events) -> tuple[npt.NDArray[np.bool_], Int64, Int64]:
    """The voxels (n,) whose observations differ, with their first rows and OP; the others cannot drift."""
    vary = variation(table) > ONE_HOT * table.op
    return vary, events.starts[vary], table.op[vary].astype(np.int64)


def _drift_tables(T: Int64) -> tuple[Float64, Float64]:
    """What the kernels look up for voxels of up to that OP."""
    from semstab.statistics import kernels

    longest = int(T.max(initial=2))
    return kernels.one_hot_drifts(min(longest, kernels.LONGEST_TABLE)), kernels.shrinking_drifts(longest)


def _log_factorials(count: int) -> Float64:
    """log 0!, log 1!, ..., (count,)."""
    logs: Float64 = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, count)))])
    return logs


def _spread_out(values: Float64, where: npt.NDArray[np.bool_]) -> Float64:
    """The values at the voxels that they belong to, NaN elsewhere."""
    out = np.full(len(where), np.nan)
    out[where] = values
    return out


def _tail(values: Float64, seen: float) -> float:
    """P-value of a value as high as the one seen, of which `values` are random draws."""
    slack = 1e-9 * (1 + abs(seen))
    return float((np.count_nonzero(values >= seen - slack) + 1) / (len(values) + 1))


def _total(values: Float64) -> float:
    return float(np.nansum(values))
