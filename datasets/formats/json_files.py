"""JSON files of datasets: an object with numbers where numbers are expected, or one DataError with the file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from semstab.datasets.formats.disk import read_bytes
from semstab.datasets.views.poses import Poses
from semstab.errors import DataError, one_line
from semstab.runtime.files import parse_json

MAX_JSON_BYTES = 2**28


def read_object(path: Path) -> dict[str, Any]:
    """The object in a file. Raises DataError where there is none."""
    data = read_bytes(path, MAX_JSON_BYTES)
    try:
        content = parse_json(data)
    except ValueError as error:
        raise DataError(f"{path}: not valid JSON ({one_line(error)[:120]})") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected an object with named values, found a {type(content).__name__}")
    return content


def number(content: Mapping[str, Any], key: str, where: str) -> float:
    """A finite number of an object. Raises DataError with `where` (the file) and the key."""
    value = content.get(key)
    if value is None:
        raise DataError(f"{where}: '{key}' is missing; add it")
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e300 or not math.isfinite(value):
        raise DataError(f"{where}: '{key}' is {repr(value)[:40]}; expected a number")
    return float(value)


def matrix(value: Any, where: str) -> Poses:
    """(4, 4) from rows of 3x4 or 4x4 numbers, NaN and infinity among them. Raises DataError with `where`."""
    try:
        T = np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{where}: expected a matrix of numbers, got {repr(value)[:60]}") from error
    if T.shape == (3, 4):
        T = np.vstack([T, [0, 0, 0, 1]])
    if T.shape != (4, 4):
        raise DataError(f"{where}: expected a 4x4 matrix, got {repr(value)[:60]}")
    return T
