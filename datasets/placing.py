"""Georeferences of projects of OpenDroneMap or OpenSfM, and the metres by which their cameras miss known positions.

Sources: OpenDroneMap's stages run_opensfm, odm_georeferencing and odm_report, and OpenSfM's export_geocoords, in their
versions from 2018 to 2026; docs/drones.md has the table of which version writes which frame.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semstab.core.types import Float64
from semstab.data.georeference import Georeference, Linear, wkt
from semstab.datasets.formats.disk import number, read_content, read_object, read_text
from semstab.datasets.geometry.cameras import Poses
from semstab.errors import DataError

logger = logging.getLogger("semstab")

COORDS, PROJ = "odm_georeferencing/coords.txt", "odm_georeferencing/proj.txt"
ALIGNMENT = "odm_georeferencing/alignment_matrix.json"
SHOTS = "odm_report/shots.geojson"
MATRIX, REFERENCE, TOPOCENTRIC = "geocoords_transformation.txt", "reference_lla.json", "reconstruction.topocentric.json"

MAX_TEXT_BYTES = 2**26
MAX_SHOTS_BYTES = 2**30

GPS_LIMIT = 10.0
"""Metres over the ground: a drone's GPS errs by less in the median of a flight, ground control points included."""

EXACT_LIMIT = 1.0
"""The same for positions that ODM itself computed of these cameras."""

SLACK = 1.0
"""Metres, and half of the best fit: the frame of the files may fit GPS worse than another one by so much."""

EXACT_SLACK = 0.1
MOST_PHOTOGRAPHS = 100
MOST_MATCHED = 1500
"""Cameras whose positions are matched one by one where they have no names."""

EARTH = 1e9
"""Metres from the origin of a projection that no position on the Earth has."""

STEP = 1.0
"""Metres from the reference at which the topocentric frame is made linear, as OpenSfM does."""


@dataclass(frozen=True)
class Placement:
    """The georeference of a project, and its source.

    Attributes:
        words: The source of the georeference and the fit of the cameras, in words.
        mesh_origin: Origin of ODM's *_geo.obj in the projection; None: they are the scene's.
    """

    georeference: Georeference
    words: str
    mesh_origin: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Positions:
    """A search for known positions: `bare` takes suffixes off a name, `photograph` finds the image of a bare name."""

    bare: Callable[[str], str]
    photograph: Callable[[str], Path | None]


@dataclass(frozen=True, eq=False)
class _Known:
    """Known positions over the ground, east and north in the projection, by name or (n, 2) without; `source` in words.

    Attributes:
        exact: Whether they were computed of these cameras, not measured.
    """

    source: str
    named: Mapping[str, Float64]
    unnamed: Float64
    exact: bool = False

    def apart(self, cameras: Mapping[str, Float64]) -> float | None:
        """Return the median distance of cameras (2,) to these positions in metres, or None without a common camera."""
        if self.named:
            common = [name for name in cameras if name in self.named]
            return (
                float(np.median([np.hypot(*(cameras[name] - self.named[name])) for name in common])) if common else None
            )
        cameras_xy, known_xy = _on_earth(np.array([*cameras.values()]).reshape(-1, 2)), _on_earth(self.unnamed)
        if not len(known_xy) or not len(cameras_xy):
            return None
        if max(len(cameras_xy), len(known_xy)) > MOST_MATCHED:
            return float(np.hypot(*(np.median(cameras_xy, axis=0) - np.median(known_xy, axis=0))))
        from scipy.optimize import linear_sum_assignment
        from scipy.spatial.distance import cdist

        # of all assignments the squares of distances are least for the true one, however far all are shifted
        squares = cdist(cameras_xy, known_xy, "sqeuclidean")
        return float(np.sqrt(np.median(squares[linear_sum_assignment(squares)])))


@dataclass(frozen=True, eq=False)
class _Candidate:
    georeference: Georeference
    words: str
    mesh_origin: tuple[float, float, float] | None = None


