"""The up axis, where a dataset does not give it: the normal of the ground plane in the fused map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Mask
from semstab.data.voxels import VoxelTable
from semstab.errors import DataError

PLANES = 4
"""Planes that are considered, the largest first; the ground is one of them."""

THICKNESS = 0.01
"""A plane's points lie within this share of the scene's size on either side: ground is rough, and rises and falls."""

POINTS = 10_000
"""Points used, drawn at random from more."""

ITERATIONS, DRAW_CHUNKS = 2_000, 50
"""Draws of three points a plane, and parts of them whose points are counted together. They all lie in a plane of 15 %
of the points once in 300 draws."""


def estimate_up(points: VoxelTable | npt.ArrayLike, poses: Sequence[npt.ArrayLike] | npt.ArrayLike) -> Float64:
    """Return the world's up axis (3,): the normal, towards the cameras, of the plane that is likely the ground.

    Up in the image is up in the world for a level camera, and straight ahead for one that looks down. So of the largest
    planes of the map (RANSAC, seeded) the cameras see from above, the one with the largest share * cos(angle to the up
    of a camera that looks 27 degrees down) is taken: before a level camera a wall counts half as much as a floor.

    It is wrong where the ground is not among the largest planes (a façade filmed from the street, a tilted table top),
    where cameras are rolled by tens of degrees, and by the ground's own slope. Set `up_axis` instead then.

    Args:
        points: A fused map, whose voxels count by area; or world points (n, 3), metres.
        poses: (m, 4, 4) camera-to-world of the frames behind it, OpenCV axes; or (m, 3, 3): down, forward and centre.

    Raises:
        DataError: If there are fewer than 3 points, or no plane with the cameras above it.
    """
    at = points.centers if isinstance(points, VoxelTable) else np.asarray(points, dtype=np.float64)
    down, forward, centre = np.asarray(poses, dtype=np.float64)[:, :3, -3:].transpose(2, 0, 1)
    prior = -(2 * down + forward).mean(axis=0)
    prior /= np.linalg.norm(prior)
    planes = list(_planes(at, centre)) if len(at) >= 3 else []
    scores = [share * float(normal @ prior) for normal, share in planes]
    if max(scores, default=0.0) <= 0:
        raise DataError(
            f"there is no ground plane under the cameras in {len(at)} points; set the axis that points up (up_axis)"
        )
    return planes[int(np.argmax(scores))][0]


def _planes(points: Float64, cameras: Float64) -> Iterator[tuple[Float64, float]]:
    """Yield normal (3,) towards the cameras and share of points of the largest planes, each in what others left."""
    origin = np.median(points, axis=0)
    rest, cameras = points - origin, cameras - origin
    rng = np.random.default_rng(0)
    if len(rest) > POINTS:
        rest = rng.choice(rest, POINTS, replace=False, shuffle=False)
    total = len(rest)
    low, high = np.percentile(rest, [5, 95], axis=0)
    distance = THICKNESS * float(np.linalg.norm(high - low))
    for _ in range(PLANES):
        if len(rest) < 3 or distance == 0:
            return
        inlier = _largest_plane(rest, distance, rng)
        if not inlier.any():
            return
        mean = rest[inlier].mean(axis=0)
        normal = np.linalg.eigh(np.cov(rest[inlier].T))[1][:, 0]  # the least squares' plane of the inliers
        above = np.median((cameras - mean) @ normal) > 0
        yield normal if above else -normal, np.count_nonzero(inlier) / total
        rest = rest[~inlier]


def _largest_plane(points: Float64, distance: float, rng: np.random.Generator) -> Mask:
    """Return which points (n,) lie within a distance of that plane through three of them which has most (RANSAC).

    Open3D can do the same, but takes a second to load.
    """
    a, b, c = points[rng.integers(len(points), size=(3, ITERATIONS))]
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    offset = np.where(normal.any(axis=1), -(normal * a).sum(axis=1), np.inf)  # three points in a line are no plane
    plane = np.column_stack([normal, offset]).astype(np.float32)
    homogeneous = np.vstack([points.T, np.ones(len(points))]).astype(np.float32)
    within = [
        np.count_nonzero(np.abs(chunk @ homogeneous) <= distance, axis=1) for chunk in np.split(plane, DRAW_CHUNKS)
    ]
    inlier: Mask = np.abs(plane[int(np.argmax(np.concatenate(within)))] @ homogeneous) <= distance
    return inlier
