"""The result of fusion: one row a voxel."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.core.process import available_bytes
from semstab.core.types import Float64, Int32, Int64, Mask, UInt8
from semstab.data import parquet
from semstab.data.display import as_figure, from_above
from semstab.data.evidence import Evidence
from semstab.data.measures import MeasureMeans, dominant, measures, vss
from semstab.data.voxel_keys import in_order
from semstab.errors import DataError, MissingDependencyError

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


# Columns as tables of Arrow and pandas, and the small tables that a notebook shows.

Cell = str | int | float

CAPTION = "VSS from above, dark 0 to yellow 1; grey: seen once"


def to_arrow(columns: Mapping[str, Any]) -> pa.Table:
    """Return the columns; undefined numbers are null."""
    import pyarrow as pa

    return pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})


def to_pandas(columns: Mapping[str, Any]) -> pd.DataFrame:
    """Return the columns; names are categories.

    Raises:
        MissingDependencyError: Without pandas.
    """
    try:
        import pandas  # noqa: F401  what Arrow needs for it
    except ImportError as error:
        install = "pip install 'semstab[pandas]', or take to_arrow()"
        raise MissingDependencyError(f"data frames need pandas; {install}") from error
    return to_arrow(columns).to_pandas()


def name_column(rows: npt.NDArray[np.integer[Any]], names: Sequence[str]) -> pa.DictionaryArray:
    """Return a column of names by their rows."""
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(rows.astype(np.int32), list(names))


def as_html(
    title: str, headers: Sequence[str], rows: Sequence[Sequence[Cell]], colors: Mapping[str, str] | None = None
) -> str:
    """Return a table with a caption; names are shown as they are, and cells of these texts in their colours."""

    def cell(value: Cell) -> str:
        text, color = _text(value), (colors or {}).get(str(value))
        style = f' style="color: {color}; font-weight: bold"' if color else ""
        return f"<td{style}>{html.escape(text)}</td>"

    head = "".join(f"<th>{html.escape(header)}</th>" for header in headers)
    body = "".join("<tr>" + "".join(map(cell, row)) + "</tr>" for row in rows)
    caption = f'<caption style="text-align: left; white-space: nowrap">{html.escape(title)}</caption>'
    return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def number(value: float, digits: int) -> str:
    """Format a value with `digits` decimals; '-' for NaN."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _text(cell: Cell) -> str:
    return f"{cell:,}" if isinstance(cell, int) else str(cell)


# The columns of voxels and of observations, and the methods that both tables share.

Types = dict[str, type[np.generic]]

BYTES_A_VOXEL = 200
"""The bytes a voxel of a table that is put together from tiles: twice what it takes."""

INDEX: Types = {"ix": np.int32, "iy": np.int32, "iz": np.int32}
OF_VOXELS: Types = INDEX | {
    "op": np.int32, "evidence": np.float64, "drift_sum": np.float64, "pixels": np.int64, "first_frame": np.int32,
    "last_frame": np.int32, "self_sum": np.float64, "frame_entropy_sum": np.float64,
}  # fmt: skip
WEIGHT: Types = {"weight": np.float64}
OF_FRAMES = ("self_sum", "frame_entropy_sum")
"""The column of maps by other rules, and those that they do not have."""

OF_EVENTS: Types = {"voxel": np.int32, "frame": np.int32, "evidence": np.float64, "pixels": np.int32}
"""The columns of both by name: the index of a voxel, then those of its row and of an observation."""


def index_columns(index: npt.NDArray[np.integer[Any]]) -> dict[str, Any]:
    """Return voxel indices (n, 3) as the columns ix, iy, iz."""
    return dict(zip(INDEX, index.T.astype(np.int32), strict=True))


def require_memory(path: Path, files: Sequence[Path]) -> None:
    """Raise DataError where a map in tiles does not fit into the memory that is free."""
    voxels, free = parquet.rows_in(files), available_bytes()
    if (needed := voxels * BYTES_A_VOXEL) > free:
        raise DataError(
            f"{path}: {voxels / 1e6:.3g} million voxels in {len(files)} tiles take {needed / 1e9:.2g} GB at once, and"
            f" {free / 1e9:.2g} GB are free; take them tile by tile (VoxelTable.iter_tiles, or DuckDB on its files)"
        )


def freeze(table: Any, types: Types, like: npt.NDArray[Any]) -> None:
    """Make a table's columns arrays of their types that cannot be written to, as long as that one.

    Raises:
        DataError: If one is not.
    """
    for name, dtype in types.items():
        values = getattr(table, name)
        if len(values) != len(like):
            raise DataError(f"{type(table).__name__}: column '{name}' has {len(values)} rows, expected {len(like)}")
        object.__setattr__(table, name, _evidence(table, values) if name == "evidence" else _frozen(values, dtype))


def _frozen(values: npt.ArrayLike, dtype: type[np.generic]) -> npt.NDArray[Any]:
    column: npt.NDArray[Any] = np.ascontiguousarray(values, dtype=dtype).view()
    column.setflags(write=False)
    return column