def placement_of(folder: Path, opensfm: Path, shots: Mapping[str, Poses], find: Positions) -> Placement | None:
    """Return the georeference of a project whose cameras have these poses (4, 4) world to camera; None if it has none.

    The frame of the files is compared with known positions of the cameras. If another frame fits clearly better, that
    is taken, with a warning; another warning says that the cameras lie further off than GPS explains.

    Raises:
        DataError: For damaged files.
        ConfigError: For a projection that is not known.
    """
    candidates, sure = _candidates(folder, opensfm)
    if not candidates:
        return None
    centres = np.array([-T[:3, :3].T @ T[:3, 3] for T in shots.values()])
    positions = _known(folder, opensfm, list(shots), find, candidates[0].georeference.crs)
    first, projected = candidates[0], [candidate.georeference.projected(centres)[:, :2] for candidate in candidates]
    gaps = [None if positions is None else positions.apart(dict(zip(shots, xy, strict=True))) for xy in projected]
    if positions is None or gaps[0] is None:
        words = f"{first.words}; no known position to compare the cameras with"
        return Placement(first.georeference, words, first.mesh_origin)
    distances = [np.inf if gap is None else gap for gap in gaps]
    best = int(np.argmin(distances))
    slack = 0.0 if not sure else EXACT_SLACK if positions.exact else SLACK + distances[best] / 2
    chosen = best if distances[0] > distances[best] + slack else 0
    if chosen and sure:
        logger.warning(
            "%s: the cameras lie %.3g m (median) from %s by its files (%s), but %.3g m by %s, which is used; is"
            " a file left from another version of ODM?",
            folder, distances[0], positions.source, first.words, distances[chosen], candidates[chosen].words,
        )  # fmt: skip
    taken, off = candidates[chosen], distances[chosen]
    limit = EXACT_LIMIT if positions.exact else GPS_LIMIT
    if off > limit:
        explained = "of the same cameras" if positions.exact else f"more than the {GPS_LIMIT:g} m that GPS explains"
        logger.warning(
            "%s: the cameras lie %.3g m (median, horizontal) from %s, %s: the poses are not in the assumed frame"
            " (%s), and the map is as far off; restore opensfm/%s and %s of this run, or give crs, offset, linear",
            folder, off, positions.source, explained, taken.words, MATRIX, REFERENCE,
        )  # fmt: skip
    words = f"{taken.words}; cameras {off:.2f} m (median, horizontal) from {positions.source}"
    return Placement(taken.georeference, words, taken.mesh_origin)


# --- frames -----------------------------------------------------------------------------------------------------------


def _candidates(folder: Path, opensfm: Path) -> tuple[list[_Candidate], bool]:
    """Return the frames that the poses may be in, the likeliest first, and whether the files tell which."""
    coords, proj = folder / COORDS, folder / PROJ
    if not coords.is_file():
        local = _mercator(opensfm)
        return ([] if local is None else [local]), True
    east, north, _ = _read_coords(coords)
    crs = wkt(_crs(coords, proj), str(proj if proj.is_file() else coords))
    offset = Georeference(crs, (east, north, 0.0))
    projected = [_Candidate(offset, f"poses in the projection, less the offset of {COORDS}")]
    if (alignment := folder / ALIGNMENT).is_file():
        aligned = _affine(
            crs, _matrix_of(read_content(alignment, MAX_TEXT_BYTES), alignment) @ _as_matrix(offset), alignment
        )
        words = f"poses in the projection, moved by {ALIGNMENT}"
        projected = [_Candidate(aligned, words, (east, north, 0.0))]  # further from GPS for a reason
    topocentric = []
    matrix, reference = opensfm / MATRIX, opensfm / REFERENCE
    if matrix.is_file():
        T = _matrix_of(
            [line.split() for line in read_text(matrix, MAX_TEXT_BYTES).splitlines() if line.strip()], matrix
        )
        if np.hypot(*T[:2, 3]) < np.hypot(*(T[:2, 3] - (east, north))):  # written with --offset-x, --offset-y
            T[:2, 3] += east, north
        topocentric.append(_turned(_affine(crs, T, matrix), f"opensfm/{MATRIX}"))
    if reference.is_file():
        topocentric.append(_turned(_linearised(crs, reference), f"opensfm/{REFERENCE}"))
    if (opensfm / TOPOCENTRIC).is_file() or not topocentric:
        return projected + topocentric, True
    return (topocentric + projected, True) if matrix.is_file() else (projected + topocentric, False)


def _turned(georeference: Georeference, source: str) -> _Candidate:
    """Return the georeference of topocentric poses; ODM's meshes have the projection's height, not east and north."""
    east, north, _ = georeference.offset
    return _Candidate(georeference, f"poses topocentric, brought into the projection by {source}", (east, north, 0.0))


def _as_matrix(georeference: Georeference) -> Float64:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = georeference.linear, georeference.offset
    return T


