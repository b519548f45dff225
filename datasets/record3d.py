"""Exports of the app Record3D (EXR and JPG sequence): rgb/, depth/ in metres, metadata.json.

Source: record3d.app, Export options; Tancik et al., Nerfstudio, SIGGRAPH 2023, its converter of the metadata.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from semstab.core.types import Float64
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, Folders, FrameSource
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import number, pixels, read_object
from semstab.datasets.formats.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from semstab.datasets.geometry.cameras import Camera, from_quaternions
from semstab.errors import DataError

METADATA = ("metadata.json", "metadata")


class Record3DOptions(FileOptions):
    """Options with the defaults of the format."""

    camera_axes: opt.CameraAxes = "opengl"
    pixel_centre: opt.PixelCentre = 0.5
    up_axis: opt.UpAxis = "y"


class Record3D(FileDataset[Record3DOptions]):
    """{name} is the number of the frame, from 0, as the files are called: 12."""

    Options: type[BaseModel] = Record3DOptions
    contents = "metadata.json, rgb/ and depth/ of Record3D (EXR and JPG)"

    def is_scene(self, folder: Path) -> bool:
        """Return whether the metadata and depth are there."""
        return self._metadata(folder) is not None and self.has_depth(folder / "depth")

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each pose.

        Raises:
            DataError: For metadata that lack a value.
        """
        path, folders = self._metadata(folder), Folders()
        assert path is not None
        content, where = read_object(path), str(path)
        rows = _table(content, "poses", 7, where)
        poses = from_quaternions(rows[:, 4:], rows[:, :4], path)
        size = pixels(content, "w", where), pixels(content, "h", where)
        K = content.get("K")
        if not isinstance(K, list) or len(K) != 9:
            raise DataError(f"{where}: 'K' must be nine numbers; export the recording again")
        fx, fy, cx, cy = (number({"K": K[k]}, "K", where) for k in (0, 4, 6, 7))  # column by column
        cameras = np.tile([fx, fy, cx, cy], (len(poses), 1))
        if content.get("perFrameIntrinsicCoeffs"):
            cameras = _table(content, "perFrameIntrinsicCoeffs", 4, where)
        if len(cameras) != len(poses):
            raise DataError(f"{where}: {len(cameras)} intrinsics for {len(poses)} poses; export the recording again")
        for k, (pose, (fx, fy, cx, cy)) in enumerate(zip(poses, cameras.tolist(), strict=True)):
            depth = folder / f"depth/{k}"
            yield FrameSource(
                name=str(k), depth=folders.one_of(depth, DEPTH_SUFFIXES) or depth.with_name(f"{k}.exr"), pose=pose,
                pose_file=path, camera=Camera.stated((fx, fy, cx, cy), size, where),
                color=folders.one_of(folder / f"rgb/{k}", COLOR_SUFFIXES),
            )  # fmt: skip

    def _metadata(self, folder: Path) -> Path | None:
        return next((path for name in METADATA if (path := folder / name).is_file()), None)


def _table(content: Mapping[str, Any], key: str, columns: int, where: str) -> Float64:
    """Return the rows (n, columns) of a value."""
    rows = content.get(key)
    if not isinstance(rows, list) or not rows or any(not isinstance(row, list) or len(row) != columns for row in rows):
        raise DataError(f"{where}: '{key}' must be a list of rows of {columns} numbers; export the recording again")
    return np.array([[number({key: value}, key, where) for value in row] for row in rows])
