"""Parquet and CSV: a row a voxel, with its coordinates, the name of its class, and measures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from semstab.metrics import CATEGORIES
from semstab.outputs.export.voxels import Voxels
from semstab.runtime.files import atomic_path

if TYPE_CHECKING:
    import pyarrow as pa


def write_parquet(voxels: Voxels, path: Path) -> None:
    """Columns, and in the metadata entry 'semstab' what they mean; what is undefined is null."""
    import pyarrow.parquet as pq

    about = {
        "voxel_size": voxels.table.voxel_size,
        "crs": None if voxels.georeference is None else voxels.georeference.crs,
        "taxonomy": voxels.taxonomy,
        "classes": list(voxels.classes),
        "units": {name: column.unit for name, column in voxels.columns.items() if column.unit},
    }
    table = arrow(voxels).replace_schema_metadata({"semstab": json.dumps(about)})
    with atomic_path(path) as temporary:
        pq.write_table(table, temporary, compression="zstd")


def write_csv(voxels: Voxels, path: Path) -> None:
    """Columns; what is undefined is an empty field."""
    from pyarrow import csv

    with atomic_path(path) as temporary:
        csv.write_csv(arrow(voxels), temporary)


def arrow(voxels: Voxels) -> pa.Table:
    """x, y, z in metres, class and category by their names, and the other columns."""
    import pyarrow as pa

    x, y, z = voxels.points.T
    columns = {name: pa.array(column.values, from_pandas=True) for name, column in voxels.columns.items()}
    if "category" in columns:
        columns["category"] = pa.DictionaryArray.from_arrays(columns["category"], list(CATEGORIES))
    label = pa.DictionaryArray.from_arrays(voxels.classified.astype("int32") - 1, list(voxels.classes))
    return pa.table({"x": x, "y": y, "z": z, "class": label, **columns})