def _matrix_of(rows: Any, path: Path) -> Float64:
    """Return (4, 4) of rows of numbers or words.

    Raises:
        DataError: For anything but an affine map.
    """
    try:
        T = np.array([[float(value) for value in row] for row in rows])
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: expected four rows of four numbers; write it again, or delete it") from error
    if T.shape != (4, 4) or not np.isfinite(T).all() or T[3].tolist() != [0, 0, 0, 1]:
        raise DataError(f"{path}: expected four rows of four numbers, 0 0 0 1 the last; write it again, or delete it")
    return T


def _affine(crs: str, T: Float64, path: Path) -> Georeference:
    a, b, c, d, e, f, g, h, i = T[:3, :3].ravel().tolist()
    linear: Linear = ((a, b, c), (d, e, f), (g, h, i))
    east, north, up = T[:3, 3].tolist()
    return Georeference.from_crs(crs, (east, north, up), str(path), linear)


def _linearised(crs: str, path: Path) -> Georeference:
    """Return the map from the topocentric frame about a reference to the projection, linear about the reference."""
    from pyproj import CRS, Proj, Transformer

    latitude, longitude, altitude = _reference(path)
    origin = f"+lat_0={latitude!r} +lon_0={longitude!r} +h_0={altitude!r}"
    geographic = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 {origin} +step +inv +proj=cart +ellps=WGS84"
    )
    lon, lat, up = np.array(geographic.transform(*np.vstack([np.zeros(3), STEP * np.eye(3)]).T))
    east, north = Proj(CRS.from_wkt(crs))(lon, lat)
    points = np.stack([east, north, up], axis=1)
    if not np.isfinite(points).all():
        raise DataError(
            f"{path}: {latitude:g}, {longitude:g} lies outside the projection of {PROJ}; are both of one run?"
        )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = (points[1:] - points[0]).T / STEP, points[0]
    return _affine(crs, T, path)


def _mercator(opensfm: Path) -> _Candidate | None:
    """Return east, north and up about OpenSfM's reference, as a transverse Mercator projection about the same point.

    Within a kilometre the two differ by centimetres: by the height above the ellipsoid over the Earth's radius.
    """
    path = opensfm / REFERENCE
    if not path.is_file():
        return None
    latitude, longitude, altitude = _reference(path)
    crs = f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=1 +datum=WGS84 +units=m +no_defs +type=crs"
    georeference = Georeference.from_crs(crs, (0.0, 0.0, altitude), str(path))
    return _Candidate(
        georeference, f"poses topocentric about {REFERENCE}, in a transverse Mercator projection about it"
    )


def _reference(path: Path) -> tuple[float, float, float]:
    content = read_object(path)
    latitude, longitude, altitude = (number(content, key, str(path)) for key in ("latitude", "longitude", "altitude"))
    if abs(latitude) > 90 or abs(longitude) > 360:
        raise DataError(
            f"{path}: {latitude:g}, {longitude:g} is no latitude and longitude in degrees; run OpenSfM again"
        )
    return latitude, longitude, altitude


def _crs(coords: Path, proj: Path) -> str:
    """Return proj.txt, else the first line of coords.txt: 'WGS84 UTM 15N' or a PROJ string."""
    if proj.is_file():
        return read_text(proj, MAX_TEXT_BYTES).strip()
    words = read_text(coords, MAX_TEXT_BYTES).split("\n")[0].split()
    if len(words) == 3 and words[:2] == ["WGS84", "UTM"] and words[2][:-1].isdecimal():
        return f"EPSG:{(326 if words[2][-1] == 'N' else 327) * 100 + int(words[2][:-1])}"
    return " ".join(words)


def _read_coords(path: Path) -> tuple[float, float, Float64]:
    """Return the offset to the east and north, and the positions (n, 3) of the photographs relative to it."""
    lines = [line.split() for line in read_text(path, MAX_TEXT_BYTES).splitlines()[1:] if line.strip()]
    try:
        numbers = [[float(word) for word in line] for line in lines]
        east, north = numbers[0]
        positions = np.array(numbers[1:], dtype=np.float64).reshape(-1, 3)
    except (ValueError, IndexError) as error:
        raise DataError(f"{path}: expected a projection, 'EAST NORTH', then 'x y z' a line; run ODM again") from error
    if not np.isfinite([east, north]).all():
        raise DataError(f"{path}: the offset {east:g} {north:g} is not finite; run ODM again")
    return east, north, positions


