"""The depth of views, coarsely, and the votes that it gives spots.

The depth of up to MOST_KEPT views is kept, so that each spot is looked up in views before it was found and after it. A
view sees through a spot if all that it shows there, some pixels around included, is farther than the spot by more than
errors of depth and poses explain. A nearer surface hides the spot, which says nothing.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, Mask, UInt16
from semstab.data.frames import Frame, Pinhole
from semstab.statistics.kept_points import KeptPoints, codes
from semstab.statistics.misplaced import fitting
from semstab.statistics.votes import LEAST_VOTES, NEXT_TO, NEXT_TO_OF_POINTS, SpotVotes, has_moved, lone

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
    camera: Pinhole
    stride: float
    near: UInt16
    far: UInt16

    @classmethod
    def of_image(cls, view: int, T_wc: Float64, camera: Pinhole, depth: npt.NDArray[Any]) -> KeptDepth:
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
        nothing = np.zeros(len(point), np.bool_)
        alone = SpotVotes(num_seen, hidden, through, at_end, nothing, shares, ~fits, between, self._gap(sigma))
        rows, next_to = np.flatnonzero(fits[found] & ~stays), nothing.copy()
        within = NEXT_TO_OF_POINTS if self._of_points else NEXT_TO
        next_to[rows] = alone.take(rows).by_neighbours(point[rows], spacing, within)
        told = dataclasses.replace(alone, next_to=next_to)
        if not self._of_points:
            return told
        counted = ~(lone(point, told.moved, told.static, spacing) if spacing > 0 else nothing)
        return dataclasses.replace(
            told,
            seen=np.where(stays & fits[found], seen_at_edge, num_seen),
            through=through * counted,
            at_end=at_end * counted,
            next_to=next_to & counted,
        )

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
        well_placed = [view_depth for view_depth in self.kept if not misplaced[view_depth.view]]
        votes = np.zeros((len(well_placed), len(point)), np.uint8)
        for view_votes, view_depth in zip(votes, well_placed, strict=True):
            view_votes[:] = view_depth.votes(point, sigma)
        counts, at_end, _ = _tallied(votes, np.ones(len(well_placed), np.bool_))
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


def gap_of(sigma: float) -> float:
    """Return how much farther than a spot a surface is at least, relative, that shows that a view sees through it."""
    return max(GAP, GAP_SIGMAS * sigma)


def aside_of(sigma: float) -> float:
    """Return how much farther than a spot, relative, a surface is at least that is not the spot's."""
    return max(ASIDE, ASIDE_SIGMAS * sigma)


def near_by_of(sigma: float) -> float:
    """Return how much nearer or farther than a spot, relative, a surface is at most that is the spot's."""
    return max(NEAR_BY, NEAR_BY_SIGMAS * sigma)


def firm(point: Float64, T_wc: Float64, camera: Pinhole, depth: npt.NDArray[Any], noise: float) -> Mask:
    """Return which points (n, 3) that an image (H, W) shows lie at no edge of its depth; `noise` is relative."""
    from semstab.statistics.loops.moving import on_one_surface

    firm = np.empty(len(point), np.bool_)
    reach = max(1, round(REACH * math.sqrt(depth.size / BLOCKS)))
    limits = EDGE + EDGE_SIGMAS * noise, SAME + SAME_SIGMAS * noise
    on_one_surface(point, T_wc, camera, depth, reach, *limits, firm)
    return firm
