"""Write the worst places of a map as a table or as GeoJSON, which QGIS and other programs of maps open."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semstab.core.files import csv_text, write_json, write_text
from semstab.data.georeference import INSTALL, Georeference
from semstab.data.records import Record
from semstab.errors import ConfigError, MissingDependencyError
from semstab.exports.voxels import ExportedUnit, ExportedVoxels
from semstab.report.places import frame_names
from semstab.statistics.observations import SpotObservations
from semstab.statistics.places import Place, worst_places

GEOJSON = ".geojson"

LOCAL = "local metres of the scene, x and y: it has no georeference, and these are no degrees"
"""The note in a GeoJSON file without longitude and latitude."""


def holds_places(file: Path) -> bool:
    """Return whether a file gets places: FILE.geojson, places.csv, or NAME-places.csv."""
    name = file.stem.lower().replace("-", "_").replace(".", "_").rpartition("_")[2]
    return file.suffix.lower() == GEOJSON or (file.suffix.lower() == ".csv" and name == "places")


def write_places(chosen: ExportedUnit, record: Record, file: Path, most: int) -> tuple[int, ExportedVoxels]:
    """Write the worst places among the chosen voxels, at most `most`; return their number and a part of the map.

    Raises:
        ConfigError: If frames disagree nowhere.
        MissingDependencyError: For GeoJSON without pyproj.
    """
    observations_file = record.observations_file
    spots = (
        None
        if observations_file is None or not observations_file.exists()
        else SpotObservations.load(observations_file)
    )
    places = worst_places((part.table for part in chosen), spots, most)
    if not places:
        raise ConfigError(
            f"{file}: no place where at most half of the pairs of frames agree; there is nothing to write"
        )
    part, names = chosen.first, frame_names(record)
    points = part.in_file(np.array([place.centre for place in places]))
    rows = [_row(place, point.tolist(), part, names) for place, point in zip(places, points, strict=True)]
    degrees = None if part.georeference is None else degrees_of(points, part.georeference, file)
    if file.suffix.lower() == GEOJSON:
        write_json(file, geojson(rows, points.tolist(), degrees, part))
    else:
        write_text(file, places_table(rows, degrees))
    return len(places), part


def _row(place: Place, point: Sequence[float], part: ExportedVoxels, names: Mapping[int, str]) -> dict[str, Any]:
    """Return what is known of a place, by name: coordinates are those of the other exports."""
    frames = [names.get(view.frame, str(view.frame)) for view in place.views]
    labels = ["" if view.label < 0 else part.classes[view.label] for view in place.views]
    return {
        "number": place.number, "class": part.classes[place.label], "confused_with": part.classes[place.other],
        "voxels": place.voxels, "size_m": round(place.size, 3), "agreement": round(place.agreement, 4),
        "share": round(place.share, 6), "op": place.op, **dict(zip("xyz", (round(c, 3) for c in point), strict=True)),
        "crs": "" if part.georeference is None else part.georeference.name, "frames": frames, "given": labels,
    }  # fmt: skip


def degrees_of(points: Any, georeference: Georeference, file: Path) -> list[tuple[float, float]]:
    """Return longitude and latitude in WGS 84 of points (n, 3) in the projection."""
    try:
        from pyproj import Transformer
    except ImportError as error:
        raise MissingDependencyError(f"{file}: longitude and latitude need pyproj; {INSTALL}") from error
    to_wgs84 = Transformer.from_crs(georeference.crs, "EPSG:4326", always_xy=True)
    lon, lat = to_wgs84.transform(points[:, 0], points[:, 1])
    return [(round(float(x), 8), round(float(y), 8)) for x, y in zip(lon, lat, strict=True)]


def geojson(
    rows: Sequence[Mapping[str, Any]],
    points: Sequence[Sequence[float]],
    degrees: Sequence[tuple[float, float]] | None,
    part: ExportedVoxels,
) -> dict[str, Any]:
    """Return a collection of points: longitude and latitude (RFC 7946), or with a note metres of the scene."""
    where = {"crs": None, "note": LOCAL} if degrees is None else {"note": "longitude and latitude, WGS 84"}
    coordinates = [[round(x, 3), round(y, 3)] for x, y, _ in points] if degrees is None else degrees
    about = {"voxel_size": part.table.voxel_size, "taxonomy": part.taxonomy, "benchmark": part.benchmark}
    return {
        "type": "FeatureCollection", "name": "places", **where, **{key: value for key, value in about.items() if value},
        "features": [
            {"type": "Feature", "geometry": {"type": "Point", "coordinates": position}, "properties": row}
            for position, row in zip(coordinates, rows, strict=True)
        ],
    }  # fmt: skip


def places_table(rows: Sequence[Mapping[str, Any]], degrees: Sequence[tuple[float, float]] | None) -> str:
    """Return CSV, lists joined by '; ', in which a spreadsheet sees no formula."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*rows[0], *([] if degrees is None else ["longitude", "latitude"])])
    for k, row in enumerate(rows):
        cells = ["; ".join(cell) if isinstance(cell, list) else cell for cell in row.values()]
        cells += [] if degrees is None else degrees[k]
        writer.writerow([csv_text(cell) if isinstance(cell, str) else cell for cell in cells])
    return text.getvalue()
