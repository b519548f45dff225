"""Syndrone: flights simulated by CARLA, in rgb/, depth/, semantic/ and camera/ of a town, a weather and a height.

Source: Rizzoli et al., Syndrone, ICCV Workshops 2023; github.com/LTTM/Syndrone, its generator (CarlaClient.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from semstab.core.types import Float64
from semstab.datasets.files.options import (
    DepthScale,
    FileOptions,
    FourIntrinsics,
    FrameSource,
    GroundTruth,
    MaxDepth,
    UpAxis,
)
from semstab.datasets.files.reader import FileDataset, frames_of, images_named
from semstab.datasets.formats.disk import number, read_object
from semstab.datasets.geometry.cameras import camera_of
from semstab.errors import DataError

SIZE = (1920, 1080)
USUAL = (960.0, 960.0, 959.5, 539.5)
"""Images of 90 degrees."""

FULL_SCALE = 65535 / 1000
"""Stored units of depth in a metre; 1000 m is the sky."""


class SyndroneOptions(FileOptions):
    """Options with the defaults of the format; the intrinsics are 960 960 959.5 539.5."""

    depth_scale: DepthScale = FULL_SCALE
    max_depth: MaxDepth = 999
    up_axis: UpAxis = "z"
    ground_truth: GroundTruth = "semantic/{name}.png"
    intrinsics: FourIntrinsics = None


class Syndrone(FileDataset[SyndroneOptions]):
    """{name} is the frame's number: 00012. A scene is a height, as Town01_Opt_120-ClearNoon-height50m."""

    Options: type[BaseModel] = SyndroneOptions
    contents = "depth/ and camera/NAME.json of Syndrone"

    def is_scene(self, folder: Path) -> bool:
        """Return whether cameras, colour and depth are there, in folders of their names."""
        return (folder / "camera").is_dir() and (folder / "rgb").is_dir() and self.has_depth(folder / "depth")

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Return a frame for each depth image.

        Raises:
            DataError: For a camera that is not there, or lacks a number; the message names its file.
        """
        depth = self.depth_files(folder / "depth", "", ".png", instead=images_named(folder / "rgb"))
        poses = np.array([pose_of(folder / f"camera/{name}.json") for name in depth]).reshape(-1, 4, 4)
        camera = camera_of(self.options.intrinsics, USUAL, SIZE)
        return frames_of(folder, depth, camera, pose="camera/{name}.json", color="rgb/{name}", poses=poses)


def pose_of(path: Path) -> Float64:
    """Return the pose (4, 4) camera-to-world, OpenCV axes, of a file of CARLA's numbers; the world is turned z up.

    CARLA's axes are left-handed (x forward, y right, z up), angles in degrees. y changes its sign.

    Raises:
        DataError: If a number is not there; the message names the file.
    """
    if not path.is_file():
        raise DataError(f"{path}: is missing; it holds x, y, z, pitch, yaw and roll of the camera")
    content, where = read_object(path), str(path)
    x, y, z = (number(content, name, where) for name in ("x", "y", "z"))
    pitch, yaw, roll = (np.radians(number(content, name, where)) for name in ("pitch", "yaw", "roll"))
    (cp, sp), (cy, sy), (cr, sr) = ((np.cos(angle), np.sin(angle)) for angle in (pitch, yaw, roll))
    forward = np.array([cp * cy, cp * sy, sp])
    right = np.array([cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, -cp * sr])
    up = np.array([-cy * sp * cr - sy * sr, -sy * sp * cr + cy * sr, cp * cr])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, -up, forward], axis=1)
    T[:3, 3] = x, y, z
    T[1, :4] = -T[1, :4]
    return T
