"""Sums by frame and cube of space, from which statistics, their intervals and differences follow.

They add up over clusters, and are a small file: comparisons and gates need no voxels.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from semstab.core import arrays as arrow
from semstab.core.files import atomic_path, parse_json
from semstab.core.json_form import from_json
from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data import earlier, parquet
from semstab.data.measures import Measure, measures
from semstab.errors import DataError
from semstab.statistics.agreement import ONE_HOT, alpha_of, ratio_of

# --- Columns ----------------------------------------------------------------------------------------------------------

MOST_CLASSES = 64
"""Sums by class are stored up to so many classes."""

BINS = 15
"""Bins of the reliability diagram; bin b has voxels whose largest belief lies in (b / BINS, (b + 1) / BINS]."""

PLAIN = (
    "voxels", "psa", "observations", "agreeing", "own", "twice", "twice_agreeing", "recurrent", "vss", "entropy",
)  # fmt: skip
BY_CLASS_ALONE = ("class_apart", "class_own")
DRIFT = ("sbd_excess", "sbd_known")
WITH_TRUTH = ("known", "right", "observed", "observed_right", "consistent", "consistent_wrong")
BY_TRUE_CLASS = ("class_known", "class_right", "class_predicted")
WITHOUT_FRAMES = (*DRIFT, "calibrated", "gap")
"""Sums that belong to no frame: they stand in rows whose frame is -1, as those of the register of measures."""


def of_measure(key: str) -> tuple[str, str]:
    """Return the names of the sums of a measure of the register: its total, and over how many voxels."""
    return f"{key}_sum", f"{key}_count"


@functools.lru_cache(maxsize=16)
def layout(K: int, *, truth: bool, measured: tuple[str, ...] = ()) -> Mapping[str, slice]:
    """Return the columns of the sums for each name; those by class have K columns, `gap` one for each bin.

    Those of the measures with these keys come last.
    """
    by_class = K <= MOST_CLASSES
    widths = [(name, 1) for name in PLAIN] + [("evidence", K)]
    widths += [(name, K) for name in BY_CLASS_ALONE] if by_class else []
    widths += [(name, 1) for name in DRIFT]
    if truth:
        widths += [(name, 1) for name in WITH_TRUTH]
        widths += [(name, K) for name in BY_TRUE_CLASS] if by_class else []
        widths += [("calibrated", 1), ("gap", BINS)]
    widths += [(name, 1) for key in measured for name in of_measure(key)]
    ends = np.cumsum([width for _, width in widths])
    slices = {name: slice(int(end) - width, int(end)) for (name, width), end in zip(widths, ends, strict=True)}
    return MappingProxyType(slices)


class FirstColumns(NamedTuple):
    """The first column of each sum over observations, for compiled loops; -1 where the sums have none of that name."""

    voxels: int
    psa: int
    observations: int
    agreeing: int
    own: int
    twice: int
    twice_agreeing: int
    recurrent: int
    vss: int
    entropy: int
    evidence: int
    class_apart: int
    class_own: int
    known: int
    right: int
    observed: int
    observed_right: int
    consistent: int
    consistent_wrong: int
    class_known: int
    class_right: int
    class_predicted: int

    @classmethod
    def of(cls, K: int, *, truth: bool) -> FirstColumns:
        """Return those of a layout."""
        columns = layout(K, truth=truth)
        return cls(*(columns[name].start if name in columns else -1 for name in cls._fields))


def width(K: int, *, truth: bool, measured: tuple[str, ...] = ()) -> int:
    """Return how many columns there are."""
    return max(int(part.stop) for part in layout(K, truth=truth, measured=measured).values())


def column_names(K: int, *, truth: bool, measured: tuple[str, ...] = ()) -> list[str]:
    """Return the names of the columns in a file."""
    return [
        f"{name}_{k}" if own.stop - own.start > 1 else name
        for name, own in layout(K, truth=truth, measured=measured).items()
        for k in range(own.stop - own.start)
    ]


# --- Numbers of right and wrong ---------------------------------------------------------------------------------------


def iou_of(sums: Float64) -> Float64:
    """Return intersection over union (...,) of a class from the right, a count, the true and the predicted."""
    right, _, true, predicted = np.moveaxis(sums, -1, 0)
    union = true + predicted - right
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio: Float64 = np.where(union.real > 0, right / union, np.nan)
    return ratio


def miou_of(sums: Float64) -> Float64:
    """Return its mean (...,) over the classes that are true or predicted anywhere.

    The sums are a count twice, then the same three.
    """
    right, true, predicted = np.split(sums[..., 2:], 3, axis=-1)
    union = true + predicted - right
    there = union.real > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        mean: Float64 = np.where(there, right / np.where(there, union, 1), 0).sum(axis=-1) / there.sum(axis=-1)
    return mean


def ece_of(sums: Float64) -> Float64:
    """Return expected calibration error (...,) from a count twice, and right less confidence in each bin."""
    gap = sums[..., 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        error: Float64 = (np.sign(gap.real) * gap).sum(axis=-1) / sums[..., 1]
    return error


# --- Clusters ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ClusterIndex:
    """The cube of space and the group of frames of rows (m,), some of which belong to no frame.

    Attributes:
        cubes: (G, 3) sorted, of an edge in metres; row (m,) the cube of each row.
        frames: (F,) the groups of frames, sorted, of so many each on average (per_group, 0 where they are unknown).
        known: (r,) the rows that belong to a group, column (r,) that group.
    """

    cubes: Int64
    row: Int64
    frames: Int64
    known: Int64
    column: Int64
    edge: float
    per_group: float

    @classmethod
    def of(
        cls, cell: npt.NDArray[np.integer], frame: npt.NDArray[np.integer] | None, edge: float, per_group: float = 0
    ) -> ClusterIndex:
        """Index rows by cube (m, 3) and group of frames (m,), -1 where unknown; without frames all are of one."""
        cubes, row = distinct_rows(cell)
        if frame is None:
            return cls(cubes, row, np.array([-1]), np.arange(len(row)), np.zeros(len(row), np.int64), edge, 0)
        known = np.flatnonzero((frame >= 0) | (per_group == 0))
        frames, column = np.unique(frame[known].astype(np.int64), return_inverse=True)
        return cls(cubes, row, frames, known, column, edge, per_group)

    def by_cube(self, values: Float64) -> Float64:
        """Return the sums (G,) of values (m,)."""
        return np.bincount(self.row, weights=values, minlength=len(self.cubes)).astype(np.float64, copy=False)

    def by_both(self, values: Float64) -> Float64:
        """Return the sums (G, F) of values (m,)."""
        shape = len(self.cubes), len(self.frames)
        cell = self.row[self.known] * shape[1] + self.column
        sums: Float64 = np.bincount(cell, weights=values[self.known], minlength=shape[0] * shape[1]).astype(np.float64)
        return sums.reshape(shape)


def distinct_rows(rows: npt.NDArray[np.integer]) -> tuple[Int64, Int64]:
    """Return each row of whole numbers (n, C) once, ascending, and which of them each is: np.unique by one number."""
    low = rows.min(axis=0, initial=0).astype(np.int64)
    size = [int(n) for n in rows.max(axis=0, initial=0) - low + 1]
    if math.prod(size) >= 2**63:
        distinct, of = np.unique(rows, axis=0, return_inverse=True)
        return distinct.astype(np.int64), of.ravel()
    key = np.zeros(len(rows), np.int64)
    for column, least, many in zip(rows.T, low, size, strict=True):
        key = key * many + (column - least)
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    return rows[first].astype(np.int64), of


Statistic = Callable[[Float64], Float64]
Scale = Literal["share", "agreement", "plain"]

SCHEMA = 5
WITHOUT_CELLS = 2, 3
"""Versions of files whose samples had no cells: only the sums of their maps are read."""
MOST_CELLS, MOST_GROUPS = 256, 64
"""Most cubes of space and groups of frames that are kept apart."""

MOST_SUMS = 2**24
"""Most numbers in the sums: with thousands of classes fewer groups of frames are kept apart."""


def most_groups(K: int) -> int:
    """Return how many groups of frames are kept apart with K classes."""
    return max(1, min(MOST_GROUPS, MOST_SUMS // (MOST_CELLS * K)))


@dataclass(frozen=True, eq=False)
class ClusterSums:
    """Sums over the observations in voxels with OP >= 2, a row for each cube of space and group of frames.

    Attributes:
        cell: (m, 3) int32 cube: floor(voxel centre / edge), so that the cubes of all maps of a scene are the
            same.
        frame: (m,) int32 group: frame index // step; -1 where the frames are unknown, without a log, and
            for sums that belong to none (`WITHOUT_FRAMES`).
        columns: (m, C) float64, see `layout`. A location counts 1 / T for each of its T frames in `voxels`, 1 in
            `observations`; its pairwise agreement is shared out among them in `psa` and `agreeing`.
        edge: Metres, a power of 2; that of cells is their own, so that alpha and its interval are the same whatever the
            voxels of the map.
        step: Frames of a group, a power of 2; 0 where they are unknown.
        fused: Number of frames that they come from.
        truth: True if sums of ground truth are included.
        measured: Keys of the measures of the register that have sums over the voxels.
        fine, coarse: The same of sampled cells, which are units instead of voxels and views instead of frames, and of
            cells twice as wide, where there are `CellObservations`.
    """

    cell: Int32
    frame: Int32
    columns: Float64
    edge: float
    step: int
    voxel_size: float
    K: int
    classes: tuple[str, ...] = ()
    truth: bool = False
    fused: int = 0
    measured: tuple[str, ...] = ()
    fine: ClusterSums | None = None
    coarse: ClusterSums | None = None

    def __getitem__(self, name: str) -> Float64:
        """Return sums (m, 1), or (m, K) by class, of that name."""
        return self.columns[:, self.layout[name]]

    @property
    def layout(self) -> Mapping[str, slice]:
        """The columns for each name."""
        return layout(self.K, truth=self.truth, measured=self.measured)

    def of(self, names: tuple[str, ...]) -> Float64:
        """Return sums (m, C) of several names side by side."""
        return np.concatenate([self[name] for name in names], axis=1)

    @functools.cached_property
    def index(self) -> ClusterIndex:
        """The cube and the group of frames of each row."""
        groups = len(np.unique(self.frame[self.frame >= 0]))
        per_group = self.fused / groups if self.fused and groups and self.step else self.step
        return ClusterIndex.of(self.cell, self.frame, self.edge, per_group)

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
        """Return the sums of larger cubes, or groups of frames; step 0 forgets those of the map, not of its cells.

        Cubes of the cells are then at least as large as those of the map.
        """
        cells = (own and own.coarsened(max(edge, own.edge), own.step) for own in (self.fine, self.coarse))
        fine, coarse = cells
        return dataclasses.replace(self._map_coarsened(edge, step), fine=fine, coarse=coarse)

    def _map_coarsened(self, edge: float, step: int) -> ClusterSums:
        """Return the same, with the sums of cells as they are."""
        cell = _joined(self.cell, edge / self.edge)
        known = step and self.step
        frame = _joined(self.frame, step // self.step) if known else np.full(len(cell), -1)
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
            step=step if known else 0,
        )

    def without_truth(self) -> ClusterSums:
        """Return the sums without those of ground truth."""
        names = layout(self.K, truth=False, measured=self.measured)
        return dataclasses.replace(self, columns=self.of(tuple(names)), truth=False)

    def save(self, path: str | Path, *, single: bool = False) -> None:
        """Write Parquet, atomically; in single precision, which takes half the bytes and keeps seven digits."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        parts = [part for part in (self, self.fine, self.coarse) if part is not None]
        about = {name: getattr(self, name) for name in ("K", "classes", "truth")}
        about |= {name: [getattr(part, name) for part in parts] for name in ("edge", "step", "voxel_size", "fused")}
        lengths = [len(part.frame) for part in parts]
        cell, frame = np.concatenate([part.cell for part in parts]), np.concatenate([part.frame for part in parts])
        columns = np.zeros((sum(lengths), self.columns.shape[1]))
        for part, rows in zip(parts, np.split(np.arange(len(columns)), np.cumsum(lengths)[:-1]), strict=True):
            columns[rows, : part.columns.shape[1]] = part.columns
        names = column_names(self.K, truth=self.truth, measured=self.measured)
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
        """Read a file that `save` wrote; sums that it lacks are NaN, and those of other names are left out.

        Raises:
            DataError: If the file is missing, damaged or of another kind.
        """
        with parquet.reading(path, "a file of cluster sums"):
            with parquet.opened(path) as file:
                content = file.read()
            about = parse_json((content.schema.metadata or {})[b"semstab"])
            kind, version = about.pop("kind"), about.pop("schema")
            old = (kind, version) in (("InfluenceSums", each) for each in WITHOUT_CELLS)
            if not old and (kind, version) != ("ClusterSums", SCHEMA):
                raise DataError("it is of another kind or version")
            if old:
                about |= {name: [about.get(name, 0)] for name in ("edge", "step", "voxel_size", "fused")}
            meta = from_json(SumsMeta, about, path)
            part, *keys = (_key(arrow.values_of(content.column(name)), name) for name in KEYS)
            names = [earlier.SUMS.get(name, name) for name in content.column_names] if old else content.column_names
            if len(names) < meta.K:
                raise DataError(f"{len(names) - len(KEYS)} columns of sums for {meta.K} classes")
            stored = dict(zip(names, content.columns, strict=True))
            measured = tuple(own.key for own in summed() if stored.keys() >= {*of_measure(own.key)})
            columns = np.full((len(content), width(meta.K, truth=meta.truth, measured=measured)), np.nan)
            for k, name in enumerate(column_names(meta.K, truth=meta.truth, measured=measured)):
                if name in stored:
                    columns[:, k] = arrow.values_of(stored[name])
            if np.any(np.abs(columns) > LARGEST**2):
                raise DataError("a sum is larger than any map can have")
            if not all(0 <= frames <= LARGEST for frames in (*meta.step, *meta.fused)):
                raise DataError("a number of frames is one that no map can have")
            parts: list[ClusterSums] = []
            for number, (edge, step, voxel_size, fused) in enumerate(
                zip(meta.edge, meta.step, meta.voxel_size, meta.fused, strict=True)
            ):
                own, truth, measures_of = part == number, meta.truth and not number, () if number else measured
                sums = columns[own, : width(meta.K, truth=truth, measured=measures_of)]
                cell, frame = np.stack([key[own] for key in keys[:3]], axis=1), keys[3][own]
                where = cell.astype(np.int32), frame.astype(np.int32), sums, edge, step
                parts.append(cls(*where, voxel_size, meta.K, meta.classes, truth, fused, measures_of))
        whole, *cells = parts
        return dataclasses.replace(whole, fine=cells[0], coarse=cells[1]) if cells else whole


