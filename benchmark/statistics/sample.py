"""The voxels that the statistics of a map rest on: all of a small map, a fixed number of a large one."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semstab.core.arrays import from_arrays, to_arrays
from semstab.core.files import read_arrays, write_arrays
from semstab.core.types import Int64
from semstab.data.events import Events
from semstab.data.voxels import VoxelTable
from semstab.errors import DataError
from semstab.metrics.agreement import require_same_grid, require_same_map, shared_rows
from semstab.metrics.summary import STRATA, TableSums
from semstab.statistics.drift import streams

MOST_VOXELS = 500_000
"""More voxels add nothing to an interval: errors of neighbours are similar, so only independent ones count."""


@dataclass(frozen=True, eq=False)
class MapSample:
    """At most MOST_VOXELS voxels of a map, drawn by a hash of their indices; all voxels of a smaller map.

    Attributes:
        table: Rows of the drawn voxels, sorted as a VoxelTable is.
        events: Their observations, if the map has a log.
        truth: The rows of the true labels' map at those voxels, if ground truth is known.
        summary: Additive sums over ALL voxels of the map.
    """

    table: VoxelTable
    events: Events | None
    truth: VoxelTable | None
    summary: TableSums

    @classmethod
    def draw(
        cls,
        table: VoxelTable,
        events: Events | None = None,
        truth: VoxelTable | None = None,
        *,
        edges: Sequence[int] = STRATA,
        most: int = MOST_VOXELS,
    ) -> MapSample:
        """Draw from a map or from a part of one.

        Raises:
            DataError: If the events are not the log behind the table, or the truth has other classes or voxels.
        """
        if events is not None:
            require_same_map(table, events)
        if truth is not None:
            require_same_grid(table, truth)
        table = table.summing_to_op()
        summary = TableSums.from_table(table, edges)
        if len(table) > most:
            rows = _drawn(table, most)
            table, events = table.rows(rows), None if events is None else events.rows(rows)
        if truth is not None:
            truth = truth.rows(shared_rows(table, truth)[1])
        return cls(table, events, truth, summary)

    @classmethod
    def merged(cls, parts: Sequence[MapSample], *, most: int = MOST_VOXELS) -> MapSample:
        """Return the sample of a map from the samples of its disjoint parts: the voxels with the lowest hashes."""
        table = VoxelTable.joined([part.table for part in parts])
        logs = [part.events for part in parts if part.events is not None]
        truths = [part.truth for part in parts if part.truth is not None]
        events = Events.joined(logs) if logs else None
        truth = VoxelTable.joined(truths) if truths else None
        if len(table) > most:
            rows = _drawn(table, most)
            table, events = table.rows(rows), None if events is None else events.rows(rows)
            truth = None if truth is None else truth.rows(shared_rows(table, truth)[1])
        return cls(table, events, truth, functools.reduce(operator.add, (part.summary for part in parts)))

    def bound(self, *, most: int = MOST_VOXELS) -> int | None:
        """Return the highest hash of a voxel in a full sample; None if the sample is not full."""
        return int(streams(self.table, slice(None), 0).max()) if len(self.table) >= most else None

    def below(self, bound: int | None) -> MapSample:
        """Return the part that a sample with that highest hash can take in."""
        rows = slice(None) if bound is None else np.flatnonzero(streams(self.table, slice(None), 0) <= bound)
        if isinstance(rows, slice) or len(rows) == len(self.table):
            return self
        table, events = self.table.rows(rows), None if self.events is None else self.events.rows(rows)
        truth = None if self.truth is None else self.truth.rows(shared_rows(table, self.truth)[1])
        return MapSample(table, events, truth, self.summary)

    def save(self, path: Path) -> None:
        """Write one file, atomically."""
        write_arrays(path, to_arrays(self), packed=False)

    @classmethod
    def load(cls, path: Path) -> MapSample:
        """Read a file that `save` wrote.

        Raises:
            DataError: If the file is missing or damaged.
        """
        arrays = read_arrays(path)
        if arrays is None:
            raise DataError(f"{path}: it is missing, damaged or not a sample of a map; start the run again")
        return from_arrays(cls, arrays)


def _drawn(table: VoxelTable, most: int) -> Int64:
    """Return the rows of the voxels with the lowest hashes, ascending; there are more than `most`."""
    return np.sort(np.argpartition(streams(table, slice(None), 0), most)[:most])
