"""Arrays of HDF5 files, or one DataError with the file: links and data in other files are not followed."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.files import open_file
from semstab.errors import DataError, MissingDependencyError, summarize_error

INSTALL = "pip install 'semstab[midair]'"


@contextmanager
def opened(path: Path, data: bytes | None = None) -> Iterator[Any]:
    """Yield the open file, or that of its content; of what fails in the context, DataError with the file.

    Raises:
        DataError: If it is damaged.
        MissingDependencyError: If h5py is not installed.
    """
    try:
        import h5py
    except ImportError as error:
        raise MissingDependencyError(f"{path}: needs h5py ({summarize_error(error)}); {INSTALL}") from error
    try:
        with open_file(path) if data is None else io.BytesIO(data) as file, h5py.File(file, "r") as records:
            yield records
    except DataError:
        raise
    except (
        OSError,
        ArithmeticError,
        LookupError,
        ValueError,
        TypeError,
        RuntimeError,
        AttributeError,
        MemoryError,
    ) as error:
        raise DataError(f"{path}: cannot be read ({summarize_error(error)}); download it again") from error


def numbers(records: Any, name: str, shape: tuple[int | None, ...], most: int, path: Path) -> npt.NDArray[Any]:
    """Return an array of numbers of an open file, of a shape in which None is any length.

    Raises:
        DataError: If it is not there, of another kind, or claims more than `most` numbers.
    """
    import h5py

    parts = name.split("/")
    for k in range(1, len(parts) + 1):
        if not isinstance(records.get("/".join(parts[:k]), getlink=True), h5py.HardLink):
            raise DataError(f"{path}: has no {name}; download it again")
    table = records[name]
    is_stored = isinstance(table, h5py.Dataset) and not table.external and not table.is_virtual
    if is_stored and table.dtype.kind in "fiu" and len(table.shape) == len(shape):
        if table.size > most:
            raise DataError(f"{path}: {name} claims {len(table)} rows; is it damaged?")
        if all(expected in (None, actual) for expected, actual in zip(shape, table.shape, strict=True)):
            return np.asarray(table[()])
    form = " x ".join("N" if side is None else str(side) for side in shape)
    raise DataError(f"{path}: {name} is no table of {form} numbers; download it again")
