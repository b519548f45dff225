"""Select the voxels of a finished unit for export, with columns and coordinates; write Parquet and CSV."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.config import nearest
from semstab.core.files import atomic_path, csv_text
from semstab.core.prefetch import SizedCache
from semstab.core.types import Float64, UInt8
from semstab.data import labels as colors
from semstab.data import parquet
from semstab.data.georeference import IDENTITY, Georeference
from semstab.data.labels import name_key
from semstab.data.measures import dominant, measures
from semstab.data.parquet import files_of
from semstab.data.records import OVERVIEW, Record, Result
from semstab.data.results import slug
from semstab.data.tiles import AT_HAND, TileIndex
from semstab.data.voxel_keys import in_order, voxel_keys
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError, DataError
from semstab.metrics import CATEGORIES, categories
from semstab.metrics.agreement import rows_of
from semstab.report.figures.maps import Overview
from semstab.statistics import psa
from semstab.statistics.acceptance import AcceptanceThresholds

if TYPE_CHECKING:
    import pyarrow as pa


INDEX = ("ix", "iy", "iz")


@dataclass(frozen=True, eq=False)
class VoxelColumn:
    """A number of each voxel (n,), its unit, and a short description."""

    values: npt.NDArray[Any]
    unit: str = ""
    about: str = ""


@dataclass(frozen=True, eq=False)
class ExportedVoxels:
    """The voxels of a map that are exported, in the order of its table.

    Attributes:
        table: The rows of the voxels.
        columns: The numbers of each voxel, by name.
        classes: The names of the K classes.
        colors: (K, 3) RGB.
        taxonomy: The taxonomy of the classes.
        up: (3,) the scene's up axis, None if unknown.
        georeference: Georeference of the scene, or None.
        benchmark: The benchmark that the run is of, '' for none.
    """

    table: VoxelTable
    columns: Mapping[str, VoxelColumn]
    classes: tuple[str, ...]
    colors: UInt8
    taxonomy: str
    up: tuple[float, float, float] | None
    georeference: Georeference | None
    benchmark: str = ""

    @property
    def points(self) -> Float64:
        """Return centres (n, 3): global coordinates with a georeference, else the scene's; metres."""
        return self.in_file(self.table.centers)

    @property
    def laid(self) -> Float64:
        """Return centres (n, 3) along the axes of `points`, without the offset; metres."""
        return self.table.centers if self.georeference is None else self.georeference.along(self.table.centers)

    @property
    def linear(self) -> Float64:
        """Return the matrix (3, 3) from the scene's axes to those of `points`."""
        return np.array(IDENTITY if self.georeference is None else self.georeference.linear)

    def in_file(self, points: Float64) -> Float64:
        """Return coordinates (n, 3) of the scene in the system of `points`."""
        return points if self.georeference is None else self.georeference.projected(points)

    def in_scene(self, points: Float64) -> Float64:
        """Return coordinates (n, 3) of the system of `points` in that of the scene."""
        return points if self.georeference is None else self.georeference.in_scene(points)

    @property
    def offset(self) -> Float64:
        """Return the difference (3,) of `points` and `laid`."""
        return np.zeros(3) if self.georeference is None else np.array(self.georeference.offset)

    @property
    def classified(self) -> npt.NDArray[np.unsignedinteger[Any]]:
        """Return the dominant class (n,) in 8 or 16 bits, counted from 1: 0 is 'unclassified' in exported files."""
        return (dominant(self.table) + 1).astype(np.min_scalar_type(self.table.K))


