"""The layout of DeepVideoMVS and its HoloLens sample: images/, depth/ in millimetres, poses.txt, K.txt.

Source: Düzçeker et al., DeepVideoMVS, CVPR 2021 (github.com/ardaduz/deep-video-mvs).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from pydantic import BaseModel

from semstab.datasets.files.options import DepthScale, FileOptions, FrameSource
from semstab.datasets.files.reader import FileDataset, frames_of
from semstab.datasets.formats.disk import files_named, read_intrinsics, read_table
from semstab.datasets.geometry.cameras import Camera
from semstab.errors import DataError


class HoloLensOptions(FileOptions):
    """Options with the defaults of the format."""

    depth_scale: DepthScale = 1000


class HoloLens(FileDataset[HoloLensOptions]):
    """{name} is the image's name without suffix: 00003. Frames go in the alphabetical order of their images."""

    Options: type[BaseModel] = HoloLensOptions
    contents = "images/, depth/, poses.txt and K.txt"

    def is_scene(self, folder: Path) -> bool:
        """Return whether poses.txt and K.txt are there."""
        return (folder / "poses.txt").is_file() and (folder / "K.txt").is_file()

    def frames(self, folder: Path) -> Iterable[FrameSource]:
        """Return a frame for each line of poses.txt.

        Raises:
            DataError: If there are not as many images.
        """
        camera = Camera(read_intrinsics(folder / "K.txt"))
        poses = read_table(folder / "poses.txt", 16, "a flattened 4x4 matrix").reshape(-1, 4, 4)
        images = files_named(folder / "images", "", ".png")
        if not images:
            raise DataError(f"{folder / 'images'}: there is no PNG image; its name ties a pose to its depth")
        depth = {name: folder / f"depth/{name}.png" for name in sorted(images)}
        return frames_of(folder, depth, camera, pose="poses.txt", color="images/{name}", poses=poses, what="images")
