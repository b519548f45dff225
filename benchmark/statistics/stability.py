"""Is a place stable? A probability, because a few frames that agree say less than many.

Frames agree or not by chance: of places that all err in one frame of ten, those that three frames saw look perfect more
often than those that thirty saw. So a place borrows from what all places of its map are like.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, Int64
from semstab.model.evidence import stretches
from semstab.model.measures import vss
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import STABLE
from semstab.statistics.ranks import numbered

LIKELY = 0.5
"""A place is called stable from this probability on."""

STEPS, ROUNDS = 80, 200
"""Shares of the dominant class that a place may have, between 1/2 and 1, and rounds to find how many have which."""


def stable_share(agreement: float = STABLE) -> float:
    """The share p of the dominant class from which two frames agree with that probability: p^2 + (1 - p)^2."""
    return (1 + math.sqrt(2 * agreement - 1)) / 2


@dataclass(frozen=True, eq=False)
class Votes:
    """How many places of a map have which votes, of those with OP >= 2: what is the same for all parts adds up.

    seen   (v,) frames that saw a place, most (v,) how many of them are for its dominant class; sorted
    count  (v,) places
    """

    seen: Int64
    most: Int64
    count: Int64

    @classmethod
    def of(cls, table: VoxelTable) -> Votes:
        """Those of a table."""
        return cls.merged([_votes(*part)[0] for _, part in _parts(table)])

    @classmethod
    def merged(cls, parts: Sequence[Votes]) -> Votes:
        """Those of a map from its parts."""
        seen, most, count = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("seen", "most", "count")
        )
        (seen, most), of = np.unique(np.stack([seen, most]), axis=1, return_inverse=True)
        total = np.bincount(of.ravel(), weights=count, minlength=len(seen)).astype(np.int64)
        return cls(seen, most, total)

    def shares(self) -> Float64:
        """(STEPS,) how many of all places have which share of the dominant class."""
        likelihood, share = _likelihood(self.seen, self.most), np.full(STEPS, 1 / STEPS)
        if not len(self.seen):
            return share
        for _ in range(ROUNDS):  # how often each share is so, a posteriori
            share = share * ((self.count / (likelihood @ share)) @ likelihood) / self.count.sum()
        return share

    def stable(self, shares: Float64, *, stable: float = STABLE) -> Float64:
        """(v,) the probability that a place with these votes is stable, in a map of these shares."""
        posterior = _likelihood(self.seen, self.most) * shares
        posterior /= posterior.sum(axis=1, keepdims=True)
        likely: Float64 = posterior[:, stable_share(stable) <= STEPS_OF_P].sum(axis=1)
        return likely


STEPS_OF_P = 0.5 + 0.5 * (np.arange(STEPS) + 0.5) / STEPS


def _likelihood(seen: Int64, most: Int64) -> Float64:
    """(v, STEPS) of votes given each share, up to a factor of each row."""
    m, rest, p, q = most[:, None], (seen - most)[:, None], np.log(STEPS_OF_P), np.log1p(-STEPS_OF_P)
    own, folded = m * p + rest * q, rest * p + m * q
    best = np.maximum(own, folded).max(axis=1, keepdims=True)
    likelihood: Float64 = np.exp(own - best) + np.exp(folded - best)
    return likelihood


def _parts(table: VoxelTable) -> Iterator[tuple[slice, tuple[npt.NDArray[Any], Float64, Float64]]]:
    """OP, share of the dominant class, and how many voxels a row stands for, some rows after the others."""
    share, voxels = vss(table), table.voxels
    return ((some, (table.op[some], share[some], voxels[some])) for some in stretches(len(table)))


def _votes(op: Int32, share: Float64, voxels: Float64) -> tuple[Votes, Int64]:
    """Those of a table, and which each of its places with OP >= 2 has."""
    again = op >= 2
    T = op[again].astype(np.int64)
    longest = int(T.max(initial=0)) + 1
    votes = np.rint(share[again] * T).astype(np.int64)
    pairs, of = numbered(votes + T * longest)
    count = np.bincount(of, weights=voxels[again], minlength=len(pairs)).astype(np.int64)
    return Votes(*np.divmod(pairs, longest), count), of


def stability_posterior(table: VoxelTable, shares: Float64 | None = None, *, stable: float = STABLE) -> Float64:
    """(n,) the probability that a place is stable, given its frames and what all places are like; NaN where OP < 2.

    Of T frames m vote for the dominant class, which happens with the probability b(m; T, p) + b(T - m; T, p) where its
    share is p. How many places have which p is estimated from all of them without any form of its distribution (Kiefer
    and Wolfowitz 1956, Annals of Mathematical Statistics 27; by the EM algorithm), then Bayes' theorem is applied.
    `shares` are those of all places, where the table has but some of them.
    """
    shares = Votes.of(table).shares() if shares is None else shares
    found = np.full(len(table), np.nan)
    for some, part in _parts(table):
        votes, of = _votes(*part)
        found[some][part[0] >= 2] = votes.stable(shares, stable=stable)[of]
    return found
