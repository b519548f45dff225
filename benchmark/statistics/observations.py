"""What was seen of sampled voxels, by cells a quarter as wide: what observations and ceilings follow from.

Kept in the folder of a run, it lets maps be compared on the very looks that all of them made.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core import arrays
from semstab.core.files import atomic_path, parse_json
from semstab.core.types import Float64, Int32, Int64, Mask, UInt16, UInt32
from semstab.errors import DataError, summarize_error
from semstab.model.events import Events
from semstab.model.evidence import Evidence
from semstab.model.measures import dominant, mean
from semstab.model.voxels import index_columns
from semstab.statistics.loops import CELLS, DIGITS, SHIFTS, SPAN, WITHIN

Voxel = tuple[int, int, int]


def cells_of(key: Int64, low: Voxel) -> Int64:
    """(n, 3) indices of the cells with these keys, which begin at voxel `low`."""
    cells = np.empty((len(key), 3), np.int64)
    for axis, (shift, first, digit) in enumerate(zip(SHIFTS, low, WITHIN, strict=True)):
        voxel = ((key >> shift) & (SPAN - 1)) + first
        cells[:, axis] = CELLS * voxel + ((key >> digit) & (CELLS - 1))
    return cells


def keys_of(cells: Int64) -> tuple[Int64, Voxel]:
    """Keys (n,) of cells (n, 3), and the voxel at which they begin. Raises DataError where they span too much."""
    key, low = np.zeros(len(cells), np.int64), [0, 0, 0]
    for axis, (shift, digit) in enumerate(zip(SHIFTS, WITHIN, strict=True)):
        voxel = cells[:, axis] // CELLS
        low[axis] = int(voxel.min()) if len(voxel) else 0
        key |= (_near(voxel - low[axis]) << shift) | ((cells[:, axis] % CELLS) << digit)
    return key, (low[0], low[1], low[2])


def alike(keys: Sequence[Int64], lows: Sequence[Voxel]) -> tuple[list[Int64], Voxel]:
    """Keys of several samples that all begin at the same voxel, the lowest of all, and that voxel.

    Raises DataError where they span too much.
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
        raise DataError(f"the maps span more than {SPAN} voxels; leave out far depth, or use larger voxels")
    return voxel


# Where the frames of a sample of observations were taken.

VIEW = 5
"""Numbers of a view: frame, centre, time stamp."""


@dataclass(frozen=True, eq=False)
class Views:
    """Indices (V,) of frames, camera centres (V, 3) in metres, and time stamps (V,) in seconds or NaN."""

    frame: Int64
    centre: Float64
    timestamp: Float64

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def of(cls, rows: Sequence[Sequence[float]] | Float64) -> Views:
        """Of rows (V, 5). Raises ValueError where they are of another shape, or an index is not a finite number."""
        table = np.asarray(rows, np.float64).reshape(len(rows), VIEW)
        if not np.isfinite(table[:, 0]).all():
            raise ValueError("a frame without an index")
        return cls(table[:, 0].astype(np.int64), table[:, 1:4].copy(), table[:, 4].copy())

    @classmethod
    def joined(cls, parts: Sequence[Views]) -> Views:
        """One after the other."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))

    def rows(self) -> Float64:
        """(V, 5) what `of` takes."""
        return np.concatenate([self.frame[:, None], self.centre, self.timestamp[:, None]], axis=1)

    def take(self, rows: Int64) -> Views:
        """Some of them."""
        return Views(self.frame[rows], self.centre[rows], self.timestamp[rows])

    def rank(self, frame: npt.NDArray[np.integer]) -> Int64:
        """Which of these, in their order, the frames (m,) of these indices are."""
        order = np.argsort(self.frame)
        return np.asarray(order[np.searchsorted(self.frame, frame, sorter=order)], np.int64)


LEAST_FRAMES = 2
"""What a cell shows counts where so many frames saw it: its label is to be more than one frame's own."""

