"""The mistakes of files that are looked for in scenes of cameras and of scans, in addition to other conventions.

A new one is an entry of `CAMERAS` or `SCANS`: its name, what it changes, and the mend in words.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np

from semstab.check.conventions import Convention
from semstab.check.reprojection import Sample, View
from semstab.check.scan_sample import ScanSample
from semstab.check.trials import Hypothesis
from semstab.core.types import Float64
from semstab.datasets.geometry.cameras import CAMERA_AXES

LEAST_FOCAL = 8.0
"""Pixels; a shorter focal length is one divided by the image's size."""

TO_CAMERA = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""From a LiDAR's axes (x forward, y left, z up) to the axes of a camera next to it (x right, y down, z forward)."""

FARTHEST = 500.0
"""Metres within which half of the points of a scan lie, if they are in metres."""

PoseChange = Callable[[Float64], Float64]


# --- changes of a pose (4, 4) -----------------------------------------------------------------------------------------


def rotations(change: PoseChange) -> PoseChange:
    """Return the change of poses whose rotations (3, 3) change."""

    def with_changed_rotation(T: Float64) -> Float64:
        changed = T.copy()
        changed[:3, :3] = change(T[:3, :3])
        return changed

    return with_changed_rotation


def quaternions(order: tuple[int, ...]) -> PoseChange:
    """Return the change of poses whose quaternions, as they were read, x y z w, are put in another order."""

    def reordered(R: Float64) -> Float64:
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_quat(Rotation.from_matrix(R).as_quat()[list(order)]).as_matrix())

    return rotations(reordered)


def angles(factor: float) -> PoseChange:
    """Return the change that multiplies the rotation angles of poses by `factor`."""

    def scaled(R: Float64) -> Float64:
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_rotvec(factor * Rotation.from_matrix(R).as_rotvec()).as_matrix())

    return rotations(scaled)


def positions(factor: float) -> PoseChange:
    """Return the change that multiplies the positions of poses by `factor`."""
    scale = np.array([[1.0, 1, 1, factor]] * 3 + [[1.0] * 4])
    return lambda T: T * scale


FIRST_NUMBER_LAST, LAST_NUMBER_FIRST = quaternions((1, 2, 3, 0)), quaternions((3, 0, 1, 2))


# --- cameras ----------------------------------------------------------------------------------------------------------


def views(change: Callable[[View, Convention], View]) -> Callable[[Sample], Sample]:
    """Return the change of a sample whose views change."""
    return lambda sample: sample.with_views(
        {position: change(view, sample.configured) for position, view in sample.views.items()}
    )


def _mirrored(*axes: int) -> Callable[[Sample], Sample]:
    """Return how to read images mirrored along axes: 0 upside down, 1 left to right."""

    def mended(view: View, _: Convention) -> View:
        places, camera, principal = [view.v, view.u], view.camera, [view.camera.cy, view.camera.cx]
        for axis in axes:
            last = view.depth.shape[axis] - 1
            places[axis] = last - places[axis]
            principal[axis] -= view.size[1 - axis] - 1 - last * view.stride  # the first sampled pixel is not the first
        cy, cx = principal
        camera = dataclasses.replace(camera, cx=cx, cy=cy)
        return dataclasses.replace(view, depth=np.flip(view.depth, axes), camera=camera, v=places[0], u=places[1])

    return views(mended)


def camera_poses(change: PoseChange) -> Callable[[Sample], Sample]:
    """Return how to read poses whose matrices in the file, (4, 4), would be others."""

    def mended(view: View, configured: Convention) -> View:
        file = view.T_wc.copy()
        file[:3, :3] = file[:3, :3] @ CAMERA_AXES[configured.axes].T
        inverse = configured.pose == "world_to_camera"
        file = change(np.linalg.inv(file).astype(np.float64) if inverse else file)
        pose = np.linalg.inv(file).astype(np.float64) if inverse else file
        pose[:3, :3] = pose[:3, :3] @ CAMERA_AXES[configured.axes]
        return dataclasses.replace(view, T_wc=pose)

    return views(mended)


