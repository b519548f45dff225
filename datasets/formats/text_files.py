"""Poses and intrinsics as text: one matrix a file, or one DataError with the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from semstab.datasets.formats.disk import read_bytes
from semstab.errors import DataError, one_line
from semstab.model.frames import Intrinsics

MAX_TEXT_BYTES = 2**16


def read_pose(path: Path) -> npt.NDArray[np.float64]:
    """A (4, 4) matrix from 16 numbers, or from the 12 of its upper rows, apart by whitespace or commas.

    Raises DataError for anything else.
    """
    numbers = _numbers(path)
    if len(numbers) == 12:
        numbers += [0, 0, 0, 1]
    if len(numbers) != 16:
        hint = " (position and quaternion?)" if len(numbers) in (7, 8) else ""
        raise DataError(f"{path}: expected a 4x4 or 3x4 matrix, found {len(numbers)} numbers{hint}; convert it")
    return np.array(numbers, dtype=np.float64).reshape(4, 4)


def read_intrinsics(path: Path) -> Intrinsics:
    """Intrinsics in pixels from a 3x3 or 4x4 matrix. Raises DataError for anything else."""
    numbers = _numbers(path)
    if len(numbers) not in (9, 16):
        raise DataError(
            f"{path}: expected a 3x3 camera matrix, found {len(numbers)} numbers; write fx 0 cx 0 fy cy 0 0 1"
        )
    side = 3 if len(numbers) == 9 else 4
    K = np.array(numbers, dtype=np.float64).reshape(side, side)[:3, :3]
    if not np.isfinite(K).all() or K[1, 0] != 0 or K[2].tolist() != [0, 0, 1]:
        raise DataError(f"{path}: {K.tolist()} is no camera matrix; write fx 0 cx 0 fy cy 0 0 1, in rows")
    try:
        return Intrinsics.from_matrix(K)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _numbers(path: Path) -> list[float]:
    data = read_bytes(path, MAX_TEXT_BYTES)
    words = data.decode("utf-8-sig", errors="replace").replace(",", " ").split()
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{path}: expected numbers ({one_line(error)}); write the matrix as text") from error
