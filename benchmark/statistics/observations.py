"""Labels of sampled cells, frame by frame: alpha, its intervals and comparisons follow from them."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core import arrays
from semstab.core.files import atomic_path, parse_json
from semstab.core.types import Float64, Int32, Int64, UInt16, UInt32
from semstab.data import parquet
from semstab.data.events import Events
from semstab.data.evidence import Evidence
from semstab.data.measures import dominant, mean
from semstab.data.voxels import index_columns
from semstab.errors import DataError
from semstab.statistics.cluster_sums.index import distinct_rows
from semstab.statistics.loops import CELLS, SHIFTS, SPAN, WITHIN

Voxel = tuple[int, int, int]


def cells_of(key: Int64, low: Voxel) -> Int64:
    """Return indices (n, 3) of the cells with these keys, which begin at block `low`."""
    cells = np.empty((len(key), 3), np.int64)
    for axis, (shift, first, digit) in enumerate(zip(SHIFTS, low, WITHIN, strict=True)):
        voxel = ((key >> shift) & (SPAN - 1)) + first
        cells[:, axis] = CELLS * voxel + ((key >> digit) & (CELLS - 1))
    return cells


def keys_of(cells: Int64) -> tuple[Int64, Voxel]:
    """Return keys (n,) of cells (n, 3), and the block at which they begin.

    Raises:
        DataError: If the cells span too much.
    """
    key, low = np.zeros(len(cells), np.int64), [0, 0, 0]
    for axis, (shift, digit) in enumerate(zip(SHIFTS, WITHIN, strict=True)):
        voxel = cells[:, axis] // CELLS
        low[axis] = int(voxel.min()) if len(voxel) else 0
        key |= (_near(voxel - low[axis]) << shift) | ((cells[:, axis] % CELLS) << digit)
    return key, (low[0], low[1], low[2])


def alike(keys: Sequence[Int64], lows: Sequence[Voxel]) -> tuple[list[Int64], Voxel]:
    """Return keys of several samples that all begin at the same block, the lowest of all, and that block.

    Raises:
        DataError: If the samples span too much.
    """
    if len({*lows}) == 1:
        return list(keys), lows[0]
    low, moved = [0, 0, 0], list(keys)
    for axis, shift in enumerate(SHIFTS):
        voxels = [((key >> shift) & (SPAN - 1)) + own[axis] for key, own in zip(keys, lows, strict=True)]
        low[axis] = min((int(voxel.min()) for voxel in voxels if len(voxel)), default=0)
        for k, voxel in enumerate(voxels):
            moved[k] = moved[k] + ((_near(voxel - low[axis]) - (voxel - lows[k][axis])) << shift)
    return moved, (low[0], low[1], low[2])


def _near(voxel: Int64) -> Int64:
    if voxel.max(initial=0) >= SPAN:
        raise DataError(f"the observations span more than {SPAN} blocks of cells; leave out far depth")
    return voxel


# The views from which the frames of a sample were taken.

VIEW = 6
"""Numbers of a view: frame, centre, time stamp, footprint."""


@dataclass(frozen=True, eq=False)
class Views:
    """Distinct views: frames that a camera took from one position count as one, the first of them.

    Attributes:
        frame: (V,) indices of frames.
        centre: (V, 3) camera centres in metres.
        timestamp: (V,) time stamps in seconds, NaN where unknown.
        footprint: (V,) median width of a pixel on the surface that it shows, in metres.
    """

    frame: Int64
    centre: Float64
    timestamp: Float64
    footprint: Float64

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def of(cls, rows: Sequence[Sequence[float]] | Float64) -> Views:
        """Build views from rows (V, 6).

        Raises:
            ValueError: If the rows have another shape, or an index is not a finite number.
        """
        table = np.asarray(rows, np.float64).reshape(len(rows), VIEW)
        if not np.isfinite(table[:, 0]).all():
            raise ValueError("a frame without an index")
        return cls(table[:, 0].astype(np.int64), table[:, 1:4].copy(), table[:, 4].copy(), table[:, 5].copy())

    @classmethod
    def joined(cls, parts: Sequence[Views]) -> Views:
        """Return the views of several parts, one after the other."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))

    def rows(self) -> Float64:
        """Return rows (V, 6), as `of` takes them."""
        others = self.timestamp[:, None], self.footprint[:, None]
        return np.concatenate([self.frame[:, None], self.centre, *others], axis=1)

    def take(self, rows: Int64) -> Views:
        """Return some of the views."""
        return Views(*(column[rows] for column in vars(self).values()))

    def rank(self, frame: npt.NDArray[np.integer]) -> Int64:
        """Return the positions (m,) of views by the indices (m,) of their frames."""
        order = np.argsort(self.frame)
        return np.asarray(order[np.searchsorted(self.frame, frame, sorter=order)], np.int64)


