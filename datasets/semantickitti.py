"""SemanticKITTI: scans of KITTI's odometry sequences with a class a point, poses and calibration.

Source: Behley et al., SemanticKITTI, ICCV 2019, and semantic-kitti.org: data format; classes and learning_map of
github.com/PRBonn/semantic-kitti-api, config/semantic-kitti.yaml.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field

from semstab.config import read_yaml
from semstab.core.types import Float32, Float64, Mask, UInt16
from semstab.data.labels import IGNORE_16BIT
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.scans import NO_ID, ScanDataset, ScanOptions, ScanSource, as_poses, floats_of, rigid_inverse
from semstab.datasets.formats.disk import files_named, read_matrices, read_table
from semstab.datasets.formats.images import Read
from semstab.errors import ConfigError, DataError

LEARNING_MAP = {
    10: 10, 11: 11, 13: 20, 15: 15, 16: 20, 18: 18, 20: 20, 30: 30, 31: 31, 32: 32, 40: 40, 44: 44, 48: 48, 49: 49,
    50: 50, 51: 51, 60: 40, 70: 70, 71: 71, 72: 72, 80: 80, 81: 81, 252: 10, 253: 31, 254: 30, 255: 32, 256: 20,
    257: 20, 258: 18, 259: 20,
}  # fmt: skip
"""The stored ids of the 19 classes that are evaluated, as the benchmark's learning_map joins them; bus, for example, is
other-vehicle, and a lane marking road."""

IGNORED = (0, 1, 52, 99)
"""Stored ids that the benchmark does not evaluate: unlabeled, outlier, other-structure, other-object."""

MOVING = range(252, 260)


class SemanticKittiOptions(ScanOptions):
    """Options with the defaults of the format."""

    up_axis: opt.UpAxis = "z"
    poses: str = Field("poses.txt", description="file of the poses, 3x4 in a row, a row a scan")
    pose_frame: Literal["camera", "lidar"] = Field(
        "camera", description="what the poses are of: camera 0, with Tr of calib.txt from the LiDAR to it, or the LiDAR"
    )
    pose_convention: Literal["camera_to_world", "world_to_camera"] = Field(
        "camera_to_world", description="map of the poses"
    )
    moving: Literal["leave_out", "keep"] = Field(
        "leave_out", description="points whose true class moves (ids 252 to 259)"
    )
    learning_map: Path | None = Field(
        None, description="YAML with a learning_map from stored ids to those of taxonomy, instead of the benchmark's"
    )


class SemanticKitti(ScanDataset[SemanticKittiOptions]):
    """{name} is the scan's number: 000012. Predictions are .label files as the ground truth in labels/.

    Points whose true class moves are left out of all maps, as masked pixels are.
    """

    Options: type[BaseModel] = SemanticKittiOptions
    contents = "velodyne/ and poses.txt"
    labels = ("predictions/{model}/{name}.label", "{model}/predictions/{name}.label")
    truth = "labels/{name}.label"
    taxonomy = "semantickitti"

    def __init__(self, options: SemanticKittiOptions) -> None:
        super().__init__(options)
        self._table = _table(options)

    def find_scenes(self, root: Path) -> Iterable[SceneEntry]:
        """Return the scenes; one in the folder sequences/ of the benchmark is called as its sequence is: 08."""
        entries = [*super().find_scenes(root)]
        short = [entry.name.removeprefix("sequences-") for entry in entries]
        unique = len(set(short)) == len(short)
        return [replace(entry, name=name) if unique else entry for entry, name in zip(entries, short, strict=True)]

    def is_scene(self, folder: Path) -> bool:
        """Return whether scans are there, and their poses."""
        return (folder / "velodyne").is_dir() and (folder / self.options.poses).is_file()

    def scans(self, entry: SceneEntry) -> Iterator[ScanSource]:
        """Return a scan for each file of points; raises what `scans_of` raises."""
        options = self.options
        return scans_of(entry.folder, options.poses, options.pose_convention, options.pose_frame)

    def points(self, path: Path, read: Read) -> Float32:
        """Return the points of x, y, z and remission."""
        return floats_of(path, read(path), 4)[:, :3]

    def class_ids(self, model: str) -> UInt16 | None:
        """Return the learning map as a table."""
        return self._table

    def moving(self, ids: Callable[[], npt.NDArray[np.integer[Any]]]) -> Mask | None:
        """Return the points of ids 252 to 259, where they are to be left out."""
        return None if self.options.moving == "keep" else np.isin(ids(), MOVING)


def scans_of(folder: Path, poses_file: str, convention: str, pose_frame: str) -> Iterator[ScanSource]:
    """Yield a scan for each file of points of a sequence, with the pose of the LiDAR in the world of the first one.

    Raises:
        DataError: If there are fewer poses, or the calibration is not there.
    """
    files = files_named(folder / "velodyne", "", ".bin")
    path = folder / poses_file
    rows = read_table(path, 12, "r11 r12 r13 t1 ... of each scan").reshape(-1, 3, 4)
    poses = as_poses(rows, convention, path)
    if pose_frame == "camera":
        Tr = lidar_to_camera(
            folder / "calib.txt", "; where the poses are the LiDAR's own, set pose_frame: lidar (--option"
            " pose_frame=lidar)"
        )  # fmt: skip
        poses = rigid_inverse(Tr, str(folder / "calib.txt")) @ poses @ Tr  # in the world of the first LiDAR, z up
    times = folder / "times.txt"
    stamps = read_table(times, 1, "seconds").ravel() if times.is_file() else None
    for k, (name, points) in enumerate(files.items()):
        row = int(name) if name.isdigit() and len(poses) > len(files) else k
        if row >= len(poses):
            raise DataError(f"{path}: has {len(poses)} poses, and scan {name} is number {row}; add its pose")
        stamp = None if stamps is None or row >= len(stamps) else float(stamps[row])
        yield ScanSource(name, points, poses[row], path, stamp)


def benchmark_ids() -> UInt16:
    """Return the benchmark's learning_map as a table (65536,) from stored ids to those of the 19 classes."""
    table = np.full(1 << 16, NO_ID, np.uint16)
    table[[*IGNORED, IGNORE_16BIT]] = IGNORE_16BIT
    table[[*LEARNING_MAP]] = [*LEARNING_MAP.values()]
    return table


