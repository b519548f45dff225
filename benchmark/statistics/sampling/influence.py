"""What each frame contributed to each cube of space: sums from which values, intervals and differences follow.

They add up over parts of a map, and are a small file: comparisons and gates need no voxels.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semstab.errors import DataError, one_line
from semstab.runtime.files import atomic_path
from semstab.statistics.agreement import alpha_of, between_of, ratio_of

Float64 = npt.NDArray[np.float64]
Int32 = npt.NDArray[np.int32]
Statistic = Callable[[Float64], Float64]

SCHEMA = 1
MOST_CELLS, MOST_GROUPS = 256, 64
"""Cubes of space and groups of frames that are kept apart, at most."""

MOST_CLASSES = 64
"""Sums by class are kept up to so many classes."""

PLAIN = (
    "voxels", "psa", "observations", "agreeing", "own", "twice", "twice_agreeing", "recurrent", "vss", "entropy",
)  # fmt: skip
WITH_TRUTH = ("known", "right", "looks", "looks_right", "stable", "stable_wrong")


def layout(K: int, *, truth: bool) -> dict[str, slice]:
    """Which columns of the sums each name stands for; those by class have K columns."""
    by_class = ["class_apart", "class_own"] if K <= MOST_CLASSES else []
    known = [*WITH_TRUTH, *(["class_known", "class_right"] if by_class else [])] if truth else []
    widths = [(name, 1) for name in PLAIN] + [(name, K) for name in ["evidence", *by_class]]
    widths += [(name, K if name.startswith("class") else 1) for name in known]
    ends = np.cumsum([width for _, width in widths])
    return {name: slice(int(end) - width, int(end)) for (name, width), end in zip(widths, ends, strict=True)}


@dataclass(frozen=True, eq=False)
class InfluenceSums:
    """Sums over the observations in voxels with OP >= 2, a row for each cube of space and group of frames.

    cell     (m, 3) int32 which cube: floor(voxel centre / edge), so that the cubes of all maps of a scene are the same
    frame    (m,) int32 which group: frame index // step; -1 where the frames are not known, for want of a log
    columns  (m, C) float64, see `layout`. A place counts 1 / T for each of its T frames in `voxels`, 1 in
             `observations`; its pairwise agreement is shared out among them in `psa` and `agreeing`
    edge     metres, a power of 2
    step     frames of a group, a power of 2; 0 where they are not known
    truth    whether ground truth is in it
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

    def __getitem__(self, name: str) -> Float64:
        """Sums (m, 1), or (m, K) by class, of that name."""
        return self.columns[:, layout(self.K, truth=self.truth)[name]]

    def of(self, names: tuple[str, ...]) -> Float64:
        """Sums (m, C) of several names side by side."""
        return np.concatenate([self[name] for name in names], axis=1)

    @property
    def frames(self) -> int:
        """How many groups of frames there are; 0 where they are not known."""
        return len(np.unique(self.frame)) if self.step else 0

    @property
    def cells(self) -> int:
        """How many cubes hold a voxel that was seen twice."""
        return len(np.unique(self.cell, axis=0))

    def coarsened(self, edge: float, step: int) -> InfluenceSums:
        """With larger cubes, or groups of frames; step 0 forgets the frames."""
        cell = np.floor_divide(self.cell, round(edge / self.edge)).astype(np.int32)
        known = step and self.step
        frame = self.frame // (step // self.step) if known else np.full(len(self.frame), -1)
        key = np.concatenate([cell, frame[:, None]], axis=1)
        rows, of = np.unique(key, axis=0, return_inverse=True)
        columns = np.zeros((len(rows), self.columns.shape[1]))
        np.add.at(columns, of.ravel(), self.columns)
        return dataclasses.replace(
            self,
            cell=rows[:, :3].astype(np.int32),
            frame=rows[:, 3].astype(np.int32),
            columns=columns,
            edge=edge,
            step=step if known else 0,
        )

    def bounded(self) -> InfluenceSums:
        """With at most MOST_CELLS cubes and MOST_GROUPS groups."""
        edge, step = self.edge, self.step
        while len(np.unique(self.cell // round(edge / self.edge), axis=0)) > MOST_CELLS:
            edge *= 2
        while step and len(np.unique(self.frame // (step // self.step))) > MOST_GROUPS:
            step *= 2
        return self if (edge, step) == (self.edge, self.step) else self.coarsened(edge, step)

    def save(self, path: str | Path) -> None:
        """Write Parquet, atomically."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        about = {name: getattr(self, name) for name in ("edge", "step", "voxel_size", "K", "classes", "truth")}
        keys = dict(zip(("ix", "iy", "iz"), self.cell.T, strict=True)) | {"frame": self.frame}
        sums = {
            f"{name}_{k}" if columns.stop - columns.start > 1 else name: self.columns[:, columns.start + k]
            for name, columns in layout(self.K, truth=self.truth).items()
            for k in range(columns.stop - columns.start)
        }
        content = pa.table({name: pa.array(np.ascontiguousarray(column)) for name, column in (keys | sums).items()})
        text = json.dumps({"schema": SCHEMA, "kind": "InfluenceSums", **about})
        with atomic_path(path) as temporary:
            pq.write_table(content.replace_schema_metadata({"semstab": text}), temporary, compression="zstd")

    @classmethod
    def load(cls, path: str | Path) -> InfluenceSums:
        """Read what `save` wrote. Raises DataError where the file is missing, damaged or of another kind."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            content = pq.read_table(path)
            about = json.loads((content.schema.metadata or {})[b"semstab"])
            if (about.pop("kind"), about.pop("schema")) != ("InfluenceSums", SCHEMA):
                raise DataError("of another kind or version")
            about["classes"] = tuple(about["classes"])
            columns = [column.to_numpy() for column in content.columns]
            cell, frame = np.stack(columns[:3], axis=1).astype(np.int32), columns[3].astype(np.int32)
            sums = cls(cell, frame, np.stack(columns[4:], axis=1).astype(np.float64), **about)
            if sums.columns.shape[1] != max(part.stop for part in layout(sums.K, truth=sums.truth).values()):
                raise DataError(f"{sums.columns.shape[1]} columns of sums for {sums.K} classes")
        except (OSError, LookupError, TypeError, ValueError, pa.ArrowException, DataError) as error:
            raise DataError(f"{path}: not a file of influence sums ({one_line(error)})") from error
        return sums


def merged(*parts: InfluenceSums) -> InfluenceSums:
    """The sums of a map from those of its parts. Raises DataError where they differ in classes or voxel size."""
    parts = aligned(*parts)
    together = dataclasses.replace(
        parts[0],
        cell=np.concatenate([part.cell for part in parts]),
        frame=np.concatenate([part.frame for part in parts]),
        columns=np.concatenate([part.columns for part in parts]),
    )
    return together.coarsened(together.edge, together.step).bounded()


def aligned(*parts: InfluenceSums) -> tuple[InfluenceSums, ...]:
    """The sums at the finest cubes and groups of frames that all of them have.

    Raises DataError where they differ in what their columns are.
    """
    if len({(part.K, part.classes, part.truth) for part in parts}) > 1:
        raise DataError("sums of maps of different classes, or with and without ground truth, do not fit together")
    edge, steps = max(part.edge for part in parts), [part.step for part in parts]
    return tuple(part.coarsened(edge, max(steps) if all(steps) else 0) for part in parts)


# --- What follows from the sums ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Functional:
    """A number that is a smooth function of sums over a map.

    names      of the sums
    of         the number (...,) from these sums (..., C)
    low, high  its range
    agreement  the first sum is of pairwise agreement, which of a place that two frames saw neither has for itself alone
    """

    names: tuple[str, ...]
    of: Statistic
    low: float = 0.0
    high: float = 1.0
    agreement: bool = False

    def value(self, sums: InfluenceSums) -> float:
        """The number; NaN where undefined."""
        return float(self.of(sums.of(self.names).sum(axis=0)))


def class_alpha_of(sums: Float64) -> Float64:
    """Alpha (...,) of one class against all others, from the sums apart, observations, evidence and own squares."""
    apart, n, total, squares = np.moveaxis(sums, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = 2 * ((n - 1) * total - total**2 + squares) / (n * (n - 1))
        value: Float64 = 1 - (apart / n) / np.where(expected > 1e-9, expected, np.nan)
    return value


FUNCTIONALS: Mapping[str, Functional] = {
    "psa": Functional(("psa", "voxels"), ratio_of, agreement=True),
    "alpha": Functional(("agreeing", "observations", "own", "evidence"), alpha_of, low=-1.0, agreement=True),
    "alpha_between": Functional(("agreeing", "observations", "own", "evidence"), between_of, low=-1.0, agreement=True),
    "vss": Functional(("vss", "recurrent"), ratio_of),
    "entropy": Functional(("entropy", "voxels"), ratio_of),
    "accuracy": Functional(("right", "known"), ratio_of),
    "look_accuracy": Functional(("looks_right", "looks"), ratio_of),
    "wrong_of_stable": Functional(("stable_wrong", "stable"), ratio_of),
}
"""By key: PSA, alpha, and entropy at OP >= 2, VSS at OP >= 3; with ground truth the accuracy of the fused labels at
OP >= 2 and of single looks, and the wrong among the stable places at OP >= 3."""

BY_CLASS: Mapping[str, tuple[str, ...]] = {
    "alpha": ("class_apart", "observations", "evidence", "class_own"),
    "accuracy": ("class_right", "class_known"),
}


def functional(key: str, k: int | None = None) -> Functional:
    """What a key stands for: of all classes, or of class k ('alpha': against all others; 'accuracy': where it is true).

    Of class k, the sums are those that `columns_of` gives for it.
    """
    if k is None:
        return FUNCTIONALS[key]
    return Functional(BY_CLASS[key], class_alpha_of if key == "alpha" else ratio_of, -1.0 if key == "alpha" else 0.0)


def columns_of(sums: InfluenceSums, key: str, k: int | None = None) -> Float64:
    """The sums (m, C) that a functional is of."""
    if k is None:
        return sums.of(FUNCTIONALS[key].names)
    own = [sums[name][:, k if name.startswith(("class", "evidence")) else 0] for name in BY_CLASS[key]]
    return np.stack(own, axis=1)


def defined(sums: InfluenceSums, key: str, k: int | None = None) -> bool:
    """Whether the sums hold what a key is of."""
    names = FUNCTIONALS[key].names if k is None else BY_CLASS[key]
    return set(names) <= set(layout(sums.K, truth=sums.truth))


def value(sums: InfluenceSums, key: str, k: int | None = None) -> float:
    """The number; NaN where undefined."""
    return float(functional(key, k).of(columns_of(sums, key, k).sum(axis=0))) if defined(sums, key, k) else math.nan
