"""ARKitScenes, raw data: lowres_wide/, lowres_depth/, confidence/, lowres_wide_intrinsics/, lowres_wide.traj.

Source: Baruch et al., ARKitScenes, NeurIPS 2021 (Datasets and Benchmarks), and its DATA.md and tenFpsDataLoader.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field

from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, Folders, FrameSource
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import files_named, natural, read_table
from semstab.datasets.formats.images import COLOR_SUFFIXES
from semstab.datasets.geometry.cameras import Camera, between_times
from semstab.errors import DataError

TRAJECTORY = "lowres_wide.traj"


class ArkitScenesOptions(FileOptions):
    """Options with the defaults of the format."""

    depth_scale: opt.DepthScale = 1000
    up_axis: opt.UpAxis = "z"
    least_confidence: opt.LeastConfidence = 1
    max_pose_gap: opt.Positive = Field(0.5, description="seconds between two poses, of which the one between is taken")
    time_offset: opt.TimeOffset = 0.0


class ArkitScenes(FileDataset[ArkitScenesOptions]):
    """{name} is VIDEO_SECONDS as the files are called: 41069021_305.377. Poses, ten a second, are interpolated."""

    Options: type[BaseModel] = ArkitScenesOptions
    contents = f"{TRAJECTORY}, lowres_depth/ and lowres_wide_intrinsics/ of ARKitScenes"

    def is_scene(self, folder: Path) -> bool:
        """Return whether the trajectory and the intrinsics are there."""
        return (folder / TRAJECTORY).is_file() and (folder / "lowres_wide_intrinsics").is_dir()

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each depth image that has intrinsics; one before the first or after the last pose has none.

        Raises:
            DataError: For a damaged file, or no frame.
        """
        from scipy.spatial.transform import Rotation

        path, folders = folder / TRAJECTORY, Folders()
        rows = read_table(path, 7, "seconds, axis and angle to the camera, translation")
        order = np.argsort(rows[:, 0], kind="stable")
        rows = rows[order][np.diff(rows[order, 0], prepend=-np.inf) > 0]
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        turns = Rotation.from_rotvec(rows[:, 1:4]).as_matrix()  # of the world to the camera
        T[:, :3, :3] = turns.transpose(0, 2, 1)
        T[:, :3, 3] = -np.einsum("nji,nj->ni", turns, rows[:, 4:])
        cameras = files_named(folder / "lowres_wide_intrinsics", "", ".pincam")
        images = files_named(folder / "lowres_wide", "", ".png")
        depth = self.depth_files(folder / "lowres_depth", "", ".png", instead=images)
        names = sorted((name for name in depth if name in cameras), key=natural)
        if not names:
            raise DataError(f"{folder}: no depth image has intrinsics of its name; download both")
        times = np.array([_seconds(name, folder) for name in names])
        poses = between_times(rows[:, 0], T, times + self.options.time_offset, self.options.max_pose_gap)
        for name, time, pose in zip(names, times.tolist(), poses, strict=True):
            width, height, fx, fy, cx, cy = _pinhole(cameras[name])
            confidence = folder / f"confidence/{name}.png"
            yield FrameSource(
                name=name, depth=depth[name], pose=pose, pose_file=path, timestamp=time,
                camera=Camera.stated((fx, fy, cx, cy), (round(width), round(height)), str(cameras[name])),
                color=folders.one_of(folder / f"lowres_wide/{name}", COLOR_SUFFIXES),
                confidence=confidence if self.options.least_confidence else None,
                least_confidence=self.options.least_confidence,
            )  # fmt: skip


def _pinhole(path: Path) -> list[float]:
    """Return width, height, fx, fy, cx, cy of a .pincam file."""
    rows = read_table(path, 6, "width height fx fy cx cy")
    if len(rows) != 1 or not ((rows[0, :2] >= 1) & (rows[0, :2] < 2**20)).all():
        raise DataError(f"{path}: expected one line of width height fx fy cx cy; download it again")
    return [float(value) for value in rows[0]]


def _seconds(name: str, folder: Path) -> float:
    """Return the time in a name: 305.377 of 41069021_305.377."""
    try:
        return float(name.rpartition("_")[2])
    except ValueError as error:
        raise DataError(f"{folder}: {name[:80]!r} does not end in seconds, as in 41069021_305.377") from error
