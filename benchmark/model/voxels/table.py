"""What fusion leaves behind: one row a voxel."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.errors import DataError
from semstab.model.evidence import Evidence
from semstab.model.measures import MeasureMeans, dominant, measures
from semstab.model.voxels import parquet, tabular
from semstab.model.voxels.columns import (
    INDEX,
    OF_VOXELS,
    freeze,
    in_order,
    require_memory,
)

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]


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
        freeze(self, OF_VOXELS, self.ix)
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
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in OF_VOXELS if name != "evidence"}
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
            own = {name: np.asarray(getattr(part, name)) for name in OF_VOXELS}
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
            require_memory(Path(path), files)
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
        files, sorting = parquet.files_of(path), tuple(INDEX)
        wanted = [*dict.fromkeys((*names, *(sorting if len(files) > 1 else ())))]
        parts = [parquet.columns(file, wanted) for file in files]
        found = {name: np.concatenate([part[name] for part in parts]) for name in wanted}
        order = in_order(found) if len(files) > 1 else slice(None)
        return {name: found[name][order] for name in names}

    @classmethod
    def joined(cls, parts: Sequence[VoxelTable]) -> VoxelTable:
        """One table of the voxels of several that share none."""
        if len(parts) == 1:
            return parts[0]
        index = {name: np.concatenate([getattr(part, name) for part in parts]) for name in INDEX}
        order = in_order(index)
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts])[order]
            for name in OF_VOXELS
            if name != "evidence"
        }
        evidence = Evidence.joined([part.evidence for part in parts]).take(order)
        return replace(parts[0], **columns, evidence=evidence)

    @classmethod
    def _read(cls, path: Path) -> VoxelTable:
        with parquet.reading(path):
            return cls(**parquet.read(path, OF_VOXELS))
