"""UAVScenes: a folder a flight with photographs and sampleinfos_interpolated.json, depth from the maps of DJI Terra.

Source: Wang et al., UAVScenes, ICCV 2025, and github.com/sijieaaa/UAVScenes: README, cmap.py.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from semstab.core.files import read_json
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.options import FileOptions, FrameSource
from semstab.datasets.files.scene import FileScene
from semstab.datasets.files.surfaces import Surface
from semstab.datasets.geometry.cameras import Camera
from semstab.datasets.geometry.lenses import Lens
from semstab.datasets.photographs import PhotographOptions, Photographs, Reconstruction, Shot
from semstab.datasets.scene import GROUND_TRUTH
from semstab.errors import DataError

FILE = "sampleinfos_interpolated.json"

FLIGHT = re.compile(r"interval(?P<step>\d+)_(?P<name>(?P<place>.+?)\d*)")
"""The folder of a flight: interval5_AMtown01, interval1_HKairport_GNSS_Evening."""

MAPS = "terra_3dmap_pointcloud_mesh"
"""Folder of the maps, PLACE/Mesh.ply in it or one deeper."""

ABOVE = 4
"""Folders above a flight in which maps and labels are sought."""


class UavScenesOptions(PhotographOptions):
    """Options with the defaults of the format."""

    pose_convention: opt.PoseConvention = "camera_to_world"


class UavScenes(Photographs[UavScenesOptions]):
    """Scenes are called as the flights, AMtown01. Only frames with a photograph count: of interval5 each fifth pose.

    Depth comes from Mesh.ply of the flight's place, ground truth from interval5_CAM_label, both found in folders above.
    """

    Options: type[BaseModel] = UavScenesOptions
    contents = f"{FILE} and interval5_CAM/ of UAVScenes"
    patterns = (FILE,)

    def has_cameras(self, path: Path) -> bool:
        """Return whether the file is one of cameras: its name says so."""
        return True

    def find_scenes(self, root: Path) -> Iterable[SceneEntry]:
        """Return the flights below the root under their own names.

        Raises:
            DataError: If there is none, or one in two intervals.
        """
        entries = [_named(entry) for entry in super().find_scenes(root)]
        names = [entry.name for entry in entries]
        if twice := next((entry for entry in entries if names.count(entry.name) > 1), None):
            raise DataError(f"{root}: holds {twice.name} in two intervals; set root to one of them")
        return entries

    def reconstruction(self, path: Path, folder: Path) -> Reconstruction:
        """Read the file; of the cameras in it those that have a photograph. Raises DataError for a damaged one."""
        content = read_json(path)
        if not isinstance(content, list):
            raise DataError(f"{path}: expected a list of cameras, got a {type(content).__name__}; download it again")
        image_names = {image.name for image_folder in self.image_folders(folder) for image in image_folder.glob("*.*")}
        shots = [_shot(camera, f"{path}, camera {k}") for k, camera in enumerate(content)]
        return Reconstruction(path, [shot for shot in shots if shot.name in image_names] if image_names else shots)

    def image_folders(self, folder: Path) -> Sequence[Path]:
        """Return the folders of a flight's photographs, interval5_CAM first."""
        return [*sorted(folder.glob("interval*_CAM")), *super().image_folders(folder)]

    def frames(self, folder: Path) -> list[FrameSource]:
        """Return a frame for each photograph with the time that it is called after, seconds."""
        return [dataclasses.replace(frame, timestamp=_seconds(frame.name)) for frame in super().frames(folder)]

    def settled(self, folder: Path) -> UavScenesOptions:
        """Return the options, with the mesh of the flight's place as surface where nothing else gives depth."""
        options = self.options
        if options.surface is None and (mesh := _map_of(folder)) is not None:
            return options.model_copy(update={"surface": mesh})
        return super().settled(folder)

    def opened(
        self, entry: SceneEntry, frames: Sequence[FrameSource], options: FileOptions, surface: Surface | None
    ) -> FileScene:
        """Return the scene, with the ground truth that lies in a folder of its own."""
        truth = _truth_of(entry.folder)
        label_folders = {} if truth is None or options.ground_truth is not None else {GROUND_TRUTH: truth}
        return FileScene(entry, frames, options, surface=surface, label_folders=label_folders)


def _named(entry: SceneEntry) -> SceneEntry:
    """Return the scene under the name of its flight, where its folder has one."""
    flight = FLIGHT.fullmatch(entry.folder.name)
    return entry if flight is None else SceneEntry(flight["name"], entry.folder, flight["name"])


def _map_of(folder: Path) -> Path | None:
    """Return the mesh of the place of a flight, or None without the mesh."""
    flight = FLIGHT.fullmatch(folder.name)
    candidates = [] if flight is None else _above(folder, MAPS, f"{flight['place']}/Mesh.ply")
    return next((path for path in candidates if path.is_file()), None)


def _truth_of(folder: Path) -> Path | None:
    """Return the folder of a flight's label maps, or None without label maps."""
    flight = FLIGHT.fullmatch(folder.name)
    archive = "" if flight is None else f"interval{flight['step']}_CAM_label"
    candidates = _above(folder, archive, f"{folder.name}/{archive}_id") if archive else []
    return next((path for path in candidates if path.is_dir()), None)


def _above(folder: Path, archive: str, inner: str) -> list[Path]:
    """Return where a part of an archive may lie above a flight: an archive holds a folder of its own name, or not."""
    above = [*folder.absolute().parents][:ABOVE]
    return [parent / outer / inner for parent in above for outer in (archive, f"{archive}/{archive}")]


def _seconds(name: str) -> float | None:
    try:
        return float(name)
    except ValueError:
        return None


def _shot(camera: Any, where: str) -> Shot:
    """Return a camera of the file: T4x4 from the camera to the map, P3x3, K1 to K3 and P1, P2 as OpenCV has them."""
    if not isinstance(camera, Mapping):
        raise DataError(f"{where}: is no camera; download the file again")
    name = camera.get("OriginalImageName")
    if not isinstance(name, str) or not name:
        raise DataError(f"{where}: OriginalImageName is missing; download the file again")
    T, K = _matrix(camera, "T4x4", 4, where), _matrix(camera, "P3x3", 3, where)
    width, height = (_number(camera, key, where) for key in ("Width", "Height"))
    k1, k2, k3, p1, p2 = (_number(camera, key, where, 0.0) for key in ("K1", "K2", "K3", "P1", "P2"))
    if abs(K[0, 1]) > 1e-6 or (K[2] != (0, 0, 1)).any():
        raise DataError(f"{where}: P3x3 is no matrix of a camera without skew; download the file again")
    if not (width.is_integer() and height.is_integer() and 0 < width < 1e6 and 0 < height < 1e6):
        raise DataError(f"{where}: a photograph of {width:g}x{height:g} pixels; download the file again")
    size = (int(width), int(height))
    stated = Camera.stated((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), size, where)
    lens = Lens(stated, "brown", (k1, k2, p1, p2, k3)) if any((k1, k2, k3, p1, p2)) else None
    return Shot(name, T, stated, lens)


def _matrix(camera: Mapping[str, Any], key: str, size: int, where: str) -> Any:
    try:
        matrix = np.array(camera.get(key), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise DataError(f"{where}: {key} is no {size}x{size} matrix; download the file again")
    return matrix


def _number(camera: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    value = camera.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
        raise DataError(f"{where}: {key} is no number; download the file again")
    return float(value)