def _table(options: SemanticKittiOptions) -> UInt16:
    if options.learning_map is None:
        return benchmark_ids()
    table = np.full(1 << 16, NO_ID, np.uint16)
    table[[*IGNORED, IGNORE_16BIT]] = IGNORE_16BIT
    path = options.learning_map
    content = read_yaml(path).get("learning_map")
    if not isinstance(content, dict) or not all(isinstance(n, int) for pair in content.items() for n in pair):
        raise ConfigError(f"{path}: has no learning_map of ids; see config/semantic-kitti.yaml of semantic-kitti-api")
    if options.taxonomy is None and options.classes is None:
        raise ConfigError(f"{path}: name the classes of its ids, taxonomy: FILE.yaml or classes: [name, ...]")
    if wrong := next((n for pair in content.items() for n in pair if not 0 <= n < NO_ID), None):
        raise ConfigError(f"{path}: learning_map: {wrong} is no id from 0 to {NO_ID - 1}")
    table[[*content]] = [*content.values()]
    return table


def lidar_to_camera(path: Path, otherwise: str = "") -> Float64:
    """Return Tr (4, 4), from the LiDAR to camera 0, of KITTI's calib.txt; raises DataError, `otherwise` at its end."""
    if not path.is_file():
        raise DataError(f"{path}: is missing; it holds Tr, from the LiDAR to camera 0{otherwise}")
    matrices = read_matrices(path)
    for key in ("Tr", "Tr_velo_to_cam"):
        if key in matrices:
            return matrices[key]
    raise DataError(f"{path}: has no line Tr of 12 numbers; copy that of SemanticKITTI's calib.txt{otherwise}")
