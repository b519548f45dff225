"""Votes on spots, and which spots moved by them: views that see the surface at a spot, or see through it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, Mask, UInt16

LEAST_THROUGH, SHARE_THROUGH = 2, 1 / 3
"""A spot moved if LEAST_THROUGH views see through it, and more than SHARE_THROUGH of the views that see it or through
it."""

LEAST_AT_END = 3
"""It moved, too, if as many views see through it before the first one that sees it, or after the last one: it came, or
left, and stood for longer than it was away."""

LEAST_VOTES = 2
"""Views that see a spot or see through it, below which it is unknown whether it moved."""

NEXT_TO, LEAST_NEXT_TO, STEPS = 1.5, 2, 2
"""An unknown spot moved if LEAST_NEXT_TO spots or more within NEXT_TO spacings of spots moved, and half of those there
that are known; then so did unknown spots next to it, STEPS steps in all. Most such spots lie at an edge of the depth of
a thing that moved, which no view tells."""

SHARE_OF_SUSPECTS = 1 / 4
"""A spot is suspect if a view sees through it, and at least this share of the views that see it or through it. With
LEAST_NEXT_TO spots within NEXT_TO spacings that are suspect, too, or moved, and at least as many as are static, it
moved: what errors do to one spot they seldom do to the spots next to it."""

NEXT_TO_OF_POINTS = 2.5
"""Spacings of spots within which an unknown spot is next to others, of points: more of these are unknown."""

LONE, SHARE_OF_LONE = 2.5, 1 / 4
"""A spot that moved, by points, is lone if no other spot within LONE spacings moved, or less than SHARE_OF_LONE of the
known ones there: few rays meet leaves and wires. Views that see through it do not count."""

NEIGHBOURS = round(math.pi * NEXT_TO**2) - 1
"""Spots, about, within NEXT_TO spacings of a spot."""

OF_SPOTS = ("seen", "hidden", "through", "at_end", "next_to")
"""Votes on each spot, and whether it is next to spots that moved, by name."""


def has_moved(through: npt.NDArray[Any], votes: npt.NDArray[Any], at_end: npt.NDArray[Any]) -> Mask:
    """Return what moved: enough views see through it and more than SHARE_THROUGH of all, or enough at an end."""
    many = (through >= LEAST_THROUGH) & (through > SHARE_THROUGH * votes)
    return np.asarray(many | (at_end >= LEAST_AT_END), np.bool_)


def is_suspect(through: npt.NDArray[Any], votes: npt.NDArray[Any]) -> Mask:
    """Return what a view sees through, and SHARE_OF_SUSPECTS of all votes at least."""
    return np.asarray((through >= 1) & (through >= SHARE_OF_SUSPECTS * votes), np.bool_)


def confirmed(point: Float64, suspect: Mask, moved: Mask, static: Mask, spacing: float) -> Mask:
    """Return which suspect spots (n,) have enough spots around that moved or are suspect, too."""
    from scipy.spatial import cKDTree

    trees = cKDTree(point[moved | suspect]), cKDTree(point[static & ~suspect])
    near, stayed = (tree.query_ball_point(point[suspect], NEXT_TO * spacing, return_length=True) for tree in trees)
    confirmed: Mask = np.zeros(len(point), np.bool_)
    confirmed[suspect] = (near - 1 >= LEAST_NEXT_TO) & (near - 1 >= stayed)  # without the spot itself
    return confirmed


def next_to_moved(point: Float64, moved: Mask, static: Mask, spacing: float, within: float = NEXT_TO) -> Mask:
    """Return which spots (n,) are neither moved nor static, and next to spots that moved, in up to STEPS steps."""
    from scipy.spatial import cKDTree

    next_to: Mask = np.zeros(len(point), np.bool_)
    stayed = cKDTree(point[static])
    for _ in range(STEPS):
        unknown, of_moved = np.flatnonzero(~moved & ~static & ~next_to), point[moved | next_to]
        if not len(unknown) or len(of_moved) < LEAST_NEXT_TO:
            break
        near = cKDTree(of_moved).query_ball_point(point[unknown], within * spacing, return_length=True)
        unknown, near = unknown[near >= LEAST_NEXT_TO], near[near >= LEAST_NEXT_TO]
        next_to[unknown] = near >= stayed.query_ball_point(point[unknown], within * spacing, return_length=True)
    return next_to


def lone(point: Float64, moved: Mask, static: Mask, spacing: float) -> Mask:
    """Return which spots (n,) that moved have too few around that moved, too, by number or by share of the known."""
    from scipy.spatial import cKDTree

    lone, of_moved = moved.copy(), point[moved]
    trees = cKDTree(of_moved), cKDTree(point[static])
    near, stayed = (tree.query_ball_point(of_moved, LONE * spacing, return_length=True) for tree in trees)
    near = near - 1  # without the spot itself
    lone[moved] = (near == 0) | (near < SHARE_OF_LONE * (near + stayed))
    return lone


@dataclass(frozen=True, eq=False)
class SpotVotes:
    """How many views see each spot, have it hidden, or see through it, and which frames do not fit the others.

    Attributes:
        seen, hidden, through: (n,) uint16 views of each spot, without those that are misplaced; 0 of a spot that was
            found in one of these.
        at_end: (n,) uint16 of those that see through it, the ones before the first that sees it, or after the last.
        next_to: (n,) spots of which too few views tell, next to spots that moved, or suspect ones.
        through_of_view: (V,) share of the spots of other views that a view sees through, of those that it sees or sees
            through; NaN of views whose depth was not kept.
        misplaced: (V,) views that see through many spots all over the image.
        between: (2,) votes before and after which a view sees the spot, and those of them that see through it.
        gap: By how much farther than a spot a surface is, relative, that shows that a view sees through it.
    """

    seen: UInt16
    hidden: UInt16
    through: UInt16
    at_end: UInt16
    next_to: Mask
    through_of_view: Float64
    misplaced: Mask
    between: Int64
    gap: float

    @property
    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """(n,) the votes on each spot, and whether it is next to spots that moved, by name."""
        return {name: getattr(self, name) for name in OF_SPOTS}

    def of_views(self) -> dict[str, Any]:
        """Return what is known of views, for JSON."""
        shares = [None if math.isnan(share) else share for share in self.through_of_view.tolist()]
        lists = {"misplaced": np.flatnonzero(self.misplaced).tolist(), "between": self.between.tolist()}
        return {"through_of_view": shares, **lists, "gap": self.gap}

    @classmethod
    def from_columns(cls, columns: Mapping[str, npt.NDArray[Any]], of_views: Mapping[str, Any]) -> SpotVotes:
        """Build votes from columns (n,) by name, and what `of_views` returned.

        Raises:
            IndexError: If a misplaced view is not there.
        """
        shares = np.array([math.nan if share is None else share for share in of_views["through_of_view"]], np.float64)
        misplaced = np.zeros(len(shares), np.bool_)
        misplaced[np.array(of_views["misplaced"], np.int64)] = True
        between = np.array(of_views["between"], np.int64).reshape(2)
        num_seen, hidden, through, at_end = (columns[name].astype(np.uint16) for name in OF_SPOTS[:4])
        next_to = columns["next_to"].astype(np.bool_)
        return cls(num_seen, hidden, through, at_end, next_to, shares, misplaced, between, float(of_views["gap"]))

    @property
    def votes(self) -> Int64:
        """(n,) views that see a spot or see through it."""
        return self.seen.astype(np.int64) + self.through

    @property
    def moved(self) -> Mask:
        """(n,) spots that moved: by the votes of views, or by the spots next to them."""
        return has_moved(self.through, self.votes, self.at_end) | self.next_to

    @property
    def static(self) -> Mask:
        """(n,) spots that did not move: at most SHARE_THROUGH of enough votes see through it, and few at an end."""
        few = (self.through <= SHARE_THROUGH * self.votes) & (self.at_end < LEAST_AT_END)
        return np.asarray((self.votes >= LEAST_VOTES) & few & ~self.next_to, np.bool_)

    @property
    def decided(self) -> Mask:
        """(n,) spots of which it is known whether they moved."""
        return self.moved | self.static

    @property
    def false_rate(self) -> float:
        """Share of the votes on what stayed that see through it, from votes between two that see the spot."""
        return float((self.between[1] + 0.5) / (self.between[0] + 1))

    @property
    def false_share(self) -> float:
        """Largest share of the spots known by votes that errors alone call moved, if they meet views independently.

        Of n votes, r see through the spot with the probability b(r; n, q), where q is `false_rate`; the first or the
        last LEAST_AT_END of them with at most 2 q^LEAST_AT_END. A spot is suspect with the probability s(n, q), and
        LEAST_NEXT_TO of NEIGHBOURS other spots are, too, with the mean of these probabilities.
        """
        from scipy import special

        n, count = np.unique(self.votes[self.decided & (self.votes >= LEAST_VOTES)], return_counts=True)
        if not len(n):
            return math.nan
        least = np.maximum(LEAST_THROUGH, np.floor(SHARE_THROUGH * n + 1e-9) + 1)
        at_end = np.where(least > LEAST_AT_END, 2 * self.false_rate**LEAST_AT_END, 0.0)  # fewer need no such run
        suspect = special.bdtrc(np.maximum(np.ceil(SHARE_OF_SUSPECTS * n), 1) - 1, n, self.false_rate)
        around = special.bdtrc(LEAST_NEXT_TO - 1, NEIGHBOURS, suspect @ count / count.sum())
        moved = np.minimum(special.bdtrc(least - 1, n, self.false_rate) + at_end + suspect * around, 1.0)
        return float(moved @ count / count.sum())

    def by_neighbours(self, point: Float64, spacing: float, within: float = NEXT_TO) -> Mask:
        """Return which spots (n,) at `point` (n, 3) moved by those around: suspect ones, and unknown ones.

        Unknown ones are next to spots that are within `within` spacings.
        """
        suspect = is_suspect(self.through, self.votes) & ~self.moved
        told = confirmed(point, suspect, self.moved, self.static, spacing)
        return told | next_to_moved(point, self.moved, self.static, spacing, within)

    def take(self, rows: Any) -> SpotVotes:
        """Return the votes on some of the spots."""
        return dataclasses.replace(self, **{name: column[rows] for name, column in self.columns.items()})
