"""Text files with one record a line (trajectories, lists of images): all of it, or one DataError with the line."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semstab.datasets.formats.disk import read_bytes
from semstab.errors import DataError

MAX_TABLE_BYTES = 2**28


def records(path: Path) -> Iterator[tuple[int, str]]:
    """Number, from 1, and text of each line that is neither empty nor a comment (#).

    Raises DataError where the file cannot be read or is larger than any such table.
    """
    data = read_bytes(path, MAX_TABLE_BYTES)
    for number, line in enumerate(data.decode("utf-8-sig", errors="replace").split("\n"), start=1):
        text = line.strip()
        if text and not text.startswith("#"):
            yield number, text


def read_table(path: Path, columns: int, what: str) -> npt.NDArray[np.float64]:
    """(n, columns) numbers, apart by whitespace or commas; `what` says in errors what a line is.

    Raises DataError that names the line for another number of words, or one that is no number; and for no line.
    """
    values = array("d")
    for number, text in records(path):
        words = text.replace(",", " ").split()
        if len(words) != columns:
            raise DataError(f"{path}: line {number} has {len(words)} values; expected {columns} ({what})")
        values.extend(to_number(word, path, number) for word in words)
    if not values:
        raise DataError(f"{path}: holds no line; expected lines of {what}")
    return np.frombuffer(values, dtype=np.float64).reshape(-1, columns)


def read_matrices(path: Path) -> npt.NDArray[np.float64]:
    """(n, 4, 4) from a flattened matrix a line. Raises what `read_table` raises."""
    return read_table(path, 16, "a flattened 4x4 matrix").reshape(-1, 4, 4)


def to_number(word: str, path: Path, line: int) -> float:
    """One number. Raises DataError that names the line."""
    try:
        return float(word)
    except ValueError as error:
        raise DataError(f"{path}: line {line}: {word[:40]!r} is not a number") from error
