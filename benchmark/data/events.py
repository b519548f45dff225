"""The log of observations, from which a map's rows can be computed again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, Int64
from semstab.data import parquet
from semstab.data.evidence import Evidence
from semstab.data.information import entropy_bits, js_divergence, normalise
from semstab.data.voxel_keys import in_order
from semstab.data.voxels import INDEX, OF_EVENTS, OF_VOXELS, VoxelTable, freeze, index_columns, require_memory
from semstab.errors import DataError

COMPUTED = [name for name in OF_VOXELS if name not in (*INDEX, "evidence")]
"""The columns of a voxel's row that its observations give."""


@dataclass(frozen=True, eq=False)
class Events:
    """The log of observations: m rows, one a (voxel, frame), grouped by voxel and in order of integration within one.

    Attributes:
        ix, iy, iz: (n,) int32 the voxels, sorted.
        voxel: (m,) int32 row into them, ascending.
        frame: (m,) int32 frame index.
        evidence: (m, K) s_bar, the mean of the frame's evidence in the voxel; stored sparse.
        pixels: (m,) int32 pixels behind it.
        voxel_size: r, metres.
        classes: The K class names, where they are known.

    Examples:
        >>> events = semstab.load("run").events(model="sim-steady")  # a run with --events
        >>> int(events.frame.max()), events.evidence.shape[1] == len(events.classes)
        (23, True)
    """

    ix: Int32
    iy: Int32
    iz: Int32
    voxel: npt.NDArray[np.integer]
    frame: Int32
    evidence: Evidence
    pixels: npt.NDArray[np.integer]
    voxel_size: float
    classes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, INDEX, self.ix)
        freeze(self, OF_EVENTS, self.voxel)
        further = self.voxel[1:][self.voxel[1:] != self.voxel[:-1]]
        if not np.array_equal(np.append(self.voxel[:1], further), np.arange(len(self.ix))):
            raise DataError("events: rows must be grouped by voxel, each voxel with one row or more")

    def __repr__(self) -> str:
        return f"<Events: {len(self):,} observations of {len(self.ix):,} voxels of {self.voxel_size:g} m>"

    def __len__(self) -> int:
        return len(self.voxel)

    @property
    def K(self) -> int:
        """Number of classes."""
        return self.evidence.K

    @cached_property
    def bounds(self) -> Int64:
        """(n + 1,) first row of each voxel, then how many rows there are."""
        from semstab.data.kernels import bound_groups

        bounds = np.zeros(len(self.ix) + 1, np.int64)
        bound_groups(self.voxel, bounds)
        return bounds

    @property
    def starts(self) -> Int64:
        """(n,) first row of each voxel."""
        return self.bounds[:-1]

    @property
    def ends(self) -> Int64:
        """(n,) the row after each voxel's last."""
        return self.bounds[1:]

    def table(self) -> VoxelTable:
        """Return the voxel table, each column from its definition (paper, Persistent Voxel Evidence)."""
        parts = [log._columns() for log in self._few_at_a_time()]
        columns: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in COMPUTED}
        evidence = Evidence.joined([part["evidence"] for part in parts])
        index = {name: getattr(self, name) for name in INDEX}
        return VoxelTable(**index, **columns, evidence=evidence, voxel_size=self.voxel_size, classes=self.classes)

    def _columns(self) -> dict[str, Any]:
        starts, s_bar = self.starts, self.evidence[:]
        return {
            "op": np.diff(np.append(starts, len(self))).astype(np.int32),
            "evidence": Evidence.from_rows(_sum_by_voxel(s_bar, starts)),
            "drift_sum": _sum_by_voxel(self.drift(), starts),
            "pixels": _sum_by_voxel(self.pixels.astype(np.int64), starts),
            "first_frame": np.minimum.reduceat(self.frame, starts) if len(self) else self.frame,
            "last_frame": np.maximum.reduceat(self.frame, starts) if len(self) else self.frame,
            "self_sum": _sum_by_voxel((s_bar**2).sum(axis=1), starts),
            "frame_entropy_sum": _sum_by_voxel(entropy_bits(s_bar), starts),
        }

    def _few_at_a_time(self) -> Iterator[Events]:
        """Yield the logs of voxels one after the other, of as many as have little evidence when it is dense."""
        edges = np.array([chunk.start for chunk in self.evidence.chunks()])
        cuts = np.unique(np.append(np.searchsorted(self.starts, edges), len(self.ix))).tolist()
        for first, last in zip(cuts, cuts[1:] or cuts, strict=False):
            rows, of = slice(self.bounds[first], self.bounds[last]), slice(first, last)
            columns: dict[str, Any] = {name: getattr(self, name)[of] for name in INDEX}
            columns |= {name: getattr(self, name)[rows] for name in ("frame", "pixels")}
            yield replace(self, **columns, voxel=self.voxel[rows] - first, evidence=self.evidence.take(rows))

    def beliefs(self) -> Float64:
        """Return (m, K) the belief p^(t) after each observation.

        It is the normalised sum of the voxel's evidence up to it.
        """
        accumulated = self.evidence[:]
        age = np.arange(len(self)) - self.starts[self.voxel]
        by_age = np.argsort(age, kind="stable")
        ends = np.cumsum(np.bincount(age, minlength=1))
        for rows in np.split(by_age, ends)[1:]:
            accumulated[rows] += accumulated[rows - 1]
        return normalise(accumulated)

    def drift(self) -> Float64:
        """Return (m,) D_JS(p^(t), p^(t-1)) in bits, that each observation caused at its voxel.

        It is 0 for a voxel's first.
        """
        belief = self.beliefs()
        drift = np.zeros(len(self))
        again = np.flatnonzero(np.diff(self.voxel, prepend=-1) == 0)
        drift[again] = js_divergence(belief[again], belief[again - 1])
        return drift

    def rows(self, voxels: Int64) -> Events:
        """Return the log of these of its voxels (r,), ascending."""
        first = self.bounds[voxels]
        count = self.bounds[voxels + 1] - first
        number = np.repeat(np.arange(len(voxels), dtype=np.int32), count)
        rows = np.repeat(first - np.cumsum(count) + count, count)
        rows += np.arange(len(rows))
        columns: dict[str, Any] = {name: getattr(self, name)[voxels] for name in INDEX}
        columns |= {name: getattr(self, name)[rows] for name in ("frame", "pixels")}
        return replace(self, **columns, voxel=number, evidence=self.evidence.take(rows))

    def save(self, path: str | Path, tile: parquet.Tile | None = None) -> None:
        """Write Parquet, atomically: one row an observation, with its voxel's index."""

        def columns(chunk: slice) -> dict[str, npt.NDArray[Any]]:
            values = {name: getattr(self, name)[chunk] for name in OF_EVENTS}
            return values | {name: getattr(self, name)[self.voxel[chunk]] for name in INDEX}

        parts = map(columns, self.evidence.chunks())
        parquet.write(path, parts, type(self).__name__, self.voxel_size, self.classes, tile)

    @classmethod
    def joined(cls, parts: Sequence[Events]) -> Events:
        """Return one log of the voxels of several that share none."""
        if len(parts) == 1:
            return parts[0]
        index = np.concatenate([np.stack([part.ix, part.iy, part.iz], axis=1) for part in parts])
        order = in_order(index)
        count = np.concatenate([np.diff(np.append(part.starts, len(part))) for part in parts])
        first = np.cumsum(count) - count
        number = np.repeat(np.arange(len(order)), count[order])
        rows = np.arange(len(number)) + (first[order] - np.cumsum(count[order]) + count[order])[number]
        return cls(
            **index_columns(index[order]),
            voxel=number,
            frame=np.concatenate([part.frame for part in parts])[rows],
            evidence=Evidence.joined([part.evidence for part in parts], rows),
            pixels=np.concatenate([part.pixels for part in parts])[rows],
            voxel_size=parts[0].voxel_size,
            classes=parts[0].classes,
        )

    @classmethod
    def load(cls, path: str | Path) -> Events:
        """Read what `save` wrote, a file or a folder of tiles, all of it.

        Raises:
            DataError: If a file is missing, damaged or of another kind, or a log in tiles is larger than memory.
        """
        files = parquet.files_of(path)
        if len(files) > 1:
            require_memory(Path(path), files)
        return cls.joined([cls._read(file) for file in files])

    @classmethod
    def _read(cls, path: Path) -> Events:
        with parquet.reading(path):
            content = parquet.read(path, OF_EVENTS | INDEX)
            first = np.flatnonzero(np.diff(content["voxel"], prepend=-1))
            return cls(**content | {name: content[name][first] for name in INDEX})


def accumulated(events: Events) -> Evidence:
    """Return the evidence (n, K) of each voxel of a log."""
    logs = events._few_at_a_time()
    return Evidence.joined([Evidence.from_rows(_sum_by_voxel(log.evidence[:], log.starts)) for log in logs])


def _sum_by_voxel(values: npt.NDArray[Any], starts: Int64) -> npt.NDArray[Any]:
    return np.add.reduceat(values, starts, axis=0) if len(starts) else values
