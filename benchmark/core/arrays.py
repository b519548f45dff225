"""Data classes of arrays as arrays by name and back, rows that grow, and columns of Arrow."""

from __future__ import annotations

import dataclasses
import threading
import types
from array import array
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, Mask

if TYPE_CHECKING:
    import pyarrow as pa


T = TypeVar("T")
A = TypeVar("A", bound="npt.NDArray[Any]")
Arrays = dict[str, npt.NDArray[Any]]

COUNTED = 2
"""See `distinct_keys`."""


def to_arrays(value: Any, name: str = "") -> Arrays:
    """Return all that a data class holds by its path: arrays, numbers, names, mappings, data classes; None is left out.

    >>> to_arrays({"a": {"b": 3}})
    {'a/b': array(3)}
    """
    if value is None:
        return {}
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if not isinstance(value, Mapping):
        return {name: np.asarray(value)}
    below = f"{name}/" if name else ""
    return {
        path: values for field, content in value.items() for path, values in to_arrays(content, below + field).items()
    }


def from_arrays(cls: type[T], arrays: Mapping[str, npt.NDArray[Any]], name: str = "") -> T:
    """Return the data class that `to_arrays` took apart.

    Raises:
        KeyError: If an array of it is missing.
    """
    below, hints = f"{name}/" if name else "", get_type_hints(cls)
    names = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    return cls(**{field: _read(hints[field], arrays, below + field) for field in names})


def _read(kind: Any, arrays: Mapping[str, npt.NDArray[Any]], path: str) -> Any:
    inside = {key.removeprefix(f"{path}/"): key for key in arrays if key.startswith(f"{path}/")}
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(member for member in get_args(kind) if member is not types.NoneType)
        if path not in arrays and not inside:
            return None
    if dataclasses.is_dataclass(kind):
        return from_arrays(kind, arrays, path)  # type: ignore[arg-type]
    origin = get_origin(kind)
    origin = get_origin(getattr(origin, "__value__", None)) or origin  # NDArray is a `type` alias from NumPy 2.5 on
    if origin is not None and origin is not np.ndarray and issubclass(origin, Mapping):
        return {key: arrays[full_key] for key, full_key in inside.items()}
    if origin is tuple:
        return tuple(arrays[path].tolist())
    return arrays[path] if origin is np.ndarray else kind(arrays[path][()])


class GrowingRows:
    """A table of float64 that grows row by row; rows (n, columns) are the first ones."""

    def __init__(self, columns: int, rows: npt.ArrayLike = ()) -> None:
        self.columns = columns
        self._numbers = array("d", np.asarray(rows, dtype=np.float64).tobytes())

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._numbers) // self.columns

    def append(self, row: Iterable[float | None]) -> None:
        """Add a row, None as NaN."""
        self._numbers.extend(np.nan if value is None else value for value in row)

    def row(self, at: int) -> list[float]:
        """Return one row.

        Raises:
            IndexError: If there is none.
        """
        start = range(len(self))[at] * self.columns
        return self._numbers[start : start + self.columns].tolist()

    def column(self, k: int) -> Float64:
        """Return a copy (n,) of the k-th number of each row."""
        return np.array(self._numbers[k :: self.columns])

    def table(self) -> Float64:
        """Return a copy (n, columns) of the rows."""
        return np.array(self._numbers).reshape(-1, self.columns)


# Arrays of numpy as columns of Arrow, and back.


class RecentArrays:
    """The latest arrays by number, with at most `most_bytes` bytes; threads may share it."""

    def __init__(self, most_bytes: int) -> None:
        self._most, self._bytes = most_bytes, 0
        self._arrays: dict[int, npt.NDArray[Any]] = {}  # the one that was asked for last comes last
        self._lock = threading.Lock()

    def get(self, number: int, make: Callable[[], A]) -> A:
        """Return the array of a number, read-only; make the array if it is not stored."""
        with self._lock:
            cached = self._arrays.pop(number, None)
            if cached is not None:
                self._arrays[number] = cached
                return cast(A, cached)
        made = make()
        made.flags.writeable = False
        with self._lock:
            self._bytes += made.nbytes - (self._arrays.pop(number).nbytes if number in self._arrays else 0)
            self._arrays[number] = made
            while self._bytes > self._most and self._arrays:
                self._bytes -= self._arrays.pop(next(iter(self._arrays))).nbytes
        return made


def column(values: npt.NDArray[Any]) -> pa.Array:
    """Return the values (n,) as Arrow has them, numbers without a copy.

    `pyarrow.array` imports pandas, where that is installed, to see whether it was given a part of it: most of a second.
    """
    import pyarrow as pa

    if values.dtype.kind not in "iufb":
        return pa.array(values)
    stored = np.packbits(values, bitorder="little") if values.dtype == bool else np.ascontiguousarray(values)
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(stored)])


def values_of(column: pa.ChunkedArray) -> npt.NDArray[Any]:
    """Return a column as numpy has it (n,), numbers in one piece without a copy; `to_numpy` imports pandas as well."""
    import pyarrow as pa

    if not column.null_count and pa.types.is_boolean(column.type):
        return np.concatenate([np.zeros(0, np.bool_), *map(_truth_values, column.chunks)])
    if column.null_count or not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
        return cast(npt.NDArray[Any], column.to_numpy())
    parts = [np.from_dlpack(part) for part in column.chunks]
    return parts[0] if len(parts) == 1 else np.concatenate([np.zeros(0, column.type.to_pandas_dtype()), *parts])


def _truth_values(part: pa.BooleanArray) -> Mask:
    bits = np.frombuffer(part.buffers()[1], np.uint8)
    return np.unpackbits(bits, count=part.offset + len(part), bitorder="little")[part.offset :].astype(np.bool_)


def evenly(length: int, count: int) -> list[int]:
    """Return at most `count` positions of a sequence, evenly spaced, the first and the last among them."""
    return sorted({round(position) for position in np.linspace(0, length - 1, min(length, count)).tolist()})


def stable_order(number: npt.NDArray[np.integer[Any]], count: int) -> Int64:
    """Return the order (n,) of numbers (n,) below a count, equal ones as they are; small ones NumPy sorts by digits."""
    return np.argsort(number.astype(np.min_scalar_type(count)), kind="stable")


def distinct_keys(key: Int64) -> tuple[Int64, Int64]:
    """Return each of the numbers (n,) once, ascending, and which of them each is: np.unique.

    Numbers in a range below COUNTED * n are counted, which takes a tenth of the time of putting them in order.
    """
    if not len(key) or int(key.max()) - (least := int(key.min())) >= COUNTED * len(key):
        keys, of = np.unique(key, return_inverse=True)
        return keys, of
    from_least = key - least
    is_there = np.zeros(int(from_least.max()) + 1, np.bool_)
    is_there[from_least] = True
    return np.flatnonzero(is_there) + least, (np.cumsum(is_there) - 1)[from_least]
