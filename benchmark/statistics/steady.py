"""Is a place stable? A probability, because a few frames that agree say less than many.

Frames agree or not by chance: of places that all err in one frame of ten, those that three frames saw look perfect more
often than those that thirty saw. So a place borrows from what all places of its map are like.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from semstab.model.measures import vss
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import STABLE

Float64 = npt.NDArray[np.float64]

LIKELY = 0.5
"""A place is called stable from this probability on."""

STEPS, ROUNDS = 80, 200
"""Shares of the dominant class that a place may have, between 1/2 and 1, and rounds to find how many have which."""


def stable_share(agreement: float = STABLE) -> float:
    """The share p of the dominant class from which two frames agree with that probability: p^2 + (1 - p)^2."""
    return (1 + math.sqrt(2 * agreement - 1)) / 2


def steady(table: VoxelTable, *, stable: float = STABLE) -> Float64:
    """(n,) the probability that a place is stable, given its frames and what all places are like; NaN where OP < 2.

    Of T frames m vote for the dominant class, which happens with the probability b(m; T, p) + b(T - m; T, p) where its
    share is p. How many places have which p is estimated from all of them without any form of its distribution (Kiefer
    and Wolfowitz 1956, Annals of Mathematical Statistics 27; by the EM algorithm), then Bayes' theorem is applied.
    """
    from scipy.special import xlog1py, xlogy

    again = table.op >= 2
    T = table.op[again].astype(np.int64)
    found = np.full(len(table), np.nan)
    if not len(T):
        return found
    votes = np.rint(vss(table)[again] * T).astype(np.int64)
    pairs, of, count = np.unique(votes + T * (T.max() + 1), return_inverse=True, return_counts=True)
    seen, most = np.divmod(pairs, T.max() + 1)
    p = 0.5 + 0.5 * (np.arange(STEPS) + 0.5) / STEPS
    m, t = most[:, None], seen[:, None]
    own, folded = xlogy(m, p) + xlog1py(t - m, -p), xlogy(t - m, p) + xlog1py(m, -p)
    likelihood = np.exp(np.logaddexp(own, folded) - np.logaddexp(own, folded).max(axis=1, keepdims=True))
    share = np.full(STEPS, 1 / STEPS)
    for _ in range(ROUNDS):
        posterior = likelihood * share
        posterior /= posterior.sum(axis=1, keepdims=True)
        share = count @ posterior / count.sum()
    posterior = likelihood * share
    posterior /= posterior.sum(axis=1, keepdims=True)
    found[again] = posterior[:, p >= stable_share(stable)].sum(axis=1)[of]
    return found
