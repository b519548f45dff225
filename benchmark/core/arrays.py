"""Nested data classes of arrays as arrays by name, as a file of arrays has them, and back."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import pyarrow as pa


T = TypeVar("T")
Arrays = dict[str, npt.NDArray[Any]]

SEPARATOR = "/"


def to_arrays(value: Any, name: str = "") -> Arrays:
    """All that a data class holds by its path: arrays, numbers, names, mappings and data classes of these.

    What is None is left out.
    """
    if value is None:
        return {}
    if dataclasses.is_dataclass(value):
        return _joined({field.name: getattr(value, field.name) for field in dataclasses.fields(value)}, name)
    if isinstance(value, Mapping):
        return _joined(value, name)
    return {name: np.asarray(value)}


def from_arrays(cls: type[T], arrays: Mapping[str, npt.NDArray[Any]], name: str = "") -> T:
    """What `to_arrays` made them of. Raises KeyError where one is not there."""
    hints = get_type_hints(cls)
    fields = {field.name: _path(name, field.name) for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    return cls(**{field: _read(hints[field], arrays, path) for field, path in fields.items()})


def _read(kind: Any, arrays: Mapping[str, npt.NDArray[Any]], path: str) -> Any:
    inside = {key.removeprefix(path + SEPARATOR): key for key in arrays if key.startswith(path + SEPARATOR)}
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(own for own in get_args(kind) if own is not types.NoneType)
        if path not in arrays and not inside:
            return None
    if dataclasses.is_dataclass(kind):
        return from_arrays(kind, arrays, path)  # type: ignore[arg-type]
    origin = get_origin(kind)
    if origin is not None and origin is not np.ndarray and issubclass(origin, Mapping):
        return {key: arrays[own] for key, own in inside.items()}
    if origin is tuple:
        return tuple(arrays[path].tolist())
    return arrays[path] if origin is np.ndarray else kind(arrays[path][()])


def _joined(values: Mapping[str, Any], name: str) -> Arrays:
    return {key: own for field, value in values.items() for key, own in to_arrays(value, _path(name, field)).items()}


def _path(name: str, field: str) -> str:
    return f"{name}{SEPARATOR}{field}" if name else field


# Arrays of numpy as columns of Arrow, and back.


def column(values: npt.NDArray[Any]) -> pa.Array:
    """The values (n,) as Arrow has them, numbers without a copy.

    `pyarrow.array` imports pandas, where that is installed, to see whether it was given a part of it: most of a second.
    """
    import pyarrow as pa

    if values.dtype.kind not in "iuf":
        return pa.array(values)
    values = np.ascontiguousarray(values)
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(values)])


def values_of(column: pa.ChunkedArray) -> npt.NDArray[Any]:
    """A column as numpy has it (n,), numbers in one piece without a copy; `to_numpy` imports pandas as well."""
    import pyarrow as pa

    if column.null_count or not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
        return cast(npt.NDArray[Any], column.to_numpy())
    parts = [np.from_dlpack(part) for part in column.chunks]
    return parts[0] if len(parts) == 1 else np.concatenate([np.zeros(0, column.type.to_pandas_dtype()), *parts])
