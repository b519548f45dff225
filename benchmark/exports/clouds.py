"""Write point clouds: PLY for CloudCompare, and LAS; each point has the class, colour and measures of a voxel."""

from __future__ import annotations

import importlib.resources
import itertools
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from semstab.config import nearest, read_yaml
from semstab.core.files import atomic_path, not_written
from semstab.core.types import UInt8
from semstab.data.georeference import INSTALL
from semstab.data.labels import name_key
from semstab.datasets.files.surfaces import open_las
from semstab.errors import ConfigError, DataError, MissingDependencyError, summarize_error
from semstab.exports.voxels import Voxels, crs_name

if TYPE_CHECKING:
    import laspy


TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""The types of NumPy by their names in PLY."""

ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_HEADER = 2**20


@dataclass(frozen=True, eq=False)
class Header:
    """The header of a binary PLY file.

    Attributes:
        dtype: Type of a point.
        count: Number of points.
        size: Bytes of the header.
        comments: Its comment lines, without the word.
    """

    dtype: np.dtype[np.void]
    count: int
    size: int
    comments: tuple[str, ...] = ()

    @classmethod
    def read(cls, file: BinaryIO, path: Path) -> Header:
        """Read the header of a cloud.

        Raises:
            DataError: If the file is no binary PLY of points alone.
        """
        lines = list(_header_lines(file, path))
        try:
            return cls._parsed(lines, file.tell(), path)
        except DataError:
            raise
        except (LookupError, ValueError) as error:  # a missing word, no number, a repeated name
            raise DataError(
                f"{path}: its header cannot be read ({summarize_error(error)}); save the cloud anew"
            ) from error

    @classmethod
    def _parsed(cls, lines: list[str], size: int, path: Path) -> Header:
        words = [line.split() for line in lines]
        form = next((word[1] for word in words if word[:1] == ["format"]), "")
        elements = [word for word in words if word[:1] == ["element"]]
        if form not in ORDERS:
            raise DataError(f"{path}: a PLY file in format '{form}'; save it as binary")
        if [word[1] for word in elements if int(word[2])] != ["vertex"]:
            raise DataError(f"{path}: holds more than points, or none; save the cloud alone")
        start = words.index(elements[0])
        properties = []
        for word in words[start + 1 :]:
            if word[0] == "element":
                break
            if word[0] == "property" and len(word) == 3 and word[1] in TYPES:
                properties.append((word[2], ORDERS[form] + TYPES[word[1]]))
            elif word[0] != "comment":
                raise DataError(f"{path}: '{' '.join(word)[:60]}' in its header cannot be read; save the cloud anew")
        comments = (line.removeprefix("comment").strip() for line in lines if line.startswith("comment"))
        header = cls(np.dtype(properties), int(elements[0][2]), size, tuple(comments))
        if header.count < 0:
            raise DataError(f"{path}: has {header.count} points in its header; save the cloud anew")
        missing = {"x", "y", "z"} - set(header.dtype.names or ())
        if missing:
            raise DataError(f"{path}: its points have no {', '.join(sorted(missing))}")
        return header

    def text(self) -> bytes:
        """Return the header of a little-endian file."""
        names = {np.dtype(code): name for name, code in reversed(TYPES.items())}
        lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in self.comments)]
        lines.append(f"element vertex {self.count}")
        for name, (kind, *_) in (self.dtype.fields or {}).items():
            lines.append(f"property {names[kind.newbyteorder('<')]} {name}")
        return "\n".join([*lines, "end_header", ""]).encode()


def write_ply(parts: Iterable[Voxels], path: Path, count: int) -> int:
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


def legend(voxels: Voxels) -> Iterable[str]:
    """Yield the lines that explain a file: the voxel size, the coordinates, the classes, the columns."""
    where = "coordinates of the scene" if voxels.georeference is None else crs_name(voxels.georeference)
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


def _header_lines(file: BinaryIO, path: Path) -> Iterable[str]:
    if file.readline(8).strip() != b"ply":
        raise DataError(f"{path}: not a PLY file")
    while file.tell() < LONGEST_HEADER:
        line = file.readline(LONGEST_HEADER)
        if line.strip() == b"end_header":
            return
        if not line:
            break
        if line.strip():
            yield line.decode("utf-8", "replace").strip()
    raise DataError(f"{path}: the header of a PLY file does not end; the file is damaged")


# LAS and LAZ store the voxels as classified points, with the number of the class and measures in extra dimensions.

MILLIMETRE = 0.001
NEVER_CLASSIFIED, UNCLASSIFIED = 0, 1
"""The ASPRS codes of a point without a class, and of a class without a code."""

FORMAT = 7
"""The point format of LAS 1.4 that has colour."""

FIRST_OF_1_4 = 6


def write_las(parts: Iterable[Voxels], path: Path, asprs: Path | None = None) -> int:
    """Write the voxels' centres to the millimetre, part after part; return the number of voxels.

    Raises:
        MissingDependencyError, ConfigError: For a table of codes.
    """
    las, left = with_lazrs(path), iter(parts)
    first = next(left)
    header, written = las.LasHeader(point_format=FORMAT, version="1.4"), 0
    header.scales, header.offsets = np.full(3, MILLIMETRE), np.floor(first.points.min(axis=0))
    declare(header, first)
    with atomic_path(path) as temporary, las_writer(temporary, header) as cloud:
        for voxels in itertools.chain([first], left):
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
            whole = reader.header.point_count == writer.header.point_count
    except DataError as error:
        raise not_written() from error
    if not whole:
        raise not_written()


def with_lazrs(path: Path) -> Any:
    """Return laspy once it can compress LAZ too. Raises MissingDependencyError."""
    try:
        import laspy
        import lazrs  # noqa: F401  laspy compresses with it
    except ImportError as error:
        raise MissingDependencyError(f"{path}: {path.suffix} needs laspy and lazrs; {INSTALL}") from error
    return laspy


def declare(header: laspy.LasHeader, voxels: Voxels, **more: tuple[npt.DTypeLike, str]) -> None:
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


def codes(voxels: Voxels, table: Path | None = None) -> UInt8:
    """Return (1 + K,) the ASPRS code of 'unclassified' and of each class, from a YAML file CLASS: CODE.

    Without a file the codes are those that ship for the taxonomy.

    Raises:
        ConfigError: For an unknown class or a code out of range.
    """
    row = {name_key(name): k for k, name in enumerate(voxels.classes, start=1)}
    if table is not None:
        given = read_yaml(table)
    else:
        content = read_yaml(str(importlib.resources.files("semstab.configs") / "asprs.yaml"))
        shipped = content.get(voxels.taxonomy, {})
        given = {name: code for name, code in shipped.items() if name_key(name) in row}
    codes_by_row = np.full(1 + len(row), UNCLASSIFIED, np.uint8)
    codes_by_row[0] = NEVER_CLASSIFIED
    for name, code in given.items():
        if name_key(str(name)) not in row:
            raise ConfigError(f"{table}: no class '{name}' in the run; {nearest(str(name), voxels.classes)}")
        if isinstance(code, bool) or not isinstance(code, int) or not 0 <= code < 2**8:
            raise ConfigError(f"{table}: {name}: {code!r} is no ASPRS code; write a whole number from 0 to 255")
        codes_by_row[row[name_key(str(name))]] = code
    return codes_by_row


def without_code(voxels: Voxels, table: Path | None) -> list[str]:
    """Return the classes without a code of their own, which become 'unclassified'."""
    return [name for name, code in zip(voxels.classes, codes(voxels, table)[1:], strict=True) if code == UNCLASSIFIED]
