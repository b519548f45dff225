"""Posed clouds in plain folders: points/NAME.las (.laz, .ply, .npy), pose/NAME.txt or poses.txt, labels/MODEL/."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field

from semstab.config import nearest
from semstab.core.types import Float64
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.scans import (
    LABEL_FIELDS,
    ScanDataset,
    ScanOptions,
    ScanSource,
    as_poses,
    classes_in,
    ids_of,
)
from semstab.datasets.files.surfaces import open_las
from semstab.datasets.formats.disk import decode_array, files_by_stem, natural, read_pose, read_table
from semstab.datasets.formats.images import Read
from semstab.datasets.formats.ply import Header
from semstab.errors import DataError

LAS = (".las", ".laz")
PLY = ".ply"
SUFFIXES = (*LAS, PLY, ".npy")
PROPERTIES = (*LABEL_FIELDS, "classification")
"""Names of a property of classes in PLY files, in upper or lower case, after 'scalar_' too, as CloudCompare writes."""


class PointsOptions(ScanOptions):
    """Options with the defaults of the format."""

    coordinates: Literal["sensor", "world"] = Field(
        "sensor", description="what points are in; those in the world need the pose only for where the sensor was"
    )
    pose_convention: Literal["camera_to_world", "world_to_camera"] = Field(
        "camera_to_world", description="map of the poses: from the sensor to the world, or back"
    )
    label_field: str | None = Field(
        None, description="property of PLY files that is the class of each point; '' for none"
    )


class PointsFolder(ScanDataset[PointsOptions]):
    """{name} is the name that a scan's files share. Classes in LAS and PLY files of points are the ground truth."""

    Options: type[BaseModel] = PointsOptions
    contents = "points/ and pose/ or poses.txt"
    labels = ("labels/{model}/{name}",)

    def __init__(self, options: PointsOptions) -> None:
        super().__init__(options)
        self.in_world = options.coordinates == "world"

    def is_scene(self, folder: Path) -> bool:
        """Return whether points are there, and poses."""
        return (folder / "points").is_dir() and ((folder / "pose").is_dir() or (folder / "poses.txt").is_file())

    def scans(self, entry: SceneEntry) -> Iterator[ScanSource]:
        """Yield a scan for each cloud, with NaN for its pose where pose/ has none.

        Raises:
            DataError: If poses.txt has another number of rows, or a file is damaged.
        """
        folder = entry.folder
        files = files_by_stem(folder / "points", SUFFIXES)
        names = sorted(files, key=natural)
        self.truth = self._truth_in(folder / "points", files)
        poses = self._poses(folder, names)
        for name, (pose, path) in zip(names, poses, strict=True):
            yield ScanSource(name, folder / "points" / files[name], pose, path)

    def points(self, path: Path, read: Read) -> npt.NDArray[np.floating[Any]]:
        """Return x, y, z of a cloud."""
        if path.suffix.lower() in LAS:
            with open_las(path) as reader:
                return np.asarray(reader.read().xyz, np.float64)
        if path.suffix.lower() == PLY:
            cloud = _of_ply(path, read(path))
            return np.column_stack([cloud[axis].astype(np.float64) for axis in "xyz"])
        rows = decode_array(path, read(path), "points")
        if rows.ndim != 2 or rows.shape[1] < 3 or not np.issubdtype(rows.dtype, np.floating):
            raise DataError(f"{path}: holds {rows.dtype} of shape {rows.shape}; write float (N, 3), metres")
        return rows[:, :3]

    def ids(self, path: Path, read: Read) -> npt.NDArray[np.integer[Any]]:
        """Return the classification of a LAS file, the classes of a PLY file, or the ids of another one."""
        if path.suffix.lower() == PLY:
            cloud = _of_ply(path, read(path))
            name = self._property(cloud.dtype.names or (), path)
            return classes_in(cloud[name], name, str(path))
        if path.suffix.lower() not in LAS:
            return ids_of(path, read(path))
        with open_las(path) as reader:
            return np.asarray(reader.read().classification, np.uint8)

    def _truth_in(self, folder: Path, files: dict[str, str]) -> str | None:
        """Return the template of clouds that hold classes; of PLY files the first one tells."""
        suffixes = (suffix for suffix in LAS if _ends(files, suffix))
        clouds = [file for file in files.values() if file.lower().endswith(PLY)]
        suffix = next(suffixes, PLY if clouds and self._has_classes(folder / clouds[0]) else None)
        return None if suffix is None else f"points/{{name}}{suffix}"

    def _has_classes(self, path: Path) -> bool:
        if self.options.label_field is not None:
            return self.options.label_field != ""
        try:
            with path.open("rb") as file:
                return _class_property(Header.read(file, path).dtype.names or ()) is not None
        except (OSError, DataError):  # said with the scan, when it is read
            return False

    def _property(self, names: Sequence[str], path: Path) -> str:
        """Return the property of classes."""
        name = self.options.label_field or _class_property(names)
        if name is None:
            raise DataError(f"{path}: no property is one of classes ({', '.join(PROPERTIES)}); name it by label_field")
        if name not in names:
            raise DataError(f"{path}: has no property '{name}', option label_field; {nearest(name, names)}")
        return name

    def _poses(self, folder: Path, names: list[str]) -> list[tuple[Float64, Path]]:
        convention, path = self.options.pose_convention, folder / "poses.txt"
        if not path.is_file():
            stored, lost = files_by_stem(folder / "pose", (".txt",)), np.full((4, 4), np.nan)
            paths = {name: folder / "pose" / stored.get(name, f"{name}.txt") for name in names}
            poses = {name: read_pose(path) if name in stored else lost for name, path in paths.items()}
            return [(as_poses(poses[name][None], convention, paths[name])[0], paths[name]) for name in names]
        rows = read_table(path, 12, "r11 r12 r13 t1 ... of each scan").reshape(-1, 3, 4)
        if len(rows) != len(names):
            raise DataError(f"{path}: has {len(rows)} poses, but there are {len(names)} clouds; they must be as many")
        return [(pose, path) for pose in as_poses(rows, convention, path)]


def _ends(files: dict[str, str], suffix: str) -> bool:
    return any(file.lower().endswith(suffix) for file in files.values())


def _class_property(names: Sequence[str]) -> str | None:
    """Return which of a PLY file's properties is that of classes, by its name."""
    bare = {name.lower().removeprefix("scalar_"): name for name in names}
    return next((bare[word] for word in PROPERTIES if word in bare), None)


def _of_ply(path: Path, data: bytes) -> npt.NDArray[np.void]:
    """Return the points (N,) of a binary PLY file, with all their properties."""
    header = Header.read(io.BytesIO(data), path)
    if len(data) < header.size + header.count * header.dtype.itemsize:
        raise DataError(f"{path}: ends before its {header.count:,} points; it is cut short")
    return np.frombuffer(data, header.dtype, header.count, header.size)
