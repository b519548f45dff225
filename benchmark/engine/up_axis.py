"""Which way is up, where a dataset does not say: the normal of the ground plane, found in the fused map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Mask
from semstab.errors import DataError
from semstab.model.voxels import VoxelTable

PLANES = 4
"""Planes looked at, the largest first; the ground is one of them."""

THICKNESS = 0.01
"""A plane's points lie within this share of the scene's size on either side: ground is rough, and rises and falls."""

POINTS = 10_000
"""Points used, drawn at random from more."""

ITERATIONS = 2_000
"""Draws of three points a plane. They all lie in a plane of 15% of the points once in 300 draws."""

CHUNKS = 50
"""Parts of these draws whose points are looked at together."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane in the map.

    normal  (3,) unit vector towards the cameras
    share   of the points that lie in it, 0 to 1
    """

    normal: Float64
    share: float


def estimate_up(points: VoxelTable | npt.ArrayLike, poses: Sequence[npt.ArrayLike] | npt.ArrayLike) -> Float64:
    """The world's up axis (3,), a unit vector: the normal, towards the cameras, of the plane that is likely the ground.

    points  a fused map, whose voxels count by area; or world points (n, 3), metres
    poses   (m, 4, 4) camera-to-world of the frames behind it, OpenCV axes; or (m, 3, 3): down, forward and centre

    The cameras alone do not tell: up in their images is up in the world for a level camera, and straight ahead for one
    that looks down. So the largest planes of the map are found (RANSAC, seeded: the same input gives the same answer),
    and of those which the cameras see from above, the one with the largest share * cos(angle to the up of a camera that
    looks 27 degrees down) is taken: before a level camera a wall counts half as much as a floor of its size.

    It is wrong where the ground is not among the largest planes (a façade filmed from the street, a table top that is
    tilted), where cameras are rolled by tens of degrees, and by the ground's own slope. Say `up_axis` instead then.
    Raises DataError where there are fewer than 3 points, or no plane with the cameras above it.
    """
    at = points.centers if isinstance(points, VoxelTable) else np.asarray(points, dtype=np.float64)
    down, forward, centre = np.asarray(poses, dtype=np.float64)[:, :3, -3:].transpose(2, 0, 1)
    prior = _unit(-(2 * down + forward).mean(axis=0))
    planes = list(_planes(at, centre)) if len(at) >= 3 else []
    scores = [plane.share * float(plane.normal @ prior) for plane in planes]
    if max(scores, default=0.0) <= 0:
        raise DataError(f"no ground plane found under the cameras in {len(at)} points; say which axis is up (up_axis)")
    return planes[int(np.argmax(scores))].normal


def _planes(points: Float64, cameras: Float64) -> Iterator[Plane]:
    """The largest planes, each found among the points that the ones before it left."""
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
        yield Plane(normal if above else -normal, np.count_nonzero(inlier) / total)
        rest = rest[~inlier]


def _largest_plane(points: Float64, distance: float, rng: np.random.Generator) -> Mask:
    """Which points (n,) lie within a distance of that plane through three of them which has most (RANSAC).

    Here and not by Open3D, as a run that fuses without it takes a second to load it.
    """
    a, b, c = points[rng.integers(len(points), size=(3, ITERATIONS))]
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    offset = np.where(normal.any(axis=1), -(normal * a).sum(axis=1), np.inf)  # three points in a line are no plane
    plane = np.column_stack([normal, offset]).astype(np.float32)
    homogeneous = np.vstack([points.T, np.ones(len(points))]).astype(np.float32)
    within = [np.count_nonzero(np.abs(some @ homogeneous) <= distance, axis=1) for some in np.split(plane, CHUNKS)]
    best = plane[int(np.argmax(np.concatenate(within)))]
    inlier: Mask = np.abs(best @ homogeneous) <= distance
    return inlier


def _unit(vector: Float64) -> Float64:
    unit: Float64 = vector / np.linalg.norm(vector)
    return unit
