"""Movement of beliefs with time: drift against random order, flips, and the part of disagreement that goes one way.

SBD is never 0 where observations disagree, and falls with OP whatever the model does: later observations move a mean
less. So it is reported with the drift of a random order of the same observations. None of these numbers separates drift
of the model from errors that depend on the view, or that last over frames: both are ordered in time along a flight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.core.arrays import distinct_keys
from semstab.core.types import Float64, UInt64
from semstab.data.events import Events
from semstab.data.measures import Quantity
from semstab.data.voxels import VoxelTable
from semstab.statistics.agreement import ONE_HOT

FLIP_RATE = Quantity(key="flip_rate", title="Flip rate", better="lower", needs="events")


@dataclass(frozen=True, eq=False)
class Flips:
    """Changes of the predicted class between successive observations of a voxel (n,); NaN if undefined.

    Attributes:
        rate: Share of the steps from one observation to the next at which the class changes; OP >= 2.
        null: Its expectation in random order: the share of all pairs of observations that differ.
        since: Frames from the last change to the last observation; NaN if the class never changed.
    """

    rate: Float64
    null: Float64
    since: Float64


def expected_sbd(table: VoxelTable, events: Events | None = None, *, seed: int = 0) -> Float64:
    """Return SBD (n,) expected in random order, bits: exactly, from the counts of one-hot observations alone.

    Where a frame's pixels in the voxel disagree, or OP exceeds 256, it is the mean of eight turns of one random order;
    NaN there without the log behind the table, and where OP < 2.
    """
    from semstab.core.compiled import in_chunks
    from semstab.statistics.loops.orders import LONGEST_TABLE, expected_one_hot, mean_drifts, one_hot_drifts

    T, evidence = table.op, table.evidence
    is_exact = (T >= 2) & (LONGEST_TABLE >= T) & (np.abs(table.self_sum - T) <= ONE_HOT * T)
    number = np.diff(evidence.starts)
    entries = np.flatnonzero(np.repeat(is_exact, number))
    of = np.repeat(np.flatnonzero(is_exact), number[is_exact])
    times = np.rint(evidence.weight[entries]).astype(np.int64)
    pairs, which = distinct_keys(times * (LONGEST_TABLE + 1) + T[of])
    part, drifts = np.zeros(len(pairs)), one_hot_drifts(int(T.max(initial=2, where=is_exact)))
    log_factorials = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, LONGEST_TABLE + 1)))])
    in_chunks(expected_one_hot, *np.divmod(pairs, LONGEST_TABLE + 1), log_factorials, drifts, part)
    total = np.bincount(of, weights=part[which], minlength=len(table))
    null = np.where(is_exact, total / np.maximum(T - 1, 1), np.nan)
    rest = np.flatnonzero((T >= 2) & ~is_exact)
    if events is not None and len(rest):
        log = events.evidence.entries
        most = int((log[0][events.ends] - log[0][events.starts]).max())
        stream = np.zeros(len(table), np.uint64)
        stream[rest] = streams(table, rest, seed)
        in_chunks(mean_drifts, rest, events.starts, T.astype(np.int64), log, events.K, most, stream, null)
    return null


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


def streams(table: VoxelTable, rows: Any, seed: int) -> UInt64:
    """Return a random number (r,) of each of some voxels that depends on its index and the seed only."""
    from semstab.statistics.loops import orders

    index = np.stack([table.ix[rows], table.iy[rows], table.iz[rows]], axis=1)
    random_numbers = np.empty(len(index), np.uint64)
    orders.draw_streams(index, np.random.default_rng(seed).integers(2**64, dtype=np.uint64), random_numbers)
    return random_numbers