KEYS = ("part", "ix", "iy", "iz", "frame")
"""The columns of the file before the sums; part 0 is the map, 1 the fine cells, 2 the coarse ones."""


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
        parts = {len(each) for each in (self.edge, self.step, self.voxel_size, self.fused)}
        if not (parts <= {1} or parts <= {3}):
            raise DataError("sums of other parts than a map, fine and coarse cells")
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
    """Return the larger cubes, or groups of frames, that join so many of these; -1 of frames stays."""
    wide: Int64 = index.astype(np.int64) // round(min(times, 2.0**40))
    return wide


def _key(values: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
    """Return a column of whole numbers that fit; raises DataError where they do not."""
    if values.dtype.kind not in "iu" or not np.array_equal(values, values.astype(np.int32)):
        raise DataError(f"a number of column '{name}' is out of range")
    return values


def aligned(*parts: ClusterSums) -> tuple[ClusterSums, ...]:
    """Return the sums at the finest cubes and groups of frames that all of them have, those of cells alike.

    Raises:
        DataError: If they have different columns.
    """
    if len({(part.K, part.classes, part.truth) for part in parts}) > 1:
        raise DataError("the sums do not fit together: their maps differ in classes, or only some have ground truth")
    edge, steps = max(part.edge for part in parts), [part.step for part in parts]
    step = max(steps) if all(steps) else 0
    same = [part if (part.edge, part.step) == (edge, step) else part._map_coarsened(edge, step) for part in parts]
    fine, coarse = [part.fine for part in same if part.fine], [part.coarse for part in same if part.coarse]
    if len(fine) < len(same) or len(coarse) < len(same):
        return tuple(same)
    cells = zip(same, aligned(*fine), aligned(*coarse), strict=True)
    return tuple(dataclasses.replace(part, fine=one, coarse=two) for part, one, two in cells)


# --- Numbers that follow from the sums --------------------------------------------------------------------------------


Part = Literal["map", "fine", "coarse"]


@dataclass(frozen=True)
class Functional:
    """A number that is a smooth function of sums over a map.

    The second sum counts the terms of the first.

    Attributes:
        names: Names of the sums.
        of: The number (...,) from these sums (..., C).
        low, high: Its range.
        scale: Scale of its interval: a 'share' or mean of numbers from 0 to 1, an 'agreement', at most 1, or 'plain'.
        parts: The parts that its sums come from, each with its weight: a map, or sampled cells.
        pairs: The first sum is of pairwise agreement; at a location that two frames saw, neither frame has it for
            itself alone.
        by_location: What a location adds is no frame's more than another's, so that frames do not show how much the
            number varies between flights: its intervals are for these frames (docs/validity.md).
    """

    names: tuple[str, ...]
    of: Statistic
    low: float = 0.0
    high: float = 1.0
    scale: Scale = "share"
    pairs: bool = False
    parts: tuple[tuple[Part, float], ...] = (("map", 1.0),)
    by_location: bool = False


CELLS: tuple[tuple[Part, float], ...] = (("fine", 2.0), ("coarse", -1.0))
"""2 alpha(h) - alpha(2 h): alpha falls with the size of cells, to first order linearly, as they mix more surfaces."""


def class_alpha_of(sums: Float64) -> Float64:
    """Return alpha (...,) of a class against all others, from sums apart, observations, evidence, own squares."""
    apart, n, total, squares = np.moveaxis(sums, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = 2 * ((n - 1) * total - total**2 + squares) / (n * (n - 1))
        value: Float64 = 1 - (apart / n) / np.where(expected.real > ONE_HOT, expected, np.nan)
    return value


ALPHA_SUMS = ("agreeing", "observations", "own", "evidence")
CLASS_SUMS = ("class_apart", "observations", "evidence", "class_own")

FUNCTIONALS: Mapping[str, Functional] = {
    "psa": Functional(("psa", "voxels"), ratio_of, pairs=True),
    "alpha": Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=True, parts=CELLS),
    "voxel_alpha": Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=True),
    "vss": Functional(("vss", "recurrent"), ratio_of),
    "entropy": Functional(("entropy", "voxels"), ratio_of, by_location=True),
    "accuracy": Functional(("right", "known"), ratio_of),
    "observation_accuracy": Functional(("observed_right", "observed"), ratio_of),
    "wrong_of_consistent": Functional(("consistent_wrong", "consistent"), ratio_of, by_location=True),
    "sbd_excess": Functional(("sbd_excess", "sbd_known"), ratio_of, -1.0, 1.0, "plain"),
    "miou": Functional(("known", "known", "class_right", "class_known", "class_predicted"), miou_of, scale="plain"),
    "ece": Functional(("calibrated", "calibrated", "gap"), ece_of, scale="plain"),
}
"""Numbers by key: alpha, of cells that two views saw or more; PSA, Krippendorff's alpha of voxels and entropy at
OP >= 2, VSS at OP >= 3, SBD less that in random order where that is known; with ground truth the accuracy of the fused
labels at OP >= 2 and of single observations, the wrong among the consistent locations at OP >= 3, mean intersection
over union and expected calibration error at OP >= 2."""

