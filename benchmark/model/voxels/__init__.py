"""What fusion leaves behind: one row a voxel, and the log of observations from which that row can be computed again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.errors import DataError
from semstab.model.evidence import Evidence
from semstab.model.information import entropy_bits, js_divergence, normalise
from semstab.model.measures import MeasureMeans, dominant, measures
from semstab.model.voxels import parquet, tabular
from semstab.runtime.memory import available_bytes

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]
Types = dict[str, type[np.generic]]

BYTES_A_VOXEL = 200
"""Of a table that is put together from tiles: twice what it takes."""


@dataclass(frozen=True, eq=False)
class VoxelTable:
    """The fused map: n voxels sorted by (ix, iy, iz). Everything reported about a voxel is a function of its row.

    ix, iy, iz         (n,) int32 voxel index, floor(x_w / r)
    op                 (n,) int32 observation persistence: the number of frames that saw the voxel
    evidence           (n, K) accumulated evidence e(q), the sum over frames of s_bar; kept sparse
    drift_sum          (n,) float64 sum over t >= 2 of the JS divergence of successive beliefs, bits
    pixels             (n,) int64 pixels that fell into the voxel, all frames
    first_frame        (n,) int32 lowest frame index that saw it
    last_frame         (n,) int32 highest frame index that saw it
    self_sum           (n,) float64 sum over frames of ||s_bar||^2
    frame_entropy_sum  (n,) float64 sum over frames of the entropy of s_bar, bits
    voxel_size         r, metres
    classes            the K class names, where they are known
    copies             (n,) how many voxels each row stands for, where they are not one each: see `statistics.kinds`

    Raises DataError where columns disagree in length or rows are not sorted and distinct.
    """

    ix: Int32
    iy: Int32
    iz: Int32
    op: Int32
    evidence: Evidence
    drift_sum: Float64
    pixels: Int64
    first_frame: Int32
    last_frame: Int32
    self_sum: Float64
    frame_entropy_sum: Float64
    voxel_size: float
    classes: tuple[str, ...] = ()
    copies: Float64 | None = None

    def __post_init__(self) -> None:
        _freeze_columns(self, _VOXEL_TYPES, self.ix)
        if self.classes and len(self.classes) != self.K:
            raise DataError(f"voxel table: evidence of shape {self.evidence.shape} for {len(self.classes)} classes")
        ascends = self.iz[1:] > self.iz[:-1]
        for column in (self.iy, self.ix):  # a column decides where those before it are equal
            ascends = (column[1:] > column[:-1]) | ((column[1:] == column[:-1]) & ascends)
        if not ascends.all():
            raise DataError("voxel table: rows must be distinct and sorted by ix, iy, iz")

    def __len__(self) -> int:
        return len(self.ix)

    @property
    def K(self) -> int:
        """Number of classes."""
        return self.evidence.K

    @property
    def index(self) -> Int32:
        """(n, 3) int32 voxel indices."""
        return np.stack([self.ix, self.iy, self.iz], axis=1)

    @property
    def centers(self) -> Float64:
        """(n, 3) world coordinates of the voxel centres, metres."""
        return (self.index.astype(np.float64) + 0.5) * self.voxel_size

    def rows(self, rows: Any) -> VoxelTable:
        """The table of some of its voxels: a slice, their numbers ascending, or a mask (n,)."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in _VOXEL_TYPES if name != "evidence"}
        copies = None if self.copies is None else self.copies[rows]
        return replace(self, **columns, evidence=self.evidence.take(rows), copies=copies)

    @property
    def voxels(self) -> Float64:
        """(n,) how many voxels each row stands for."""
        return np.ones(len(self)) if self.copies is None else self.copies

    def measured(self) -> VoxelTable:
        """The same with what measures are functions of, which is then computed once: see `Evidence.measured`."""
        return self if self.evidence.known is not None else replace(self, evidence=self.evidence.measured())

    def to_arrow(self) -> pa.Table:
        """Columns of every voxel: index, x, y, z in metres, op, class, every measure, evidence_CLASS."""
        return tabular.to_arrow(self._columns())

    def to_pandas(self) -> pd.DataFrame:
        """The same as a data frame. Raises MissingDependencyError without pandas."""
        return tabular.to_pandas(self._columns())

    def _columns(self) -> dict[str, Any]:
        names = self.classes or tuple(str(k) for k in range(self.K))
        x, y, z = self.centers.T
        evidence = self.evidence[:]
        return {
            "ix": self.ix, "iy": self.iy, "iz": self.iz, "x": x, "y": y, "z": z, "op": self.op,
            "class": tabular.named(dominant(self), names),
            **{measure.key: measure.of(self) for measure in measures()},
            "pixels": self.pixels, "first_frame": self.first_frame, "last_frame": self.last_frame,
            **{f"evidence_{name}": evidence[:, k] for k, name in enumerate(names)},
        }  # fmt: skip

    def _repr_html_(self) -> str:
        """The means of all voxels and of the recurrent ones, in a notebook."""
        values = {measure: measure.of(self) for measure in measures()}
        rows: list[list[tabular.Cell]] = []
        for name, where in (("all", self.op > 0), ("OP >= 3", self.op >= 3)):
            means = MeasureMeans.over(values, self.op, where)
            numbers = (tabular.number(means[measure], measure.digits[0]) for measure in measures())
            rows.append([name, int(np.count_nonzero(where)), *numbers])
        title = f"{len(self):,} voxels of {self.voxel_size:g} m, {self.K} classes"
        return tabular.as_html(title, ["", "voxels", *(measure.title for measure in measures())], rows)

    def save(
        self,
        path: str | Path,
        extra: Mapping[str, npt.NDArray[Any]] | None = None,
        computed: Mapping[str, Callable[[VoxelTable], npt.NDArray[Any]]] | None = None,
        tile: parquet.Tile | None = None,
    ) -> None:
        """Write Parquet, atomically, some rows after the others; as a tile of a larger map, where one is named.

        `extra` columns (n,), and what is `computed` from the rows that are written, go along for other programs and are
        not read back.
        """

        def columns(some: slice) -> dict[str, npt.NDArray[Any]]:
            part = self.rows(some)
            own = {name: np.asarray(getattr(part, name)) for name in _VOXEL_TYPES}
            made = {name: of(part) for name, of in (computed or {}).items()}
            return own | made | {name: values[some] for name, values in (extra or {}).items()}

        parts = map(columns, self.evidence.chunks())
        parquet.write(path, parts, type(self).__name__, self.voxel_size, self.classes, tile)

    @classmethod
    def load(cls, path: str | Path) -> VoxelTable:
        """Read what `save` wrote, a file or a folder of tiles, all of it.

        Raises DataError where a file is missing, damaged or of another kind, or a map in tiles is larger than memory.
        """
        files = parquet.files_of(path)
        if len(files) > 1:
            _require_memory(Path(path), files)
        return cls.joined([cls._read(file) for file in files])

    @classmethod
    def iter_tiles(cls, path: str | Path) -> Iterator[VoxelTable]:
        """The tiles of a map one after the other, by x and y; of a map in one file that file."""
        return map(cls._read, parquet.files_of(path))

    @classmethod
    def columns(cls, path: str | Path, names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
        """Single columns (n,) by name, also measures and what else the file has, in the order of `load`.

        Raises DataError where one is not there.
        """
        files, sorting = parquet.files_of(path), tuple(_INDEX_TYPES)
        wanted = [*dict.fromkeys((*names, *(sorting if len(files) > 1 else ())))]
        parts = [parquet.columns(file, wanted) for file in files]
        found = {name: np.concatenate([part[name] for part in parts]) for name in wanted}
        order = _sorted(found) if len(files) > 1 else slice(None)
        return {name: found[name][order] for name in names}

    @classmethod
    def joined(cls, parts: Sequence[VoxelTable]) -> VoxelTable:
        """One table of the voxels of several that share none."""
        if len(parts) == 1:
            return parts[0]
        index = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _INDEX_TYPES}
        order = _sorted(index)
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts])[order]
            for name in _VOXEL_TYPES
            if name != "evidence"
        }
        evidence = Evidence.joined([part.evidence for part in parts]).take(order)
        return replace(parts[0], **columns, evidence=evidence)

    @classmethod
    def _read(cls, path: Path) -> VoxelTable:
        with parquet.reading(path):
            return cls(**parquet.read(path, _VOXEL_TYPES))


