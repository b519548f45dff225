"""npy and npz bytes to an array of plain numbers: the whole one, or one DataError with the file; nothing is run."""

from __future__ import annotations

import io
import math
import re
import reprlib
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.datasets.formats.disk import AGAIN
from semstab.errors import DataError, one_line

MAX_ARRAY_BYTES = 2**29
"""Of an image as an array; scores, of many classes, may be larger."""
MAX_SCORE_BYTES = 2**32

NPY_DTYPE = re.compile(rb"""['"]descr['"]\s*:\s*['"]([<>|=]?(?:b1|[iu][1248]|f[248]))['"]""")
NPY_ORDER = re.compile(rb"""['"]fortran_order['"]\s*:\s*(True|False)""")
NPY_SHAPE = re.compile(rb"""['"]shape['"]\s*:\s*\(([\d\s,]{0,200})\)""")


def decode_array(path: Path, data: bytes, key: str, limit: int | None = None) -> npt.NDArray[Any]:
    """The array of an .npy file, or of an .npz file the one called `key` or the only one; read-only."""
    return (
        _decode_npz(path, data, key, limit or MAX_ARRAY_BYTES)
        if path.suffix.lower() == ".npz"
        else _decode_npy(str(path), data)
    )


def _decode_npy(where: str, data: bytes) -> npt.NDArray[Any]:
    """Parsed by hand: numpy evaluates the header as Python, with its warnings, and allocates what it claims."""
    if not data.startswith(b"\x93NUMPY") or len(data) < 12:
        raise DataError(f"{where}: not an .npy array; {AGAIN}")
    width = 2 if data[6] == 1 else 4
    start = 8 + width + int.from_bytes(data[8 : 8 + width], "little")
    if start > len(data):
        raise DataError(f"{where}: the .npy array is truncated after {len(data)} bytes; {AGAIN}")
    header = data[8 + width : start]
    dtype, order, shape = (pattern.search(header) for pattern in (NPY_DTYPE, NPY_ORDER, NPY_SHAPE))
    if not (dtype and order and shape):
        raise DataError(f"{where}: the .npy header is damaged, or the array does not hold plain numbers; save it anew")
    kind = np.dtype(dtype[1].decode())
    sizes = tuple(int(n) for n in re.findall(rb"\d+", shape[1]))
    needed, found = math.prod(sizes) * kind.itemsize, len(data) - start
    if needed == 0 or len(sizes) > 4:
        raise DataError(f"{where}: an array of shape {sizes} cannot hold an image; {AGAIN}")
    if found != needed:
        raise DataError(f"{where}: the array {sizes} of {kind} needs {needed} bytes, the file has {found}; {AGAIN}")
    array = np.frombuffer(data, kind, offset=start).reshape(sizes, order="F" if order[1] == b"True" else "C")
    return array.astype(kind.newbyteorder("="), copy=False)


def _decode_npz(path: Path, data: bytes, key: str, limit: int) -> npt.NDArray[Any]:
    damage = (zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError, ValueError, LookupError, RuntimeError)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            info = _member(path, archive, key, limit)
            with archive.open(info) as member:
                content = member.read(info.file_size)  # bounded; the checksum is verified at its end
    except DataError:
        raise
    except damage as error:
        raise DataError(f"{path}: not a whole .npz archive ({one_line(error)}); {AGAIN}") from error
    return _decode_npy(f"{path} ({reprlib.repr(info.filename)})", content)


def _member(path: Path, archive: zipfile.ZipFile, key: str, limit: int) -> zipfile.ZipInfo:
    """The member called `key`, or the only one. Raises DataError where there is none that can be read."""
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    info = next(iter(members.values())) if len(members) == 1 else members.get(key)
    if info is None:
        raise DataError(f"{path}: holds arrays {reprlib.repr(sorted(members))}; name one '{key}'")
    if info.file_size > limit or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise DataError(
            f"{path}: {reprlib.repr(info.filename)} claims {info.file_size} bytes (at most {limit}), compression"
            f" {info.compress_type} (stored or deflated are read); save it with numpy"
        )
    return info
