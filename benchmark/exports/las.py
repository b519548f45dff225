"""LAS and LAZ: the voxels as classified points, the class's number and measures in extra dimensions."""

from __future__ import annotations

import importlib.resources
import itertools
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.config import nearest, read_yaml
from semstab.core.files import atomic_path
from semstab.core.types import UInt8
from semstab.errors import ConfigError, MissingDependencyError
from semstab.exports.ply import as_stored
from semstab.exports.voxels import Column, Voxels
from semstab.model.georeference import INSTALL, Georeference
from semstab.model.labels import name_key

if TYPE_CHECKING:
    import laspy


MILLIMETRE = 0.001
NEVER_CLASSIFIED, UNCLASSIFIED = 0, 1
"""ASPRS codes of a point of which nothing is known, and of a class that has no code."""

FORMAT = 7
"""The point format of LAS 1.4 that has colour."""

FIRST_OF_1_4 = 6


def write(parts: Iterable[Voxels], path: Path, asprs: Path | None = None) -> int:
    """The voxels' centres, to the millimetre, part after part; how many there are.

    Raises MissingDependencyError, and ConfigError for a table of codes.
    """
    las, left = with_lazrs(path), iter(parts)
    first = next(left)
    header, written = _header(first), 0
    compress = path.suffix.lower() == ".laz"
    with (
        atomic_path(path) as temporary,
        las.open(str(temporary), mode="w", header=header, do_compress=compress) as cloud,
    ):
        for voxels in itertools.chain([first], left):
            cloud.write_points(_points(voxels, header, asprs))
            written += len(voxels.table)
    return written


def _header(voxels: Voxels) -> laspy.LasHeader:
    """Of a cloud that begins with these voxels."""
    las = with_lazrs(Path("header"))
    header = las.LasHeader(point_format=FORMAT, version="1.4")
    header.scales = np.full(3, MILLIMETRE)
    header.offsets = np.floor(voxels.points.min(axis=0))
    declare(header, "class", voxels.classified.dtype, "1 to K; 0 unclassified")
    for name, column in voxels.columns.items():
        declare_column(header, name, column)
    describe(header, voxels)
    return header


def _points(voxels: Voxels, header: laspy.LasHeader, asprs: Path | None) -> laspy.ScaleAwarePointRecord:
    points = with_lazrs(Path("points")).ScaleAwarePointRecord.zeros(len(voxels.table), header=header)
    points.x, points.y, points.z = voxels.points.T
    points.red, points.green, points.blue = (voxels.colors[voxels.classified - 1].astype(np.uint16) * 257).T
    points.classification = codes(voxels, asprs)[voxels.classified]
    points["class"] = voxels.classified
    for name, column in voxels.columns.items():
        points[name] = as_stored(column.values)
    return points


def with_lazrs(path: Path) -> Any:
    """Laspy, with what compresses LAZ. Raises MissingDependencyError."""
    try:
        import laspy
        import lazrs  # noqa: F401  what laspy compresses with
    except ImportError as error:
        raise MissingDependencyError(f"{path}: {path.suffix} needs laspy and lazrs; {INSTALL}") from error
    return laspy


def declare(header: laspy.LasHeader, name: str, kind: npt.DTypeLike, about: str) -> None:
    """An extra dimension, where the header has none of that name."""
    las = with_lazrs(Path(name))
    if name not in header.point_format.dimension_names:
        header.add_extra_dims([las.ExtraBytesParams(name=name, type=np.dtype(kind), description=about[:31])])


def declare_column(header: laspy.LasHeader, name: str, column: Column) -> None:
    """The extra dimension of a column, with its unit."""
    declare(header, name, as_stored(column.values).dtype, ", ".join(filter(None, (column.about, column.unit))))


def describe(header: laspy.LasHeader, voxels: Voxels) -> None:
    """Write into the header which class is which and, where the cloud has none, its reference system."""
    las = with_lazrs(Path("header"))
    legend = {"taxonomy": voxels.taxonomy, "classes": ["unclassified", *voxels.classes]}
    header.vlrs.append(las.VLR("semstab", 1, "classes of dimension class", json.dumps(legend).encode()))
    if voxels.georeference is not None and header.parse_crs() is None and header.point_format.id >= 6:
        header.vlrs.append(las.vlrs.known.WktCoordinateSystemVlr(wkt1(voxels.georeference)))
        header.global_encoding.wkt = True


def wkt1(georeference: Georeference) -> str:
    """The reference system in the older WKT that LAS prescribes and every program reads."""
    from pyproj import CRS

    return str(CRS.from_wkt(georeference.crs).to_wkt("WKT1_GDAL"))


def codes(voxels: Voxels, table: Path | None = None) -> UInt8:
    """(1 + K,) the ASPRS code of 'unclassified' and of each class: of a YAML file CLASS: CODE, else of the taxonomy's.

    Raises ConfigError for a class that is not there or a code out of range.
    """
    row = {name_key(name): k for k, name in enumerate(voxels.classes, start=1)}
    shipped = {name: code for name, code in codes_of(voxels.taxonomy).items() if name_key(name) in row}
    said = shipped if table is None else read_yaml(table)
    found = np.full(1 + len(row), UNCLASSIFIED, np.uint8)
    found[0] = NEVER_CLASSIFIED
    for name, code in said.items():
        if name_key(str(name)) not in row:
            raise ConfigError(f"{table}: no class '{name}' in the run; {nearest(str(name), voxels.classes)}")
        if isinstance(code, bool) or not isinstance(code, int) or not 0 <= code < 2**8:
            raise ConfigError(f"{table}: {name}: {code!r} is no ASPRS code; write a whole number from 0 to 255")
        found[row[name_key(str(name))]] = code
    return found


def codes_of(taxonomy: str) -> Mapping[str, int]:
    """The ASPRS codes of a taxonomy's classes; none where no table ships for it."""
    shipped = importlib.resources.files("semstab.configs") / "asprs.yaml"
    content: Mapping[str, Mapping[str, int]] = read_yaml(str(shipped))
    return content.get(taxonomy, {})


def without_code(voxels: Voxels, table: Path | None) -> Iterable[str]:
    """The classes that have no code of their own, and become 'unclassified'."""
    found = codes(voxels, table)[1:]
    return [name for name, code in zip(voxels.classes, found, strict=True) if code == UNCLASSIFIED]
