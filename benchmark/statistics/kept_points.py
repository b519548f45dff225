"""The points of a LiDAR's view, as an image of directions, and its votes on spots."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Mask, UInt16
from semstab.data.frames import Pinhole

PIXELS, WIDER = 125_000, 1.1
"""Most pixels, about, of a view's image of directions, and the edge of a pixel by the distance of the points, at least:
256 views take 64 MB."""

REACH = 2.0
"""Distances of the points within which points around a spot tell of it: most have a ring above and a ring below."""

LIMIT, LIMIT_SIGMAS = 0.015, 0.9
"""A point is at a spot's depth if it differs by at most LIMIT, relative, or by LIMIT_SIGMAS standard deviations of how
depth differs between views. These hold errors of the planes through points, which votes have not."""

CLEAR = 1.2
"""A view sees through a spot if farther points are around it, and all others are CLEAR times as far away in the image,
at least: a fence in front of a car, or a wall beside it, does not keep the view from telling that the car left."""

SPAN = 0.3
"""A view sees a spot between points whose depths differ by at most SPAN, relative, too: a steep surface."""

SAME, SAME_REACH = 0.6, 1.25
"""A spot is at a point if a point at most SAME_REACH distances of the points away has its depth, up to SAME of what
LIMIT allows. A plane through points of two surfaces has other places, too, at which there is nothing."""


@dataclass(frozen=True, eq=False)
class KeptPoints:
    """The nearest depth in each direction in which a view of a LiDAR has points.

    Attributes:
        view: Its number.
        T_wc: (4, 4) its pose.
        camera: Focal lengths and principal point in pixels; of a scan, pixels in a radian.
        around: Whether columns close a circle.
        stride: Edge of a pixel here, in pixels of the camera.
        spacing: Distance of the points in pixels of the camera.
        top: Rows above the first one that has points.
        near: (rows, columns) uint16 codes of the nearest depth, 0 without points.
    """

    view: int
    T_wc: Float64
    camera: Pinhole
    around: bool
    stride: float
    spacing: float
    top: int
    near: UInt16

    @classmethod
    def from_points(
        cls,
        view: int,
        T_wc: Float64,
        camera: Pinhole,
        around: bool,
        spacing: float,
        shape: tuple[int, int],
        points: tuple[Float64, Float64, Float64],
    ) -> KeptPoints:
        """Keep points by image coordinates and inverse depth, `spacing` pixels apart, of an image of this shape."""
        from semstab.statistics.loops.moving_points import nearest_in_pixels

        v = points[1][points[2] > 0]
        low, high = (float(v.min()), float(v.max())) if len(v) else (0.0, 0.0)
        stride = max(WIDER * spacing, math.sqrt((high - low + 1) * shape[1] / PIXELS), 1.0)
        columns = max(1, round(shape[1] / stride)) if around else math.ceil(shape[1] / stride)
        stride = shape[1] / columns if around else stride
        top, bottom = (math.floor((row + 0.5) / stride) for row in (low, high))
        near = np.empty((bottom - top + 1, columns), np.uint16)
        nearest_in_pixels(*points, stride, top, near)
        return cls(view, T_wc, camera, around, stride, spacing, top, near)

    def gap(self, sigma: float) -> float:
        """Return how much farther than a spot points are at least, relative, if a view sees through it."""
        return max(LIMIT, LIMIT_SIGMAS * sigma)

    def votes(self, point: Float64, sigma: float) -> npt.NDArray[np.uint8]:
        """Return the vote (n,) on points (n, 3); depth of a surface differs by `sigma`, relative, between views."""
        return self._votes(point, REACH, self.gap(sigma), SPAN)

    def at_points(self, point: Float64, sigma: float) -> Mask:
        """Return which places (n, 3) that this view found lie at its points, and not between two surfaces."""
        from semstab.statistics.loops.moving import SEEN

        return np.asarray(self._votes(point, SAME_REACH, SAME * self.gap(sigma), 0.0) & 3 == SEEN, np.bool_)

    def _votes(self, point: Float64, distances: float, limit: float, span: float) -> npt.NDArray[np.uint8]:
        """Return the vote (n,) on points (n, 3), by the points within `distances` distances of points."""
        from semstab.statistics.loops.moving_points import vote_by_points

        votes = np.empty(len(point), np.uint8)
        place = self.T_wc, self.camera, self.around, self.stride, self.top, self.near
        reach = distances * self.spacing / self.stride
        vote_by_points(point, *place, reach, CLEAR, codes(limit), codes(span), votes)
        return votes


def codes(farther: float) -> int:
    """Return by how many codes depth differs that is farther by this, relative."""
    from semstab.statistics.loops.moving import STEP

    return math.ceil(math.log1p(farther) / STEP)