BY_CLASS: Mapping[str, Functional] = {
    "alpha": Functional(CLASS_SUMS, class_alpha_of, -1.0, 1.0, "agreement", parts=CELLS),
    "voxel_alpha": Functional(CLASS_SUMS, class_alpha_of, -1.0, 1.0, "agreement"),
    "accuracy": Functional(("class_right", "class_known"), ratio_of),
    "precision": Functional(("class_right", "class_predicted"), ratio_of),
    "iou": Functional(("class_right", "known", "class_known", "class_predicted"), iou_of),
}
"""Numbers of one class by key: alphas against all others, accuracy where it is the true one (recall) and where it is
predicted (precision), and intersection over union."""


def summed() -> tuple[Measure, ...]:
    """Return the measures of the register that have sums over the voxels; others have their own over observations."""
    return tuple(measure for measure in measures() if measure.key not in FUNCTIONALS)


def mean_over_voxels(measure: Measure) -> Functional:
    """Return the mean of a measure of the register over the voxels with OP >= 2 where it is defined."""
    scale: Scale = "share" if measure.largest == 1 else "plain"
    return Functional(of_measure(measure.key), ratio_of, 0.0, measure.largest, scale, by_location=True)


def chance_of(cells: ClusterSums) -> float:
    """Return the probability that two observations from anywhere, of different views, agree; NaN for fewer than two."""
    evidence, n = cells["evidence"].sum(axis=0), float(cells["observations"].sum())
    return float((evidence**2).sum() - cells["own"].sum()) / (n * (n - 1)) if n > 1 else math.nan