COLUMNS = "key", "view", "label", "weight", "drawn"
"""Columns of entries."""

SCHEMA = 4
Entries = tuple[Int64, Int32, UInt16, Float64]


@dataclass(frozen=True, eq=False)
class CellObservations:
    """Labels of the pixels of sampled cells, view by view: an entry (m,) for each cell, view and class.

    Cells are cubes about as wide as a pixel's footprint, so that two views of one cell see the same spot; they do not
    depend on the voxels of a map. A block of CELLS cells along each edge is the unit of sampling.

    Attributes:
        key: (m,) int64 of the cell, see `keys_of`.
        view: (m,) int32 row of `views`.
        label: (m,) uint16 class; K for pixels with depth that have no label.
        weight: (m,) pixels.
        drawn: (m,) uint32 hash of the block; blocks below `share` are in the sample.
        low: Block at which keys begin.
        views: Distinct views, in order of integration.
        cell_size: Edge of a cell in metres, a power of 2.
        K: Number of classes.
        share: Sampled share of the blocks, times 2^32.
        classes: Names of the classes.
        frames: Number of frames, of which some may share a view.
        sparse: Whether views are scans: their points lie apart, so that fine and coarse cells that two of them meet lie
            at other ranges, and alpha is that of fine cells, without extrapolation.
    """

    key: Int64
    view: Int32
    label: UInt16
    weight: Float64
    drawn: UInt32
    low: Voxel
    views: Views
    cell_size: float
    K: int
    share: int = 1 << 32
    classes: tuple[str, ...] = ()
    frames: int = 0
    sparse: bool = False

    def __len__(self) -> int:
        return len(self.key)

    @property
    def cell(self) -> Int64:
        """(m, 3) index of the cell: floor(point / cell_size)."""
        return cells_of(self.key, self.low)

    @property
    def coarsening(self) -> int:
        """Return how many cells of the sample make the edge of a fine cell, by the views' median footprint: 1 or 2.

        A fine cell is one to two footprints wide; two of them make the edge of a coarse one, which a block holds whole.
        """
        footprint = float(np.median(self.views.footprint)) if len(self.views) else self.cell_size
        return int(min(max(2.0 ** math.ceil(math.log2(footprint / self.cell_size)), 1.0), CELLS // 2))

    def coarsened(self, cell_size: float) -> CellObservations:
        """Return the sample with larger cells, whose edge in metres is a power of 2, and with blocks of these."""
        from semstab.statistics.loops.observations import hash_row

        if cell_size == self.cell_size or not len(self):
            return dataclasses.replace(self, cell_size=cell_size)
        cell = self.cell // round(cell_size / self.cell_size)
        (key, low), drawn = keys_of(cell), np.empty(len(self), np.uint32)
        hash_row(*np.ascontiguousarray((cell // CELLS).T.astype(np.int32)), drawn)
        larger = dataclasses.replace(self, key=key, drawn=drawn, low=low, cell_size=cell_size)
        return larger.only(drawn < np.uint64(self.share))

    def labelled(self) -> CellObservations:
        """Return the entries of pixels that have a label."""
        return self.only(self.label < self.K)

    def labelled_share(self) -> float:
        """Return the share of the cells seen by two views that have a label in at least half of their observations."""
        seen, of = distinct_rows(np.stack([self._number(self.cell // CELLS), self.view], axis=1))
        pixels, own = (np.bincount(of, w) for w in (self.weight, self.weight * (self.label < self.K)))
        _, of = np.unique(seen[:, 0], return_inverse=True)
        frames, labelled = np.bincount(of), np.bincount(of, 2 * own >= pixels)
        return mean((2 * labelled >= frames)[frames >= 2].astype(np.float64))

    def without(self, classes: Sequence[int]) -> CellObservations:
        """Return the entries of coarse cells whose fused class is none of these."""
        if not len(classes) or not len(self):
            return self
        log = self.observations(self.coarsening * 2)
        retained = np.stack([log.ix, log.iy, log.iz], axis=1)[~np.isin(dominant(log.table()), classes)]
        _, of = np.unique(np.concatenate([retained, self.cell // (2 * self.coarsening)]), axis=0, return_inverse=True)
        return self.only(np.isin(of.ravel()[len(retained) :], of.ravel()[: len(retained)]))

    def only(self, rows: Any) -> CellObservations:
        """Return some of the entries."""
        return self._each(lambda column: column[rows])

    def copied(self) -> CellObservations:
        """Return a copy with its own memory."""
        return self._each(np.copy)

    def _each(self, change: Callable[[Any], Any]) -> CellObservations:
        columns: dict[str, Any] = {name: change(getattr(self, name)) for name in COLUMNS}
        return dataclasses.replace(self, **columns)

    @classmethod
    def joined(cls, parts: Sequence[CellObservations]) -> CellObservations:
        """Return the entries of several samples, with all else from the first."""
        keys, low = alike([part.key for part in parts], [part.low for part in parts])
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS[1:]
        }
        return dataclasses.replace(parts[0], key=np.concatenate(keys), **columns, low=low)

    def observations(self, coarsening: int | None = None) -> Events:
        """Return the log of cells: the shares of classes among a view's labelled pixels in each cell.

        Args:
            coarsening: How many cells of the sample make an edge of a cell of the log; that of fine cells by default.
        """
        from semstab.statistics.loops.observations import observe

        times = self.coarsening if coarsening is None else coarsening
        own = self.labelled()
        cell = own.cell // times
        number = own._number(cell)
        order = np.lexsort((own.view, number))
        number, view, label, weight = number[order], own.view[order], own.label[order], own.weight[order]
        n = len(number)
        first, of, starts = np.empty(n, np.int64), np.empty(n, np.int32), np.empty(n + 1, np.int64)
        pixels, share, text = np.empty(n), np.empty(n), np.empty(n, np.uint16)
        n, m = observe(number, view, label, weight, self.K, first, of, pixels, starts, text, share)
        first, of = first[:n], of[:n]
        at = order[first[np.flatnonzero(np.diff(of, prepend=-1))]]
        return Events(
            **index_columns(cell[at]),
            voxel=of,
            frame=self.views.frame.astype(np.int32)[view[first]],
            evidence=Evidence(starts[: n + 1], text[:m], share[:m], self.K),
            pixels=np.rint(pixels[:n]).astype(np.int32),
            voxel_size=times * self.cell_size,
            classes=self.classes,
        )

    @staticmethod
    def _number(cell: Int64) -> Int64:
        """Return the numbers (n,) of cells (n, 3) in lexical order, equal for equal cells."""
        low = cell.min(axis=0, initial=np.iinfo(np.int64).max)
        size = cell.max(axis=0, initial=np.iinfo(np.int64).min) - low + 1
        x, y, z = (cell - low).T
        return np.asarray((x * size[1] + y) * size[2] + z, np.int64)

    def save(self, path: str | Path) -> None:
        """Write Parquet, atomically."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = dict(zip("xyz", self.cell.astype(np.int32).T, strict=True))
        columns |= {name: getattr(self, name) for name in COLUMNS[1:]}
        about = {name: getattr(self, name) for name in ("cell_size", "K", "share", "classes", "frames", "sparse")}
        content = pa.table({name: arrays.column(values) for name, values in columns.items()})
        text = json.dumps({"schema": SCHEMA, "kind": "CellObservations", **about, "views": self.views.rows().tolist()})
        with atomic_path(path) as temporary, pq.ParquetWriter(temporary, content.schema, compression="zstd") as file:
            file.write_table(content)
            file.add_key_value_metadata(
                {"semstab": text}
            )  # metadata of a schema is written twice, and copied more often

    @classmethod
    def load(cls, path: str | Path) -> CellObservations:
        """Read a file that `save` wrote.

        Raises:
            DataError: If the file is missing, damaged or of another kind.
        """
        with parquet.reading(path, "a file of sampled observations"):
            with parquet.opened(path) as file:
                content = file.read()
            about = parse_json((content.schema.metadata or {})[b"semstab"])
            if (about.pop("kind"), about.pop("schema")) != ("CellObservations", SCHEMA):
                raise DataError("it is of another kind, or of another version that sampled other cells; run it again")
            views = Views.of(about.pop("views"))
            about["classes"] = tuple(about["classes"])
            x, y, z, view, label, weight, drawn = map(arrays.values_of, content.columns)
            key, low = keys_of(np.stack([x, y, z], axis=1).astype(np.int64))
            return cls(key, view, label, weight, drawn, low, views, **about)
