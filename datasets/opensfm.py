"""OpenSfM's reconstructions: the cameras and the shots of a reconstruction.json; points are skipped.

Source: opensfm.org, Reconstruction Format and Geometric Models; OpenDroneMap has them in its folder opensfm/.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from semstab.datasets.formats.disk import number, pixels, read_content
from semstab.datasets.geometry.cameras import Camera
from semstab.datasets.geometry.lenses import Lens
from semstab.datasets.photographs import Shot
from semstab.errors import DataError

MAX_BYTES = 2**32
"""The most bytes of a file, with the points of thousands of photographs."""

COEFFICIENTS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "perspective": ("brown", ("k1", "k2", "", "", "")),
    "simple_radial": ("brown", ("k1", "", "", "", "")),
    "radial": ("brown", ("k1", "k2", "", "", "")),
    "brown": ("brown", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("fisheye", ("k1", "k2", "", "")),
    "fisheye_opencv": ("fisheye", ("k1", "k2", "k3", "k4")),
}
"""The model of the lens by projection type, and which key each of the lens's coefficients has, if any."""


def read_reconstruction(path: Path, wanted: int | None = None) -> list[Shot]:
    """Return the shots of the only reconstruction of a file, or of the one with that number, in its order.

    Poses are from the world to the camera.

    Raises:
        DataError: For a damaged file, several reconstructions without a setting that selects one, or an unknown camera
            model.
    """
    reconstructions = read_content(path, MAX_BYTES)
    if not isinstance(reconstructions, list) or {type(entry) for entry in reconstructions} != {dict}:
        raise DataError(f"{path}: expected a list of reconstructions; run the reconstruction again")
    if len(reconstructions) > 1 and wanted is None:
        names = "; ".join(f"{k}: {_summary(entry)}" for k, entry in enumerate(reconstructions[:5]))
        more = f"; {len(reconstructions) - 5} more" if len(reconstructions) > 5 else ""
        raise DataError(
            f"{path}: {len(reconstructions)} reconstructions, which share no coordinates ({names}{more}); choose one"
            " with reconstruction: NUMBER"
        )
    if not 0 <= (wanted or 0) < len(reconstructions):
        raise DataError(f"{path}: there is no reconstruction {wanted}; it has {len(reconstructions)}, counted from 0")
    cameras, shots = (_part(reconstructions[wanted or 0], key, path) for key in ("cameras", "shots"))
    lenses = {name: _lens(values, f"{path}: camera {name[:60]!r}") for name, values in cameras.items()}
    read = [_shot(name, values, lenses, f"{path}: shot {name[:80]!r}") for name, values in shots.items()]
    if not read:
        raise DataError(f"{path}: the reconstruction has no shot; reconstruct again")
    return read


def _part(content: Mapping[str, Any], key: str, path: Path) -> Mapping[str, Mapping[str, Any]]:
    part = content.get(key)
    if not isinstance(part, dict) or not all(isinstance(values, dict) for values in part.values()):
        raise DataError(f"{path}: '{key}' must be an object with an entry for each")
    return part


def _summary(content: Mapping[str, Any]) -> str:
    shots = content.get("shots")
    names = list(shots) if isinstance(shots, dict) else []
    return f"{len(names)} shots" + (f" from {names[0][:40]}" if names else "")


def _shot(name: str, values: Mapping[str, Any], lenses: Mapping[str, tuple[Camera, Lens | None]], where: str) -> Shot:
    from scipy.spatial.transform import Rotation

    camera = str(values.get("camera"))
    if camera not in lenses:
        raise DataError(f"{where}: its camera {camera[:60]!r} is not in the file")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(_vector(values, "rotation", where)).as_matrix()
    T[:3, 3] = _vector(values, "translation", where)
    return Shot(name, T, *lenses[camera])


def _vector(values: Mapping[str, Any], key: str, where: str) -> list[float]:
    parts = values.get(key)
    if not isinstance(parts, list) or len(parts) != 3:
        raise DataError(f"{where}: '{key}' must be three numbers")
    return [number({key: part}, key, where) for part in parts]


def _lens(values: Mapping[str, Any], where: str) -> tuple[Camera, Lens | None]:
    """Return the pinhole that stands for a camera, and its lens if it distorts.

    OpenSfM's own undistorted images have this pinhole: the mean focal length, the centre of the image.
    """
    kind = values.get("projection_type", "perspective")
    if not isinstance(kind, str) or kind not in COEFFICIENTS:
        raise DataError(
            f"{where}: the camera model {str(kind)[:40]!r} is not known; there is {', '.join(COEFFICIENTS)}; undistort"
            " the images (opensfm undistort)"
        )
    width, height = (pixels(values, key, where) for key in ("width", "height"))
    side = max(width, height)
    fx, fy = (number(values, key if key in values else "focal", where) * side for key in ("focal_x", "focal_y"))
    cx, cy = (_or_zero(values, key, where) * side for key in ("c_x", "c_y"))
    model, keys = COEFFICIENTS[kind]
    coefficients = tuple(_or_zero(values, key, where) for key in keys)
    centre = ((width - 1) / 2, (height - 1) / 2)
    pinhole = Camera.stated(((fx + fy) / 2, (fx + fy) / 2, *centre), (width, height), where)
    stated = Camera.stated((fx, fy, centre[0] + cx, centre[1] + cy), (width, height), where)
    if model == "brown" and not any(coefficients):
        return stated, None
    return pinhole, Lens(stated, "brown" if model == "brown" else "fisheye", coefficients)


def _or_zero(values: Mapping[str, Any], key: str, where: str) -> float:
    return number(values, key, where) if key in values else 0.0
