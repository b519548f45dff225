"""LiDAR points seen by a camera: the pixels of a depth image that they fall on, without those that a surface hides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Float64
from semstab.data.frames import Intrinsics

NEAREST = 0.5
"""Metres from the camera up to which points are its own vehicle's."""

AROUND = (9, 5)
"""Rows and columns around a pixel in which a nearer surface hides what is behind it: beams lie far apart."""

BEHIND, BEHIND_METRES = 1.1, 0.3
"""Least distance of a hidden point, as a factor of the distance of the surface in front, plus metres."""


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """The points of a cloud that a camera sees, one a pixel.

    Attributes:
        v: (n,) rows of the pixels.
        u: (n,) columns of the pixels.
        depth: (n,) metres along the optical axis.
        points: (n,) numbers of the points in the cloud.
        shape: (H, W) of the image.
    """

    v: npt.NDArray[np.intp]
    u: npt.NDArray[np.intp]
    depth: Float64
    points: npt.NDArray[np.intp]
    shape: tuple[int, int]

    def depth_image(self) -> Float32:
        """Return (H, W) float32 in metres, 0 for pixels without a point."""
        image = np.zeros(self.shape, np.float32)
        image[self.v, self.u] = self.depth
        return image


def seen_points(
    points: npt.NDArray[np.floating[Any]], T_cl: Float64, K: Intrinsics, shape: tuple[int, int]
) -> SeenPoints:
    """Return what a camera of an image (H, W) sees of points (N, 3), metres, that T_cl (4, 4) brings to its axes.

    Of the points on one pixel the nearest is seen. A LiDAR stands elsewhere than the camera and sees past edges: a
    point is hidden where a surface around its pixel is nearer by 10 % and 0.3 m.
    """
    from scipy.ndimage import minimum_filter

    H, W = shape
    with np.errstate(all="ignore"):  # points that are not finite are not seen
        x, y, z = T_cl[:3, :3] @ points.astype(np.float64).T + T_cl[:3, 3:]
        u, v = np.rint(K.fx * x / z + K.cx), np.rint(K.fy * y / z + K.cy)
        (inside,) = np.nonzero((z > NEAREST) & np.isfinite(z) & (u >= 0) & (u < W) & (v >= 0) & (v < H))
    inside = inside[np.argsort(-z[inside], kind="stable")]  # the nearest is written last
    u, v, z = u[inside].astype(np.intp), v[inside].astype(np.intp), z[inside]
    nearest, last = np.full(shape, np.inf), np.full(shape, -1, np.intp)
    nearest[v, u], last[v, u] = z, np.arange(len(z))
    hidden = z > BEHIND * minimum_filter(nearest, size=AROUND)[v, u] + BEHIND_METRES
    visible = (last[v, u] == np.arange(len(z))) & ~hidden
    return SeenPoints(v[visible], u[visible], z[visible], inside[visible], shape)
