"""TartanAir, both versions: image_CAMERA/, depth_CAMERA/, seg_CAMERA/, pose_CAMERA.txt, in a folder a trajectory.

Sources: Wang et al., TartanAir, IROS 2020, and data_type.md (github.com/castacks/tartanair_tools); of V2 tartanair.org,
Modalities, and github.com/castacks/tartanairpy, its readers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, Field

from semstab.datasets.files.options import CameraAxes, FileOptions, FourIntrinsics, FrameSource, MaxDepth, UpAxis
from semstab.datasets.files.reader import FileDataset, frames_of, images_named
from semstab.datasets.formats.disk import read_table
from semstab.datasets.geometry.cameras import camera_of, from_quaternions

V1 = ("left", "right")
V2 = tuple(f"{side}cam_{face}" for side in "lr" for face in ("front", "back", "left", "right", "top", "bottom"))
"""Cameras of each version."""


@dataclass(frozen=True)
class Version:
    """Properties of a version: the size of images, the usual intrinsics, suffixes of depth and labels."""

    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    suffix: str


VERSIONS: Mapping[str, Version] = {
    **dict.fromkeys(V1, Version((640, 480), (320.0, 320.0, 320.0, 240.0), ".npy")),
    **dict.fromkeys(V2, Version((640, 640), (320.0, 320.0, 320.0, 320.0), ".png")),
}


class TartanAirOptions(FileOptions):
    """Options with the defaults of the format; the intrinsics are 320 320 320 240, of V2 320 320 320 320."""

    camera: str = Field(
        "", pattern=f"^({'|'.join(VERSIONS)}|)$", description=f"{', '.join(V1)}; of V2 lcam_front, rcam_left, ..."
    )
    max_depth: MaxDepth = 1000
    camera_axes: CameraAxes = "ned"
    up_axis: UpAxis = "-z"
    intrinsics: FourIntrinsics = None


class TartanAir(FileDataset[TartanAirOptions]):
    """{name} is the frame's number: 000012. The ground truth are the ids of seg_CAMERA/, of left or lcam_front."""

    Options: type[BaseModel] = TartanAirOptions
    contents = "depth_left/ and pose_left.txt (of V2 depth_lcam_front/ and pose_lcam_front.txt)"

    def is_scene(self, folder: Path) -> bool:
        """Return whether the camera's poses and depth are there; with a surface, the poses."""
        return self._camera(folder) is not None

    def settled(self, folder: Path) -> TartanAirOptions:
        """Return the options with the ground truth of the camera."""
        camera = self._camera(folder)
        assert camera is not None
        truth = f"seg_{camera}/{{name}}_{camera}_seg{VERSIONS[camera].suffix}"
        return self.options.model_copy(update={"ground_truth": self.options.ground_truth or truth})

    def frames(self, folder: Path) -> Iterable[FrameSource]:
        """Return a frame for each depth map.

        Raises:
            DataError: If there are not as many poses.
        """
        side = self._camera(folder)
        assert side is not None
        version = VERSIONS[side]
        path = folder / f"pose_{side}.txt"
        numbers = read_table(path, 7, "tx ty tz qx qy qz qw")
        poses = from_quaternions(numbers[:, :3], numbers[:, 3:], path)
        images = images_named(folder / f"image_{side}", "", f"_{side}")
        depth = self.depth_files(folder / f"depth_{side}", "", f"_{side}_depth{version.suffix}", instead=images)
        camera = camera_of(self.options.intrinsics, version.intrinsics, version.size)
        color = f"image_{side}/{{name}}_{side}"
        scale = 1.0 if version.suffix == ".png" else None  # metres, packed into four channels
        return frames_of(
            folder, depth, camera, pose=path.name, color=color, poses=poses, depth_scale=scale, what="depth maps"
        )

    def _camera(self, folder: Path) -> str | None:
        """Return the camera of the options, else the first camera of a folder, else None."""
        sides = (self.options.camera,) if self.options.camera else VERSIONS
        with_poses = (side for side in sides if (folder / f"pose_{side}.txt").is_file())
        return next((side for side in with_poses if self.has_depth(folder / f"depth_{side}")), None)
