"""Poses of other conventions as camera-to-world matrices with OpenCV axes; trajectories between their time stamps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from semstab.errors import DataError

Poses = npt.NDArray[np.float64]

CAMERA_AXES: Mapping[str, Poses] = {
    "opencv": np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ned": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}
"""From OpenCV camera axes (x right, y down, z forward) to the named ones: opengl has x right, y up, z backward;
ned has x forward, y right, z down, as TartanAir."""

UP_AXES: Mapping[str, tuple[float, float, float]] = {
    "x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1),
}  # fmt: skip

UNIT_TOLERANCE = 0.01
LARGEST = 1e9
"""Metres from the origin: beyond, coordinates would lose the size of a voxel."""


def to_camera_to_world(T: Poses, convention: str, axes: str, where: str) -> Poses:
    """T (4, 4) of a convention and camera axes as camera-to-world with OpenCV axes; one that is not finite stays.

    Raises DataError with `where` (the file) where it cannot be inverted.
    """
    if not np.isfinite(T).all():
        return T
    if (largest := np.abs(T).max()) > LARGEST:
        raise DataError(f"{where}: the pose holds {largest:g}, which no camera's has; is the file damaged?")
    if convention == "world_to_camera":
        T = _inverse(T, where)
    T = T.copy()
    T[:3, :3] = T[:3, :3] @ CAMERA_AXES[axes]
    return T


def from_quaternions(translations: Poses, quaternions: Poses, path: Path) -> Poses:
    """(n, 4, 4) from translations (n, 3) and quaternions (n, 4) in the order x y z w; NaN where one is not finite.

    Raises DataError that names the file and the pose, counted from 1, for a quaternion that is not of length 1.
    """
    from scipy.spatial.transform import Rotation

    T = np.full((len(translations), 4, 4), np.nan)
    finite = np.isfinite(translations).all(axis=1) & np.isfinite(quaternions).all(axis=1)
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
    times: npt.NDArray[np.float64],
    poses: Poses,
    wanted: npt.NDArray[np.float64],
    max_gap: float,
    method: Literal["interpolate", "nearest"],
) -> Poses:
    """(m, 4, 4) at `wanted` seconds of a trajectory (n, 4, 4) at ascending `times`: the nearest, or between the two.

    NaN where no pose is within `max_gap` seconds, and beside a pose that is NaN. Between two poses the position is
    linear and the rotation spherically linear (slerp); before the first and after the last one they hold.
    """
    kept = np.isfinite(poses).all(axis=(1, 2))
    times, poses = times[kept], poses[kept]
    if not len(times):
        return np.full((len(wanted), 4, 4), np.nan)
    at = nearest(wanted, times)
    found = poses[at] if method == "nearest" or len(times) == 1 else _between(times, poses, wanted)
    found[np.abs(times[at] - wanted) > max_gap] = np.nan
    return found


def nearest(times: npt.NDArray[np.float64], others: npt.NDArray[np.float64]) -> npt.NDArray[np.intp]:
    """For each time the index of the nearest of the ascending others; of two as near the earlier one."""
    after = np.searchsorted(others, times).clip(max=len(others) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(times - others[before]) <= np.abs(others[after] - times), before, after)


def _between(times: npt.NDArray[np.float64], poses: Poses, wanted: npt.NDArray[np.float64]) -> Poses:
    from scipy.spatial.transform import Rotation, Slerp

    at = wanted.clip(times[0], times[-1])
    T = np.tile(np.eye(4), (len(at), 1, 1))
    T[:, :3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    for axis in range(3):
        T[:, axis, 3] = np.interp(at, times, poses[:, axis, 3])
    return T


def _inverse(T: Poses, where: str) -> Poses:
    try:
        return np.linalg.inv(T).astype(np.float64, copy=False)
    except np.linalg.LinAlgError as error:
        raise DataError(f"{where}: the pose cannot be inverted, so it is not rigid; leave this frame out") from error
