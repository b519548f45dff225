"""Files and folders of a dataset as they lie on disk: read whole, or one DataError with the path."""

from __future__ import annotations

import codecs
import hashlib
import io
import math
import os
import re
import reprlib
import zipfile
from array import array
from collections.abc import Callable, Container, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO, Literal

import numpy as np
import numpy.typing as npt

from semstab.core.files import FILE_DIGEST, parse_json, read_limited
from semstab.core.types import Float64
from semstab.data.frames import Intrinsics
from semstab.datasets.geometry.cameras import Poses
from semstab.errors import DataError, summarize_error

AGAIN = "copy or export it again"
MAX_BYTES = 2**32


def read_bytes(path: Path, limit: int = MAX_BYTES) -> bytes:
    """Return the content of a file of at most `limit` bytes.

    Raises:
        DataError: If it cannot be read, is no file, too large or empty, or is a Git LFS pointer.
    """
    try:
        data = read_limited(path, limit)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    if not data:
        raise DataError(f"{path}: the file is empty; {AGAIN}")
    if data.startswith(b"version https://git-lfs"):
        raise DataError(f"{path}: a Git LFS pointer, not the file itself; run 'git lfs pull'")
    return data


def read_text(path: Path, limit: int) -> str:
    """Return the text of a file; raises what `read_bytes` raises."""
    return as_text(read_bytes(path, limit))


def as_text(data: bytes) -> str:
    """Return the text of a file in UTF-8, or in UTF-16, which editors and shells of Windows write."""
    utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode("utf-16" if utf_16 else "utf-8-sig", errors="replace")


def digest(data: bytes) -> bytes:
    """Return a hash of a file's content, the one of `semstab.core.files.file_digest`."""
    return hashlib.new(FILE_DIGEST, data).digest()


def natural(name: str) -> tuple[list[str | int], str]:
    """Sort key with numbers by value: frame2 before frame10."""
    # a number has as many digits as Python turns into one; the whole name tells longer ones apart
    return [int(part[:4000]) if part.isdecimal() else part for part in re.split(r"(\d+)", name)], name


def subfolders(folder: Path) -> list[str]:
    """Return names in natural order.

    Raises:
        DataError: If the folder cannot be listed.
    """
    return sorted((entry.name for entry in _entries(folder) if entry.is_dir()), key=natural)


def files_by_stem(folder: Path, suffixes: Container[str]) -> dict[str, str]:
    """Return the names of the files with one of these suffixes.

    Raises:
        DataError: For two of one stem, or a folder that cannot be listed.
    """
    files: dict[str, str] = {}
    for entry in _entries(folder):
        stem, suffix = os.path.splitext(entry.name)  # noqa: PTH122  of a hundred thousand names
        if suffix.lower() in suffixes and entry.is_file():
            if stem in files:
                raise DataError(f"{folder / entry.name}: {files[stem]} is the same frame; delete one of the two")
            files[stem] = entry.name
    return files


def files_named(folder: Path, before: str, after: str) -> dict[str, Path]:
    """Return the files 'BEFORE name AFTER' of a folder by name, in natural order; an empty result without the folder.

    The case of AFTER, which is a suffix, does not count.

    Raises:
        DataError: If the folder cannot be listed.
    """
    end, matches = after.lower(), dict[str, str]()
    for entry in _entries(folder):
        name = entry.name[len(before) : len(entry.name) - len(after)]
        fits = entry.name.startswith(before) and entry.name.lower().endswith(end)
        if name and fits and (name not in matches or entry.name.endswith(after)):
            matches[name] = entry.name
    return {name: folder / matches[name] for name in sorted(matches, key=natural)}


def _entries(folder: Path) -> Iterator[os.DirEntry[str]]:
    """Yield the entries of a folder without hidden entries; yield nothing without the folder."""
    try:
        with os.scandir(folder) as entries:
            yield from (entry for entry in entries if not entry.name.startswith("."))
    except FileNotFoundError:
        return
    except OSError as error:
        raise DataError(f"{folder}: the folder cannot be listed ({error.strerror})") from error


