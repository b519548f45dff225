"""Write point clouds: PLY for CloudCompare, and LAS; each point has the class, colour and measures of a voxel."""

from __future__ import annotations

import importlib.resources
import itertools
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.config import nearest, read_yaml
from semstab.core.files import atomic_path, not_written
from semstab.core.types import UInt8
from semstab.data.georeference import INSTALL
from semstab.data.labels import name_key
from semstab.datasets.files.surfaces import open_las
from semstab.datasets.formats.ply import Header
from semstab.errors import ConfigError, DataError, MissingDependencyError
from semstab.exports.voxels import ExportedVoxels

if TYPE_CHECKING:
    import laspy


def write_ply(parts: Iterable[ExportedVoxels], path: Path, count: int) -> int:
    """Write the centres of `count` voxels with colour, class and measures; the names of the classes are comments."""
    written = 0
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        for part in parts:
            red, green, blue = part.colors[part.classified - 1].T
            x, y, z = part.points.T
            columns = {"x": x, "y": y, "z": z, "red": red, "green": green, "blue": blue, "class": part.classified}
            columns |= {name: as_stored(column.values) for name, column in part.columns.items()}
            dtype = np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
            rows = np.empty(len(part.table), dtype)
            for name, values in columns.items():
                rows[name] = values
            if not written:
                file.write(Header(dtype, count, 0, tuple(legend(part))).text())
            file.write(rows.tobytes())
            written += len(rows)
    return written


def legend(voxels: ExportedVoxels) -> Iterable[str]:
    """Yield the lines that explain a file: the voxel size, the coordinates, the classes, the columns."""
    where = "coordinates of the scene" if voxels.georeference is None else voxels.georeference.name
    yield f"semstab: voxels of {voxels.table.voxel_size:g} m, {where}"
    if voxels.benchmark:
        yield f"benchmark {voxels.benchmark}"
    yield from (f"class {k} {name}" for k, name in enumerate(("unclassified", *voxels.classes)))
    yield from (f"{name}: {column.about} {column.unit}".rstrip() for name, column in voxels.columns.items())