def _in_pixels(view: View, _: Convention) -> View:
    (W, H), K = view.size, view.camera
    return dataclasses.replace(view, camera=dataclasses.replace(K, fx=K.fx * W, cx=K.cx * W, fy=K.fy * H, cy=K.cy * H))


def _exchanged(view: View, _: Convention) -> View:
    return dataclasses.replace(view, camera=dataclasses.replace(view.camera, cx=view.camera.cy, cy=view.camera.cx))


def _in_pixels_already(sample: Sample) -> bool:
    return all(view.camera.fx >= LEAST_FOCAL for view in sample.views.values())


def _as_shares(sample: Sample) -> bool:
    return all(view.camera.fx < LEAST_FOCAL for view in sample.views.values())


def _is_off_centre(sample: Sample) -> bool:
    """Return whether cx and cy may be exchanged: each is nearer to the middle of the other side."""
    cameras = [(*view.size, view.camera) for view in sample.views.values()]
    off = [abs(K.cx - H / 2) + abs(K.cy - W / 2) < abs(K.cx - W / 2) + abs(K.cy - H / 2) for W, H, K in cameras]
    return _in_pixels_already(sample) and all(off)


ANEW = "no setting mends it: write the files again"
OR_LEFT_HANDED = f"{ANEW}, or convert the poses if they are left-handed (Unity, Unreal), which looks the same"
mistake = functools.partial(Hypothesis[Sample], applies=_in_pixels_already)
CAMERAS: tuple[Hypothesis[Sample], ...] = (
    mistake("depth images mirrored left to right", _mirrored(1), OR_LEFT_HANDED),
    mistake("depth images upside down", _mirrored(0), OR_LEFT_HANDED),
    mistake("depth images turned by 180 degrees", _mirrored(0, 1), ANEW),
    mistake(
        "poses with transposed rotations",
        camera_poses(rotations(np.transpose)),
        "transpose the rotation (3, 3) of each",
    ),
    mistake("quaternions w x y z that are read as x y z w", camera_poses(FIRST_NUMBER_LAST), "write them as x y z w"),
    mistake("quaternions x y z w that are read as w x y z", camera_poses(LAST_NUMBER_FIRST), "write them as w x y z"),
    mistake("intrinsics with cx and cy exchanged", views(_exchanged), "exchange them", applies=_is_off_centre),
    mistake(
        "intrinsics as shares of the image's size",
        views(_in_pixels),
        "multiply fx and cx by its width, fy and cy by its height",
        applies=_as_shares,
    ),
)
"""Mistakes of a camera's files that no setting mends."""


# --- scans ------------------------------------------------------------------------------------------------------------


def scan_poses(change: PoseChange) -> Callable[[ScanSample], ScanSample]:
    """Return the change of scans whose poses change."""
    return lambda sample: sample.posed(change)


def _nearer_to_their_sensors(sample: ScanSample) -> bool:
    """Return whether points lie around the positions of their sensors, and not around the origin."""
    middle, sensor = sample.places
    from_sensor, from_origin = (np.linalg.norm(middle - origin, axis=1) for origin in (sensor, np.zeros(3)))
    return bool(np.median(from_sensor) < np.median(from_origin))


def _in_reach(sample: ScanSample) -> bool:
    """Return whether half of the points lie no farther than a LiDAR sees."""
    return bool(np.median(np.concatenate(sample.ranges)) < FARTHEST)


