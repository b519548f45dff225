"""What figures show of units' voxels, each table read once; the figures of a unit are drawn one after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.metrics.matching import voxel_keys
from semstab.model.records import Record, Tables
from semstab.model.results import Unit
from semstab.model.voxels import VoxelTable, parquet
from semstab.outputs.plots.histograms import Histograms, histograms, together
from semstab.outputs.plots.statistics import DriftByOP
from semstab.outputs.plots.topdown import MOST, FromAbove, topmost
from semstab.statistics import expected_sbd

LARGEST = 2e8
"""Bytes of views that are kept in memory; those of further units are made from the units' files."""


@dataclass(frozen=True, eq=False)
class Sums:
    """A unit's voxels by OP: each measure, and SBD beside random order."""

    measures: Histograms
    drift: DriftByOP

    @classmethod
    def of(cls, table: VoxelTable, null: npt.NDArray[np.float64]) -> Sums:
        """Of a map, and the SBD (n,) expected of its voxels in random order."""
        return cls(histograms(table), DriftByOP.of(table, null))

    def __add__(self, other: Sums) -> Sums:
        return Sums(together([self.measures, other.measures]), self.drift + other.drift)


class Views:
    """The sums of every unit that was asked for or seen, and views from above: of the last one, and of units seen."""

    def __init__(self) -> None:
        self._tables = Tables()
        self._sums: dict[str, Sums] = {}
        self._above: dict[str, FromAbove] = {}
        self._last: tuple[str, FromAbove] | None = None

    def see(self, unit: Unit, table: VoxelTable, up: npt.ArrayLike | None) -> None:
        """Take what figures show of a unit while its map is in memory; from above where up is known."""
        self._sums[unit.slug] = Sums.of(table, expected_sbd(table))
        if up is not None and sum(above.nbytes for above in self._above.values()) < LARGEST:
            self._above[unit.slug] = FromAbove.of(table, up)

    def sums(self, record: Record) -> Sums:
        """The unit's voxels by OP."""
        slug = record.unit.slug
        if slug not in self._sums:
            self._sums[slug] = reduce(add, self._parts(record))
        return self._sums[slug]

    def _parts(self, record: Record) -> Iterator[Sums]:
        """Of the unit, or of each of its tiles."""
        assert record.voxels_file is not None
        for file in parquet.files_of(record.voxels_file):
            table = VoxelTable.load(file) if record.in_tiles else self._tables.of(record)
            null = _column(file, "sbd_null")
            yield Sums.of(table, expected_sbd(table) if null is None else null)

    def above(self, record: Record, up: npt.ArrayLike) -> FromAbove:
        """The unit's voxels that are seen from above."""
        slug = record.unit.slug
        if slug in self._above:
            return self._above[slug]
        if self._last is None or self._last[0] != slug:
            large = record.in_tiles and record.summary.table.voxels > MOST
            table = topmost(record.tiles(), up) if large else self._tables.of(record)
            self._last = slug, FromAbove.of(table, up)
        return self._last[1]


def kept_of(record: Record, table: VoxelTable, names: Sequence[str]) -> list[npt.NDArray[Any]] | None:
    """Columns (n,) that were written beside the voxels, of these of them, tile by tile; None where they were not."""
    if record.voxels_file is None or not {*names} <= {*parquet.names_in(record.voxels_file)}:
        return None
    found: list[npt.NDArray[Any]] | None = None
    for file in parquet.files_of(record.voxels_file):
        own = VoxelTable.columns(file, ("ix", "iy", "iz", *names))
        wanted, there = voxel_keys(table.index, np.stack([own[axis] for axis in ("ix", "iy", "iz")], axis=1))
        at = np.minimum(np.searchsorted(there, wanted), len(there) - 1)
        met = there[at] == wanted
        if found is None:
            found = [np.zeros(len(table), own[name].dtype) for name in names]
        for values, name in zip(found, names, strict=True):
            values[met] = own[name][at[met]]
    return found


def _column(file: Path, name: str) -> npt.NDArray[Any] | None:
    return VoxelTable.columns(file, [name])[name] if name in parquet.names_in(file) else None
