"""The voxels of a finished unit that are to leave it: which of them, what is said of each, where they lie on Earth."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.config import nearest
from semstab.core.at_hand import AtHand
from semstab.core.files import atomic_path
from semstab.core.types import Float64, UInt8
from semstab.errors import ConfigError, DataError
from semstab.metrics import CATEGORIES, categories
from semstab.metrics.agreement import rows_of, voxel_keys
from semstab.model import labels as colors
from semstab.model import parquet
from semstab.model.georeference import Georeference
from semstab.model.labels import name_key
from semstab.model.measures import dominant, measures
from semstab.model.parquet import files_of
from semstab.model.records import OVERVIEW, Record, Result
from semstab.model.results import slug
from semstab.model.tiles import AT_HAND, Place
from semstab.model.voxels import VoxelTable
from semstab.report.figures.maps import Overview
from semstab.statistics import psa
from semstab.statistics.commit import Commit

if TYPE_CHECKING:
    import pyarrow as pa


INDEX = ("ix", "iy", "iz")


@dataclass(frozen=True, eq=False)
class Column:
    """A number of each voxel (n,), its unit, and what it is in a few words."""

    values: npt.NDArray[Any]
    unit: str = ""
    about: str = ""


@dataclass(frozen=True, eq=False)
class Voxels:
    """The voxels of a map that are exported, in the order of its table.

    table        their rows
    columns      what is said of each, by name
    classes      K names
    colors       (K, 3) RGB
    taxonomy     whose classes they are
    up           (3,) the scene's up axis, None where it is not known
    georeference of the scene, None where it has none
    """

    table: VoxelTable
    columns: Mapping[str, Column]
    classes: tuple[str, ...]
    colors: UInt8
    taxonomy: str
    up: tuple[float, float, float] | None
    georeference: Georeference | None

    @property
    def points(self) -> Float64:
        """(n, 3) centres: global coordinates where there is a georeference, else the scene's; metres."""
        return self.table.centers + self.offset

    @property
    def offset(self) -> Float64:
        """(3,) what leads from the scene's coordinates to those of the file."""
        return np.zeros(3) if self.georeference is None else np.array(self.georeference.offset)

    @property
    def classified(self) -> npt.NDArray[np.unsignedinteger[Any]]:
        """(n,) dominant class in 8 or 16 bits, counted from 1: 0 is 'unclassified' in what is exported."""
        return (dominant(self.table) + 1).astype(np.min_scalar_type(self.table.K))


class Chosen:
    """The voxels of a unit that are to leave it, by the tile that holds them; the last few tiles are at hand.

    Those with OP >= min_op and one of these dominant classes, all where none is named; with thresholds (commit), of
    those the ones whose label has enough evidence. `columns` names measures, op, category, psa, columns of the unit's
    Parquet file, or of one `beside` it, which has some of the same voxels; where not given, see `usual`.
    Raises ConfigError for a name that is not there, and where no voxel is left.

    size  edge of a tile in voxels, None for the one tile of a map in a single file
    """

    def __init__(
        self,
        result: Result,
        record: Record,
        *,
        columns: Sequence[str] | None = None,
        min_op: int = 1,
        classes: Sequence[str] = (),
        beside: Path | None = None,
        commit: Commit | None = None,
    ) -> None:
        if record.voxels_file is None:
            raise ConfigError(f"{record.unit.slug}: its voxels were not kept; run it with a folder")
        self._record, self._limits = record, (min_op, classes, commit)
        self._load = partial(_chosen, result, record, columns, min_op, classes, commit, beside)
        tiles = {file: parquet.tile_of(file) if record.in_tiles else None for file in files_of(record.voxels_file)}
        self._files = {(0, 0) if tile is None else (tile.x, tile.y): file for file, tile in tiles.items()}
        self.size = next(None if tile is None else tile.size for tile in tiles.values())
        self._highest = 0
        self._at_hand = AtHand(self._read, lambda voxels: len(voxels.table), AT_HAND)

    def __contains__(self, place: Place) -> bool:
        return place in self._files

    def __getitem__(self, place: Place) -> Voxels:
        """Those of a tile, which may be none."""
        return self._at_hand[place]

    def __iter__(self) -> Iterator[Voxels]:
        """Tile by tile, but for those without any."""
        return (self[place] for place in self.places())

    def places(self) -> Iterator[Place]:
        """The tiles that have some."""
        left = False
        for place in self._files:
            if len(self[place].table):
                left = True
                yield place
        if not left:
            raise _none_left(self._record, *self._limits, self._highest)

    @cached_property
    def first(self) -> Voxels:
        """Some of them, for what all have in common."""
        return next(iter(self))

    def _read(self, place: Place) -> Voxels:
        file = self._files[place]
        table = VoxelTable.load(file)
        self._highest = max(self._highest, int(table.op.max(initial=0)))
        return self._load(table, file)


def together(parts: Sequence[Voxels]) -> Voxels:
    """Voxels of several tiles as those of one."""
    if len(parts) == 1:
        return parts[0]
    order = np.lexsort(np.concatenate([part.table.index for part in parts]).T[::-1])
    columns = {
        name: replace(column, values=np.concatenate([part.columns[name].values for part in parts])[order])
        for name, column in parts[0].columns.items()
    }
    return replace(parts[0], table=VoxelTable.joined([part.table for part in parts]), columns=columns)


