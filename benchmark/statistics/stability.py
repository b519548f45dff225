"""Is a location stable? A probability, because a few frames that agree say less than many.

Frames agree or not by chance: of locations that all err in one frame of ten, those that three frames saw look perfect
more often than those that thirty saw. So a location borrows from what all locations of its map are like.
"""

from __future__ import annotations

import math

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.model.measures import vss
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import STABLE

LIKELY = 0.5
"""A place is called stable from this probability on."""

STEPS, ROUNDS = 80, 200
"""Shares of the dominant class that a place may have, between 1/2 and 1, and rounds to find how many have which."""


def stable_share(agreement: float = STABLE) -> float:
    """The share p of the dominant class from which two frames agree with that probability: p^2 + (1 - p)^2."""
    return (1 + math.sqrt(2 * agreement - 1)) / 2


def shares_of(table: VoxelTable) -> Float64:
    """Return how many of a map's locations (STEPS,) have which share of the dominant class."""
    seen, most, of = _votes(table)
    count, likelihood, share = np.bincount(of), _likelihood(seen, most), np.full(STEPS, 1 / STEPS)
    if not len(seen):
        return share
    for _ in range(ROUNDS):  # how often each share is so, a posteriori
        share = share * ((count / (likelihood @ share)) @ likelihood) / count.sum()
    return share


def stability_posterior(table: VoxelTable, shares: Float64 | None = None, *, stable: float = STABLE) -> Float64:
    """(n,) the probability that a location is stable, given its frames and all locations; NaN where OP < 2.

    Of T frames m vote for the dominant class, which happens with the probability b(m; T, p) + b(T - m; T, p) where its
    share is p. How many locations have which p is estimated from all of them without any form of its distribution
    (Kiefer and Wolfowitz 1956, Annals of Mathematical Statistics 27; by the EM algorithm), then Bayes' theorem is
    applied. `shares` are those of the whole map, where the table has but some of its locations.
    """
    seen, most, of = _votes(table)
    posterior = _likelihood(seen, most) * (shares_of(table) if shares is None else shares)
    posterior /= posterior.sum(axis=1, keepdims=True)
    likely = np.full(len(table), np.nan)
    likely[table.op >= 2] = posterior[:, stable_share(stable) <= STEPS_OF_P].sum(axis=1)[of]
    return likely


STEPS_OF_P = 0.5 + 0.5 * (np.arange(STEPS) + 0.5) / STEPS


def _likelihood(seen: Int64, most: Int64) -> Float64:
    """(v, STEPS) of votes given each share, up to a factor of each row."""
    m, rest, p, q = most[:, None], (seen - most)[:, None], np.log(STEPS_OF_P), np.log1p(-STEPS_OF_P)
    own, folded = m * p + rest * q, rest * p + m * q
    best = np.maximum(own, folded).max(axis=1, keepdims=True)
    likelihood: Float64 = np.exp(own - best) + np.exp(folded - best)
    return likelihood


def _votes(table: VoxelTable) -> tuple[Int64, Int64, Int64]:
    """Frames that saw a location and votes for its class, each pair once (v,); which pair each with OP >= 2 has."""
    again = table.op >= 2
    T = table.op[again].astype(np.int64)
    longest = int(T.max(initial=0)) + 1
    pairs, of = np.unique(np.rint(vss(table)[again] * T).astype(np.int64) + T * longest, return_inverse=True)
    seen, most = np.divmod(pairs, longest)
    return seen, most, of
