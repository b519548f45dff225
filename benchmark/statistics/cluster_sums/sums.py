"""Sums by frame and cube of space, their file, and how they are coarsened to fit others."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core import arrays as arrow
from semstab.core.files import atomic_path, parse_json
from semstab.core.json_form import from_json
from semstab.core.types import Float64, Int32, Int64
from semstab.data import parquet
from semstab.data.measures import measures
from semstab.errors import DataError
from semstab.statistics.cluster_sums.columns import (
    OF_TRUTH,
    column_names,
    layout,
    layout_of_features,
    of_measure,
    side_by_side,
    width,
)
from semstab.statistics.cluster_sums.index import MOST_CELLS, ClusterIndex, distinct_rows

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class ClusterSums:
    """Sums by name, a row for each cube of space and group of frames; sums of parts of a map add up to the map's.

    Sums of a whole map are over the observations in voxels with OP >= 2, and have the `layout` of its classes; a
    location counts 1 / T for each of its T frames in `voxels`, 1 in `observations`, and its pairwise agreement is
    shared out among them in `psa` and `agreeing`. Sums of any values of voxels have their own names and no frames.

    Attributes:
        cell: (m, 3) int32 cube: floor(voxel centre / edge), so that the cubes of all maps of a scene are the
            same.
        frame: (m,) int32 group: frame index // step; -1 where the frames are unknown, without a log, and
            for sums that belong to none (`WITHOUT_FRAMES`).
        columns: (m, C) float64.
        layout: The columns of each name.
        edge: Metres, a power of 2; spots have another edge, so that alpha and its interval are the same for maps of any
            voxel size.
        step: Frames of a group, a power of 2; 0 where they are unknown.
        voxel_size: Metres.
        fused: Number of frames that they come from.
        answers: The same of spots, which are units instead of voxels, and views, instead of frames: of their first,
            second and third answers; empty without `SpotObservations`.
        features: The same of features at spots, with the columns `OF_FEATURES`; None without features.
    """

    cell: Int32
    frame: Int32
    columns: Float64
    layout: Mapping[str, slice]
    edge: float
    step: int = 0
    voxel_size: float = math.nan
    classes: tuple[str, ...] = ()
    fused: int = 0
    answers: tuple[ClusterSums, ...] = ()
    features: ClusterSums | None = None

    @classmethod
    def of_cubes(cls, cell: npt.NDArray[np.integer], edge: float, sums: Mapping[str, Float64]) -> ClusterSums:
        """Return sums (G, C) by name over the voxels of each cube (G, 3), whose frames are not told apart."""
        columns = np.concatenate([*sums.values()], axis=1)
        slices = side_by_side({name: column.shape[1] for name, column in sums.items()})
        return cls(cell.astype(np.int32), np.full(len(cell), -1, np.int32), columns, slices, edge)

    @classmethod
    def joined(cls, parts: Sequence[ClusterSums]) -> ClusterSums:
        """Return the sums over at most MOST_CELLS cubes of a map from those of its parts, without frames."""
        edge = max(part.edge for part in parts)
        parts = [part.coarsened(edge, 0) for part in parts]
        cell, frame, columns = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("cell", "frame", "columns")
        )
        merged = dataclasses.replace(parts[0], cell=cell, frame=frame, columns=columns)
        while len(distinct_rows(merged.cell // round(edge / merged.edge))[0]) > MOST_CELLS:
            edge *= 2
        return merged.coarsened(edge, 0)

    def __getitem__(self, name: str) -> Float64:
        """Return sums (m, 1), or (m, K) by class, of that name."""
        return self.columns[:, self.layout[name]]

    def side_by_side(self, names: Sequence[str]) -> Float64:
        """Return sums (m, C) of several names side by side."""
        return np.concatenate([self[name] for name in names], axis=1)

    @property
    def K(self) -> int:
        """The number of classes of a whole map."""
        evidence = self.layout["evidence"]
        return int(evidence.stop - evidence.start)

    @property
    def truth(self) -> bool:
        """Return whether sums of ground truth are included."""
        return "known" in self.layout

    @functools.cached_property
    def index(self) -> ClusterIndex:
        """The cube and the group of frames of each row."""
        groups = len(np.unique(self.frame[self.frame >= 0]))
        per_group = self.fused / groups if self.fused and groups and self.step else self.step
        return ClusterIndex.from_cells(self.cell, self.frame, self.edge, per_group)

    @property
    def frames(self) -> int:
        """Return how many groups of frames there are; 0 where they are unknown."""
        return len(self.index.frames) if self.step else 0

    @property
    def frame_count(self) -> int:
        """Return how many frames they come from, about; 0 where they are unknown."""
        return round(self.frames * self.index.per_group)

    @property
    def cells(self) -> int:
        """Return how many cubes hold a voxel that was seen twice."""
        return len(self.index.cubes)

    def coarsened(self, edge: float, step: int) -> ClusterSums:
        """Return the sums of larger cubes, or groups of frames; step 0 forgets the frames of the map, not of its spots.

        Cubes of the spots are then at least as large as cubes of the map.
        """
        answers = tuple(part.coarsened(max(edge, part.edge), part.step) for part in self.answers)
        of = self.features
        features = None if of is None else of.coarsened(max(edge, of.edge), of.step)
        return dataclasses.replace(self.map_coarsened(edge, step), answers=answers, features=features)

    def map_coarsened(self, edge: float, step: int) -> ClusterSums:
        """Return the sums of the map in larger cubes or groups of frames, with the sums of spots unchanged."""
        cell = _joined(self.cell, edge / self.edge)
        has_frames = step and self.step
        frame = _joined(self.frame, step // self.step) if has_frames else np.full(len(cell), -1)
        key = np.concatenate([cell, frame[:, None]], axis=1)
        rows, of = distinct_rows(key)
        columns = np.zeros((len(rows), self.columns.shape[1]))
        np.add.at(columns, of, self.columns)
        return dataclasses.replace(
            self,
            cell=rows[:, :3].astype(np.int32),
            frame=rows[:, 3].astype(np.int32),
            columns=columns,
            edge=edge,
            step=step if has_frames else 0,
        )

    def without_truth(self) -> ClusterSums:
        """Return the sums without the columns of ground truth."""
        names = [name for name in self.layout if name not in OF_TRUTH]
        slices = side_by_side({name: self[name].shape[1] for name in names})
        return dataclasses.replace(self, columns=self.side_by_side(names), layout=slices)

    def save(self, path: str | Path, *, single: bool = False) -> None:
        """Write Parquet, atomically; in single precision, which takes half the bytes and keeps seven digits."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        parts = self, *self.answers, *([] if self.features is None else [self.features])
        about = {name: getattr(self, name) for name in ("K", "classes", "truth")}
        about |= {name: [getattr(part, name) for part in parts] for name in ("edge", "step", "voxel_size", "fused")}
        lengths = [len(part.frame) for part in parts]
        cell, frame = np.concatenate([part.cell for part in parts]), np.concatenate([part.frame for part in parts])
        names = [*dict.fromkeys(name for part in parts for name in column_names(part.layout))]
        at = {name: k for k, name in enumerate(names)}
        columns = np.zeros((sum(lengths), len(names)))
        for part, rows in zip(parts, np.split(np.arange(len(columns)), np.cumsum(lengths)[:-1]), strict=True):
            for name, column in zip(column_names(part.layout), part.columns.T, strict=True):
                columns[rows, at[name]] = column
        stored = columns.astype(np.float32) if single else columns
        arrays = [np.repeat(np.arange(len(parts)), lengths), *cell.T, frame, *stored.T]
        content = pa.table({name: arrow.column(array) for name, array in zip([*KEYS, *names], arrays, strict=True)})
        text = json.dumps({"schema": SCHEMA, "kind": "ClusterSums", **about})
        with atomic_path(path) as temporary:
            packed: dict[str, Any] = {"use_dictionary": False, "use_byte_stream_split": names} if single else {}
            content = content.replace_schema_metadata({"semstab": text})
            pq.write_table(content, temporary, compression="zstd", compression_level=19 if single else None, **packed)

    @classmethod
    def load(cls, path: str | Path) -> ClusterSums:
        """Read a file that `save` wrote; sums that it lacks are NaN, and columns of other names are left out.

        Raises:
            DataError: If the file is missing, damaged or of another kind.
        """
        with parquet.reading(path, "a file of cluster sums"):
            with parquet.opened(path) as file:
                content = file.read()
            about = parse_json((content.schema.metadata or {})[b"semstab"])
            kind, version = about.pop("kind"), about.pop("schema")
            if (kind, version) != ("ClusterSums", SCHEMA):
                raise DataError("it is of another kind or version")
            meta = from_json(SumsMeta, about, path)
            part, *keys = (_key(arrow.values_of(content.column(name)), name) for name in KEYS)
            names = content.column_names
            if len(names) < meta.K:
                raise DataError(f"{len(names) - len(KEYS)} columns of sums for {meta.K} classes")
            stored = dict(zip(names, content.columns, strict=True))
            measured = tuple(measure.key for measure in measures() if stored.keys() >= {*of_measure(measure.key)})
            of_map = layout(meta.K, truth=meta.truth, measured=measured)
            of_answers = layout(meta.K, truth=False, meaning="similar" in stored)
            layouts = [of_map, *ANSWERS * [of_answers], layout_of_features()]
            numbers = {
                name: arrow.values_of(stored[name])
                for name in dict.fromkeys(name for columns in layouts for name in column_names(columns))
                if name in stored
            }
            if any(np.any(np.abs(column) > LARGEST**2) for column in numbers.values()):
                raise DataError("a sum is larger than any map can have")
            if not all(0 <= frames <= LARGEST for frames in (*meta.step, *meta.fused)):
                raise DataError("a number of frames is one that no map can have")
            parts: list[ClusterSums] = []
            for number, (edge, step, voxel_size, fused) in enumerate(
                zip(meta.edge, meta.step, meta.voxel_size, meta.fused, strict=True)
            ):
                rows, its_layout = part == number, layouts[number]
                cell, frame = np.stack([key[rows] for key in keys[:3]], axis=1), keys[3][rows]
                columns = np.full((len(frame), width(its_layout)), np.nan)
                for k, name in enumerate(column_names(its_layout)):
                    if name in numbers:
                        columns[:, k] = numbers[name][rows]
                where = cell.astype(np.int32), frame.astype(np.int32), columns
                classes = () if number > ANSWERS else meta.classes
                parts.append(cls(*where, its_layout, edge, step, voxel_size, classes, fused))
        answers, features = tuple(parts[1 : 1 + ANSWERS]), parts[1 + ANSWERS :]
        return dataclasses.replace(parts[0], answers=answers, features=features[0] if features else None)