def _none_left(record: Record, min_op: int, classes: Sequence[str], commit: Commit | None, highest: int) -> ConfigError:
    limits = f"OP >= {min_op}" + (f" and class {' or '.join(classes)}" if classes else "")
    limits += " and the evidence that --commit asks for" if commit is not None else ""
    return ConfigError(f"{record.voxels_file}: no voxel with {limits}; OP goes up to {highest}")


def _chosen(
    result: Result,
    record: Record,
    columns: Sequence[str] | None,
    min_op: int,
    classes: Sequence[str],
    commit: Commit | None,
    beside: Path | None,
    table: VoxelTable,
    file: Path,
) -> Voxels:
    """Of a table, which is in a file."""
    assert record.voxels_file is not None
    names = table.classes or tuple(str(k) for k in range(table.K))
    keep = table.op >= min_op
    if classes:
        keep &= np.isin(dominant(table), rows_named(classes, names, str(record.voxels_file)))
    if commit is not None:
        keep &= commit.decide(table) >= 0
    further = {} if beside is None else columns_beside(table, beside)
    chosen = {
        name: further[name] if name in further else _column(name, table, file)
        for name in columns or (*usual(), *further)
    }
    scene, backbone = record.unit.scene, record.unit.backbone
    georeference = result.georeference.get(scene)
    return Voxels(
        rows_of(table, keep),
        {name: Column(column.values[keep], column.unit, column.about) for name, column in chosen.items()},
        names,
        _colors(record.voxels_file.parents[1] / OVERVIEW / f"{slug(scene, backbone)}.npz", table.K),
        record.summary.taxonomy,
        result.up.get(scene) if georeference is None else (0.0, 0.0, 1.0),
        georeference,
    )


def columns_beside(table: VoxelTable, file: Path) -> dict[str, Column]:
    """The columns of a file with rows of these voxels, as `compare` writes it; 0, or NaN, where it has no row.

    Raises DataError where it is no such file, or has voxels of another size.
    """
    import pyarrow.parquet as pq

    with parquet.reading(file):
        names = [name for name in pq.read_schema(file).names if name not in INDEX]
        content = parquet.read(file, (*INDEX, *names))
        own, theirs = voxel_keys(table.index, np.stack([content[name] for name in INDEX], axis=1))
    if content["voxel_size"] != table.voxel_size:
        raise DataError(f"{file}: has voxels of {content['voxel_size']:g} m, the map of {table.voxel_size:g} m")
    at = np.minimum(np.searchsorted(own, theirs), len(own) - 1)
    there = own[at] == theirs
    found = {}
    for name in names:
        empty = np.nan if content[name].dtype.kind == "f" else 0
        values = np.full(len(table), empty, dtype=content[name].dtype)
        values[at[there]] = content[name][there]
        found[name] = Column(values)
    return found


def crs_name(georeference: Georeference) -> str:
    """What a reference system is called, with its number where there is one: 'WGS 84 / UTM zone 15N (EPSG:32615)'."""
    name = re.search(r'"([^"]*)"', georeference.crs)
    number = re.search(r'ID\["EPSG",\s*(\d+)\]\s*\]\s*$', georeference.crs)
    return f"{name[1] if name else 'a projection'}{f' (EPSG:{number[1]})' if number else ''}"


def usual() -> tuple[str, ...]:
    """The columns that go along where none is chosen: the measures, OP, category."""
    return (*(measure.key for measure in measures()), "op", "category")


def rows_named(wanted: Sequence[str], names: Sequence[str], where: str) -> list[int]:
    """The rows of classes by name. Raises ConfigError with the nearest known one."""
    known = {name_key(name): row for row, name in enumerate(names)}
    for name in wanted:
        if name_key(name) not in known:
            raise ConfigError(f"{where}: no class '{name}'; {nearest(name, names)}")
    return [known[name_key(name)] for name in wanted]


def _column(name: str, table: VoxelTable, file: Path) -> Column:
    """A number of each voxel by its name."""
    known = {measure.key: measure for measure in measures()}
    if name in known:
        return Column(known[name].of(table), known[name].unit, known[name].title)
    if name == "op":
        return Column(table.op, "frames", "observations")
    if name == "category":
        return Column(categories(table), "", "0 low 1 drift 2 uncert 3 stable")
    if name == "psa":
        return Column(psa(table), "", "pairwise semantic agreement")
    return _kept_column(name, file, known)


def _kept_column(name: str, file: Path, known: Iterable[str]) -> Column:
    """A column that the run wrote beside those that every map has."""
    kept = parquet.names_in(file)
    if name not in kept:
        there = sorted({*known, "op", "category", "psa", *kept} - {"ix", "iy", "iz", "label"})
        raise ConfigError(f"{file}: the run has no column '{name}'; {nearest(name, there)}")
    return Column(VoxelTable.columns(file, [name])[name])


def _colors(overview: Path, K: int) -> UInt8:
    """Of the classes, as the run's figures show them; of the palette where it kept none."""
    try:
        palette = Overview.load(overview).palette
    except DataError:
        palette = np.array(colors.palette(K), dtype=np.uint8)
    return palette


# Parquet and CSV: a row a voxel, with its coordinates, the name of its class, and measures.


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