@dataclass(frozen=True, eq=False)
class Events:
    """The log of observations: m rows, one a (voxel, frame), grouped by voxel and in order of integration within one.

    ix, iy, iz  (n,) int32 the voxels, sorted
    voxel       (m,) int32 row into them, ascending
    frame       (m,) int32 frame index
    evidence    (m, K) s_bar, the mean of the frame's evidence in the voxel; kept sparse
    pixels      (m,) int32 pixels behind it
    voxel_size  r, metres
    classes     the K class names, where they are known
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
        _freeze_columns(self, _INDEX_TYPES, self.ix)
        _freeze_columns(self, _EVENT_TYPES, self.voxel)
        further = self.voxel[1:][self.voxel[1:] != self.voxel[:-1]]
        if not np.array_equal(np.append(self.voxel[:1], further), np.arange(len(self.ix))):
            raise DataError("events: rows must be grouped by voxel, each voxel with one row or more")

    def __len__(self) -> int:
        return len(self.voxel)

    @property
    def K(self) -> int:
        """Number of classes."""
        return self.evidence.K

    @cached_property
    def bounds(self) -> Int64:
        """(n + 1,) first row of each voxel, then how many rows there are."""
        from semstab.model.row_kernel import bound_groups

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
        """The voxel table, each column from its definition (paper, Persistent Voxel Evidence)."""
        parts = [log._columns() for log in self._few_at_a_time()]
        columns: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in _SUMS}
        evidence = Evidence.joined([part["evidence"] for part in parts])
        index = {name: getattr(self, name) for name in _INDEX_TYPES}
        return VoxelTable(**index, **columns, evidence=evidence, voxel_size=self.voxel_size, classes=self.classes)

    def _columns(self) -> dict[str, Any]:
        starts, s_bar = self.starts, self.evidence[:]
        return {
            "op": np.diff(np.append(starts, len(self))).astype(np.int32),
            "evidence": Evidence.of(_sum_by_voxel(s_bar, starts)),
            "drift_sum": _sum_by_voxel(self.drift(), starts),
            "pixels": _sum_by_voxel(self.pixels.astype(np.int64), starts),
            "first_frame": np.minimum.reduceat(self.frame, starts) if len(self) else self.frame,
            "last_frame": np.maximum.reduceat(self.frame, starts) if len(self) else self.frame,
            "self_sum": _sum_by_voxel((s_bar**2).sum(axis=1), starts),
            "frame_entropy_sum": _sum_by_voxel(entropy_bits(s_bar), starts),
        }

    def _few_at_a_time(self) -> Iterator[Events]:
        """The logs of voxels one after the other, of as many as have little evidence when it is dense."""
        edges = np.array([some.start for some in self.evidence.chunks()])
        cuts = np.unique(np.append(np.searchsorted(self.starts, edges), len(self.ix))).tolist()
        for first, last in zip(cuts, cuts[1:] or cuts, strict=False):
            own, of = slice(self.bounds[first], self.bounds[last]), slice(first, last)
            columns: dict[str, Any] = {name: getattr(self, name)[of] for name in _INDEX_TYPES}
            columns |= {name: getattr(self, name)[own] for name in ("frame", "pixels")}
            yield replace(self, **columns, voxel=self.voxel[own] - first, evidence=self.evidence.take(own))

    def beliefs(self) -> Float64:
        """(m, K) the belief p^(t) after each observation: the normalised sum of the voxel's evidence up to it."""
        accumulated = self.evidence[:]
        age = np.arange(len(self)) - self.starts[self.voxel]
        by_age = np.argsort(age, kind="stable")
        ends = np.cumsum(np.bincount(age, minlength=1))
        for rows in np.split(by_age, ends)[1:]:
            accumulated[rows] += accumulated[rows - 1]
        return normalise(accumulated)

    def drift(self) -> Float64:
        """(m,) D_JS(p^(t), p^(t-1)) in bits, that each observation caused at its voxel; 0 for a voxel's first."""
        belief = self.beliefs()
        drift = np.zeros(len(self))
        again = np.flatnonzero(np.diff(self.voxel, prepend=-1) == 0)
        drift[again] = js_divergence(belief[again], belief[again - 1])
        return drift

    def coarsen(self, factor: int) -> Events:
        """The log on voxels `factor` times as large, in order of frame index within a voxel.

        s_bar of a frame is the mean over its pixels, so the mean of the finer voxels' s_bar weighted by their pixels.
        """
        index = np.stack([self.ix, self.iy, self.iz], axis=1) // factor
        coarse, parent = np.unique(index, axis=0, return_inverse=True)
        pairs = np.stack([parent.ravel()[self.voxel], self.frame], axis=1)
        pairs, rows = np.unique(pairs, axis=0, return_inverse=True)
        pixels = np.zeros(len(pairs), dtype=np.int64)
        evidence = np.zeros((len(pairs), self.evidence.K))
        np.add.at(pixels, rows.ravel(), self.pixels)
        np.add.at(evidence, rows.ravel(), self.evidence[:] * self.pixels[:, None])
        return Events(
            **index_columns(coarse),
            voxel=pairs[:, 0].astype(np.int64),
            frame=pairs[:, 1].astype(np.int32),
            evidence=Evidence.of(evidence / pixels[:, None]),
            pixels=pixels,
            voxel_size=self.voxel_size * factor,
            classes=self.classes,
        )

    def rows(self, voxels: Int64) -> Events:
        """The log of these of its voxels (r,), ascending."""
        first = self.bounds[voxels]
        count = self.bounds[voxels + 1] - first
        number = np.repeat(np.arange(len(voxels), dtype=np.int32), count)
        rows = np.repeat(first - np.cumsum(count) + count, count)
        rows += np.arange(len(rows))
        own: dict[str, Any] = {name: getattr(self, name)[voxels] for name in _INDEX_TYPES}
        own |= {name: getattr(self, name)[rows] for name in ("frame", "pixels")}
        return replace(self, **own, voxel=number, evidence=self.evidence.take(rows))

    def save(self, path: str | Path, tile: parquet.Tile | None = None) -> None:
        """Write Parquet, atomically: one row an observation, with its voxel's index."""

        def columns(some: slice) -> dict[str, npt.NDArray[Any]]:
            own = {name: getattr(self, name)[some] for name in _EVENT_TYPES}
            return own | {name: getattr(self, name)[self.voxel[some]] for name in _INDEX_TYPES}

        parts = map(columns, self.evidence.chunks())
        parquet.write(path, parts, type(self).__name__, self.voxel_size, self.classes, tile)

    @classmethod
    def joined(cls, parts: Sequence[Events]) -> Events:
        """One log of the voxels of several that share none."""
        if len(parts) == 1:
            return parts[0]
        index = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _INDEX_TYPES}
        order = _sorted(index)
        count = np.concatenate([np.diff(np.append(part.starts, len(part))) for part in parts])
        first = np.cumsum(count) - count
        number = np.repeat(np.arange(len(order)), count[order])
        rows = np.arange(len(number)) + (first[order] - np.cumsum(count[order]) + count[order])[number]
        return cls(
            **{name: values[order] for name, values in index.items()},
            voxel=number,
            frame=np.concatenate([part.frame for part in parts])[rows],
            evidence=Evidence.joined([part.evidence for part in parts]).take(rows),
            pixels=np.concatenate([part.pixels for part in parts])[rows],
            voxel_size=parts[0].voxel_size,
            classes=parts[0].classes,
        )

    @classmethod
    def load(cls, path: str | Path) -> Events:
        """Read what `save` wrote, a file or a folder of tiles, all of it.

        Raises DataError where a file is missing, damaged or of another kind, or a log in tiles is larger than memory.
        """
        files = parquet.files_of(path)
        if len(files) > 1:
            _require_memory(Path(path), files)
        return cls.joined([cls._read(file) for file in files])

    @classmethod
    def _read(cls, path: Path) -> Events:
        with parquet.reading(path):
            content = parquet.read(path, _EVENT_TYPES | _INDEX_TYPES)
            first = np.flatnonzero(np.diff(content["voxel"], prepend=-1))
            return cls(**content | {name: content[name][first] for name in _INDEX_TYPES})


