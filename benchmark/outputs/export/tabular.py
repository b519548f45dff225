"""Parquet and CSV: a row a voxel, with its coordinates, the name of its class, and measures."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semstab.metrics import CATEGORIES
from semstab.outputs.export.voxels import Voxels
from semstab.runtime.files import atomic_path

if TYPE_CHECKING:
    import pyarrow as pa


def write_parquet(parts: Iterable[Voxels], path: Path) -> int:
    """Columns, part after part, and in the metadata entry 'semstab' what they mean; what is undefined is null."""
    import pyarrow.parquet as pq

    return _written(parts, path, lambda file, schema: pq.ParquetWriter(file, schema, compression="zstd"))


def write_csv(parts: Iterable[Voxels], path: Path) -> int:
    """Columns, part after part; what is undefined is an empty field."""
    from pyarrow import csv

    return _written(parts, path, csv.CSVWriter)


def _written(parts: Iterable[Voxels], path: Path, opened: Callable[[Path, pa.Schema], Any]) -> int:
    """How many voxels went into the file that a writer of Arrow opens."""
    voxels, writer = 0, None
    with atomic_path(path) as temporary, ExitStack() as open_files:
        for part in parts:
            table = arrow(part).replace_schema_metadata(_about(part))
            writer = writer or open_files.enter_context(opened(temporary, table.schema))
            writer.write_table(table)
            voxels += len(part.table)
    return voxels


def _about(voxels: Voxels) -> dict[str, str]:
    about = {
        "voxel_size": voxels.table.voxel_size,
        "crs": None if voxels.georeference is None else voxels.georeference.crs,
        "taxonomy": voxels.taxonomy,
        "classes": list(voxels.classes),
        "units": {name: column.unit for name, column in voxels.columns.items() if column.unit},
    }
    return {"semstab": json.dumps(about)}


def arrow(voxels: Voxels) -> pa.Table:
    """x, y, z in metres, class and category by their names, and the other columns."""
    import pyarrow as pa

    x, y, z = voxels.points.T
    columns = {name: pa.array(column.values, from_pandas=True) for name, column in voxels.columns.items()}
    if "category" in columns:
        columns["category"] = pa.DictionaryArray.from_arrays(columns["category"], list(CATEGORIES))
    label = pa.DictionaryArray.from_arrays(voxels.classified.astype("int32") - 1, list(voxels.classes))
    return pa.table({"x": x, "y": y, "z": z, "class": label, **columns})