def as_stored(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a column in a type that PLY and LAS have: measures in single precision, counts in 32 bits."""
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    if values.dtype.itemsize <= 2:
        return values.astype(np.uint8) if values.dtype.kind == "b" else values
    return values.astype(np.int32 if values.max(initial=0) < 2**31 else np.float64)


# LAS and LAZ store the voxels as classified points, with the number of the class and measures in extra dimensions.

MILLIMETRE = 0.001
NEVER_CLASSIFIED, UNCLASSIFIED = 0, 1
"""The ASPRS codes of a point without a class, and of a class without a code."""

FORMAT = 7
"""The point format of LAS 1.4 that has colour."""

FIRST_OF_1_4 = 6


def write_las(parts: Iterable[ExportedVoxels], path: Path, asprs: Path | None = None) -> int:
    """Write the voxels' centres to the millimetre, part after part; return the number of voxels.

    Raises:
        MissingDependencyError, ConfigError: For a table of codes.
    """
    las, remaining = with_lazrs(path), iter(parts)
    first = next(remaining)
    header, written = las.LasHeader(point_format=FORMAT, version="1.4"), 0
    header.scales, header.offsets = np.full(3, MILLIMETRE), np.floor(first.points.min(axis=0))
    declare(header, first)
    with atomic_path(path) as temporary, las_writer(temporary, header) as cloud:
        for voxels in itertools.chain([first], remaining):
            points = las.ScaleAwarePointRecord.zeros(len(voxels.table), header=header)
            points.x, points.y, points.z = voxels.points.T
            points.red, points.green, points.blue = (voxels.colors[voxels.classified - 1].astype(np.uint16) * 257).T
            points.classification = codes(voxels, asprs)[voxels.classified]
            points["class"] = voxels.classified
            for name, column in voxels.columns.items():
                points[name] = as_stored(column.values)
            cloud.write_points(points)
            written += len(points)
    return written


@contextmanager
def las_writer(path: Path, header: laspy.LasHeader) -> Iterator[laspy.LasWriter]:
    """Yield the writer of a LAS or LAZ file, which is then opened again: lazrs does not see each full disk.

    Raises:
        OSError: If it could not be written, or is not whole.
    """
    las = with_lazrs(path)
    from lazrs import LazrsError

    try:
        compress = path.suffix.lower() == ".laz"
        with path.open("w+b") as file, las.open(file, "w", False, header=header, do_compress=compress) as writer:
            yield writer
    except LazrsError as error:
        raise not_written() from error
    try:
        with open_las(path) as reader:
            complete = reader.header.point_count == writer.header.point_count
    except DataError as error:
        raise not_written() from error
    if not complete:
        raise not_written()


def with_lazrs(path: Path) -> Any:
    """Return laspy once it can compress LAZ too. Raises MissingDependencyError."""
    try:
        import laspy
        import lazrs  # noqa: F401  laspy compresses with it
    except ImportError as error:
        raise MissingDependencyError(f"{path}: {path.suffix} needs laspy and lazrs; {INSTALL}") from error
    return laspy


def declare(header: laspy.LasHeader, voxels: ExportedVoxels, **more: tuple[npt.DTypeLike, str]) -> None:
    """Declare the class, the voxels' columns and `more` as extra dimensions where the header has none of that name.

    Also write the names of the classes and, where the cloud has none, the reference system.
    """
    import laspy

    dimensions: dict[str, tuple[npt.DTypeLike, str]] = {
        **more,
        "class": (voxels.classified.dtype, "1 to K; 0 unclassified"),
    }
    for name, column in voxels.columns.items():
        dimensions[name] = as_stored(column.values).dtype, ", ".join(filter(None, (column.about, column.unit)))
    for name, (kind, about) in dimensions.items():
        if name not in header.point_format.dimension_names:
            header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=np.dtype(kind), description=about[:31])])
    legend = {
        "taxonomy": voxels.taxonomy,
        "classes": ["unclassified", *voxels.classes],
        "benchmark": voxels.benchmark,
    }
    header.vlrs.append(laspy.VLR("semstab", 1, "classes of dimension class", json.dumps(legend).encode()))
    if voxels.georeference is not None and header.parse_crs() is None and header.point_format.id >= FIRST_OF_1_4:
        from pyproj import CRS

        wkt1 = str(CRS.from_wkt(voxels.georeference.crs).to_wkt("WKT1_GDAL"))  # LAS prescribes the older WKT
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt1))
        header.global_encoding.wkt = True


def codes(voxels: ExportedVoxels, table: Path | None = None) -> UInt8:
    """Return (1 + K,) the ASPRS code of 'unclassified' and of each class, from a YAML file CLASS: CODE.

    Without a file the codes are those that ship for the taxonomy.

    Raises:
        ConfigError: For an unknown class or a code out of range.
    """
    row = {name_key(name): k for k, name in enumerate(voxels.classes, start=1)}
    if table is not None:
        stated = read_yaml(table)
    else:
        content = read_yaml(str(importlib.resources.files("semstab.configs") / "asprs.yaml"))
        shipped = content.get(voxels.taxonomy, {})
        stated = {name: code for name, code in shipped.items() if name_key(name) in row}
    codes_by_row = np.full(1 + len(row), UNCLASSIFIED, np.uint8)
    codes_by_row[0] = NEVER_CLASSIFIED
    for name, code in stated.items():
        if name_key(str(name)) not in row:
            raise ConfigError(f"{table}: no class '{name}' in the run; {nearest(str(name), voxels.classes)}")
        if isinstance(code, bool) or not isinstance(code, int) or not 0 <= code < 2**8:
            raise ConfigError(f"{table}: {name}: {code!r} is no ASPRS code; write a whole number from 0 to 255")
        codes_by_row[row[name_key(str(name))]] = code
    return codes_by_row


def without_code(voxels: ExportedVoxels, table: Path | None) -> list[str]:
    """Return the classes of these voxels without a code of their own, which become 'unclassified'."""
    code_of_row, present = codes(voxels, table), np.unique(voxels.classified)
    return [voxels.classes[row - 1] for row in present.tolist() if row and code_of_row[row] == UNCLASSIFIED]
