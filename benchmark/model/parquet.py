"""Voxel tables and logs of observations as Parquet: columns, and in the metadata what they belong to."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.errors import DataError, one_line
from semstab.model.evidence import Evidence
from semstab.runtime.files import atomic_path

if TYPE_CHECKING:
    import pyarrow as pa

SCHEMA = 1


def write(
    path: str | Path,
    parts: Iterable[Mapping[str, npt.NDArray[Any]]],
    kind: str,
    voxel_size: float,
    classes: Sequence[str],
) -> None:
    """Columns (n,) and (n, K), part after part, one at least; atomically."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    about = {"schema": SCHEMA, "kind": kind, "voxel_size": voxel_size, "classes": classes}
    with atomic_path(path) as temporary, ExitStack() as open_files:
        writer = None
        for columns in parts:
            content = pa.table({name: _to_arrow(values) for name, values in columns.items()})
            content = content.replace_schema_metadata({"semstab": json.dumps(about)})
            writer = writer or open_files.enter_context(pq.ParquetWriter(temporary, content.schema, compression="zstd"))
            writer.write_table(content)


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Whatever is wrong with a file's content is a DataError of one line that names the file."""
    import pyarrow as pa

    try:
        yield
    except (OSError, LookupError, TypeError, ValueError, OverflowError, pa.ArrowException) as error:
        raise DataError(f"{path}: not a semstab table ({one_line(error)})") from error


def read(path: str | Path, names: Iterable[str]) -> dict[str, Any]:
    """Columns by name, voxel_size and classes; what it raises becomes a DataError in `reading`."""
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as content:
        about = json.loads((content.schema_arrow.metadata or {})[b"semstab"])
        if about["schema"] != SCHEMA:
            raise DataError(f"written with schema {about['schema']}, this version reads {SCHEMA}")
        parts: dict[str, list[Any]] = {name: [] for name in names}
        for group in range(content.num_row_groups):
            rows = content.read_row_group(group, columns=list(parts))
            for name, values in parts.items():
                values.append(_to_numpy(rows.column(name)))
    columns = {name: _joined(values) for name, values in parts.items()}
    return columns | {"voxel_size": float(about["voxel_size"]), "classes": tuple(about["classes"])}


def _joined(parts: list[Any]) -> Any:
    return Evidence.joined(parts) if isinstance(parts[0], Evidence) else np.concatenate(parts)


def _to_arrow(values: npt.NDArray[Any]) -> pa.Array:
    import pyarrow as pa

    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _to_numpy(column: pa.ChunkedArray) -> npt.NDArray[Any] | Evidence:
    """Values (n,); rows of classes are sparse."""
    import pyarrow as pa

    if column.null_count:
        raise DataError("a column has missing values")
    if pa.types.is_fixed_size_list(column.type):
        return Evidence.of(column.combine_chunks().flatten().to_numpy().reshape(-1, column.type.list_size))
    values: npt.NDArray[Any] = column.to_numpy()
    return values
