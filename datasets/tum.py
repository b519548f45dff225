"""TUM RGB-D: rgb.txt, depth.txt and groundtruth.txt, tied to each other by time stamps.

Source: Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012, and the dataset's page.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.types import Float64
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, FrameSource, inside
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import read_table, records, to_number
from semstab.datasets.geometry.cameras import Camera, at_times, camera_of, from_quaternions, mutual_nearest
from semstab.errors import DataError

logger = logging.getLogger("semstab")

IMAGE_SIZE = (640, 480)
CAMERAS = {
    "freiburg1": (517.306408, 516.469215, 318.643040, 255.313989),
    "freiburg2": (520.908620, 521.007327, 325.141442, 249.701764),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""Calibrated intrinsics of the colour camera, to which depth is registered, by a part of the sequence's name."""


class TumOptions(FileOptions):
    """Options with the defaults of the format."""

    depth_scale: opt.DepthScale = 5000
    up_axis: opt.UpAxis = "z"
    intrinsics: opt.FourIntrinsics = None
    max_difference: opt.Positive = Field(0.02, description="seconds by which the time stamps of a frame may differ")
    poses: Literal["interpolate", "nearest"] = Field("interpolate", description="the pose at a depth image's time")
    time_offset: opt.TimeOffset = 0.0
    trajectory: str = Field("groundtruth.txt", description="file of the poses: t tx ty tz qx qy qz qw")


class Tum(FileDataset[TumOptions]):
    """{name} is the colour image's name without suffix, 1305031102.175304, or the depth image's without rgb.txt.

    A depth image and a colour image form a frame if each is the other's nearest in time. By default, the sequence's
    name (freiburg1, 2, 3) selects the intrinsics.
    """

    Options: type[BaseModel] = TumOptions
    contents = "depth.txt, groundtruth.txt and rgb.txt"

    def is_scene(self, folder: Path) -> bool:
        """Return whether depth.txt is there, or with a surface rgb.txt."""
        return (folder / self._list(folder)).is_file()

    def frames(self, folder: Path) -> list[FrameSource]:
        """Return a frame for each depth image that has a colour image; its pose is NaN without a near pose.

        If a surface gives the depth and no depth.txt is there, there is one frame for each colour image.

        Raises:
            DataError: For time stamps that do not ascend, or where nothing fits together in time.
        """
        trajectory = inside(self.options.root, folder, self.options.trajectory, "option trajectory")
        numbers = read_table(trajectory, 8, "timestamp tx ty tz qx qy qz qw")
        _require_ascending(trajectory, numbers[:, 0])
        times, depths = self._listed(folder, self._list(folder))
        images, partners = depths, np.arange(len(times))
        if in_color := (folder / "rgb.txt").is_file():
            color_times, images = self._listed(folder, "rgb.txt")
            partners = mutual_nearest(times, color_times, self.options.max_difference)
        paired = partners >= 0
        if not paired.any():
            limit = self.options.max_difference
            raise DataError(f"{folder}: no depth image is within {limit:g} s of a colour image; set max_difference")
        if not paired.all():
            logger.warning("%s: %d depth images have no colour image; left out", folder, np.count_nonzero(~paired))
        poses = at_times(
            times=numbers[:, 0],
            poses=from_quaternions(numbers[:, 1:4], numbers[:, 4:], trajectory),
            wanted=times + self.options.time_offset,
            max_gap=self.options.max_difference,
            method=self.options.poses,
        )
        _require_overlap(trajectory, numbers[:, 0], times + self.options.time_offset)
        camera = self._camera(folder)
        return [
            FrameSource(
                name=images[partners[k]].stem,
                depth=depths[k],
                pose=poses[k],
                pose_file=trajectory,
                camera=camera,
                color=images[partners[k]] if in_color else None,
                timestamp=float(times[k]),
            )
            for k in np.flatnonzero(paired)
        ]

    def _camera(self, folder: Path) -> Camera:
        """Return the stated intrinsics, else those of the sequence's name."""
        usual = next((numbers for key, numbers in CAMERAS.items() if key in folder.resolve().name), None)
        if usual is None and self.options.intrinsics is None:
            raise DataError(
                f"{folder}: the intrinsics are not known, as the folder's name has none of {', '.join(CAMERAS)}; set"
                " intrinsics: [fx, fy, cx, cy] (--option 'intrinsics=[fx, fy, cx, cy]')"
            )
        return camera_of(self.options.intrinsics, usual or CAMERAS["freiburg1"], IMAGE_SIZE)

    def _list(self, folder: Path) -> str:
        cast = self.options.surface is not None and not (folder / "depth.txt").is_file()
        return "rgb.txt" if cast else "depth.txt"

    def _listed(self, folder: Path, name: str) -> tuple[Float64, list[Path]]:
        path = folder / name
        times, paths = [], []
        for line, text in records(path):
            words = text.replace(",", " ").split(maxsplit=1)
            if len(words) != 2:
                raise DataError(f"{path}: line {line} is {text[:40]!r}; expected 'timestamp filename'")
            times.append(to_number(words[0], path, line))
            paths.append(inside(self.options.root, folder, words[1], f"{path}: line {line}"))
        if not paths:
            raise DataError(f"{path}: lists no image; expected lines of 'timestamp filename'")
        stamps = np.array(times, dtype=np.float64)
        _require_ascending(path, stamps)
        return stamps, paths


UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}


def _require_overlap(path: Path, times: Float64, image_times: Float64) -> None:
    """Raise DataError where the trajectory and the images have no time in common, with the reason that shows."""
    if times[0] <= image_times[-1] and image_times[0] <= times[-1]:
        return
    for unit, name in UNITS.items():
        for factor, where in ((1 / unit, path.name), (unit, "the lists of images")):
            if abs(times[0] * factor - image_times[0]) < 0.1 * min(times[0] * factor, image_times[0]):
                raise DataError(f"{path}: time stamps of {where} look like {name}; write seconds")
    raise DataError(
        f"{path}: poses are from {times[0]:.6f} to {times[-1]:.6f} s, images from {image_times[0]:.6f} to"
        f" {image_times[-1]:.6f} s: they have no time in common; if the clocks differ, set time_offset (about"
        f" {times[0] - image_times[0]:.6g})"
    )


def _require_ascending(path: Path, times: Float64) -> None:
    if not np.isfinite(times).all():
        raise DataError(f"{path}: the time stamp of record {np.flatnonzero(~np.isfinite(times))[0] + 1} is not finite")
    if (late := np.diff(times) <= 0).any():
        k = np.flatnonzero(late)[0]
        raise DataError(
            f"{path}: time stamps must ascend, but record {k + 2} ({times[k + 1]:.6f}) is not after record {k + 1}"
            f" ({times[k]:.6f}); sort the file"
        )