# npy and npz bytes to an array of plain numbers: the whole one, or one DataError with the file; no code is run.

NPY_DTYPE = re.compile(rb"""['"]descr['"]\s*:\s*['"]([<>|=]?(?:b1|[iu][1248]|f[248]))['"]""")
NPY_ORDER = re.compile(rb"""['"]fortran_order['"]\s*:\s*(True|False)""")
NPY_SHAPE = re.compile(rb"""['"]shape['"]\s*:\s*\(([\d\s,]{0,200})\)""")


LONGEST_HEADER = 2**16
"""Bytes at the beginning of an .npy file that hold the header of an array of plain numbers."""

MAX_UNPACKED = 2**32
"""Bytes that an array in an .npz file may take."""

ORDINARY, DENSEST = 2**28, 64
"""Bytes that an array which is no image may take whatever its file's size; and times the size of the file above."""

Claimed = Callable[[tuple[int, ...], "np.dtype[Any]"], None]
"""Is shown the shape and type that a header claims before anything is unpacked; raises DataError to refuse it."""


def decode_array(path: Path, data: bytes, key: str, claimed: Claimed | None = None) -> npt.NDArray[Any]:
    """Return the array of an .npy file, or of an .npz file the one called `key` or the only one; read-only."""
    if path.suffix.lower() == ".npz":
        return _decode_npz(path, data, key, claimed)
    return _decode_npy(str(path), data, claimed)