class ExportedUnit:
    """The voxels of a unit that are exported, tile by tile; the latest tiles stay in memory.

    A voxel is exported if its OP is at least min_op, its dominant class is one of `classes` (any if `classes` is empty)
    and, with thresholds, its label has enough evidence. `columns` names measures, op, category, psa, columns of the
    unit's Parquet file, or of a file to `join`, which has some of the same voxels; for the default see `usual`.

    Attributes:
        size: Edge of a tile in voxels, None for the one tile of a map in a single file.

    Raises:
        ConfigError: For an unknown name, and if no voxel is left.
    """

    def __init__(
        self,
        result: Result,
        record: Record,
        *,
        columns: Sequence[str] | None = None,
        min_op: int = 1,
        classes: Sequence[str] = (),
        join: Path | None = None,
        thresholds: AcceptanceThresholds | None = None,
    ) -> None:
        if record.voxels_file is None:
            why = "its voxels were not stored; run it with a folder" if record.pixels is None else "a video has no map"
            raise ConfigError(f"{record.unit.slug}: {why}")
        self._result, self._record = result, record
        self._columns, self._join = columns, join
        self._min_op, self._classes, self._thresholds = min_op, classes, thresholds
        tiles = {file: parquet.tile_of(file) if record.in_tiles else None for file in files_of(record.voxels_file)}
        self._files = {(0, 0) if tile is None else (tile.x, tile.y): file for file, tile in tiles.items()}
        self.size = next(None if tile is None else tile.size for tile in tiles.values())
        self._highest = 0
        self._cache = SizedCache(self._read, lambda voxels: len(voxels.table), AT_HAND)

    @property
    def whole(self) -> bool:
        """Return whether no voxel is left out."""
        return self._min_op <= 1 and not self._classes and self._thresholds is None

    def __contains__(self, tile: TileIndex) -> bool:
        return tile in self._files

    def __getitem__(self, tile: TileIndex) -> ExportedVoxels:
        """Return the voxels of a tile, which may be none."""
        return self._cache[tile]

    def __iter__(self) -> Iterator[ExportedVoxels]:
        """Yield the voxels tile by tile, without empty tiles."""
        return (self[tile] for tile in self.tiles())

    def tiles(self) -> Iterator[TileIndex]:
        """Yield the tiles that have voxels.

        Raises:
            ConfigError: If none has.
        """
        has_voxels = False
        for tile in self._files:
            if len(self[tile].table):
                has_voxels = True
                yield tile
        if not has_voxels:
            limits = f"OP >= {self._min_op}" + (f" and class {' or '.join(self._classes)}" if self._classes else "")
            limits += " and the evidence that --thresholds requires" if self._thresholds is not None else ""
            raise ConfigError(f"{self._record.voxels_file}: no voxel with {limits}; OP goes up to {self._highest}")

    @cached_property
    def first(self) -> ExportedVoxels:
        """The voxels of one tile, for the properties that all share."""
        return next(iter(self))

    def _read(self, tile: TileIndex) -> ExportedVoxels:
        """Read a tile and choose its voxels."""
        file, record = self._files[tile], self._record
        assert record.voxels_file is not None
        table = VoxelTable.load(file)
        self._highest = max(self._highest, int(table.op.max(initial=0)))
        names = table.classes or tuple(str(k) for k in range(table.K))
        keep = table.op >= self._min_op
        if self._classes:
            keep &= np.isin(dominant(table), rows_named(self._classes, names, str(record.voxels_file)))
        if self._thresholds is not None:
            keep &= self._thresholds.decide(table) >= 0
        further = {} if self._join is None else joined_columns(table, self._join)
        columns = {
            name: further.get(name) or _column(name, table, file) for name in self._columns or (*usual(), *further)
        }
        scene, model = record.unit.scene, record.unit.model
        georeference = self._result.georeference.get(scene)
        return ExportedVoxels(
            rows_of(table, keep),
            {name: replace(column, values=column.values[keep]) for name, column in columns.items()},
            names,
            _colors(record.voxels_file.parents[1] / OVERVIEW / f"{slug(scene, model)}.npz", table.K),
            record.taxonomy,
            self._result.up.get(scene) if georeference is None else (0.0, 0.0, 1.0),
            georeference,
            self._result.benchmark,
        )


def together(parts: Sequence[ExportedVoxels]) -> ExportedVoxels:
    """Return the voxels of several tiles as one."""
    if len(parts) == 1:
        return parts[0]
    order = in_order(np.concatenate([part.table.index for part in parts]))
    columns = {
        name: replace(column, values=np.concatenate([part.columns[name].values for part in parts])[order])
        for name, column in parts[0].columns.items()
    }
    return replace(parts[0], table=VoxelTable.joined([part.table for part in parts]), columns=columns)


def joined_columns(table: VoxelTable, file: Path) -> dict[str, VoxelColumn]:
    """Return the columns of a file with rows of these voxels, as `compare` writes it; 0, or NaN, without a row.

    Raises:
        DataError: If it is another file, or has voxels of another size.
    """
    import pyarrow.parquet as pq

    with parquet.reading(file):
        names = [name for name in pq.read_schema(file).names if name not in INDEX]
        content = parquet.read(file, (*INDEX, *names))
        keys, file_keys = voxel_keys(table.index, np.stack([content[name] for name in INDEX], axis=1))
    if content["voxel_size"] != table.voxel_size:
        raise DataError(
            f"{file}: the file has voxels of {content['voxel_size']:g} m, the map of {table.voxel_size:g} m"
        )
    positions = np.minimum(np.searchsorted(keys, file_keys), len(keys) - 1)
    joined = keys[positions] == file_keys
    columns = {}
    for name in names:
        empty = np.nan if content[name].dtype.kind == "f" else 0
        values = np.full(len(table), empty, dtype=content[name].dtype)
        values[positions[joined]] = content[name][joined]
        columns[name] = VoxelColumn(values)
    return columns


