"""The columns of voxels and of observations, and what both tables do with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.errors import DataError
from semstab.model.evidence import Evidence
from semstab.model.voxels import parquet
from semstab.runtime.memory import available_bytes

Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]
Types = dict[str, type[np.generic]]

BYTES_A_VOXEL = 200
"""Of a table that is put together from tiles: twice what it takes."""

INDEX: Types = {"ix": np.int32, "iy": np.int32, "iz": np.int32}
OF_VOXELS: Types = INDEX | {
    "op": np.int32, "evidence": np.float64, "drift_sum": np.float64, "pixels": np.int64, "first_frame": np.int32,
    "last_frame": np.int32, "self_sum": np.float64, "frame_entropy_sum": np.float64,
}  # fmt: skip
OF_EVENTS: Types = {"voxel": np.int32, "frame": np.int32, "evidence": np.float64, "pixels": np.int32}
"""Of both by name: where a voxel is, and what its row and that of an observation have."""


def index_columns(index: npt.NDArray[np.integer[Any]]) -> dict[str, Any]:
    """Voxel indices (n, 3) as the columns ix, iy, iz."""
    return dict(zip(INDEX, index.T.astype(np.int32), strict=True))


def in_order(index: Mapping[str, npt.NDArray[Any]]) -> Int64:
    """The order of voxels by ix, iy, iz."""
    order: Int64 = np.lexsort([index[name] for name in reversed(INDEX)])
    return order


def require_memory(path: Path, files: Sequence[Path]) -> None:
    """Raise DataError where a map in tiles does not fit into the memory that is free."""
    voxels, free = parquet.rows_in(files), available_bytes()
    if (needed := voxels * BYTES_A_VOXEL) > free:
        raise DataError(
            f"{path}: {voxels / 1e6:.3g} million voxels in {len(files)} tiles take {needed / 1e9:.2g} GB at once, and"
            f" {free / 1e9:.2g} GB are free; take them tile by tile (VoxelTable.iter_tiles, or DuckDB on its files)"
        )


def freeze(table: Any, types: Types, like: npt.NDArray[Any]) -> None:
    """Make a table's columns arrays of their types that cannot be written to, as long as that one.

    Raises DataError where one is not.
    """
    for name, dtype in types.items():
        given = getattr(table, name)
        if len(given) != len(like):
            raise DataError(f"{type(table).__name__}: column '{name}' has {len(given)} rows, expected {len(like)}")
        object.__setattr__(table, name, _evidence(table, given) if name == "evidence" else _frozen(given, dtype))


def _frozen(given: npt.ArrayLike, dtype: type[np.generic]) -> npt.NDArray[Any]:
    column: npt.NDArray[Any] = np.ascontiguousarray(given, dtype=dtype).view()
    column.setflags(write=False)
    return column


def _evidence(table: Any, given: npt.NDArray[Any] | Evidence) -> Evidence:
    shape = np.shape(given)
    if len(shape) != 2:
        raise DataError(f"{type(table).__name__}: evidence of shape {shape}, expected one row of K classes each")
    return Evidence.of(given)
