"""Cameras as datasets state them: intrinsics for images of a size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Float64
from semstab.data.frames import Intrinsics
from semstab.errors import DataError

LARGEST = 1e9
FxFyCxCy = tuple[float, float, float, float]


@dataclass(frozen=True)
class Camera:
    """Intrinsics as a dataset states them, and the (width, height) that they are for; None: of any image's own.

    Raises:
        DataError: For numbers that no camera has, so that nothing overflows.
    """

    intrinsics: Intrinsics
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        K = self.intrinsics
        for name, value, least in (("fx", K.fx, 1e-3), ("fy", K.fy, 1e-3), ("cx", K.cx, 0), ("cy", K.cy, 0)):
            if not least <= abs(value) <= LARGEST:
                raise DataError(f"intrinsics: {name} = {value:g} pixels does not fit a camera; is the file damaged?")

    @classmethod
    def stated(cls, numbers: FxFyCxCy, size: tuple[int, int] | None, where: str) -> Camera:
        """Return a camera as the file `where` states it.

        Raises:
            DataError: For numbers that no camera has.
        """
        try:
            return cls(Intrinsics(*numbers), size)
        except DataError as error:
            raise DataError(f"{where}: {error}") from error

    def intrinsics_at(self, shape: tuple[int, ...], centre: float = 0.0) -> Intrinsics:
        """Return intrinsics, pixel centres at integers, of an image of the whole field of view, of shape (H, W, ...).

        `centre` is the dataset's coordinate of the first pixel's centre: 0, or 0.5 for coordinates from the corner.
        """
        stated, size = self.intrinsics, (shape[1], shape[0])
        K = Intrinsics(stated.fx, stated.fy, stated.cx - centre, stated.cy - centre)
        return K if self.size in (None, size) else K.resized(self.size or size, size)


def seen_across(degrees: float, size: tuple[int, int], where: str) -> Camera:
    """Return the camera of square pixels that sees that angle across an image (width, height); `where` is the file."""
    W, H = size
    f = W / 2 / math.tan(math.radians(degrees) / 2)
    return Camera.stated((f, f, (W - 1) / 2, (H - 1) / 2), size, where)


def camera_of(stated: FxFyCxCy | None, usual: FxFyCxCy, size: tuple[int, int]) -> Camera:
    """Return the stated intrinsics, of the depth images as they are, or a dataset's usual ones, of images of a size."""
    return Camera(Intrinsics(*stated)) if stated is not None else Camera(Intrinsics(*usual), size)


# Poses of other conventions as camera-to-world matrices with OpenCV axes; trajectories between their time stamps.

Poses = Float64

