"""Cameras of Pix4Dmapper: PROJECT_calibrated_camera_parameters.txt, with PROJECT_offset.xyz and PROJECT_wkt.prj.

Source: support.pix4d.com, articles 202977149 (the folder params) and 202559089 (internal and external parameters).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from semstab.data.georeference import Georeference
from semstab.datasets.files import options as opt
from semstab.datasets.formats.disk import records, to_number
from semstab.datasets.geometry.cameras import Camera
from semstab.datasets.geometry.lenses import Lens
from semstab.datasets.photographs import PhotographOptions, Photographs, Reconstruction, Shot
from semstab.errors import DataError

SUFFIX = "_calibrated_camera_parameters.txt"

BLOCK = (3, 3, 3, 3, 2, 3, 3, 3, 3)
"""Numbers in each line of a photograph: K, radial and tangential distortion, position, rotation."""


class Pix4dOptions(PhotographOptions):
    """Options with the defaults of the format."""

    pose_convention: opt.PoseConvention = "world_to_camera"


class Pix4d(Photographs[Pix4dOptions]):
    """Coordinates are the projection's coordinates minus the offset, as in the meshes that Pix4D exports."""

    Options: type[BaseModel] = Pix4dOptions
    contents = f"PROJECT{SUFFIX} of Pix4D (1_initial/params)"
    patterns = (f"*{SUFFIX}", f"params/*{SUFFIX}", f"1_initial/params/*{SUFFIX}")

    def has_cameras(self, path: Path) -> bool:
        """Return whether the file is one of cameras: its name says so."""
        return True

    def reconstruction(self, path: Path, folder: Path) -> Reconstruction:
        """Read the file, and the files of the georeference next to it. Raises DataError for a damaged file."""
        shots, project = read_cameras(path), path.name.removesuffix(SUFFIX)
        projection, shift = (path.with_name(f"{project}_{name}") for name in ("wkt.prj", "offset.xyz"))
        if self.options.crs is not None or not projection.is_file():
            return Reconstruction(path, shots)
        words = " ".join(text for _, text in records(projection))
        offset = (0.0, 0.0, 0.0)
        if shift.is_file():
            numbers = [to_number(word, shift, line) for line, text in records(shift) for word in text.split()]
            if len(numbers) != 3:
                raise DataError(f"{shift}: expected three numbers, got {len(numbers)}; export the parameters again")
            offset = (numbers[0], numbers[1], numbers[2])
        return Reconstruction(path, shots, Georeference.from_crs(words, offset, str(projection)))


def read_cameras(path: Path) -> list[Shot]:
    """Return the photographs of a file. Poses are from the world to the camera.

    Raises:
        DataError: For a damaged file; the message names the line.
    """
    lines = [(number, text.split()) for number, text in records(path)]
    start = next((k for k, (_, words) in enumerate(lines) if _is_head(words)), None)
    if start is None:
        raise DataError(f"{path}: holds no photograph, a line of 'NAME WIDTH HEIGHT'; export the parameters again")
    shots = []
    for position in range(start, len(lines), 1 + len(BLOCK)):
        number, head = lines[position]
        if not _is_head(head):
            raise DataError(f"{path}, line {number}: expected 'NAME WIDTH HEIGHT'; export the parameters again")
        shots.append(_shot(path, number, head, lines[position + 1 : position + 1 + len(BLOCK)]))
    return shots


def _is_head(words: Sequence[str]) -> bool:
    """Return whether a line begins a photograph: its name, which may have spaces, its width and its height."""
    return len(words) >= 3 and words[-1].isdecimal() and words[-2].isdecimal() and len(words[-1]) < 7 > len(words[-2])


def _shot(path: Path, number: int, head: Sequence[str], lines: Sequence[tuple[int, Sequence[str]]]) -> Shot:
    name, width, height = " ".join(head[:-2]), int(head[-2]), int(head[-1])
    where = f"{path}, line {number}: {name[:80]!r}"
    if [len(words) for _, words in lines] != [*BLOCK]:
        raise DataError(f"{where}: expected lines of {', '.join(map(str, BLOCK))} numbers; export the parameters again")
    rows = [[to_number(word, path, line) for word in words] for line, words in lines]
    K, (r1, r2, r3), (t1, t2), position, R = np.array(rows[:3]), rows[3], rows[4], rows[5], np.array(rows[6:])
    if abs(K[0, 1]) > 1e-6 or (K[2] != (0, 0, 1)).any():
        raise DataError(f"{where}: its matrix K has skew, which is not supported; export the parameters again")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ np.array(position)
    size, centre = (width, height), ((width - 1) / 2, (height - 1) / 2)
    stated = Camera.stated((K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5), size, where)  # pixels count from a corner
    if not any((r1, r2, r3, t1, t2)):
        return Shot(name, T, stated, None)
    pinhole = Camera.stated(((K[0, 0] + K[1, 1]) / 2,) * 2 + centre, size, where)
    return Shot(name, T, pinhole, Lens(stated, "brown", (r1, r2, t1, t2, r3)))
