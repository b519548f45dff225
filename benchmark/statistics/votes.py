"""Votes on which spots moved: views that see the surface at a spot, and views that see through it.

The depth of up to MOST_KEPT views is kept, coarsely, so that each spot is looked up in views before it was found and
after it. A view sees through a spot if all that it shows there, some pixels around included, is farther than the spot
by more than errors of depth and poses explain. A nearer surface hides the spot, which says nothing.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, Mask, UInt16
from semstab.data.frames import Frame
from semstab.statistics.kept_points import KeptPoints, codes
from semstab.statistics.misplaced import fitting

MOST_KEPT = 256
"""Most views whose depth is kept; of more views, every second, fourth, ... one is."""

BLOCKS = 20_000
"""Blocks of pixels, about, of a view's depth."""

GAP, GAP_SIGMAS = 0.01, 5.0
"""The surface in a spot's own block is farther than the spot if it is by more than GAP, relative, and by more than
GAP_SIGMAS standard deviations of how depth differs between views."""

AROUND = 2
"""Blocks to each side of a spot that a view must show farther away to see through it: errors of poses and of edges of
depth move things sidewards in an image. Holes count as near in the next blocks."""

ASIDE, ASIDE_SIGMAS = 0.003, 4.0
"""In the blocks around, what is farther by more than ASIDE, relative, and by more than ASIDE_SIGMAS standard deviations
is not the spot's surface. The ground at which a thing stands comes near to the thing there."""

REACH = 0.25
"""Blocks to each side, a pixel at least, in which the view that found a spot must see a smooth surface."""

EDGE, EDGE_SIGMAS = 0.05, 6.0
"""Inverse depth of the pixels around a spot differs by EDGE, relative, and EDGE_SIGMAS standard deviations of noise,
at most: else the spot is at an edge of depth, or seen at a grazing angle."""

SAME, SAME_SIGMAS = 0.01, 2.0
"""At an edge a spot is told, too, if inverse depth of more than half of the pixels around differs from it by at most
SAME, relative, and SAME_SIGMAS standard deviations of noise."""

NEAR_BY, NEAR_BY_SIGMAS = 0.003, 3.0
"""A view sees a spot if depth there differs by at most NEAR_BY, relative, and by NEAR_BY_SIGMAS standard deviations."""

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

LONE, LEAST_OF_LONE, SHARE_OF_LONE = 2.5, 2, 1 / 3
"""A spot that moved, by points, is lone if fewer than LEAST_OF_LONE other spots within LONE spacings moved, or less
than SHARE_OF_LONE of the known ones there: few rays meet leaves and wires. Views that see through it do not count."""

NEIGHBOURS = round(math.pi * NEXT_TO**2) - 1
"""Spots, about, within NEXT_TO spacings of a spot."""

OF_SPOTS = ("seen", "hidden", "through", "at_end", "next_to")
"""Votes on each spot, and whether it is next to spots that moved, by name."""


