"""Recordings of the app Stray Scanner: odometry.csv, camera_matrix.csv, depth/, confidence/.

Source: docs.strayrobots.io, Data Specification; github.com/strayrobots/scanner, docs/format.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field

from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, Folders, FrameSource
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import read_intrinsics, records, to_number
from semstab.datasets.formats.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from semstab.datasets.geometry.cameras import Camera, from_quaternions
from semstab.errors import DataError

COLUMNS = (9, 13)
"""Numbers in a line of odometry.csv: time, frame, position, quaternion, and of newer recordings fx, fy, cx, cy."""


class StrayScannerOptions(FileOptions):
    """Options with the defaults of the format."""

    depth_scale: opt.DepthScale = 1000
    up_axis: opt.UpAxis = "y"
    least_confidence: opt.LeastConfidence = 1
    image_size: tuple[int, int] = Field((1920, 1440), description="[width, height] of the video")
    images: str = Field("rgb/{name}", description="template of the video's images: ffmpeg -i rgb.mp4 rgb/%06d.jpg")


class StrayScanner(FileDataset[StrayScannerOptions]):
    """{name} is the frame's number with six digits: 000012. Colour is read from the images of the video."""

    Options: type[BaseModel] = StrayScannerOptions
    contents = "odometry.csv, camera_matrix.csv and depth/ of Stray Scanner"

    def is_scene(self, folder: Path) -> bool:
        """Return whether odometry.csv and camera_matrix.csv are there."""
        return (folder / "odometry.csv").is_file() and (folder / "camera_matrix.csv").is_file()

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each line of odometry.csv.

        Raises:
            DataError: For a damaged line; the message names it.
        """
        path, folders = folder / "odometry.csv", Folders()
        lines = [(line, text.replace(",", " ").split()) for line, text in records(path)][1:]  # after the header
        if not lines:
            raise DataError(f"{path}: holds no pose; record again")
        if wrong := next((line for line, words in lines if len(words) not in COLUMNS), None):
            raise DataError(f"{path}: line {wrong} does not have {' or '.join(map(str, COLUMNS))} values; record again")
        numbers = [[to_number(word, path, line) for word in words] for line, words in lines]
        first = np.array([row[:9] for row in numbers])
        poses = from_quaternions(first[:, 2:5], first[:, 5:9], path)
        usual = read_intrinsics(folder / "camera_matrix.csv")
        shared = Camera(usual, self.options.image_size)
        for (line, words), row, pose in zip(lines, numbers, poses, strict=True):
            name = words[1].zfill(6)
            where, intrinsics = f"{path}: line {line}", (row[9], row[10], row[11], row[12]) if len(row) > 9 else None
            depth, confidence = (folder / f"{kind}/{name}" for kind in ("depth", "confidence"))
            image = folder / self.options.images.replace("{name}", name)
            yield FrameSource(
                name=name, depth=folders.one_of(depth, DEPTH_SUFFIXES) or depth.with_name(f"{name}.png"),
                pose=pose, pose_file=path, timestamp=row[0],
                camera=shared if intrinsics is None else Camera.stated(intrinsics, self.options.image_size, where),
                color=folders.one_of(image, COLOR_SUFFIXES),
                confidence=confidence.with_name(f"{name}.png") if self.options.least_confidence else None,
                least_confidence=self.options.least_confidence,
            )  # fmt: skip