def names_in(data: bytes) -> list[str]:
    """Return the names of the arrays in the content of an .npz file that `decode_array` has read."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def _decode_npy(where: str, data: bytes | bytearray, claimed: Claimed | None = None) -> npt.NDArray[Any]:
    """Return the array; numpy itself would evaluate the header as Python, and allocate the claimed size."""
    sizes, kind, order, start = _claims(where, data)
    needed, available = math.prod(sizes) * kind.itemsize, len(data) - start
    if available != needed:
        raise DataError(f"{where}: the array {sizes} of {kind} needs {needed} bytes, the file has {available}; {AGAIN}")
    if claimed is not None:
        claimed(sizes, kind)
    array = np.frombuffer(data, kind, offset=start)
    array.flags.writeable = False
    return array.reshape(sizes, order=order).astype(kind.newbyteorder("="), copy=False)


def _claims(where: str, data: bytes | bytearray) -> tuple[tuple[int, ...], np.dtype[Any], Literal["C", "F"], int]:
    """Return the shape, the type and the order that an .npy header claims, and the position of its end."""
    if not data.startswith(b"\x93NUMPY") or len(data) < 12:
        raise DataError(f"{where}: not an .npy array; {AGAIN}")
    width = 2 if data[6] == 1 else 4
    start = 8 + width + int.from_bytes(data[8 : 8 + width], "little")
    if start > len(data):
        raise DataError(f"{where}: the .npy array is truncated after {len(data)} bytes; {AGAIN}")
    header = data[8 + width : start]
    dtype, order, shape = (pattern.search(header) for pattern in (NPY_DTYPE, NPY_ORDER, NPY_SHAPE))
    if not (dtype and order and shape):
        raise DataError(f"{where}: the .npy header is damaged, or the array does not hold plain numbers; save it again")
    kind = np.dtype(dtype[1].decode())
    sizes = tuple(int(n) for n in re.findall(rb"\d+", shape[1]))
    if math.prod(sizes) == 0 or len(sizes) > 4:
        raise DataError(f"{where}: an array of shape {sizes} cannot hold an image; {AGAIN}")
    return sizes, kind, "F" if order[1] == b"True" else "C", start


def _decode_npz(path: Path, data: bytes, key: str, claimed: Claimed | None) -> npt.NDArray[Any]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name.removesuffix(".npy"): name for name in archive.namelist()}
            name = next(iter(members.values())) if len(members) == 1 else members.get(key)
            if name is None:
                raise DataError(f"{path}: holds arrays {reprlib.repr(sorted(members))}; name one '{key}'")
            where, size = f"{path} ({reprlib.repr(name)})", archive.getinfo(name).file_size
            with archive.open(name) as member:
                head = member.read(min(size, LONGEST_HEADER))
                shape, kind, _, start = _claims(where, head)
                needed = math.prod(shape) * kind.itemsize
                if size != start + needed or size > MAX_UNPACKED:
                    raise DataError(
                        f"{where}: the array {shape} of {kind} needs {needed} bytes, the file has {size - start};"
                        f" {AGAIN}"
                    )
                if claimed is not None:
                    claimed(shape, kind)
                elif size > max(ORDINARY, DENSEST * len(data)):
                    raise DataError(f"{where}: claims an array of shape {shape} in {len(data)} bytes; {AGAIN}")
                content = _unpacked(member, head, size)
    except DataError:
        raise
    except Exception as error:
        raise DataError(f"{path}: not a whole .npz archive ({summarize_error(error)}); {AGAIN}") from error
    return _decode_npy(where, content)


def _unpacked(member: IO[bytes], head: bytes, size: int) -> bytearray:
    """Return a member of an archive, piece by piece: `read` would hold it twice."""
    content, filled = bytearray(size), len(head)
    content[:filled] = head
    with memoryview(content) as view:
        while piece := member.read(2**20):
            view[filled : filled + len(piece)] = piece
            filled += len(piece)
    return content if filled == size else content[:filled]


# JSON files of datasets: an object with numbers where numbers are expected, or one DataError with the file.

MAX_JSON_BYTES = 2**28


def read_object(path: Path) -> dict[str, Any]:
    """Return the object in a file.

    Raises:
        DataError: If there is none.
    """
    content = read_content(path, MAX_JSON_BYTES)
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected an object with named values, got a {type(content).__name__}")
    return content


def read_content(path: Path, limit: int) -> Any:
    """Return the content of a JSON file of at most `limit` bytes.

    Raises:
        DataError: If it is none.
    """
    data = read_bytes(path, limit)
    try:
        return parse_json(data)
    except ValueError as error:
        raise DataError(f"{path}: not valid JSON ({summarize_error(error)[:120]})") from error


def pixels(content: Mapping[str, Any], key: str, where: str) -> int:
    """Return the side of an image in an object.

    Raises:
        DataError: If that fails, with `where` (the file) and the key.
    """
    value = number(content, key, where)
    if not 1 <= value <= 2**24:
        raise DataError(f"{where}: '{key}' is {value:g}; expected a number of pixels")
    return int(value)


def number(content: Mapping[str, Any], key: str, where: str) -> float:
    """Return a finite number of an object.

    Raises:
        DataError: If that fails, with `where` (the file) and the key.
    """
    value = content.get(key)
    if value is None:
        raise DataError(f"{where}: '{key}' is missing; add it")
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e300 or not math.isfinite(value):
        raise DataError(f"{where}: '{key}' is {repr(value)[:40]}; expected a number")
    return float(value)


def matrix(value: Any, where: str) -> Poses:
    """Return (4, 4) from rows of 3x4 or 4x4 numbers, NaN and infinity among them.

    Raises:
        DataError: If that fails, with `where`.
    """
    try:
        T = np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{where}: expected a matrix of numbers, got {repr(value)[:60]}") from error
    if T.shape == (3, 4):
        T = np.vstack([T, [0, 0, 0, 1]])
    if T.shape != (4, 4):
        raise DataError(f"{where}: expected a 4x4 matrix, got {repr(value)[:60]}")
    return T


# Poses and intrinsics as text: one matrix a file, or one DataError with the file.

MAX_TEXT_BYTES = 2**16


def read_pose(path: Path) -> Float64:
    """Return a (4, 4) matrix from 16 numbers, or from the 12 of its upper rows.

    They are in a text, apart by whitespace or commas, in an .npy array, or in a .json: rows, or one list, or an object
    with one such value.

    Raises:
        DataError: For anything else.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        array = decode_array(path, read_bytes(path, MAX_TEXT_BYTES), "pose")
        numbers = np.ravel(array).astype(np.float64).tolist()
    else:
        numbers = _of_json(path) if suffix == ".json" else _numbers(path)
    if len(numbers) not in (12, 16):
        hint = " (position and quaternion?)" if len(numbers) in (7, 8) else ""
        raise DataError(f"{path}: expected a 4x4 or 3x4 matrix, got {len(numbers)} numbers{hint}; convert it")
    return np.array([*numbers, 0, 0, 0, 1][:16], dtype=np.float64).reshape(4, 4)


