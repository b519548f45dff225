"""Clouds of ROS messages: points and classes, from fields of any type at any place in the bytes of a point.

Source: sensor_msgs/PointCloud2 and PointField.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.config import nearest
from semstab.datasets.files.scans import LABEL_FIELDS, classes_in
from semstab.datasets.formats.disk import AGAIN
from semstab.errors import DataError

CLOUD = "sensor_msgs/PointCloud2"
AXES = ("x", "y", "z")
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of numbers, by PointField.datatype."""


def label_field_of(message: Any) -> str | None:
    """Return the name of a cloud's field of classes, or None without such a field."""
    names = {field.name for field in message.fields}
    return next((name for name in LABEL_FIELDS if name in names), None)


def size_of(message: Any) -> int:
    """Return how many points a cloud says it has, those that are not valid among them."""
    return int(message.height) * int(message.width)


def points_of(message: Any, where: str) -> npt.NDArray[np.floating[Any]]:
    """Return points (N, 3) of a cloud, in the order of its bytes, with the NaN values of the cloud.

    Raises:
        DataError: If it has no x, y, z of floats, or is damaged, with `where`.
    """
    columns = [field_of(message, axis, where) for axis in AXES]
    if other := next((str(column.dtype) for column in columns if column.dtype.kind != "f"), None):
        raise DataError(f"{where}: x, y, z are {other}, not FLOAT32 or FLOAT64; publish them as metres")
    return np.column_stack(columns)


def classes_of(message: Any, name: str, where: str) -> npt.NDArray[np.int64]:
    """Return the classes (N,) of a cloud that a field holds; NaN is no class.

    Raises:
        DataError: If there is no such field, or it holds no whole numbers, with `where`.
    """
    return classes_in(field_of(message, name, where), name, where)


def field_of(message: Any, name: str, where: str) -> npt.NDArray[Any]:
    """Return the values (N,) of a field of a cloud, in the machine's order of bytes.

    Raises:
        DataError: If there is none, it is no single number, or the cloud is shorter than it says, with `where`.
    """
    fields = {field.name: field for field in message.fields}
    if name not in fields:
        raise DataError(f"{where}: the cloud has no field '{name}'; {_hint(name, [*fields])}")
    field = fields[name]
    if field.datatype not in TYPES or field.count > 1:
        raise DataError(
            f"{where}: the field '{name}' has datatype {field.datatype} and count {field.count}; expected one number a"
            " point (datatype 1 to 8)"
        )
    dtype = np.dtype(TYPES[field.datatype]).newbyteorder(">" if message.is_bigendian else "<")
    H, W, row, step = (int(n) for n in (message.height, message.width, message.row_step, message.point_step))
    if field.offset + dtype.itemsize > step or W * step > row or len(message.data) < H * row:
        raise DataError(
            f"{where}: {H} rows of {row} bytes, each of {W} points of {step} bytes with '{name}' at {field.offset}, do"
            f" not fit into {len(message.data)} bytes; {AGAIN}"
        )
    data = np.ascontiguousarray(message.data)
    values: npt.NDArray[Any] = np.ndarray((H, W), dtype, data, field.offset, (row, step))
    return values.reshape(-1).astype(dtype.newbyteorder("="))


def _hint(name: str, names: Sequence[str]) -> str:
    return nearest(name, names) if names else "it has none at all; record the bag again"