COLUMNS = "key", "view", "label", "weight", "drawn"
"""Of entries."""

SCHEMA = 3
Entries = tuple[Int64, Int32, UInt16, Float64]


@dataclass(frozen=True, eq=False)
class ObservationSample:
    """What was seen of the sampled voxels, and what part of the disagreement comes from seeing other parts of them.

    seen   observations (s_bar of a voxel in a frame), of the cells that LEAST_FRAMES or more saw
    voxel, label, shift  (m,) how much further apart two frames are about a class in a voxel, by its row of `seen`,
           where they see of its cells what a frame sees of itself
    views  of all frames, in order of integration
    soft   whether the evidence is scores
    labelled  see `CellObservations.labelled_share`
    """

    seen: Events
    voxel: Int32
    label: UInt16
    shift: Float64
    views: Views
    soft: bool
    labelled: float = 1.0


@dataclass(frozen=True, eq=False)
class CellObservations:
    """Entries (m,) of a cell, a frame and a class: what the frame's pixels in the cell say for the class.

    key     (m,) int64 of the cell, see `keys`
    view    (m,) int32 row of `views`
    label   (m,) uint16; K of the pixels with depth that have no label
    weight  (m,) pixels of that label, or the sum of their scores
    drawn   (m,) uint32, the hash of the voxel; in the sample are those below `share`
    low     voxel at which keys begin
    """

    key: Int64
    view: Int32
    label: UInt16
    weight: Float64
    drawn: UInt32
    low: Voxel
    views: Views
    voxel_size: float
    K: int
    share: int = 1 << 32
    soft: bool = False
    classes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.key)

    @property
    def cell(self) -> Int64:
        """(m, 3) index of the cell, of which a voxel has CELLS along its edge."""
        return cells_of(self.key, self.low)

    def sample(self) -> ObservationSample:
        """Observations of the voxels, and what comes from seeing other parts of them."""
        from semstab.statistics.loops.observations import same_cells

        key, view, label, weight = self.labelled()._in_order()
        left, of = np.empty(len(key), np.bool_), np.empty(len(key), np.int32)
        classes, shift = np.empty(len(key), np.uint16), np.empty(len(key))
        m = same_cells(key, view, label, weight, CELLS**3, self.K, LEAST_FRAMES, left, of, classes, shift)
        seen = self._log(key, view, label, weight, left)
        return ObservationSample(seen, of[:m], classes[:m], shift[:m], self.views, self.soft, self.labelled_share())

    def labelled(self) -> CellObservations:
        """Return the entries of pixels that have a label."""
        return self.only(self.label < self.K)

    def labelled_share(self) -> float:
        """Return which part of the voxels that two frames saw has a label in half of its observations or more."""
        voxel, of = np.unique(np.stack([self.key >> DIGITS, self.view]), axis=1, return_inverse=True)
        pixels, own = (np.bincount(of.ravel(), w) for w in (self.weight, self.weight * (self.label < self.K)))
        _, of = np.unique(voxel[0], return_inverse=True)
        frames, labelled = np.bincount(of), np.bincount(of, 2 * own >= pixels)
        return mean((2 * labelled >= frames)[frames >= 2].astype(np.float64))

    def without(self, classes: Sequence[int]) -> CellObservations:
        """Return the entries of voxels whose fused class is none of these."""
        if not len(classes) or not len(self):
            return self
        own, at = np.unique((self.key >> DIGITS)[self.label < self.K]), self.key >> DIGITS
        left = own[~np.isin(dominant(self.observations().table()), classes)]
        return self.only(np.isin(at, left))

    def only(self, rows: Any) -> CellObservations:
        """Some of the entries."""
        return self._each(lambda column: column[rows])

    def copied(self) -> CellObservations:
        """The same in memory of its own."""
        return self._each(np.copy)

    def _each(self, change: Callable[[Any], Any]) -> CellObservations:
        columns: dict[str, Any] = {name: change(getattr(self, name)) for name in COLUMNS}
        return dataclasses.replace(self, **columns)

    @classmethod
    def joined(cls, parts: Sequence[CellObservations]) -> CellObservations:
        """The entries of one after the other, with all else of the first."""
        keys, low = alike([part.key for part in parts], [part.low for part in parts])
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS[1:]
        }
        return dataclasses.replace(parts[0], key=np.concatenate(keys), **columns, low=low)

    def observations(self) -> Events:
        """The log of the sampled voxels: what the entries of a voxel and a frame say together."""
        own = self.labelled()._in_order()
        return self._log(*own, np.ones(len(own[0]), np.bool_))

    def _in_order(self) -> Entries:
        """Keys, views, labels and weights by voxel and frame, entries of one as they come."""
        order = np.lexsort((self.view, self.key >> DIGITS))
        return self.key[order], self.view[order], self.label[order], self.weight[order]

    def _log(self, key: Int64, view: Int32, label: UInt16, weight: Float64, kept: Mask) -> Events:
        """The log of the kept ones of entries that are in order."""
        from semstab.statistics.loops.observations import look

        n = len(self)
        first, of, starts = np.empty(n, np.int64), np.empty(n, np.int32), np.empty(n + 1, np.int64)
        pixels, share, text = np.empty(n), np.empty(n), np.empty(n, np.uint16)
        n, m = look(key, view, label, weight, kept, self.K, first, of, pixels, starts, text, share)
        first, of = first[:n], of[:n]
        at = key[first[np.flatnonzero(np.diff(of, prepend=-1))]]
        return Events(
            **index_columns(cells_of(at, self.low) // CELLS),
            voxel=of,
            frame=self.views.frame.astype(np.int32)[view[first]],
            evidence=Evidence(starts[: n + 1], text[:m], share[:m], self.K),
            pixels=np.rint(pixels[:n]).astype(np.int32),
            voxel_size=self.voxel_size,
            classes=self.classes,
        )

    def save(self, path: str | Path) -> None:
        """Write Parquet, atomically."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = dict(zip("xyz", self.cell.astype(np.int32).T, strict=True))
        columns |= {name: getattr(self, name) for name in COLUMNS[1:]}
        about = {name: getattr(self, name) for name in ("voxel_size", "K", "share", "soft", "classes")}
        content = pa.table({name: arrays.column(values) for name, values in columns.items()})
        text = json.dumps({"schema": SCHEMA, "kind": "Looks", **about, "views": self.views.rows().tolist()})
        with atomic_path(path) as temporary, pq.ParquetWriter(temporary, content.schema, compression="zstd") as file:
            file.write_table(content)
            file.add_key_value_metadata({"semstab": text})  # a schema's own is written twice, and copied more often

    @classmethod
    def load(cls, path: str | Path) -> CellObservations:
        """Read what `save` wrote. Raises DataError where the file is missing, damaged or of another kind."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            with pq.ParquetFile(path) as file:  # pq.read_table imports pandas
                content = file.read()
            about = parse_json((content.schema.metadata or {})[b"semstab"])
            if (about.pop("kind"), about.pop("schema")) not in (("Looks", 2), ("Looks", SCHEMA)):
                raise DataError("of another kind, or of another version, which sampled other voxels: run it again")
            views = Views.of(about.pop("views"))
            about["classes"] = tuple(about["classes"])
            x, y, z, view, label, weight, drawn = map(arrays.values_of, content.columns)
            key, low = keys_of(np.stack([x, y, z], axis=1).astype(np.int64))
            return cls(key, view, label, weight, drawn, low, views, **about)
        except (OSError, LookupError, TypeError, ValueError, OverflowError, pa.ArrowException) as error:
            raise DataError(f"{path}: not a file of sampled looks ({summarize_error(error)})") from error
