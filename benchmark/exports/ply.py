"""PLY: how its rows are laid out, and the voxels as points with a class, a colour and measures, for CloudCompare."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from semstab.core.files import atomic_path
from semstab.errors import DataError, one_line
from semstab.exports.voxels import Voxels, crs_name

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""NumPy's types by the names that PLY gives them."""

ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_HEADER = 2**20


@dataclass(frozen=True, eq=False)
class Header:
    """What stands before the points of a binary PLY file.

    dtype     of a point
    count     how many points there are
    size      bytes of the header
    comments  its comment lines, without the word
    """

    dtype: np.dtype[np.void]
    count: int
    size: int
    comments: tuple[str, ...] = ()

    @classmethod
    def read(cls, file: BinaryIO, path: Path) -> Header:
        """Of a cloud. Raises DataError for what is no binary PLY file of points alone, or one that is cut short."""
        lines = list(_header_lines(file, path))
        try:
            return cls._parsed(lines, file.tell(), path)
        except DataError:
            raise
        except (LookupError, ValueError) as error:  # a word that is missing, no number, a name that is there twice
            raise DataError(f"{path}: its header cannot be read ({one_line(error)}); save the cloud anew") from error

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
        header = cls(np.dtype(properties), int(elements[0][2]), size, _comments(lines))
        if header.count < 0:
            raise DataError(f"{path}: has {header.count} points in its header; save the cloud anew")
        missing = {"x", "y", "z"} - set(header.dtype.names or ())
        if missing:
            raise DataError(f"{path}: its points have no {', '.join(sorted(missing))}")
        return header

    def text(self) -> bytes:
        """The header of a little-endian file."""
        names = {np.dtype(code): name for name, code in reversed(TYPES.items())}
        lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in self.comments)]
        lines.append(f"element vertex {self.count}")
        for name, (kind, *_) in (self.dtype.fields or {}).items():
            lines.append(f"property {names[kind.newbyteorder('<')]} {name}")
        return "\n".join([*lines, "end_header", ""]).encode()


def write(parts: Iterable[Voxels], path: Path, voxels: int) -> int:
    """The centres of so many voxels with colour, class and measures; which class is which stands in comments."""
    written = 0
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        for part in parts:
            rows = _rows(part)
            if not written:
                file.write(Header(rows.dtype, voxels, 0, tuple(legend(part))).text())
            file.write(rows.tobytes())
            written += len(rows)
    return written


def _rows(voxels: Voxels) -> npt.NDArray[np.void]:
    red, green, blue = voxels.colors[voxels.classified - 1].T
    x, y, z = voxels.points.T
    columns = {"x": x, "y": y, "z": z, "red": red, "green": green, "blue": blue, "class": voxels.classified}
    columns |= {name: as_stored(column.values) for name, column in voxels.columns.items()}
    dtype = np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    rows = np.empty(len(voxels.table), dtype)
    for name, values in columns.items():
        rows[name] = values
    return rows


def legend(voxels: Voxels) -> Iterable[str]:
    """What a reader of the file has to know, a line each."""
    where = "coordinates of the scene" if voxels.georeference is None else crs_name(voxels.georeference)
    yield f"semstab: voxels of {voxels.table.voxel_size:g} m, {where}"
    yield from (f"class {k} {name}" for k, name in enumerate(("unclassified", *voxels.classes)))
    yield from (f"{name}: {column.about} {column.unit}".rstrip() for name, column in voxels.columns.items())


def as_stored(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A column in a type that PLY and LAS have: measures in single precision, counts in 32 bits."""
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


def _comments(lines: Iterable[str]) -> tuple[str, ...]:
    return tuple(line.removeprefix("comment").strip() for line in lines if line.startswith("comment"))