KEYS = ("part", "ix", "iy", "iz", "frame")
"""The columns of the file before the sums; part 0 is the map, 1 to 3 are first, second and third answers of spots, 4 is
their features."""


ANSWERS = 3
"""Answers of a spot and view."""

LARGEST = 2.0**30
"""Largest edge in metres and group of frames; its square is the largest sum. Larger numbers are damage."""


@dataclass(frozen=True)
class SumsMeta:
    """Metadata of a file of sums: edge, step, voxel_size and fused of each part; see `ClusterSums`."""

    K: int
    classes: tuple[str, ...]
    truth: bool
    edge: tuple[float, ...]
    step: tuple[int, ...]
    voxel_size: tuple[float, ...]
    fused: tuple[int, ...]

    def __post_init__(self) -> None:
        parts = {len(values) for values in (self.edge, self.step, self.voxel_size, self.fused)}
        if not any(parts <= {number} for number in (1, 1 + ANSWERS, 2 + ANSWERS)):
            raise DataError(f"sums of other parts than a map, {ANSWERS} answers of spots, and features")
        sizes = all(0 < size < math.inf for size in self.voxel_size)
        if not (sizes and self.K > 0 and len(self.classes) in (0, self.K)):
            raise DataError(f"{self.K} classes, {len(self.classes)} names, voxels of {self.voxel_size[0]:g} m")
        for edge in self.edge:
            if not (0 < edge <= LARGEST and math.frexp(edge)[0] == 0.5):
                raise DataError(f"the edge of cubes is {edge:g} m, which is not a power of 2 in range")
        for step in self.step:
            if not 0 <= step <= LARGEST or step & (step - 1):
                raise DataError(f"groups have {step} frames, which is not a power of 2 in range")