SCANS: tuple[Hypothesis[ScanSample], ...] = (
    Hypothesis(
        "inverse poses",
        scan_poses(lambda T: np.linalg.inv(T).astype(np.float64)),
        "invert the poses: they map the world to the sensor",
        {
            ("pose_convention", "camera_to_world"): "pose_convention: world_to_camera",
            ("pose_convention", "world_to_camera"): "pose_convention: camera_to_world",
        },
    ),
    Hypothesis(
        "poses of a camera, not of the LiDAR",
        scan_poses(lambda T: np.linalg.inv(TO_CAMERA) @ T @ TO_CAMERA),
        "the calibration from the LiDAR to the camera is forgotten: apply it",
        {("pose_frame", "lidar"): "pose_frame: camera"},
    ),
    Hypothesis(
        "poses of the LiDAR, to which a camera's calibration was applied",
        scan_poses(lambda T: TO_CAMERA @ T @ np.linalg.inv(TO_CAMERA)),
        "leave the calibration away",
        {("pose_frame", "camera"): "pose_frame: lidar"},
    ),
    Hypothesis(
        "points that are in the world already",
        scan_poses(lambda T: np.eye(len(T))),
        "carry the points into the axes of the sensor",
        {("coordinates", "sensor"): "coordinates: world"},
        _nearer_to_their_sensors,
    ),
    Hypothesis(
        "points that are in the sensor's axes already",
        scan_poses(lambda T: T @ T),
        "carry the points into the axes of the sensor once",
        {("coordinates", "world"): "coordinates: sensor"},
    ),
    Hypothesis("quaternions w x y z", scan_poses(FIRST_NUMBER_LAST), "write quaternions as x y z w"),
    Hypothesis("quaternions x y z w", scan_poses(LAST_NUMBER_FIRST), "write quaternions as w x y z"),
    Hypothesis("poses in millimetres", scan_poses(positions(0.001)), "divide the positions of the poses by 1000"),
    Hypothesis(
        "poses in kilometres",
        scan_poses(positions(1000.0)),
        "multiply the positions of the poses by 1000",
        applies=_in_reach,
    ),
    Hypothesis(
        "points in millimetres",
        scan_poses(positions(1000.0)),
        "divide the points by 1000",
        applies=lambda sample: not _in_reach(sample),
    ),
    Hypothesis(
        "angles in degrees, read as radians", scan_poses(angles(math.pi / 180)), "convert the angles to radians"
    ),
    Hypothesis(
        "angles in radians, read as degrees", scan_poses(angles(180 / math.pi)), "convert the angles to degrees"
    ),
)
"""Other readings of the poses of scans than the configured one."""


def axes(*rows: tuple[float, float, float]) -> Callable[[ScanSample], ScanSample]:
    """Return the change of scans whose points (x, y, z) are in other axes, given by the rows of a matrix (3, 3).

    Points are left as they are: poses are carried into their axes.
    """
    change = np.eye(4)
    change[:3, :3] = rows
    return scan_poses(lambda T: change.T @ T @ change)


def turned(degrees: float) -> Callable[[ScanSample], ScanSample]:
    """Return the change of scans whose sensor is turned about z against the body that has the poses."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = np.array([[cos, -sin, 0, 0], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return scan_poses(lambda T: T @ turn)


X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
LEFT, DOWN = (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)
OF_SCANS: tuple[Hypothesis[ScanSample], ...] = (
    Hypothesis(
        "points with y mirrored",
        axes(X, LEFT, Z),
        "negate the y of the points, or convert the poses if they are left-handed",
        applies=lambda sample: not sample.is_upside_down,
    ),
    Hypothesis("points with z mirrored", axes(X, Y, DOWN), "negate the z of the points"),
    Hypothesis("points with x and y exchanged", axes(Y, X, Z), "exchange them"),
    Hypothesis(
        "points of a sensor with z down",
        axes(X, LEFT, DOWN),
        "negate the y and z of the points: poses are of a body with z up",
        applies=lambda sample: sample.is_upside_down,
    ),
    *(
        Hypothesis(
            f"poses of another body, against which the LiDAR is turned by {degrees} degrees about z",
            turned(degrees),
            "apply the mounting of the sensor (its pose on the vehicle) to the poses",
        )
        for degrees in (90, 180, -90)
    ),
    Hypothesis(
        "the poses of the next scans",
        lambda sample: sample.delayed(1),
        "poses are one scan late: give each scan the pose of its own time",
        applies=lambda sample: sample.knows_poses,
    ),
    Hypothesis(
        "the poses of the scans before",
        lambda sample: sample.delayed(-1),
        "poses are one scan early: give each scan the pose of its own time",
        applies=lambda sample: sample.knows_poses,
    ),
)
"""Mistakes of the files of scans that no setting mends; a level and straight drive does not show most of them."""
