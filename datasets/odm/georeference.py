"""Where a project of OpenDroneMap or OpenSfM lies on Earth: coords.txt and proj.txt, or reference_lla.json."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semstab.datasets.formats.disk import read_bytes
from semstab.datasets.formats.json_files import number, read_object
from semstab.datasets.views.poses import Poses
from semstab.errors import DataError
from semstab.model.georeference import Georeference

logger = logging.getLogger("semstab")

GEOREFERENCING = "odm_georeferencing"
MAX_TEXT_BYTES = 2**26

FAR = 200.0
"""Metres: GPS in drones errs by tens of metres at most; camera centres further off lie in other coordinates."""


def georeference_of(folder: Path, opensfm: Path, T_cw: Sequence[Poses]) -> Georeference | None:
    """That of a project whose cameras have these poses, None where it has none.

    Projects of OpenDroneMap lie in the projection of proj.txt less the offset of coords.txt. Where their cameras do
    not lie at the positions of coords.txt, they are topocentric about OpenSfM's reference, as those of OpenSfM are.
    Raises DataError for damaged files, ConfigError for a projection that is not known.
    """
    centres = np.array([-T[:3, :3].T @ T[:3, 3] for T in T_cw])
    coords, proj = folder / "coords.txt", folder / "proj.txt"
    if not coords.is_file():
        return _topocentric(opensfm)
    east, north, positions = _read_coords(coords)
    off = _off(centres, positions)
    if off > FAR and (local := _topocentric(opensfm)) is not None:
        return local
    if off > FAR:
        logger.warning("%s: the cameras lie %.0f m from its positions; is it of another project?", coords, off)
    return Georeference.of(_crs(coords, proj), (east, north, 0.0), str(proj if proj.is_file() else coords))


def _crs(coords: Path, proj: Path) -> str:
    """proj.txt, else the first line of coords.txt: 'WGS84 UTM 15N' or a PROJ string."""
    if proj.is_file():
        return _text(proj).strip()
    words = _text(coords).split("\n")[0].split()
    if len(words) == 3 and words[:2] == ["WGS84", "UTM"] and words[2][:-1].isdecimal():
        return f"EPSG:{(326 if words[2][-1] == 'N' else 327) * 100 + int(words[2][:-1])}"
    return " ".join(words)


def _read_coords(path: Path) -> tuple[float, float, npt.NDArray[np.float64]]:
    """Offset to the east and north, and the positions (n, 3) of the photographs relative to it."""
    lines = [line.split() for line in _text(path).splitlines()[1:] if line.strip()]
    try:
        numbers = [[float(word) for word in line] for line in lines]
        east, north = numbers[0]
        positions = np.array(numbers[1:], dtype=np.float64).reshape(-1, 3)
    except (ValueError, IndexError) as error:
        raise DataError(f"{path}: expected a projection, 'EAST NORTH', then 'x y z' a line; run ODM again") from error
    if not np.isfinite([east, north]).all():
        raise DataError(f"{path}: the offset {east:g} {north:g} is not finite; run ODM again")
    return east, north, positions


def _off(centres: npt.NDArray[np.float64], positions: npt.NDArray[np.float64]) -> float:
    """Metres between the middles of cameras and positions, over the ground; 0 where there are no positions."""
    if not len(positions):
        return 0.0
    middle = np.median(centres[:, :2], axis=0) - np.median(positions[:, :2], axis=0)
    return float(np.hypot(*middle))


def _topocentric(opensfm: Path) -> Georeference | None:
    """East, north and up about OpenSfM's reference, as a transverse Mercator projection about the same point.

    Within a kilometre the two differ by centimetres: by the height above the ellipsoid over the Earth's radius.
    """
    path = opensfm / "reference_lla.json"
    if not path.is_file():
        return None
    content = read_object(path)
    latitude, longitude, altitude = (number(content, key, str(path)) for key in ("latitude", "longitude", "altitude"))
    crs = f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=1 +datum=WGS84 +units=m +no_defs +type=crs"
    return Georeference.of(crs, (0.0, 0.0, altitude), str(path))


def _text(path: Path) -> str:
    return read_bytes(path, MAX_TEXT_BYTES).decode("utf-8-sig", errors="replace")