CAMERA_AXES: Mapping[str, Poses] = {
    "opencv": np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ned": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}
"""Rotations from OpenCV camera axes (x right, y down, z forward) to named ones: opengl has x right, y up, z backward;
ned has x forward, y right, z down, as TartanAir."""

UP_AXES: Mapping[str, tuple[float, float, float]] = {
    "x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1),
}  # fmt: skip

UNIT_TOLERANCE = 0.01
LARGEST_COORDINATE = 1e9
"""Metres from the origin: beyond, coordinates would lose the size of a voxel."""


def to_camera_to_world(T: Poses, convention: str, axes: str, where: str) -> Poses:
    """Return T (4, 4) of a convention and camera axes as camera-to-world, OpenCV axes; one that is not finite stays.

    Raises:
        DataError: If it cannot be inverted, with `where` (the file).
    """
    if not np.isfinite(T).all():
        return T
    if (largest := np.abs(T).max()) > LARGEST_COORDINATE:
        raise DataError(f"{where}: the pose holds {largest:g}, which no camera's has; is the file damaged?")
    factor = T[3, 3]
    if np.abs(T[3, :3]).max() == 0 and abs(factor - 1) > UNIT_TOLERANCE / 10 and factor != 0:
        raise DataError(
            f"{where}: the pose is multiplied by {factor:.6g} (its last row is 0 0 0 {factor:.6g}); divide it by its"
            " last element"
        )
    if convention == "world_to_camera":
        try:
            T = np.linalg.inv(T).astype(np.float64, copy=False)
        except np.linalg.LinAlgError as error:
            raise DataError(
                f"{where}: the pose cannot be inverted, so it is not rigid; leave this frame out"
            ) from error
    T = T.copy()
    T[:3, :3] = T[:3, :3] @ CAMERA_AXES[axes]
    return T


def from_quaternions(translations: Poses, quaternions: Poses, path: Path) -> Poses:
    """Return (n, 4, 4) of translations (n, 3) and quaternions (n, 4), order x y z w; NaN for a row that is not finite.

    A quaternion of zeros says that tracking was lost, as one that is not finite does.

    Raises:
        DataError: For a quaternion that is not of length 1; the message names the file and the pose, counted from 1.
    """
    from scipy.spatial.transform import Rotation

    T = np.full((len(translations), 4, 4), np.nan)
    finite = np.isfinite(translations).all(axis=1) & np.isfinite(quaternions).all(axis=1) & quaternions.any(axis=1)
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(quaternions[finite], axis=1)
    if (wrong := np.abs(lengths - 1) > UNIT_TOLERANCE).any():
        number = np.flatnonzero(finite)[wrong][0] + 1
        raise DataError(
            f"{path}: the quaternion of pose {number} has length {lengths[wrong][0]:.4g}, not 1; is the order of the"
            " columns right?"
        )
    T[finite] = np.eye(4)
    if finite.any():
        T[finite, :3, :3] = Rotation.from_quat(quaternions[finite]).as_matrix()
    T[finite, :3, 3] = translations[finite]
    return T


def at_times(
    times: Float64, poses: Poses, wanted: Float64, max_gap: float, method: Literal["interpolate", "nearest"]
) -> Poses:
    """Return (m, 4, 4) at `wanted` seconds of a trajectory (n, 4, 4) at ascending `times`: nearest, or between two.

    The pose is NaN without a pose within `max_gap` seconds, or if the nearest pose is NaN. Between two poses the
    position is linear and the rotation spherically linear (slerp). Before the first pose and after the last pose, the
    pose is constant.
    """
    finite = np.isfinite(poses).all(axis=(1, 2))
    times, poses = times[finite], poses[finite]
    if not len(times):
        return np.full((len(wanted), 4, 4), np.nan)
    rows = nearest(wanted, times)
    T = poses[rows] if method == "nearest" or len(times) == 1 else _between(times, poses, wanted)
    T[np.abs(times[rows] - wanted) > max_gap] = np.nan
    return T


def between_times(times: Float64, poses: Poses, wanted: Float64, max_gap: float) -> Poses:
    """Return (m, 4, 4) at `wanted` seconds of a trajectory (n, 4, 4) at strictly ascending `times`, never extrapolated.

    As `at_times` between two poses; NaN before the first, after the last one, and between two that are more than
    `max_gap` seconds apart.
    """
    finite = np.isfinite(poses).all(axis=(1, 2))
    times, poses = times[finite], poses[finite]
    T = np.full((len(wanted), 4, 4), np.nan)
    if not len(times):
        return T
    after = np.searchsorted(times, wanted)
    exact = times[after.clip(max=len(times) - 1)] == wanted
    T[exact] = poses[after[exact]]
    inner = (after > 0) & (after < len(times)) & ~exact
    inner[inner] = (times[after[inner]] - times[after[inner] - 1]) <= max_gap
    if inner.any():
        T[inner] = _between(times, poses, wanted[inner])
    return T


def nearest(times: Float64, others: Float64) -> npt.NDArray[np.intp]:
    """Return for each time the index of the nearest of the ascending others; of two as near the earlier one."""
    after = np.searchsorted(others, times).clip(max=len(others) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(times - others[before]) <= np.abs(others[after] - times), before, after)


def mutual_nearest(times: Float64, others: Float64, max_difference: float) -> npt.NDArray[np.intp]:
    """Return for each ascending time the index of the other one where each is the other's nearest; -1 for none."""
    to_other, back = nearest(times, others), nearest(others, times)
    mutual = (back[to_other] == np.arange(len(times))) & (np.abs(others[to_other] - times) <= max_difference)
    return np.where(mutual, to_other, -1)


def _between(times: Float64, poses: Poses, query: Float64) -> Poses:
    from scipy.spatial.transform import Rotation, Slerp

    clipped = query.clip(times[0], times[-1])
    T = np.tile(np.eye(4), (len(clipped), 1, 1))
    T[:, :3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(clipped).as_matrix()
    for axis in range(3):
        T[:, axis, 3] = np.interp(clipped, times, poses[:, axis, 3])
    return T


# Depth that was stored as the distance along a pixel's ray, brought to the distance along the optical axis.


def ray_lengths(camera: Intrinsics, u: npt.ArrayLike, v: npt.ArrayLike) -> Float64:
    """Return the length of the rays through pixels (u, v) from the camera to the plane one metre ahead, metres."""
    x = (np.asarray(u, dtype=np.float64) - camera.cx) / camera.fx
    y = (np.asarray(v, dtype=np.float64) - camera.cy) / camera.fy
    return np.sqrt(x**2 + y**2 + 1)


def planar(depth: Float32, camera: Intrinsics) -> Float32:
    """Return planar depth (H, W), metres, from distances along the rays; invalid values stay invalid."""
    H, W = depth.shape
    along_axis: Float32 = (depth / ray_lengths(camera, np.arange(W), np.arange(H)[:, None])).astype(np.float32)
    return along_axis