def _of_json(path: Path) -> list[float]:
    """Return the numbers of the only value of a JSON file that holds a matrix.

    Raises:
        DataError: If it holds none, or several.
    """
    content = read_content(path, MAX_TEXT_BYTES)
    values = [content] if isinstance(content, list) else []
    if isinstance(content, dict):
        values = [value for value in content.values() if isinstance(value, list) and _size(value) in (12, 16)]
    if len(values) != 1:
        raise DataError(
            f"{path}: expected a 4x4 or 3x4 matrix, in rows, or an object with one, got {len(values)}; write [[r11,"
            " r12, r13, t1], ...]"
        )
    try:
        return [float(value) for value in np.ravel(np.array(values[0], dtype=np.float64))]
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{path}: expected a matrix of numbers, got {repr(values[0])[:60]}") from error


def _size(value: list[Any]) -> int:
    return sum(len(row) if isinstance(row, list) else 1 for row in value)


def read_intrinsics(path: Path) -> Intrinsics:
    """Return intrinsics in pixels from a 3x3 or 4x4 matrix.

    Raises:
        DataError: For anything else.
    """
    numbers = _numbers(path)
    if len(numbers) not in (9, 16):
        raise DataError(
            f"{path}: expected a 3x3 camera matrix, got {len(numbers)} numbers; write fx 0 cx 0 fy cy 0 0 1"
        )
    side = 3 if len(numbers) == 9 else 4
    K = np.array(numbers, dtype=np.float64).reshape(side, side)[:3, :3]
    return pinhole(path, K)


def read_camera(path: Path) -> tuple[Intrinsics, tuple[int, int] | None]:
    """Return intrinsics of a JSON file, and the (width, height) of their image, or None if the file has no size.

    It has the names of Open3D, an intrinsic_matrix whose columns follow each other; or fx, fy, cx, cy; or a matrix of
    three rows.

    Raises:
        DataError: For anything else.
    """
    content = read_object(path)
    where = str(path)
    sized = content.get("width") is not None and content.get("height") is not None
    size = (pixels(content, "width", where), pixels(content, "height", where)) if sized else None
    columns = content.get("intrinsic_matrix")
    rows = [value for value in content.values() if isinstance(value, list) and len(value) == 3 and _size(value) == 9]
    if isinstance(columns, list) and len(columns) == 9:
        numbers = [number({"intrinsic_matrix": value}, "intrinsic_matrix", where) for value in columns]
        K = np.array(numbers, dtype=np.float64).reshape(3, 3).T
    elif {"fx", "fy", "cx", "cy"} <= content.keys():
        fx, fy, cx, cy = (number(content, key, where) for key in ("fx", "fy", "cx", "cy"))
        K = Intrinsics(fx, fy, cx, cy).matrix
    elif len(rows) == 1 and all(isinstance(row, list) and len(row) == 3 for row in rows[0]):
        K = np.array([[number({"the matrix": value}, "the matrix", where) for value in row] for row in rows[0]])
    else:
        raise DataError(
            f"{path}: holds no camera; write width, height and intrinsic_matrix as Open3D does, or fx, fy, cx, cy"
        )
    return pinhole(path, K), size


