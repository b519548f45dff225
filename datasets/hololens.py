"""The layout of DeepVideoMVS and its HoloLens sample: images/, depth/ in millimetres, poses.txt, K.txt.

Source: Düzçeker et al., DeepVideoMVS, CVPR 2021 (github.com/ardaduz/deep-video-mvs).
"""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel

from semstab.datasets.files.frame_source import FrameSource
from semstab.datasets.files.options import CameraAxes, DepthScale, FileOptions, PoseConvention
from semstab.datasets.files.reader import FileDataset, files_named, require_equal
from semstab.datasets.formats.text_files import read_intrinsics
from semstab.datasets.formats.text_tables import read_table
from semstab.datasets.views.cameras import Camera
from semstab.errors import DataError


class HoloLensOptions(FileOptions):
    """What the format says, and may be said otherwise."""

    depth_scale: DepthScale = 1000
    pose_convention: PoseConvention = "camera_to_world"
    camera_axes: CameraAxes = "opencv"


class HoloLens(FileDataset[HoloLensOptions]):
    """{name} is the image's name without suffix: 00003. Frames go in the alphabetical order of their images."""

    Options: type[BaseModel] = HoloLensOptions
    looks_like = "images/, depth/, poses.txt and K.txt"

    def is_scene(self, folder: Path) -> bool:
        """Whether poses.txt and K.txt are there."""
        return (folder / "poses.txt").is_file() and (folder / "K.txt").is_file()

    def frames(self, folder: Path) -> list[FrameSource]:
        """One a line of poses.txt. Raises DataError where there are not as many images."""
        camera = Camera(read_intrinsics(folder / "K.txt"))
        path = folder / "poses.txt"
        poses = read_table(path, 16, "a flattened 4x4 matrix").reshape(-1, 4, 4)
        images = files_named(folder / "images", "", ".png")
        if not images:
            raise DataError(f"{folder / 'images'}: there is no PNG image; its name ties a pose to its depth")
        require_equal(path, len(poses), len(images), "images")
        return [
            FrameSource(name, folder / f"depth/{name}.png", pose, path, camera, color=images[name])
            for name, pose in zip(sorted(images), poses, strict=True)
        ]
