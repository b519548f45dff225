"""Views whose poses do not fit the other views, by their votes on the spots that these found."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, Mask

CONTRADICTS, MANY = 0.04, 50
"""Two views contradict each other if one sees through more than this share of the spots, MANY or more, of the other."""

MISPLACED, SPREAD = 0.1, 0.05
"""A frame of a group that contradicts a larger one is misplaced if more than MISPLACED of its spots are seen through,
and if it shows another surface at more than SPREAD of them in a third of its image."""

MOST_OF_PAIRS = 1 << 13
"""Spots, about, by which each two views are held against each other."""

LEAST_SEEN = 2
"""Views of the trusted groups that see a spot at least, by which the other views are judged."""


def fitting(
    votes: npt.NDArray[np.uint8], depth_views: Int64, finding_view: npt.NDArray[np.int32], views: int
) -> tuple[Mask, Float64]:
    """Return which views (V,) fit the others, and the share (V,) of their spots that each sees through.

    Views that fit one another are a group, of which each fits another one at least. Groups that contradict a larger one
    are misplaced, but for views that see through little of what the others see, or in few parts of the image alone: a
    large thing that moves is there.
    """
    from semstab.statistics.loops.moving import HIDDEN, SEEN, SIDES, THROUGH

    parts, (trusted, against) = SIDES * SIDES, _trusted(votes)
    num_seen, through = np.zeros((2, votes.shape[1]), np.int32)
    for view_votes in votes[trusted]:
        num_seen += view_votes & 3 == SEEN
        through += view_votes & 3 == THROUGH
    usual = (num_seen >= np.maximum(through, LEAST_SEEN)) & np.isin(finding_view, depth_views[~trusted], invert=True)
    counts = np.zeros((len(depth_views), parts, 4), np.int64)
    for k, view_votes in enumerate(votes):
        votes_on_others = view_votes[usual & (finding_view != depth_views[k])]
        counts[k] = np.bincount(votes_on_others, minlength=4 * parts).reshape(parts, 4)
    away, seen_there = counts[..., THROUGH], counts[..., SEEN]
    shares, fits = np.full(views, np.nan), np.ones(views, np.bool_)
    with np.errstate(invalid="ignore"):
        shares[depth_views] = np.fmax(away.sum(axis=1) / (away + seen_there).sum(axis=1), against)
    spread = _is_spread(away + counts[..., HIDDEN], counts[..., 1:].sum(axis=2))
    fits[depth_views] = trusted | ~(spread & (shares[depth_views] > MISPLACED))
    return fits, shares


def _trusted(votes: npt.NDArray[np.uint8]) -> tuple[Mask, Float64]:
    """Return which views (k,) are in a group that contradicts no larger one, by their votes (k, n).

    With it, the share (k,) of the spots of these views and of each view that one sees and the other sees through.
    """
    from scipy.sparse.csgraph import connected_components

    away, num_decided = _of_pairs(votes)
    enough = num_decided >= MANY
    contradicts = enough & (away > CONTRADICTS * num_decided)
    _, group = connected_components(enough & ~contradicts, directed=False)
    trusted = np.zeros(len(votes), np.bool_)
    for number in np.argsort(-np.bincount(group, minlength=1), kind="stable"):
        members = group == number
        against = contradicts[members][:, trusted]
        if 2 * np.count_nonzero(against) <= np.count_nonzero(enough[members][:, trusted]):
            trusted |= members
    with np.errstate(invalid="ignore"):
        return trusted, away[:, trusted].sum(axis=1) / num_decided[:, trusted].sum(axis=1)


def _of_pairs(votes: npt.NDArray[np.uint8]) -> tuple[Int64, Int64]:
    """Return of how many spots, of some, that one of two views sees the other sees through (k, k), and tells at all."""
    from semstab.statistics.loops.moving import SEEN, THROUGH

    sample = votes[:, :: max(1, votes.shape[1] // MOST_OF_PAIRS)] & 3
    is_seen, through = ((sample == kind).astype(np.float32) for kind in (SEEN, THROUGH))
    away = through @ is_seen.T
    away += away.T
    return away.astype(np.int64), (away + 2 * (is_seen @ is_seen.T)).astype(np.int64)


def _is_spread(other: Int64, num_decided: Int64) -> Mask:
    """Return which views (n,) show other surfaces than the spots do in a third of the image, by counts (n, p)."""
    total = num_decided.sum(axis=1)
    counts = num_decided >= np.maximum(MANY, total[:, None]) / (10 * other.shape[1])
    spread = (other > SPREAD * num_decided) & counts
    return np.asarray((total >= MANY) & (3 * spread.sum(axis=1) >= counts.sum(axis=1)), np.bool_)