def pinhole(path: Path, K: Float64) -> Intrinsics:
    """Return intrinsics of a camera matrix (3, 3) of a file; raises DataError with the file."""
    if not np.isfinite(K).all() or K[1, 0] != 0 or K[2].tolist() != [0, 0, 1]:
        raise DataError(f"{path}: {K.tolist()} is no camera matrix; write fx 0 cx 0 fy cy 0 0 1, in rows")
    try:
        return Intrinsics.from_matrix(K)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _numbers(path: Path) -> list[float]:
    text = read_text(path, MAX_TEXT_BYTES)
    require_decimal_points(str(path), text)
    words = text.replace(",", " ").split()
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{path}: expected numbers ({summarize_error(error)}); write the matrix as text") from error


DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")


def require_decimal_points(where: str, text: str) -> None:
    """Raise DataError where numbers apart by whitespace have decimal commas, as in 'NUMBER,DIGITS NUMBER,DIGITS'."""
    words = text.split()
    commas = [word for word in words if "," in word]
    if commas and len(words) > 1 and all(DECIMAL_COMMA.fullmatch(word) for word in commas):
        raise DataError(
            f"{where}: numbers have decimal commas ({commas[0]}); write points: {commas[0].replace(',', '.')}"
        )


# Text files with one record a line (trajectories, lists of images): all of it, or one DataError with the line.

MAX_TABLE_BYTES = 2**28


def records(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number, from 1, and text of each line that is neither empty nor a comment (#).

    Raises:
        DataError: If the file cannot be read or is larger than any such table.
    """
    for number, line in enumerate(read_text(path, MAX_TABLE_BYTES).split("\n"), start=1):
        text = line.strip()
        if text and not text.startswith("#"):
            yield number, text


def numbered_lines(file: BinaryIO) -> Iterator[tuple[int, str]]:
    """Yield the number, from 1, and stripped text of every line, each read when it is wanted: files may be large."""
    for number, line in enumerate(file, start=1):
        yield number, line.decode("utf-8", errors="replace").strip()


def read_table(path: Path, columns: int, what: str, heading: str | None = None) -> Float64:
    """Return (n, columns) numbers, apart by whitespace or commas; `what` describes a line in errors.

    A line that begins with the word `heading` is left out.

    Raises:
        DataError: For another number of words, or one that is no number; and for no line; the message names the line.
    """
    values = array("d")
    for number, text in records(path):
        words = text.replace(",", " ").split()
        if words[:1] == [heading]:
            continue
        if len(words) != columns:
            require_decimal_points(f"{path}: line {number}", text)
            raise DataError(f"{path}: line {number} has {len(words)} values; expected {columns} ({what})")
        values.extend(to_number(word, path, number) for word in words)
    if not values:
        raise DataError(f"{path}: holds no line; expected lines of {what}")
    return np.frombuffer(values, dtype=np.float64).reshape(-1, columns)


def read_matrices(path: Path) -> dict[str, Float64]:
    """Return the matrices (4, 4) of a file of KITTI by name: lines 'NAME: r11 r12 r13 t1 ...', others left out.

    Raises:
        DataError: For a word that is no number, with the line.
    """
    matrices = {}
    for line, text in records(path):
        key, _, values = text.partition(":")
        if len(words := values.split()) == 12:
            matrices[key.strip()] = matrix_of([to_number(word, path, line) for word in words])
    return matrices


def matrix_of(rows: npt.ArrayLike) -> Float64:
    """Return (4, 4) from the 12 numbers of its upper rows."""
    return np.vstack([np.reshape(np.asarray(rows, np.float64), (3, 4)), [0.0, 0.0, 0.0, 1.0]])


def to_number(word: str, path: Path, line: int) -> float:
    """Return one number.

    Raises:
        DataError: If that fails; the message names the line.
    """
    try:
        return float(word)
    except ValueError as error:
        raise DataError(f"{path}: line {line}: {word[:40]!r} is not a number") from error
