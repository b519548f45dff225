"""Mid-Air: simulated flights low over land, a folder a climate with color_left/, depth/ and sensor_records.hdf5.

Sources: Fonder and Van Droogenbroeck, Mid-Air, CVPR Workshops 2019; github.com/montefiore-institute/midair-dataset, its
viewer; github.com/michael-fonder/M4Depth, its lists of frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from semstab.core.types import Float32, Float64
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.options import FileOptions, FrameSource
from semstab.datasets.files.reader import FileDataset, frames_of
from semstab.datasets.formats.disk import files_named, natural, read_bytes, subfolders
from semstab.datasets.formats.hdf5 import numbers, opened
from semstab.datasets.formats.images import Read, read_depth
from semstab.datasets.geometry.cameras import camera_of, from_quaternions
from semstab.errors import DataError

RECORDS = "sensor_records.hdf5"

SIZE = (1024, 1024)
USUAL = (512.0, 512.0, 511.5, 511.5)
"""Images of 90 degrees."""

ROWS = 4
"""Rows of the ground truth, 100 a second, from an image to the next one."""

MOST = 10**7
"""Rows of a flight: more is a damaged number."""


class MidAirOptions(FileOptions):
    """Options with the defaults of the format; the intrinsics are 512 512 511.5 511.5."""

    depth_scale: opt.DepthScale = 1.0
    depth_kind: opt.DepthKind = "ray"
    max_depth: opt.MaxDepth = 1250
    camera_axes: opt.CameraAxes = "ned"
    up_axis: opt.UpAxis = "-z"
    ground_truth: opt.GroundTruth = "segmentation/{name}.PNG"
    intrinsics: opt.FourIntrinsics = None


class MidAir(FileDataset[MidAirOptions]):
    """{name} is the flight and the image's number, trajectory_0000/000012. A flight is a scene.

    Its name ends with that of the flight: Kite_training-sunny-trajectory_0000.
    """

    Options: type[BaseModel] = MidAirOptions
    contents = f"{RECORDS}, color_left/trajectory_NNNN/ and depth/trajectory_NNNN/"

    def is_scene(self, folder: Path) -> bool:
        """Return whether the poses of flights are there, and their depth; with a surface, their images."""
        return (folder / RECORDS).is_file() and bool(self._flights(folder))

    def find_scenes(self, root: Path) -> Iterable[SceneEntry]:
        """Return the flights of each folder below the root; raises what `find_scenes` of the base does."""
        return [
            replace(entry, name=f"{entry.name}-{flight}")
            for entry in super().find_scenes(root)
            for flight in self._flights(entry.folder)
        ]

    def frames_of_scene(self, entry: SceneEntry) -> Iterable[FrameSource]:
        """Return the frames of the flight that the scene is called after. Raises what `frames` raises."""
        flight = next(name for name in self._flights(entry.folder) if entry.name.endswith(f"-{name}"))
        return self._frames(entry.folder, flight)

    def frames(self, folder: Path) -> Iterable[FrameSource]:
        """Yield the frames of all flights of a folder.

        Raises:
            DataError: For damaged records, or an image to which they have no row.
            MissingDependencyError: If h5py is not installed.
        """
        for flight in self._flights(folder):
            yield from self._frames(folder, flight)

    def _flights(self, folder: Path) -> list[str]:
        within = folder / ("depth" if self.options.surface is None else "color_left")
        return [name for name in sorted(subfolders(within), key=natural) if name.startswith("trajectory_")]

    def _frames(self, folder: Path, flight: str) -> Iterable[FrameSource]:
        images = files_named(folder / f"color_left/{flight}", "", ".JPEG")
        files = self.depth_files(folder / f"depth/{flight}", "", ".PNG", instead=images)
        path = folder / RECORDS
        rows = ROWS * np.array([_number(name, folder / "depth" / flight) for name in files], dtype=np.int64)
        positions, attitudes = read_flight(path, flight)
        if len(rows) and rows.max() >= len(positions):
            raise DataError(
                f"{path}: {flight} has {len(positions)} rows, but image {max(files, key=natural)} goes with row"
                f" {rows.max()}, counted from 0; download it again"
            )
        poses = from_quaternions(positions[rows], attitudes[rows][:, [1, 2, 3, 0]], path)
        camera = camera_of(self.options.intrinsics, USUAL, SIZE)
        depth = {f"{flight}/{name}": file for name, file in files.items()}
        frames = frames_of(folder, depth, camera, pose=RECORDS, color="color_left/{name}.JPEG", poses=poses)
        return [
            replace(frame, depth_reader=read_half_floats, timestamp=float(row / (25 * ROWS)))
            for frame, row in zip(frames, rows, strict=True)
        ]


def _number(name: str, folder: Path) -> int:
    if not (name.isascii() and name.isdigit() and len(name) < 10):
        raise DataError(f"{folder}: {name[:40]!r} is no number of an image, which ties it to its pose; rename it")
    return int(name)


def read_half_floats(path: Path, scale: float | None = None, read: Read = read_bytes) -> Float32:
    """Return depth (H, W), float32, of a PNG whose 16 bits are those of a half float in metres.

    `scale` is units in a metre. Raises what `read_depth` raises.
    """
    bits = read_depth(path, 1.0, read).astype(np.uint16)
    with np.errstate(all="ignore"):  # a damaged file may hold any bits
        metres: Float32 = bits.view(np.float16).astype(np.float32) / np.float32(scale or 1)
    return metres


def read_flight(path: Path, flight: str) -> tuple[Float64, Float64]:
    """Return a flight's positions (n, 3), metres, and attitudes (n, 4), w x y z, from the drone to the world.

    The world has x to the north, y to the east, z down; the drone x forward, y to the right, z down.

    Raises:
        DataError: If the file is damaged, or lacks them.
        MissingDependencyError: If h5py is not installed.
    """
    with opened(path) as records:
        truth = f"{flight}/groundtruth"
        positions = numbers(records, f"{truth}/position", (None, 3), 3 * MOST, path).astype(np.float64)
        attitudes = numbers(records, f"{truth}/attitude", (None, 4), 4 * MOST, path).astype(np.float64)
    if len(positions) != len(attitudes):
        raise DataError(
            f"{path}: {flight} has {len(positions)} positions and {len(attitudes)} attitudes; download it again"
        )
    return positions, attitudes
