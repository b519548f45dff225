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
from semstab.statistics.looks.views import Views
from semstab.statistics.ranks import ranked

CELLS = 4
"""Cells along a voxel's edge."""

LEAST_FRAMES = 2
"""What a cell shows counts where so many frames saw it: its label is to be more than one frame's own."""

SCHEMA = 2
OWN, TRUTH = "its own labels in finer cells", "the ground truth"

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


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
    views: Views
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
    views: Views
    voxel_size: float
    K: int
    share: int = 1 << 32
    soft: bool = False
    classes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.label)

    def sample(self) -> Sample:
        """Observations of the voxels, and those of labels that do not depend on the view."""
        from semstab.statistics.looks.observing import settle

        own, voxel, child = self._in_order()
        kept, shown = np.empty(len(own), np.bool_), np.empty(len(own), np.int64)
        settle(voxel, own.view, child, own.label, own.weight, CELLS**3, self.K, LEAST_FRAMES, kept, shown)
        limit = dataclasses.replace(own, label=shown)
        return Sample(own._looks(voxel, kept), limit._looks(voxel, kept), self.views, self.soft)

    def only(self, rows: npt.NDArray[Any]) -> Looks:
        """Some of the entries."""
        names = ("cell", "view", "label", "weight", "drawn")
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in names})

    def observations(self) -> Events:
        """The log of the sampled voxels: what the entries of a voxel and a frame say together."""
        own, voxel, _ = self._in_order()
        return own._looks(voxel, np.ones(len(own), np.bool_))

    def _in_order(self) -> tuple[Looks, Int64, Int64]:
        """The same by voxel and frame, entries of one as they come; the key of each voxel, the number of each cell."""
        (voxel,) = voxel_keys(self.cell // CELLS)
        order = _order(voxel, self.view)
        own = self.only(order)
        x, y, z = (own.cell % CELLS).T
        return own, voxel[order], (x * CELLS + y) * CELLS + z

    def _looks(self, voxel: Int64, kept: npt.NDArray[np.bool_]) -> Events:
        """The log of the kept entries, which are in order."""
        from semstab.statistics.looks.observing import look

        n = len(self)
        first, of, starts, label = (np.empty(n + more, np.int64) for more in (0, 0, 1, 0))
        pixels, share = np.empty(n), np.empty(n)
        n, m = look(voxel, self.view, self.label, self.weight, kept, self.K, first, of, pixels, starts, label, share)
        frames = self.views.frame.astype(np.int32)
        first, of = first[:n], of[:n]
        return Events(
            **index_columns(self.cell[first[np.flatnonzero(np.diff(of, prepend=-1))]] // CELLS),
            voxel=of,
            frame=frames[self.view[first]],
            evidence=Evidence(starts[: n + 1], label[:m].astype(np.uint16), share[:m], self.K),
            pixels=np.rint(pixels[:n]).astype(np.int64),
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
        about["views"] = self.views.rows().tolist()
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
                raise DataError("of another kind, or of another version, which sampled other voxels: run it again")
            views = Views.of(about.pop("views"))
            about["classes"] = tuple(about["classes"])
            x, y, z, view, label, weight, drawn = (column.to_numpy() for column in content.columns)
            cell = np.stack([x, y, z], axis=1).astype(np.int64)
            return cls(
                cell, view.astype(np.int64), label.astype(np.int64), weight, drawn.astype(np.int64), views, **about
            )
        except (OSError, LookupError, TypeError, ValueError, OverflowError, pa.ArrowException) as error:
            raise DataError(f"{path}: not a file of sampled looks ({one_line(error)})") from error


def _order(place: Int64, view: Int64) -> Int64:
    """What sorts entries by place and view, stably."""
    views = int(view.max(initial=0)) + 1
    if (int(place.max(initial=0)) + 1) * views >= 2**63:
        place = np.unique(place, return_inverse=True)[1]
    return ranked(place * views + view)
