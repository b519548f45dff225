"""Cameras of RealityCapture and RealityScan: Export, Registration, Internal/External camera parameters, a CSV.

Source: Tancik et al., Nerfstudio, SIGGRAPH 2023, its converter of these files; the header of the file itself.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field

from semstab.data.georeference import Georeference
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import Folders, inside
from semstab.datasets.formats.disk import MAX_BYTES, read_text, to_number
from semstab.datasets.formats.images import color_size
from semstab.datasets.geometry.cameras import Camera
from semstab.datasets.photographs import PhotographOptions, Photographs, Reconstruction, Shot, find_image
from semstab.errors import DataError, summarize_error

HEAD = "#name"
NUMBERS = ("x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py")
DISTORTION = ("k1", "k2", "k3", "k4", "t1", "t2")

FILM = 36.0
"""Millimetres along the longer side of an image, for which focal length and principal point are stated."""


class RealityCaptureOptions(PhotographOptions):
    """Options with the defaults of the format."""

    camera_axes: opt.CameraAxes = "opengl"
    image_size: opt.Size = Field(None, description="[width, height] of the images; the size of the files by default")


class RealityCapture(Photographs[RealityCaptureOptions]):
    """Coordinates are those of the export. With `crs`, which the file does not name, they and meshes are in it.

    The file has no sizes of images: one image of each focal length is looked at, unless `image_size` says it. Its
    distortion is not documented: export undistorted images with their cameras.
    """

    Options: type[BaseModel] = RealityCaptureOptions
    contents = "a CSV of RealityCapture (Internal/External camera parameters)"
    patterns = ("*.csv",)

    def has_cameras(self, path: Path) -> bool:
        """Return whether the file begins with the header of the format."""
        with path.open("rb") as file:
            head = file.read(256).decode("utf-8", errors="replace").lstrip("\ufeff").split("\n")[0]
        return head.startswith(HEAD) and {"heading", "pitch", "roll"} <= {word.strip() for word in head.split(",")}

    def reconstruction(self, path: Path, folder: Path) -> Reconstruction:
        """Read the file and the sizes of the images. Raises DataError for a damaged one, or distorted images."""
        text = io.StringIO(read_text(path, MAX_BYTES).lstrip("\ufeff"), newline=None)
        try:
            rows = list(csv.DictReader(text))
        except csv.Error as error:
            raise DataError(f"{path}: no table ({summarize_error(error)}); export the registration again") from error
        if not rows:
            raise DataError(f"{path}: holds no camera; export the registration again")
        images = [folder / "images" if self.options.images is None else self.options.images, folder]
        contents, sizes = Folders(), dict[tuple[str, ...], tuple[int, int]]()
        shots = []
        for number, row in enumerate(rows, start=2):
            name = (row.get(HEAD) or "").strip()
            values = {key: _value(row, key, path, number) for key in (*NUMBERS, *DISTORTION)}
            if any(values[key] for key in DISTORTION):
                raise DataError(
                    f"{path}, line {number}: {name[:80]!r} is distorted; export undistorted images, and their cameras"
                )
            lens = tuple(row.get(key) or "" for key in ("f", "px", "py"))
            if self.options.image_size is not None:
                sizes[lens] = self.options.image_size
            if lens not in sizes:
                image = find_image(images, name, contents, str(path))
                stated = inside(images[0], images[0], name or "image", str(path))
                sizes[lens] = color_size(stated if image is None else image)
            shots.append(_shot(name, values, sizes[lens], f"{path}, line {number}"))
        if self.options.crs is None:
            return Reconstruction(path, shots)
        offset = np.floor(np.mean([shot.pose[:3, 3] for shot in shots], axis=0))
        for shot in shots:
            shot.pose[:3, 3] -= offset
        east, north, up = offset.tolist()
        georeference = Georeference.from_crs(self.options.crs, (east, north, up), "option crs")
        return Reconstruction(path, shots, georeference, (0.0, 0.0, 0.0))


def _value(row: Mapping[str, str | None], key: str, path: Path, number: int) -> float:
    """Return a number of a row; 0 for a distortion that the file does not state."""
    text = row.get(key)
    if text is None or not text.strip():
        if key in DISTORTION:
            return 0.0
        raise DataError(f"{path}, line {number}: '{key}' is missing; export all internal and external parameters")
    return to_number(text, path, number)


def _shot(name: str, values: Mapping[str, float], size: tuple[int, int], where: str) -> Shot:
    """Return a photograph: turned about north by heading to the east, then tilted; 0, 0, 0 looks down, north is up."""
    from scipy.spatial.transform import Rotation

    if not name:
        raise DataError(f"{where}: '{HEAD}' is missing; export the registration again")
    T = np.eye(4)
    angles = (-values["heading"], values["pitch"], values["roll"])
    T[:3, :3] = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    T[:3, 3] = [values["x"], values["y"], values["alt"]]
    (width, height), pixels = size, max(size) / FILM
    cx, cy = values["px"] * pixels + (width - 1) / 2, values["py"] * pixels + (height - 1) / 2
    return Shot(name, T, Camera.stated((values["f"] * pixels,) * 2 + (cx, cy), size, where), None)