@dataclass(frozen=True, eq=False)
class KeptDepth:
    """The dense depth of a view in blocks of pixels.

    Attributes:
        view: Its number.
        T_wc: (4, 4) its pose.
        camera: Focal lengths and principal point in pixels.
        stride: Edge of a block in pixels.
        near, far: (rows, columns) uint16 codes of the nearest and the farthest depth.
    """

    view: int
    T_wc: Float64
    camera: tuple[float, float, float, float]
    stride: float
    near: UInt16
    far: UInt16

    @classmethod
    def of_image(
        cls, view: int, T_wc: Float64, camera: tuple[float, float, float, float], depth: npt.NDArray[Any]
    ) -> KeptDepth:
        """Keep depth (H, W)."""
        from semstab.statistics.loops.moving import blocks_of_image

        stride = max(1, round(math.sqrt(depth.size / BLOCKS)))
        near, far = np.empty((2, depth.shape[0] // stride, depth.shape[1] // stride), np.uint16)
        blocks_of_image(depth, stride, *np.empty((3, depth.shape[1]), depth.dtype), near, far)
        return cls(view, T_wc, camera, float(stride), near, far)

    def gap(self, sigma: float) -> float:
        """Return how much farther than a spot a surface is at least, relative, if a view sees through the spot."""
        return gap_of(sigma)

    def votes(self, point: Float64, sigma: float) -> npt.NDArray[np.uint8]:
        """Return the vote (n,) on points (n, 3); depth of a surface differs by `sigma`, relative, between views."""
        from semstab.statistics.loops.moving import vote

        votes = np.empty(len(point), np.uint8)
        limits = (codes(limit_of(sigma)) for limit_of in (gap_of, aside_of, near_by_of))
        vote(point, self.T_wc, self.camera, self.stride, self.near, self.far, AROUND, *limits, votes)
        return votes


class DepthMemory:
    """The depth of some of the views of a flight, evenly over it."""

    def __init__(self) -> None:
        self.kept: list[KeptDepth | KeptPoints] = []
        self._step = 1

    def wants(self, view: int) -> bool:
        """Return whether the depth of a view is to be kept: it is new, and its number is a multiple of the step."""
        return view % self._step == 0 and (not self.kept or view > self.kept[-1].view)

    def add(self, depth: KeptDepth | KeptPoints) -> None:
        """Keep the depth of a view; of more than MOST_KEPT every second one is dropped."""
        self.kept.append(depth)
        while len(self.kept) > MOST_KEPT:
            self._step *= 2
            self.kept = [view_depth for view_depth in self.kept if view_depth.view % self._step == 0]

    def votes_on(
        self, point: Float64, found: npt.NDArray[np.int32], firm: Mask, views: int, sigma: float, spacing: float
    ) -> SpotVotes:
        """Return what the kept views say of spots.

        Args:
            point: (n, 3) spots in metres.
            found: (n,) the view that found each spot.
            firm: (n,) spots that lie at no edge of depth. The others have no votes; but if LEAST_VOTES views see one
                and none sees through it, the spots next to it do not tell that it moved, and of points it is static.
            views: Number of views.
            sigma: Standard deviation of how depth differs between views, relative.
            spacing: Distance of spots in metres; with 0 no spot is told by those next to it.
        """
        votes = np.zeros((len(self.kept), len(point)), np.uint8)
        for view_votes, depth in zip(votes, self.kept, strict=True):
            view_votes[:] = depth.votes(point, sigma)
        at_edge, votes = votes * ~firm, votes * firm
        depth_views = np.array([depth.view for depth in self.kept], np.int64)
        fits, shares = fitting(votes, depth_views, found, views)
        counts, at_end, between = _tallied(votes, fits[depth_views])
        counts[~fits[found]] = at_end[~fits[found]] = 0
        num_seen, hidden, through = counts.T.copy()
        seen_at_edge, _, through_at_edge = _tallied(at_edge, fits[depth_views])[0].T
        stays = (seen_at_edge >= LEAST_VOTES) & (through_at_edge == 0)
        next_to = np.zeros(len(point), np.bool_)
        alone = SpotVotes(num_seen, hidden, through, at_end, next_to, shares, ~fits, between, self._gap(sigma))
        rows = np.flatnonzero(fits[found] & ~stays)
        within = NEXT_TO_OF_POINTS if self._of_points else NEXT_TO
        next_to[rows] = alone.take(rows).by_neighbours(point[rows], spacing, within)
        if self._of_points and spacing > 0:
            counted = ~lone(point, alone.moved, alone.static, spacing)
            through, at_end, next_to = through * counted, at_end * counted, next_to & counted
        if self._of_points:
            num_seen = np.where(stays & fits[found], seen_at_edge, num_seen)
        return dataclasses.replace(alone, seen=num_seen, through=through, at_end=at_end, next_to=next_to)

    @property
    def _of_points(self) -> bool:
        """True if the depth is of the points of a LiDAR."""
        return bool(self.kept) and isinstance(self.kept[0], KeptPoints)

    def _gap(self, sigma: float) -> float:
        """Return how much farther than a spot a surface is at least, relative, that shows that a view sees through."""
        return self.kept[0].gap(sigma) if self.kept else gap_of(sigma)

    def moving_pixels(
        self, frame: Frame, sigma: float, misplaced: Mask, spacing: float, *, sparse: bool = False
    ) -> Mask:
        """Return the pixels (H, W) of a frame whose surface moved: the kept views, but for misplaced ones, tell.

        Places in blocks of pixels are asked, of sparse depth all pixels that have it, but for lone ones by the spacing
        of spots, metres; pixels next to such blocks move, too, if they go on at the same depth.
        """
        step = 1 if sparse else max(1, round(math.sqrt(frame.depth.size / BLOCKS)))
        depth = frame.depth[step // 2 :: step, step // 2 :: step].astype(np.float64)
        valid, K = (depth > 0) & (depth < np.inf), frame.intrinsics
        row, column = (step // 2 + step * indices for indices in np.nonzero(valid))
        z = depth[valid]
        rays = np.stack([(column - K.cx) / K.fx, (row - K.cy) / K.fy, np.ones(len(z))], axis=1)
        point = (rays * z[:, None]) @ frame.T_wc[:3, :3].T + frame.T_wc[:3, 3]
        kept = [view_depth for view_depth in self.kept if not misplaced[view_depth.view]]
        votes = np.zeros((len(kept), len(point)), np.uint8)
        for view_votes, view_depth in zip(votes, kept, strict=True):
            view_votes[:] = view_depth.votes(point, sigma)
        counts, at_end, _ = _tallied(votes, np.ones(len(kept), np.bool_))
        num_seen, _, through = counts.astype(np.int64).T
        moves = np.zeros(depth.shape, np.bool_)
        moved = has_moved(through, num_seen + through, at_end)
        if self._of_points:
            moved &= ~lone(point, moved, (num_seen + through >= LEAST_VOTES) & ~moved, spacing)
        moves[valid] = moved
        small = _grown(moves, np.where(valid, depth, np.nan), self._gap(sigma))
        mask = small.repeat(step, axis=0).repeat(step, axis=1)
        bottom, right = (max(0, n - m) for n, m in zip(frame.depth.shape, mask.shape, strict=True))
        mask = np.pad(mask, ((0, bottom), (0, right)), mode="edge")
        return np.asarray(mask[: frame.depth.shape[0], : frame.depth.shape[1]], np.bool_)


def _grown(moves: Mask, depth: Float64, gap: float) -> Mask:
    """Return a mask (h, w) with the pixels next to it that have the same depth but for a gap, twice."""
    for _ in range(AROUND):
        padded, around = np.pad(moves, 1), np.pad(depth, 1, constant_values=np.nan)
        grown = moves.copy()
        for b, a in itertools.product(range(3), range(3)):
            side = slice(b, b + depth.shape[0]), slice(a, a + depth.shape[1])
            grown |= padded[side] & (np.abs(around[side] - depth) <= gap * depth)
        moves = grown
    return moves


def _tallied(votes: npt.NDArray[np.uint8], counted: Mask) -> tuple[UInt16, UInt16, Int64]:
    """Return the counts of the votes (V, n) of the views that count (V,): see `tally`."""
    from semstab.statistics.loops.moving import tally

    counts, at_end = np.zeros((votes.shape[1], 3), np.uint16), np.zeros(votes.shape[1], np.uint16)
    between = np.zeros(2, np.int64)
    tally(votes, counted, counts, at_end, between)
    return counts, at_end, between


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
        trees = cKDTree(of_moved), stayed
        near = [tree.query_ball_point(point[unknown], within * spacing, return_length=True) for tree in trees]
        next_to[unknown] = (near[0] >= LEAST_NEXT_TO) & (near[0] >= near[1])
    return next_to


def lone(point: Float64, moved: Mask, static: Mask, spacing: float) -> Mask:
    """Return which spots (n,) that moved have too few around that moved, too, by number or by share of the known."""
    from scipy.spatial import cKDTree

    lone, of_moved = moved.copy(), point[moved]
    trees = cKDTree(of_moved), cKDTree(point[static])
    near, stayed = (tree.query_ball_point(of_moved, LONE * spacing, return_length=True) for tree in trees)
    near = near - 1  # without the spot itself
    lone[moved] = (near < LEAST_OF_LONE) | (near < SHARE_OF_LONE * (near + stayed))
    return lone


def gap_of(sigma: float) -> float:
    """Return how much farther than a spot a surface is at least, relative, that shows that a view sees through it."""
    return max(GAP, GAP_SIGMAS * sigma)


def aside_of(sigma: float) -> float:
    """Return how much farther than a spot, relative, a surface is at least that is not the spot's."""
    return max(ASIDE, ASIDE_SIGMAS * sigma)


def near_by_of(sigma: float) -> float:
    """Return how much nearer or farther than a spot, relative, a surface is at most that is the spot's."""
    return max(NEAR_BY, NEAR_BY_SIGMAS * sigma)


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
    def of(cls, columns: Mapping[str, npt.NDArray[Any]], of_views: Mapping[str, Any]) -> SpotVotes:
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
    def known(self) -> Mask:
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
        LEAST_NEXT_TO of NEIGHBOURS other spots are, too, with that of their mean.
        """
        from scipy import special

        n, count = np.unique(self.votes[self.known & (self.votes >= LEAST_VOTES)], return_counts=True)
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


def firm(
    point: Float64, T_wc: Float64, camera: tuple[float, float, float, float], depth: npt.NDArray[Any], noise: float
) -> Mask:
    """Return which points (n, 3) that an image (H, W) shows lie at no edge of its depth; `noise` is relative."""
    from semstab.statistics.loops.moving import on_one_surface

    firm = np.empty(len(point), np.bool_)
    reach = max(1, round(REACH * math.sqrt(depth.size / BLOCKS)))
    limits = EDGE + EDGE_SIGMAS * noise, SAME + SAME_SIGMAS * noise
    on_one_surface(point, T_wc, camera, depth, reach, *limits, firm)
    return firm
