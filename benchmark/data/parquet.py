"""Voxel tables and logs of observations as Parquet: columns, and in the metadata the map that they belong to."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import column, values_of
from semstab.core.files import atomic_path, parse_json
from semstab.data.digests import require_unchanged
from semstab.data.evidence import Evidence
from semstab.errors import DataError, summarize_error

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


SCHEMA = 1

IN_GROUP = 8
"""Parts in a row group: of less, a file takes more space, and more time to be written and read."""

TILE = re.compile(r"tile=(-?\d+)_(-?\d+)\.parquet")
"""Files of a folder that hold a map together."""


@dataclass(frozen=True)
class Tile:
    """Columns of voxels that a file holds alone: those with ix // size = x and iy // size = y.

    Attributes:
        size: Voxels along its edge, a power of 2.
        map: Names the map that it is a part of.
    """

    x: int
    y: int
    size: int
    map: str

    @property
    def name(self) -> str:
        """The name of its file."""
        return f"tile={self.x}_{self.y}.parquet"


def write(
    path: str | Path,
    parts: Iterable[Mapping[str, npt.NDArray[Any]]],
    kind: str,
    voxel_size: float,
    classes: Sequence[str],
    tile: Tile | None = None,
) -> None:
    """Write columns (n,) and (n, K), part after part, one at least; atomically."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    about = {"schema": SCHEMA, "kind": kind, "voxel_size": voxel_size, "classes": classes}
    if tile is not None:
        about |= {"tile": [tile.x, tile.y], "tile_size": tile.size, "map": tile.map}
    tables = (pa.table({name: _to_arrow(values) for name, values in columns.items()}) for columns in parts)
    with atomic_path(path) as temporary, ExitStack() as open_files:
        writer = None
        while batch := [*itertools.islice(tables, IN_GROUP)]:
            content = pa.concat_tables(batch).replace_schema_metadata({"semstab": json.dumps(about)})
            writer = writer or open_files.enter_context(pq.ParquetWriter(temporary, content.schema, compression="zstd"))
            writer.write_table(content)


def files_of(path: str | Path) -> list[Path]:
    """Return the files of a table: itself, or the tiles in a folder, by x and y.

    Raises:
        DataError: If a tile belongs to another map than the other tiles.
    """
    path = Path(path)
    if not path.is_dir():
        return [path]
    tiles = sorted((int(x), int(y), file) for file in path.iterdir() for x, y in TILE.findall(file.name))
    files = [file for _, _, file in tiles]
    if not files:
        raise DataError(f"{path}: a folder without tiles (tile=X_Y.parquet); run it again")
    marks = [(file, _about(file)) for file in files]
    for (file, about), (x, y, _) in zip(marks, tiles, strict=True):
        if (about.get("map"), about.get("tile_size")) != (marks[0][1].get("map"), marks[0][1].get("tile_size")):
            raise DataError(f"{file}: is a tile of another map than {files[0].name}; remove it, or run it again")
        if about.get("tile") != [x, y]:
            raise DataError(f"{file}: holds tile {about.get('tile')}; it was renamed, or is damaged")
    return files


def tile_of(path: Path) -> Tile:
    """Return which tile a file is.

    Raises:
        DataError: If it is none.
    """
    about = _about(path)
    with reading(path):
        x, y = about["tile"]
        return Tile(x, y, about["tile_size"], about["map"])


def voxel_size_of(path: Path) -> float:
    """Return the edge of a table's voxels, metres."""
    about = _about(path)
    with reading(path):
        return float(about["voxel_size"])


def _about(path: Path) -> dict[str, Any]:
    import pyarrow.parquet as pq

    with reading(path):
        content = parse_json((pq.read_schema(path).metadata or {})[b"semstab"])
        if not isinstance(content, dict):
            raise ValueError("its metadata are no mapping")
        return content


def rows_in(files: Iterable[Path]) -> int:
    """Return how many rows files have.

    Raises:
        DataError: As `reading` does.
    """
    import pyarrow.parquet as pq

    total = 0
    for file in files:
        with reading(file):
            total += pq.read_metadata(file).num_rows
    return total