def usual() -> tuple[str, ...]:
    """Return the columns by default: the measures, OP, category."""
    return (*(measure.key for measure in measures()), "op", "category")


def rows_named(wanted: Sequence[str], names: Sequence[str], where: str) -> list[int]:
    """Return the rows of classes by name.

    Raises:
        ConfigError: For an unknown name, with the nearest known one.
    """
    row_of_name = {name_key(name): row for row, name in enumerate(names)}
    for name in wanted:
        if name_key(name) not in row_of_name:
            raise ConfigError(f"{where}: no class '{name}'; {nearest(name, names)}")
    return [row_of_name[name_key(name)] for name in wanted]


def _column(name: str, table: VoxelTable, file: Path) -> VoxelColumn:
    """Return a column by its name: a measure, or one that the run wrote into its Parquet file."""
    measure_of_key = {measure.key: measure for measure in measures()}
    if name in measure_of_key:
        return VoxelColumn(measure_of_key[name].of(table), measure_of_key[name].unit, measure_of_key[name].title)
    if name == "op":
        return VoxelColumn(table.op, "frames", "observations")
    if name == "category":
        return VoxelColumn(categories(table), "", "0 low 1 drift 2 uncert 3 stable")
    if name == "psa":
        return VoxelColumn(psa(table), "", "pairwise semantic agreement")
    in_file = parquet.names_in(file)
    if name not in in_file:
        available = sorted({*measure_of_key, "op", "category", "psa", *in_file} - {*INDEX, "label"})
        raise ConfigError(f"{file}: the run has no column '{name}'; {nearest(name, available)}")
    return VoxelColumn(VoxelTable.columns(file, [name])[name])


def _colors(overview: Path, K: int) -> UInt8:
    """Return the colours of the classes in the run's figures, or the palette without an overview."""
    try:
        palette = Overview.load(overview).palette
    except DataError:
        palette = np.array(colors.palette(K), dtype=np.uint8)
    return palette


# Parquet and CSV have a row for each voxel, with its coordinates, the name of its class, and measures.


def write_parquet(parts: Iterable[ExportedVoxels], path: Path) -> int:
    """Write columns, part after part, and a metadata entry 'semstab' that describes them; return the number of voxels.

    An undefined value is null.
    """
    import pyarrow.parquet as pq

    return _written(parts, path, lambda file, schema: pq.ParquetWriter(file, schema, compression="zstd"))


def write_csv(parts: Iterable[ExportedVoxels], path: Path) -> int:
    """Write columns, part after part; an undefined value is an empty field. Return the number of voxels."""
    from pyarrow import csv

    return _written(map(_in_csv, parts), path, csv.CSVWriter)


def _in_csv(part: ExportedVoxels) -> ExportedVoxels:
    """Return a part with names in which a spreadsheet sees no formula."""
    columns = {csv_text(name): column for name, column in part.columns.items()}
    return replace(part, columns=columns, classes=tuple(map(csv_text, part.classes)))


def _written(parts: Iterable[ExportedVoxels], path: Path, opened: Callable[[Path, pa.Schema], Any]) -> int:
    """Write parts with a writer of Arrow; return the number of voxels."""
    voxels, writer = 0, None
    with atomic_path(path) as temporary, ExitStack() as open_files:
        for part in parts:
            about = {
                "voxel_size": part.table.voxel_size,
                "crs": None if part.georeference is None else part.georeference.crs,
                "taxonomy": part.taxonomy,
                "classes": list(part.classes),
                "benchmark": part.benchmark,
                "units": {name: column.unit for name, column in part.columns.items() if column.unit},
            }
            table = arrow(part).replace_schema_metadata({"semstab": json.dumps(about)})
            writer = writer or open_files.enter_context(opened(temporary, table.schema))
            writer.write_table(table)
            voxels += len(part.table)
    return voxels


def arrow(voxels: ExportedVoxels) -> pa.Table:
    """Return x, y, z in metres, class and category by their names, and the other columns."""
    import pyarrow as pa

    x, y, z = voxels.points.T
    columns = {name: pa.array(column.values, from_pandas=True) for name, column in voxels.columns.items()}
    if "category" in columns:
        columns["category"] = pa.DictionaryArray.from_arrays(columns["category"], list(CATEGORIES))
    label = pa.DictionaryArray.from_arrays(voxels.classified.astype("int32") - 1, list(voxels.classes))
    return pa.table({"x": x, "y": y, "z": z, "class": label, **columns})
