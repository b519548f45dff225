"""One view's pixels as another view sees them, by depth and pose, with an occlusion test."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Float64, Int32, Mask
from semstab.data.frames import Frame, pinhole
from semstab.data.labels import fixed
from semstab.errors import ConfigError

DEPTH_TOLERANCE = 0.01
"""Two views see the same surface where the depths that they give it differ by at most this share of its distance."""

LEAST_DENSITY = 0.5
"""Depth is sparse where fewer of the neighbours of pixels with depth have depth, see `density`: then most points that
another view looks up meet none. A LiDAR of 64 beams has .04 in an image of 1241x376, depth cameras have .6 and more."""


def density(depth: Float32) -> float:
    """Return the share of the neighbours, to the side and below, of pixels with depth that have depth too, 0 to 1.

    It is about the chance that a point, seen by two views, meets depth in both. NaN if no pixel has depth.
    """
    has_depth = (depth > 0) & (depth < np.inf)
    pairs = ((has_depth[:, 1:], has_depth[:, :-1]), (has_depth[1:], has_depth[:-1]))
    num_pairs = sum(np.count_nonzero(a & b) for a, b in pairs)
    num_with_depth = sum(np.count_nonzero(a) + np.count_nonzero(b) for a, b in pairs)
    return 2 * num_pairs / num_with_depth if num_with_depth else math.nan


@dataclass(frozen=True, eq=False)
class Correspondence:
    """The pixel of another view that sees the surface point behind each pixel of a frame.

    Attributes:
        pixel: (H, W) int32 flat index into the other view's images, -1 if it does not see the point.
    """

    pixel: Int32

    @property
    def visible(self) -> Mask:
        """(H, W): the point is in the other view's image, in front of it and not occluded."""
        return self.pixel >= 0

    def bring(self, values: npt.NDArray[Any], fill: Any = 0) -> npt.NDArray[Any]:
        """Return values (H', W', ...) of the other view at the frame's pixels, (H, W, ...).

        Pixels that the other view does not see get `fill`.
        """
        flat = values.reshape(-1, *values.shape[2:])
        brought: npt.NDArray[Any] = flat[self.pixel]
        brought[~self.visible] = fill
        return brought


def correspond(frame: Frame, other: Frame, *, depth_tolerance: float = DEPTH_TOLERANCE) -> Correspondence:
    """Look each pixel of `frame` up in `other` (backward warping, nearest pixel).

    A pixel with valid depth is back-projected, moved into the other camera and projected; there the nearest pixel's
    depth must be valid and differ from the point's distance z along the optical axis by at most depth_tolerance * z,
    else the point is occluded; infinity switches this test off. Labels do not matter. The frames may differ in size
    and intrinsics.

    Raises:
        ConfigError: If the tolerance is not above 0 and below 1, and not infinity.
    """
    from semstab.pixels.kernels import look_up

    if not 0 < depth_tolerance < 1 and depth_tolerance != math.inf:
        raise ConfigError(f"depth_tolerance = {depth_tolerance:g}: use a share of the distance, above 0 and below 1")
    camera = other.intrinsics
    pixel = np.empty(frame.shape, dtype=np.int32)
    look_up(
        fixed(frame.depth), frame.rays, by_rows(motion(frame, other)), fixed(other.depth),
        pinhole(camera), depth_tolerance, pixel,
    )  # fmt: skip
    return Correspondence(pixel)


def warp(
    values: npt.NDArray[Any], source: Frame, target: Frame, *, depth_tolerance: float = DEPTH_TOLERANCE, fill: Any = 0
) -> tuple[npt.NDArray[Any], Mask]:
    """Return values (H, W, ...) of source pixels (H', W', ...) as the target sees them, and the mask of seen pixels.

    Labels, scores, colours: the nearest pixel's value, never a mixture. See `correspond`.
    """
    correspondence = correspond(target, source, depth_tolerance=depth_tolerance)
    return correspondence.bring(values, fill), correspondence.visible


def motion(frame: Frame, other: Frame) -> Float64:
    """Return (3, 4) from the frame's camera axes to the other's; exact for large coordinates, which cancel first."""
    R = np.linalg.inv(other.T_wc[:3, :3])  # not the transpose: poses are orthonormal to 1e-3 only
    t = frame.T_wc[:3, 3] - other.T_wc[:3, 3]
    return np.column_stack([R @ frame.T_wc[:3, :3], R @ t])


def by_rows(matrix: Float64) -> tuple[tuple[float, ...], ...]:
    """Return a matrix as tuples, which compiled loops hold in registers."""
    return tuple(tuple(row) for row in matrix.tolist())


# Beliefs of one view's pixels, carried into the next view by depth and pose.


def carry(belief: Float32, source: Frame, target: Frame, *, depth_tolerance: float = DEPTH_TOLERANCE) -> Float32:
    """Return beliefs (H', W', K) of the source's pixels as the target's pixels see them (H, W, K), 0 without a belief.

    Backward warping, linear between the beliefs of the four nearest pixels that see the same surface: their depth
    differs from the point's distance z by at most depth_tolerance * z, and they have a belief. Nearest pixels, carried
    on from frame to frame, would stay behind a camera that moves by less than half a pixel.
    """
    from semstab.pixels.kernels import blend

    H, W = target.shape
    camera = source.intrinsics
    carried = np.zeros((H, W, belief.shape[2]), dtype=np.float32)
    blend(
        fixed(target.depth), target.rays, by_rows(motion(target, source)), fixed(source.depth),
        pinhole(camera), depth_tolerance, np.ascontiguousarray(belief), carried,
    )  # fmt: skip
    return carried