_INDEX_TYPES: Types = {"ix": np.int32, "iy": np.int32, "iz": np.int32}
_VOXEL_TYPES: Types = _INDEX_TYPES | {
    "op": np.int32, "evidence": np.float64, "drift_sum": np.float64, "pixels": np.int64, "first_frame": np.int32,
    "last_frame": np.int32, "self_sum": np.float64, "frame_entropy_sum": np.float64,
}  # fmt: skip
_SUMS = [name for name in _VOXEL_TYPES if name not in (*_INDEX_TYPES, "evidence")]
_EVENT_TYPES: Types = {"voxel": np.int32, "frame": np.int32, "evidence": np.float64, "pixels": np.int32}


def index_columns(index: npt.NDArray[np.integer[Any]]) -> dict[str, Any]:
    """Voxel indices (n, 3) as the columns ix, iy, iz."""
    return dict(zip(_INDEX_TYPES, index.T.astype(np.int32), strict=True))


def _sorted(index: Mapping[str, npt.NDArray[Any]]) -> Int64:
    """The order of voxels by ix, iy, iz."""
    order: Int64 = np.lexsort([index[name] for name in reversed(_INDEX_TYPES)])
    return order


def _require_memory(path: Path, files: Sequence[Path]) -> None:
    """Raise DataError where a map in tiles does not fit into the memory that is free."""
    voxels, free = parquet.rows_in(files), available_bytes()
    if (needed := voxels * BYTES_A_VOXEL) > free:
        raise DataError(
            f"{path}: {voxels / 1e6:.3g} million voxels in {len(files)} tiles take {needed / 1e9:.2g} GB at once, and"
            f" {free / 1e9:.2g} GB are free; take them tile by tile (VoxelTable.iter_tiles, or DuckDB on its files)"
        )


def _sum_by_voxel(values: npt.NDArray[Any], starts: Int64) -> npt.NDArray[Any]:
    return np.add.reduceat(values, starts, axis=0) if len(starts) else values


def _freeze_columns(table: Any, types: Types, like: npt.NDArray[Any]) -> None:
    for name, dtype in types.items():
        given = getattr(table, name)
        if len(given) != len(like):
            raise DataError(f"{type(table).__name__}: column '{name}' has {len(given)} rows, expected {len(like)}")
        object.__setattr__(table, name, _evidence(table, given) if name == "evidence" else _frozen(given, dtype))


def _frozen(given: npt.ArrayLike, dtype: type[np.generic]) -> npt.NDArray[Any]:
    column: npt.NDArray[Any] = np.ascontiguousarray(given, dtype=dtype).view()
    column.setflags(write=False)
    return column


def _evidence(table: Any, given: npt.NDArray[Any] | Evidence) -> Evidence:
    shape = np.shape(given)
    if len(shape) != 2:
        raise DataError(f"{type(table).__name__}: evidence of shape {shape}, expected one row of K classes each")
    return Evidence.of(given)