def of_space_alone(key: str, k: int | None = None) -> bool:
    """Return whether frames do not show how much a number varies, so that its intervals are for these frames."""
    number = functional(key, k)
    return number.by_location or set(number.names) <= set(WITHOUT_FRAMES)


def functional(key: str, k: int | None = None) -> Functional:
    """Return the number that a key stands for: of all classes, or of class k."""
    if k is not None:
        return BY_CLASS[key]
    return FUNCTIONALS[key] if key in FUNCTIONALS else mean_over_voxels({own.key: own for own in summed()}[key])


def parts_of(sums: ClusterSums, number: Functional) -> tuple[tuple[ClusterSums, float], ...]:
    """Return the sums that a number is of, each with its weight; none where they are missing."""
    of = {"map": sums, "fine": sums.fine, "coarse": sums.coarse}
    there = [(part, weight) for name, weight in number.parts if (part := of[name]) is not None]
    known = all(set(number.names) <= set(part.layout) for part, _ in there)
    return tuple(there) if known and len(there) == len(number.parts) else ()


def columns_of(part: ClusterSums, key: str, k: int | None = None) -> Float64:
    """Return the sums (m, C) of a part that a number is of."""
    own = [part[name] for name in functional(key, k).names]
    if k is not None:
        own = [columns[:, min(k, columns.shape[1] - 1)][:, None] for columns in own]
    return np.concatenate(own, axis=1)


