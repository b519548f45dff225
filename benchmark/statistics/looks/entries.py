"""What was seen of sampled voxels, by cells a quarter as wide: what observations and ceilings follow from.

Kept in the folder of a run, it lets maps be compared on the very looks that all of them made.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.errors import DataError, one_line
from semstab.metrics.matching import shared_observations, voxel_keys
from semstab.model.evidence import Evidence
from semstab.model.voxels import Events, index_columns
from semstab.runtime import arrow
from semstab.runtime.files import atomic_path, parse_json

CELLS = 4
"""Cells along a voxel's edge."""

LEAST_FRAMES = 2
"""What a cell shows counts where so many frames saw it: its label is to be more than one frame's own."""

SCHEMA = 1
OWN, TRUTH = "its own labels in finer cells", "the ground truth"

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class View:
    """Where a frame was taken: its index, camera centre (3,) in metres, and time stamp in seconds or NaN."""

    frame: int
    centre: Float64
    timestamp: float


@dataclass(frozen=True, eq=False)
class Sample:
    """What was seen of the sampled voxels, and what would have been had their labels not depended on the view.

    seen   observations (s_bar of a voxel in a frame), of the cells that LEAST_FRAMES or more saw
    limit  the same rows, each cell having the dominant label of all frames in each of them
    views  of all frames, in order of integration
    soft   whether the evidence is scores
    by     whose labels the limit has: the map's own in finer cells, or those of the ground truth
    """

    seen: Events
    limit: Events
    views: tuple[View, ...]
    soft: bool
    by: str = OWN

    def shared(self) -> tuple[Events, Events]:
        """The observations that both logs have."""
        seen, limit = shared_observations(self.seen, self.limit)
        return seen, limit

    def against(self, truth: Sample) -> Sample:
        """The same with the ground truth's labels as the limit, of a sample of the same frames."""
        return dataclasses.replace(self, limit=truth.seen, by=TRUTH)


@dataclass(frozen=True, eq=False)
class Looks:
    """Entries (m,) of a cell, a frame and a class: what the frame's pixels in the cell say for the class.

    cell    (m, 3) int64 index of the cell, of which a voxel has CELLS along its edge
    view    (m,) int64 row of `views`
    label   (m,) int64
    weight  (m,) pixels of that label, or the sum of their scores
    drawn   (m,) the hash of the voxel; in the sample are those below `share`
    """

    cell: Int64
    view: Int64
    label: Int64
    weight: Float64
    drawn: Int64
    views: tuple[View, ...]
    voxel_size: float
    K: int
    share: int = 1 << 32
    soft: bool = False
    classes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.label)

    def sample(self) -> Sample:
        """Observations of the voxels, and those of labels that do not depend on the view."""
        cell = places_of(self.cell)
        look, pixels = _looked(cell, self.view, self.weight)
        often = np.bincount(cell[np.unique(look, return_index=True)[1]]) >= LEAST_FRAMES
        shown = _dominant(cell, self.label, self.weight / pixels[look], self.K)
        kept = often[cell]
        own = self.only(kept)
        limit = dataclasses.replace(own, label=shown[cell[kept]])
        return Sample(own.observations(), limit.observations(), self.views, self.soft)

    def only(self, rows: npt.NDArray[Any]) -> Looks:
        """Some of the entries."""
        names = ("cell", "view", "label", "weight", "drawn")
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in names})

    def observations(self) -> Events:
        """The log of the sampled voxels: what the entries of a voxel and a frame say together."""
        index = self.cell // CELLS
        voxel = places_of(index)
        look, total = _looked(voxel, self.view, self.weight)
        first = np.unique(look, return_index=True)[1]
        pairs, pair = np.unique(look * self.K + self.label, return_inverse=True)
        of, label = np.divmod(pairs, self.K)
        share = np.bincount(pair, weights=self.weight) / total[of]
        starts = np.searchsorted(of, np.arange(len(total) + 1))
        frames = np.array([view.frame for view in self.views], dtype=np.int32)
        distinct = np.unique(voxel, return_index=True)[1]
        return Events(
            **index_columns(index[distinct]),
            voxel=voxel[first],
            frame=frames[self.view[first]],
            evidence=Evidence(starts, label.astype(np.uint16), share, self.K),
            pixels=np.rint(total).astype(np.int64),
            voxel_size=self.voxel_size,
            classes=self.classes,
        )

    def save(self, path: str | Path) -> None:
        """Write Parquet, atomically."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = dict(zip("xyz", self.cell.astype(np.int32).T, strict=True))
        columns |= {"view": self.view.astype(np.int32), "label": self.label.astype(np.uint16)}
        columns |= {"weight": self.weight, "drawn": self.drawn.astype(np.uint32)}
        about = {name: getattr(self, name) for name in ("voxel_size", "K", "share", "soft", "classes")}
        about["views"] = [(view.frame, *view.centre.tolist(), view.timestamp) for view in self.views]
        content = pa.table({name: arrow.column(values) for name, values in columns.items()})
        text = json.dumps({"schema": SCHEMA, "kind": "Looks", **about})
        with atomic_path(path) as temporary:
            pq.write_table(content.replace_schema_metadata({"semstab": text}), temporary, compression="zstd")

    @classmethod
    def load(cls, path: str | Path) -> Looks:
        """Read what `save` wrote. Raises DataError where the file is missing, damaged or of another kind."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            content = pq.read_table(path)
            about = parse_json((content.schema.metadata or {})[b"semstab"])
            if (about.pop("kind"), about.pop("schema")) != ("Looks", SCHEMA):
                raise DataError("of another kind or version")
            views = tuple(View(int(row[0]), np.array(row[1:4]), float(row[4])) for row in about.pop("views"))
            about["classes"] = tuple(about["classes"])
            x, y, z, view, label, weight, drawn = (column.to_numpy() for column in content.columns)
            cell = np.stack([x, y, z], axis=1).astype(np.int64)
            return cls(
                cell, view.astype(np.int64), label.astype(np.int64), weight, drawn.astype(np.int64), views, **about
            )
        except (OSError, LookupError, TypeError, ValueError, OverflowError, pa.ArrowException) as error:
            raise DataError(f"{path}: not a file of sampled looks ({one_line(error)})") from error


def places_of(index: Int64) -> Int64:
    """A number (m,) for each row of indices (m, 3), ascending with (ix, iy, iz), without gaps."""
    (key,) = voxel_keys(index)
    return np.unique(key, return_inverse=True)[1].astype(np.int64)


def _looked(place: Int64, view: Int64, weight: Float64) -> tuple[Int64, Float64]:
    """The number (m,) of each entry's place and frame, ascending, and the pixels of each such look."""
    views = int(view.max(initial=0)) + 1
    look = np.unique(place * views + view, return_inverse=True)[1].astype(np.int64)
    pixels: Float64 = np.bincount(look, weights=weight).astype(np.float64)
    return look, pixels


def _dominant(cell: Int64, label: Int64, share: Float64, K: int) -> Int64:
    """The class of the largest sum of shares of each cell, the lowest on ties."""
    pairs, pair = np.unique(cell * K + label, return_inverse=True)
    evidence = np.bincount(pair, weights=share)
    order = np.lexsort((pairs % K, -evidence, pairs // K))
    _, first = np.unique(pairs[order] // K, return_index=True)
    classes: Int64 = pairs[order][first] % K
    return classes