def _evidence(table: Any, evidence: npt.NDArray[Any] | Evidence) -> Evidence:
    shape = np.shape(evidence)
    if len(shape) != 2:
        raise DataError(f"{type(table).__name__}: evidence of shape {shape}, expected one row of K classes each")
    return Evidence.from_rows(evidence)


@dataclass(frozen=True, eq=False)
class VoxelTable:
    """The fused map: n voxels sorted by (ix, iy, iz). Everything reported about a voxel is a function of its row.

    Attributes:
        ix, iy, iz: (n,) int32 voxel index, floor(x_w / r).
        op: (n,) int32 observation persistence: the number of frames that saw the voxel.
        evidence: (n, K) accumulated evidence e(q), the sum over frames of s_bar; stored sparse.
        drift_sum: (n,) float64 sum over t >= 2 of the JS divergence of successive beliefs, bits.
        pixels: (n,) int64 pixels that fell into the voxel, all frames.
        first_frame: (n,) int32 lowest frame index that saw it.
        last_frame: (n,) int32 highest frame index that saw it.
        self_sum: (n,) float64 sum over frames of ||s_bar||^2.
        frame_entropy_sum: (n,) float64 sum over frames of the entropy of s_bar, bits.
        voxel_size: r, metres.
        classes: The K class names, where they are known.
        weight: (n,) float64 what the rows of evidence sum to, where that is not OP, as by another rule than the mean;
            sums over frames of a function of s_bar are then NaN, since they say nothing of such evidence.

    Raises:
        DataError: If columns disagree in length or rows are not sorted and distinct.

    Examples:
        >>> table = semstab.load("run").table(model="sim-steady")
        >>> often = table.op >= 3
        >>> bool(semstab.metrics.vss(table)[often].mean() > 0.9)
        True
        >>> list(table.to_pandas().columns[:9])
        ['ix', 'iy', 'iz', 'x', 'y', 'z', 'op', 'label', 'class']
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
    weight: Float64 | None = None

    def __post_init__(self) -> None:
        if self.weight is not None:
            for name in OF_FRAMES:
                object.__setattr__(self, name, np.full(len(self.ix), np.nan))
        freeze(self, self._types, self.ix)
        if self.classes and len(self.classes) != self.K:
            raise DataError(f"voxel table: evidence of shape {self.evidence.shape} for {len(self.classes)} classes")
        ascends = self.iz[1:] > self.iz[:-1]
        for column in (self.iy, self.ix):  # a column decides where those before it are equal
            ascends = (column[1:] > column[:-1]) | ((column[1:] == column[:-1]) & ascends)
        if not ascends.all():
            raise DataError("voxel table: rows must be distinct and sorted by ix, iy, iz")

    @property
    def _types(self) -> Types:
        return OF_VOXELS if self.weight is None else OF_VOXELS | WEIGHT

    @property
    def counts_frames(self) -> bool:
        """True if its evidence is the sum of one distribution a frame, so that it tells how frames agree."""
        return not np.isnan(self.self_sum).any()

    def summing_to_op(self) -> VoxelTable:
        """Return the same map, its rows of evidence scaled to sum to OP, as beliefs of voxels are added up."""
        if self.weight is None:
            return self
        scale = np.repeat(self.op / self.weight, np.diff(self.evidence.starts))
        evidence = replace(self.evidence, weight=self.evidence.weight * scale, known=None)
        return replace(self, evidence=evidence, weight=None)

    def __repr__(self) -> str:
        return f"<VoxelTable: {len(self):,} voxels of {self.voxel_size:g} m, {self.K} classes>"

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
        """Return the table of some of its voxels: a slice, their numbers ascending, or a mask (n,)."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in self._types if name != "evidence"}
        return replace(self, **columns, evidence=self.evidence.take(rows))

    def measured(self) -> VoxelTable:
        """Return the same with its concentration, which is then computed once: see `Evidence.measured`."""
        return self if self.evidence.known is not None else replace(self, evidence=self.evidence.measured())

    def to_arrow(self) -> pa.Table:
        """Return columns of every voxel: those that `save` writes, x, y, z in metres, the class, evidence_CLASS."""
        return to_arrow(self._columns())

    def to_pandas(self) -> pd.DataFrame:
        """Return the same as a data frame.

        Raises:
            MissingDependencyError: Without pandas.
        """
        return to_pandas(self._columns())

    def _columns(self) -> dict[str, Any]:
        names = self.classes or tuple(str(k) for k in range(self.K))
        x, y, z = self.centers.T
        evidence = self.evidence[:]
        return {
            "ix": self.ix, "iy": self.iy, "iz": self.iz, "x": x, "y": y, "z": z, "op": self.op,
            "label": dominant(self), "class": name_column(dominant(self), names),
            **{measure.key: measure.of(self) for measure in measures()},
            **{name: getattr(self, name) for name in self._types if name not in (*INDEX, "op", "evidence")},
            **{f"evidence_{name}": evidence[:, k] for k, name in enumerate(names)},
        }  # fmt: skip

    def _repr_html_(self) -> str:
        """Return the means of all voxels and of the recurrent ones, in a notebook."""
        values = {measure: measure.of(self) for measure in measures()}
        rows: list[list[Cell]] = []
        for name, where in (("all", self.op > 0), ("OP >= 3", self.op >= 3)):
            means = MeasureMeans.over(values, self.op, where)
            numbers = (number(means[measure], measure.digits[0]) for measure in measures())
            rows.append([name, int(np.count_nonzero(where)), *numbers])
        title = f"{len(self):,} voxels of {self.voxel_size:g} m, {self.K} classes"
        table = as_html(title, ["", "voxels", *(measure.title for measure in measures())], rows)
        return table + (as_figure(self.image(), CAPTION) if len(self) else "")

    def image(self, up: npt.ArrayLike | None = None) -> UInt8:
        """Return VSS of the topmost voxels, (H, W, 3) RGB; see `semstab.data.display.from_above`."""
        return from_above(self.index, np.where(self.op > 1, vss(self), np.nan), up)

    def save(
        self,
        path: str | Path,
        extra: Mapping[str, npt.NDArray[Any]] | None = None,
        computed: Mapping[str, Callable[[VoxelTable], npt.NDArray[Any]]] | None = None,
        tile: parquet.Tile | None = None,
    ) -> None:
        """Write Parquet, atomically, some rows after the others; as a tile of a larger map, where one is named.

        `extra` columns (n,), and those `computed` from the rows that are written, go along for other programs and are
        not read back.
        """

        def columns(chunk: slice) -> dict[str, npt.NDArray[Any]]:
            part = self.rows(chunk)
            table_columns = {name: np.asarray(getattr(part, name)) for name in self._types}
            made = {name: of(part) for name, of in (computed or {}).items()}
            return table_columns | made | {name: values[chunk] for name, values in (extra or {}).items()}

        parts = map(columns, self.evidence.chunks())
        parquet.write(path, parts, type(self).__name__, self.voxel_size, self.classes, tile)

    @classmethod
    def load(cls, path: str | Path) -> VoxelTable:
        """Read what `save` wrote, a file or a folder of tiles, all of it.

        Raises:
            DataError: If a file is missing, damaged or of another kind, or a map in tiles is larger than memory.
        """
        files = parquet.files_of(path)
        if len(files) > 1:
            require_memory(Path(path), files)
        return cls.joined([cls._read(file) for file in files])

    @classmethod
    def iter_tiles(cls, path: str | Path) -> Iterator[VoxelTable]:
        """Return the tiles of a map one after the other, by x and y; of a map in one file that file."""
        return map(cls._read, parquet.files_of(path))

    @classmethod
    def columns(cls, path: str | Path, names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
        """Return single columns (n,) by name, also measures and further columns of the file, in the order of `load`.

        Raises:
            DataError: If one is not there.
        """
        files, sorting = parquet.files_of(path), tuple(INDEX)
        all_names = [*dict.fromkeys((*names, *(sorting if len(files) > 1 else ())))]
        parts = [parquet.columns(file, all_names) for file in files]
        columns = {name: np.concatenate([part[name] for part in parts]) for name in all_names}
        order = in_order(np.stack([columns[name] for name in INDEX], axis=1)) if len(files) > 1 else slice(None)
        return {name: columns[name][order] for name in names}

    @classmethod
    def joined(cls, parts: Sequence[VoxelTable]) -> VoxelTable:
        """Return one table of the voxels of several that share none."""
        if len(parts) == 1:
            return parts[0]
        order = in_order(np.concatenate([part.index for part in parts]))
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts])[order]
            for name in parts[0]._types
            if name != "evidence"
        }
        evidence = Evidence.joined([part.evidence for part in parts], order)
        return replace(parts[0], **columns, evidence=evidence)

    @classmethod
    def _read(cls, path: Path) -> VoxelTable:
        with parquet.reading(path):
            return cls(**parquet.read(path, OF_VOXELS, WEIGHT))


# A part of space that a map is restricted to: whole columns of voxels.


@dataclass(frozen=True)
class Extent:
    """The voxels with low <= (ix, iy) < high, whatever their iz.

    Attributes:
        origin: Voxel of the first camera of the whole map, where that is known: soft scores are rounded as they are
            there.
    """

    low: tuple[int, int]
    high: tuple[int, int]
    origin: tuple[int, int, int] | None = None

    def holds(self, index: npt.NDArray[np.integer]) -> Mask:
        """Return whether each of the voxels of these indices (3, n) is one of them: (n,)."""
        ix, iy = index[0], index[1]
        inside: Mask = (ix >= self.low[0]) & (ix < self.high[0])
        inside &= (iy >= self.low[1]) & (iy < self.high[1])
        return inside
