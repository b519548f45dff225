"""Voxel tables and logs of observations as Parquet: columns, and in the metadata what they belong to."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from semstab.errors import DataError, one_line
from semstab.runtime.files import atomic_path

if TYPE_CHECKING:
    import pyarrow as pa

SCHEMA = 1


def write(
    path: str | Path, columns: Mapping[str, npt.NDArray[Any]], kind: str, voxel_size: float, classes: Sequence[str]
) -> None:
    """Columns (n,) and (n, K), atomically."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    about = {"schema": SCHEMA, "kind": kind, "voxel_size": voxel_size, "classes": classes}
    content = pa.table({name: _to_arrow(values) for name, values in columns.items()})
    content = content.replace_schema_metadata({"semstab": json.dumps(about)})
    with atomic_path(path) as temporary:
        pq.write_table(content, temporary, compression="zstd")


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Whatever is wrong with a file's content is a DataError of one line that names the file."""
    import pyarrow as pa

    try:
        yield
    except (OSError, LookupError, TypeError, ValueError, pa.ArrowException) as error:
        raise DataError(f"{path}: not a semstab table ({one_line(error)})") from error


def read(path: str | Path, names: Iterable[str]) -> dict[str, Any]:
    """Columns by name, voxel_size and classes; what it raises becomes a DataError in `reading`."""
    import pyarrow.parquet as pq

    content = pq.read_table(path)
    about = json.loads((content.schema.metadata or {})[b"semstab"])
    if about["schema"] != SCHEMA:
        raise DataError(f"written with schema {about['schema']}, this version reads {SCHEMA}")
    columns: dict[str, Any] = {name: _to_numpy(content.column(name)) for name in names}
    return columns | {"voxel_size": float(about["voxel_size"]), "classes": tuple(about["classes"])}


def _to_arrow(values: npt.NDArray[Any]) -> pa.Array:
    import pyarrow as pa

    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _to_numpy(column: pa.ChunkedArray) -> npt.NDArray[Any]:
    import pyarrow as pa

    if column.null_count:
        raise DataError("a column has missing values")
    if not pa.types.is_fixed_size_list(column.type):
        values: npt.NDArray[Any] = column.to_numpy()
    else:
        values = column.combine_chunks().flatten().to_numpy().reshape(-1, column.type.list_size)
    return values