def names_in(path: str | Path) -> list[str]:
    """Return the columns of single numbers that a table in a file, or in tiles, has."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = files_of(path)[0]
    with reading(file):
        return [field.name for field in pq.read_schema(file) if not pa.types.is_nested(field.type)]


def columns(path: Path, names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    """Return columns (n,) of a file by name.

    Raises:
        DataError: If one is not there.
    """
    with reading(path), opened(path) as file:
        content = file.read(columns=list(names))
        return {name: values_of(content.column(name)) for name in names}


ORDINARY, DENSEST = 2**28, 256
"""Bytes that a group of rows may take in memory whatever the file's size, and times the size of the file above."""


@contextmanager
def opened(path: str | Path) -> Iterator[pq.ParquetFile]:
    """Open a file to read its columns, of which a group takes no more memory than a file of its size may hold.

    Raises:
        DataError: If it is of a finished run, and not as the run wrote it; or if its metadata claim more.
    """
    import pyarrow.parquet as pq

    require_unchanged(path)
    with pq.ParquetFile(path) as file:  # pq.read_table imports pandas
        groups = [_unpacked_bytes(file.metadata.row_group(k)) for k in range(file.metadata.num_row_groups)]
        if max(groups, default=0) > max(ORDINARY, DENSEST * (size := Path(path).stat().st_size)):
            raise DataError(f"{path}: its columns unpack to {max(groups)} bytes of {size}; write it again")
        yield file


def unpacked_bytes(path: Path) -> int:
    """Return the bytes that a file's columns take in memory, by its metadata. Raises DataError as `reading` does."""
    import pyarrow.parquet as pq

    with reading(path):
        metadata = pq.read_metadata(path)
        return sum(_unpacked_bytes(metadata.row_group(k)) for k in range(metadata.num_row_groups))


def _unpacked_bytes(group: pq.RowGroupMetaData) -> int:
    """Return the bytes that a group of rows takes in memory: eight a value, or as its pages say, if that is more."""
    chunks = [group.column(k) for k in range(group.num_columns)]
    return sum(max(8 * group.num_rows, 8 * chunk.num_values, chunk.total_uncompressed_size) for chunk in chunks)


@contextmanager
def reading(path: str | Path, kind: str = "a semstab table") -> Iterator[None]:
    """Turn any error in a file's content into a DataError of one line that names the file and what it should be."""
    import pyarrow as pa

    try:
        yield
    except (OSError, LookupError, TypeError, ValueError, OverflowError, pa.ArrowException) as error:
        if isinstance(error, DataError) and str(error).startswith(f"{path}: "):
            raise
        raise DataError(f"{path}: not {kind} ({summarize_error(error)})") from error


def read(path: str | Path, names: Iterable[str], optional: Iterable[str] = ()) -> dict[str, Any]:
    """Return columns by name, optional ones if they are there, voxel_size and classes.

    What it raises becomes a DataError in `reading`.
    """
    with opened(path) as content:
        about = parse_json((content.schema_arrow.metadata or {})[b"semstab"])
        if about["schema"] != SCHEMA:
            raise DataError(f"written with schema {about['schema']}, this version reads {SCHEMA}")
        there = set(content.schema_arrow.names)
        parts: dict[str, list[Any]] = {name: [] for name in (*names, *there.intersection(optional))}
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
        return column(values)
    return pa.FixedSizeListArray.from_arrays(column(values.ravel()), values.shape[1])


def _to_numpy(column: pa.ChunkedArray) -> npt.NDArray[Any] | Evidence:
    """Return values (n,); rows of classes are sparse."""
    import pyarrow as pa

    if column.null_count:
        raise DataError("a column has missing values")
    if pa.types.is_fixed_size_list(column.type):
        flat = pa.chunked_array([part.flatten() for part in column.chunks], column.type.value_type)
        return Evidence.from_rows(values_of(flat).reshape(-1, column.type.list_size))
    return values_of(column)
