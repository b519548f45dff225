"""Virtual KITTI 2: rendered copies of KITTI's sequences, a folder a variation with frames/ and two tables of cameras.

Sources: Cabon et al., Virtual KITTI 2, 2020; europe.naverlabs.com/proxy-virtual-worlds-vkitti-2 (formats, colors.txt).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.types import Float64
from semstab.data.frames import Intrinsics
from semstab.data.labels import LabelSpace
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, FrameSource, TruthSource
from semstab.datasets.files.reader import FileDataset, frames_of, images_named
from semstab.datasets.formats.disk import read_table
from semstab.datasets.geometry.cameras import Camera
from semstab.errors import DataError

CLASSES = ("classSegmentation", "classsegmentation")
"""Names that the folder of ground truth has in releases."""


class VirtualKittiOptions(FileOptions):
    """Options with the defaults of the format."""

    camera: Literal["Camera_0", "Camera_1"] = Field("Camera_0", description="the left or the right camera")
    depth_scale: opt.DepthScale = 100
    max_depth: opt.MaxDepth = 655
    pose_convention: opt.PoseConvention = "world_to_camera"
    up_axis: opt.UpAxis = "-y"
    void_ids: opt.VoidIds = opt.ZERO_IS_VOID


class VirtualKitti(FileDataset[VirtualKittiOptions]):
    """{name} is the frame's number: 00012 of rgb_00012.jpg. Ground truth are the colours of classSegmentation/."""

    Options: type[BaseModel] = VirtualKittiOptions
    contents = "frames/depth/Camera_0/, extrinsic.txt and intrinsic.txt"

    def is_scene(self, folder: Path) -> bool:
        """Return whether depth of the camera and both tables are there; with a surface, the latter."""
        has_tables = all((folder / name).is_file() for name in ("extrinsic.txt", "intrinsic.txt"))
        return has_tables and self.has_depth(folder / "frames/depth" / self.options.camera)

    def settled(self, folder: Path) -> VirtualKittiOptions:
        """Return the options with the ground truth of the camera."""
        where = next((name for name in CLASSES if (folder / "frames" / name).is_dir()), CLASSES[0])
        truth = f"frames/{where}/{self.options.camera}/classgt_{{name}}.png"
        return self.options.model_copy(update={"ground_truth": self.options.ground_truth or truth})

    def truth(self, folder: Path) -> TruthSource:
        """Return the classes of the ground truth."""
        return TruthSource(space=LabelSpace.load("virtual_kitti"))

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each depth image.

        Raises:
            DataError: For a frame that has no row in one of the two files, or a damaged row.
        """
        camera = self.options.camera
        images = images_named(folder / f"frames/rgb/{camera}", "rgb_")
        depth = self.depth_files(folder / f"frames/depth/{camera}", "depth_", ".png", instead=images)
        numbers = [_number(name, folder) for name in depth]
        number = int(camera[-1])
        T_cw = _rows(folder / "extrinsic.txt", "frame cameraID r1,1 r1,2 r1,3 t1 ... 1", 16, number, numbers)
        K = _rows(folder / "intrinsic.txt", "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]", 4, number, numbers)
        placeholder = Camera(Intrinsics(1, 1, 0, 0))  # until that of the frame is known
        color, poses = f"frames/rgb/{camera}/rgb_{{name}}", T_cw.reshape(-1, 4, 4)
        sources = frames_of(folder, depth, placeholder, pose="extrinsic.txt", color=color, poses=poses)
        for frame, intrinsics in zip(sources, K, strict=True):
            try:
                yield replace(frame, camera=Camera(Intrinsics(*intrinsics.tolist())))
            except DataError as error:
                raise DataError(f"{folder / 'intrinsic.txt'}: frame {frame.name}: {error}") from error


def _number(name: str, folder: Path) -> int:
    if not (name.isascii() and name.isdigit() and len(name) < 10):
        raise DataError(
            f"{folder / 'frames'}: {name[:40]!r} is no number of a frame, which ties it to its pose; rename it"
        )
    return int(name)


def _rows(path: Path, header: str, values: int, camera: int, frames: list[int]) -> Float64:
    """Return (n, values) of the rows of a camera and of these frames; raises DataError for one that is not there."""
    table = read_table(path, 2 + values, header, heading="frame")
    rows = {int(row[0]): row[2:] for row in table[np.isfinite(table[:, :2]).all(axis=1)] if row[1] == camera}
    if lost := [frame for frame in frames if frame not in rows]:
        raise DataError(
            f"{path}: has no row of frame {lost[0]} and camera {camera}; unpack vkitti_*_textgt.tar.gz again"
        )
    return np.array([rows[frame] for frame in frames]).reshape(-1, values)
