"""TartanAir: image_left/, depth_left/ (.npy, metres), seg_left/, pose_left.txt, in a folder a trajectory.

Source: Wang et al., TartanAir, IROS 2020, and data_type.md (github.com/castacks/tartanair_tools).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field

from semstab.datasets.files.options import CameraAxes, FileOptions, FourIntrinsics, FrameSource, MaxDepth, UpAxis
from semstab.datasets.files.reader import FileDataset, frames_of, images_named
from semstab.datasets.formats.disk import read_table
from semstab.datasets.geometry.cameras import camera_of, from_quaternions

IMAGE_SIZE = (640, 480)
USUAL = (320.0, 320.0, 320.0, 240.0)


class TartanAirOptions(FileOptions):
    """Options with the defaults of the format; the intrinsics are 320 320 320 240."""

    camera: Literal["left", "right"] = Field("left", description="camera of the stereo pair")
    max_depth: MaxDepth = 1000
    camera_axes: CameraAxes = "ned"
    up_axis: UpAxis = "-z"
    intrinsics: FourIntrinsics = None


class TartanAir(FileDataset[TartanAirOptions]):
    """{name} is the frame's number: 000012. The ground truth are the mesh ids of seg_left/."""

    Options: type[BaseModel] = TartanAirOptions
    contents = "depth_left/ and pose_left.txt (or _right)"

    def __init__(self, options: TartanAirOptions) -> None:
        side = options.camera
        truth = options.ground_truth or f"seg_{side}/{{name}}_{side}_seg.npy"
        super().__init__(options.model_copy(update={"ground_truth": truth}))

    def is_scene(self, folder: Path) -> bool:
        """Return whether the camera's poses and depth are there; with a surface, the poses."""
        side = self.options.camera
        return (folder / f"pose_{side}.txt").is_file() and self.has_depth(folder / f"depth_{side}")

    def frames(self, folder: Path) -> Iterable[FrameSource]:
        """Return a frame for each depth map.

        Raises:
            DataError: If there are not as many poses.
        """
        side = self.options.camera
        path = folder / f"pose_{side}.txt"
        numbers = read_table(path, 7, "tx ty tz qx qy qz qw")
        poses = from_quaternions(numbers[:, :3], numbers[:, 3:], path)
        images = images_named(folder / f"image_{side}", "", f"_{side}")
        depth = self.depth_files(folder / f"depth_{side}", "", f"_{side}_depth.npy", instead=images)
        camera = camera_of(self.options.intrinsics, USUAL, IMAGE_SIZE)
        color = f"image_{side}/{{name}}_{side}"
        return frames_of(folder, depth, camera, pose=path.name, color=color, poses=poses, what="depth maps")
