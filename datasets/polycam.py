"""Raw data of the app Polycam (LiDAR or room mode): keyframes/ with images, cameras, depth and confidence.

Source: Tancik et al., Nerfstudio, SIGGRAPH 2023, its converter of these folders; github.com/PolyCam/polyform.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, Folders, FrameSource
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import files_named, natural, number, pixels, read_object
from semstab.datasets.formats.images import COLOR_SUFFIXES
from semstab.datasets.geometry.cameras import Camera
from semstab.errors import DataError

CAMERAS = ("corrected_cameras", "cameras")
"""Folders of cameras, those that Polycam has optimised first; without it the images are as they were taken."""


class PolycamOptions(FileOptions):
    """Options with the defaults of the format."""

    depth_scale: opt.DepthScale = 1000
    camera_axes: opt.CameraAxes = "opengl"
    pixel_centre: opt.PixelCentre = 0.5
    up_axis: opt.UpAxis = "y"
    least_confidence: opt.LeastConfidence = 1


class Polycam(FileDataset[PolycamOptions]):
    """{name} is the time stamp that the files of a keyframe are called by: 9382837462."""

    Options: type[BaseModel] = PolycamOptions
    contents = "keyframes/cameras and keyframes/depth of Polycam (export raw data)"

    def is_scene(self, folder: Path) -> bool:
        """Return whether there are cameras of keyframes."""
        return any((folder / "keyframes" / cameras).is_dir() for cameras in CAMERAS)

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each camera.

        Raises:
            DataError: For a camera that lacks a value; the message names its file.
        """
        keyframes, folders = folder / "keyframes", Folders()
        cameras = next(name for name in CAMERAS if (keyframes / name).is_dir())
        images = keyframes / cameras.replace("cameras", "images")
        files = files_named(keyframes / cameras, "", ".json")
        if not files:
            raise DataError(f"{keyframes / cameras}: holds no camera; export the raw data again")
        for name in sorted(files, key=natural):
            path = files[name]
            content, where = read_object(path), str(path)
            pose = np.eye(4)
            pose[:3] = [[number(content, f"t_{row}{column}", where) for column in range(4)] for row in range(3)]
            fx, fy, cx, cy = (number(content, key, where) for key in ("fx", "fy", "cx", "cy"))
            size = pixels(content, "width", where), pixels(content, "height", where)
            confidence = keyframes / f"confidence/{name}.png"
            yield FrameSource(
                name=name, depth=keyframes / f"depth/{name}.png", pose=pose, pose_file=path,
                camera=Camera.stated((fx, fy, cx, cy), size, where),
                color=folders.one_of(images / name, COLOR_SUFFIXES),
                confidence=confidence if self.options.least_confidence else None,
                least_confidence=self.options.least_confidence,
            )  # fmt: skip