def _joined(index: Int32, times: float) -> Int64:
    """Return the indices of larger cubes, or groups of frames, that join `times` of these; -1 for frames stays."""
    wide: Int64 = index.astype(np.int64) // round(min(times, 2.0**40))
    return wide


def _key(values: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
    """Return a column of whole numbers that fit; raises DataError where they do not."""
    if values.dtype.kind not in "iu" or not np.array_equal(values, values.astype(np.int32)):
        raise DataError(f"a number of column '{name}' is out of range")
    return values


def aligned(*parts: ClusterSums) -> tuple[ClusterSums, ...]:
    """Return the sums, of maps and of their spots, at the finest cubes and groups of frames that all of them have.

    Raises:
        DataError: If they have different columns.
    """
    if len({(part.K, part.classes, part.truth) for part in parts}) > 1:
        raise DataError("the sums do not fit together: their maps differ in classes, or only some have ground truth")
    edge, steps = max(part.edge for part in parts), [part.step for part in parts]
    step = max(steps) if all(steps) else 0
    same = [part if (part.edge, part.step) == (edge, step) else part.map_coarsened(edge, step) for part in parts]
    if all(part.features for part in same):
        features = aligned(*(part.features for part in same if part.features is not None))
        same = [dataclasses.replace(part, features=of) for part, of in zip(same, features, strict=True)]
    if not all(part.answers for part in same):
        return tuple(same)
    answers = zip(*(aligned(*of_all) for of_all in zip(*(part.answers for part in same), strict=True)), strict=True)
    return tuple(
        dataclasses.replace(part, answers=part_answers) for part, part_answers in zip(same, answers, strict=True)
    )