def value(sums: ClusterSums, key: str, k: int | None = None) -> float:
    """Return the number; NaN where undefined."""
    number = functional(key, k)
    parts = parts_of(sums, number)
    own = [weight * float(number.of(columns_of(part, key, k).sum(axis=0))) for part, weight in parts]
    return sum(own) if own else math.nan


def frames_of(sums: ClusterSums, key: str, k: int | None = None) -> int:
    """Return how many frames, or views, a number is of, about; 0 where they are unknown."""
    parts = parts_of(sums, functional(key, k))
    return parts[0][0].frame_count if parts else 0


def cubes_of(
    index: tuple[Int32, Int32, Int32], voxel_size: float, edge: float | None = None, some: Mask | None = None
) -> tuple[Int32, Int32, float]:
    """Return the cubes (G, 3) that hold voxels of index columns (n,), the cube (n,) of each voxel, and their edge.

    A cube is floor(voxel centre / edge). Only `some` (n,) of the voxels count, the others are in -1. The edge, unless
    it is given, is the smallest power of 2 metres, no smaller than a voxel, that leaves at most MOST_CELLS cubes.
    """
    rows = np.arange(len(index[0])) if some is None else np.flatnonzero(some)
    doubled = edge is None
    edge = 2.0 ** math.ceil(math.log2(voxel_size) - 1e-9) if edge is None else edge
    scale = voxel_size / edge
    cell = np.stack([np.floor((axis[rows] + 0.5) * scale) for axis in index], axis=1).astype(np.int64)
    cubes, number = distinct_rows(cell)
    while doubled and len(cubes) > MOST_CELLS:
        cubes, joined = distinct_rows(cubes // 2)
        number, edge = joined[number], 2 * edge
    of = np.full(len(index[0]), -1, np.int32)
    of[rows] = number
    return cubes.astype(np.int32), of, edge