def _on_earth(positions: Float64) -> Float64:
    """Return the rows that can lie on the Earth: a damaged number leaves others to compare with."""
    return positions[(np.abs(positions) < EARTH).all(axis=1)]  # NaN is not less


# --- known positions --------------------------------------------------------------------------------------------------


def _known(folder: Path, opensfm: Path, names: list[str], find: Positions, crs: str) -> _Known | None:
    """Return the best positions that a project has: ODM's own of the cameras, else GPS by name, else coords.txt."""
    from pyproj import CRS, Proj

    projection = Proj(CRS.from_wkt(crs))

    def projected(positions: Mapping[str, tuple[float, float]]) -> dict[str, Float64]:
        points = {name: np.array(projection(lon, lat)) for name, (lon, lat) in positions.items()}
        return {name: point for name, point in points.items() if np.isfinite(point).all()}

    requested, coords, none = set(names), folder / COORDS, np.zeros((0, 2))
    sources: tuple[tuple[str, Callable[[], Iterator[tuple[str, float, float]]], bool], ...] = (
        (SHOTS, lambda: _of_shots(folder / SHOTS if coords.is_file() else None, find.bare), True),
        ("the GPS of the images (opensfm/exif)", lambda: _of_opensfm(opensfm / "exif", find.bare), False),
        ("the GPS of the images", lambda: _of_photographs(names, find.photograph), False),
    )
    for source, positions_of, exact in sources:
        if by_name := projected({name: (lon, lat) for name, lon, lat in positions_of() if name in requested}):
            return _Known(source, by_name, none, exact)
    if coords.is_file():
        east, north, positions = _read_coords(coords)
        return _Known(f"the positions in {COORDS}", {}, positions[:, :2] + (east, north))
    return None


def _of_shots(path: Path | None, bare: Callable[[str], str]) -> Iterator[tuple[str, float, float]]:
    """Yield names, longitudes and latitudes of the cameras as ODM reports them."""
    if path is None or not path.is_file():
        return
    content = read_content(path, MAX_SHOTS_BYTES)
    try:
        for feature in content["features"]:
            longitude, latitude = map(float, feature["geometry"]["coordinates"][:2])
            yield bare(str(feature["properties"]["filename"])), longitude, latitude
    except (TypeError, LookupError, ValueError) as error:
        raise DataError(
            f"{path}: expected points with a filename, as ODM writes; run ODM again, or delete it"
        ) from error


def _of_opensfm(folder: Path, bare: Callable[[str], str]) -> Iterator[tuple[str, float, float]]:
    """Yield the same of the images' GPS as OpenSfM keeps it, a file an image; images without it are passed over."""
    for path in _spread(sorted(folder.glob("*.exif"))):
        gps = read_object(path).get("gps")
        if isinstance(gps, dict) and {"latitude", "longitude"} <= gps.keys():
            longitude, latitude = (number(gps, key, str(path)) for key in ("longitude", "latitude"))
            yield bare(path.name.removesuffix(".exif")), longitude, latitude


def _of_photographs(names: list[str], photograph: Callable[[str], Path | None]) -> Iterator[tuple[str, float, float]]:
    """Yield the same of the photographs' EXIF data; those without it, and unreadable ones, are passed over."""
    for name in _spread(names):
        path = photograph(name)
        if path is not None and (position := _exif_position(path)) is not None:
            yield name, *position


def _spread(items: list[Any]) -> list[Any]:
    """Return some of many items, evenly spaced."""
    return items[:: -(-len(items) // MOST_PHOTOGRAPHS) or 1]


def _exif_position(path: Path) -> tuple[float, float] | None:
    """Return longitude and latitude in degrees of an image's EXIF data, or None without a position."""
    from PIL import Image
    from PIL.ExifTags import IFD

    try:
        with Image.open(path) as image:
            gps = image.getexif().get_ifd(IFD.GPSInfo)
        latitude, longitude = (
            sign * sum(float(part) / 60**k for k, part in enumerate(gps[key]))
            for key, sign in ((2, -1 if gps.get(1) == "S" else 1), (4, -1 if gps.get(3) == "W" else 1))
        )
    except (OSError, ValueError, SyntaxError, TypeError, LookupError, ZeroDivisionError):
        return None
    return (
        (longitude, latitude) if np.isfinite([latitude, longitude]).all() and (latitude, longitude) != (0, 0) else None
    )
