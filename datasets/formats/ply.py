"""Headers of binary PLY files of points: what a point has, and how many there are, or one DataError with the file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from semstab.errors import DataError, summarize_error

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
                f"{path}: its header cannot be read ({summarize_error(error)}); save the cloud again"
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
                raise DataError(f"{path}: '{' '.join(word)[:60]}' in its header cannot be read; save the cloud again")
        comments = (line.removeprefix("comment").strip() for line in lines if line.startswith("comment"))
        header = cls(np.dtype(properties), int(elements[0][2]), size, tuple(comments))
        if header.count < 0:
            raise DataError(f"{path}: has {header.count} points in its header; save the cloud again")
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
