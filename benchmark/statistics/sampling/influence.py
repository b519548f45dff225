"""What each frame contributed to each cube of space: sums from which values, intervals and differences follow.

They add up over parts of a map, and are a small file: comparisons and gates need no voxels.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.core import arrays as arrow
from semstab.core.files import atomic_path, parse_json
from semstab.core.json_form import from_json
from semstab.core.types import Float64, Int32, Int64
from semstab.errors import DataError, one_line
from semstab.statistics.agreement import ONE_HOT, alpha_of, between_of, class_of, ratio_of
from semstab.statistics.ranks import distinct_rows
from semstab.statistics.sampling.layout import OF_PLACES, ece_of, iou_of, layout, miou_of, width
from semstab.statistics.sampling.where import Where

Statistic = Callable[[Float64], Float64]
Scale = Literal["share", "agreement", "plain"]

SCHEMA = 2
MOST_CELLS, MOST_GROUPS = 256, 64
"""Cubes of space and groups of frames that are kept apart, at most."""

MOST_SUMS = 2**24
"""Numbers in the sums, at most: of thousands of classes fewer groups of frames are kept apart."""


EDGES, MOST_STEP = (2.0**-30, 2.0**62), 2**30
"""Metres that the edge of a cube may have, and how many frames may be in a group."""

LARGEST_SUM = 1e18
"""No map has so many observations."""


def most_groups(K: int) -> int:
    """Of frames that are kept apart with K classes."""
    return max(1, min(MOST_GROUPS, MOST_SUMS // (MOST_CELLS * K)))


@dataclass(frozen=True, eq=False)
class InfluenceSums:
    """Sums over the observations in voxels with OP >= 2, a row for each cube of space and group of frames.

    cell     (m, 3) int32 which cube: floor(voxel centre / edge), so that the cubes of all maps of a scene are the same
    frame    (m,) int32 which group: frame index // step; -1 where the frames are not known, for want of a log, and for
             sums that belong to none (`OF_PLACES`)
    columns  (m, C) float64, see `layout`. A place counts 1 / T for each of its T frames in `voxels`, 1 in
             `observations`; its pairwise agreement is shared out among them in `psa` and `agreeing`
    edge     metres, a power of 2
    step     frames of a group, a power of 2; 0 where they are not known
    truth    whether ground truth is in it
    seen     the same of the sampled voxels alone, where there is an `ObservationSample`; limit of what
             they would be had their labels not depended on the view, in the same rows
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
    seen: InfluenceSums | None = None
    limit: InfluenceSums | None = None

    def __getitem__(self, name: str) -> Float64:
        """Sums (m, 1), or (m, K) by class, of that name."""
        return self.columns[:, layout(self.K, truth=self.truth)[name]]

    def of(self, names: tuple[str, ...]) -> Float64:
        """Sums (m, C) of several names side by side."""
        return np.concatenate([self[name] for name in names], axis=1)

    @functools.cached_property
    def where(self) -> Where:
        """Which cube and which group of frames each row is of."""
        return Where.of(self.cell, self.frame, self.edge, self.step)

    @property
    def frames(self) -> int:
        """How many groups of frames there are; 0 where they are not known."""
        return len(self.where.frames) if self.step else 0

    @property
    def cells(self) -> int:
        """How many cubes hold a voxel that was seen twice."""
        return len(self.where.places)

    def coarsened(self, edge: float, step: int) -> InfluenceSums:
        """With larger cubes, or groups of frames; step 0 forgets the frames."""
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
            seen=None if self.seen is None else self.seen.coarsened(edge, step),
            limit=None if self.limit is None else self.limit.coarsened(edge, step),
        )

    def without_truth(self) -> InfluenceSums:
        """Without what is right and wrong."""
        columns = self.columns[:, : width(self.K, truth=False)]
        return dataclasses.replace(self, columns=columns, truth=False)

    def bounded(self) -> InfluenceSums:
        """With at most MOST_CELLS cubes and `most_groups`."""
        edge, step = self.edge, self.step
        while len(np.unique(_joined(self.cell, edge / self.edge), axis=0)) > MOST_CELLS:
            edge *= 2
        known = self.frame[self.frame >= 0]
        while step and len(np.unique(_joined(known, step // self.step))) > most_groups(self.K):
            step *= 2
        return self if (edge, step) == (self.edge, self.step) else self.coarsened(edge, step)

    def save(self, path: str | Path) -> None:
        """Write Parquet, atomically."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        parts = [part for part in (self, self.seen, self.limit) if part is not None]
        about = {name: getattr(self, name) for name in ("edge", "step", "voxel_size", "K", "classes", "truth")}
        lengths = [len(part.frame) for part in parts]
        cell, frame = np.concatenate([part.cell for part in parts]), np.concatenate([part.frame for part in parts])
        columns = np.zeros((sum(lengths), self.columns.shape[1]))
        for part, rows in zip(parts, np.split(np.arange(len(columns)), np.cumsum(lengths)[:-1]), strict=True):
            columns[rows, : part.columns.shape[1]] = part.columns
        names = [
            f"{name}_{k}" if own.stop - own.start > 1 else name
            for name, own in layout(self.K, truth=self.truth).items()
            for k in range(own.stop - own.start)
        ]
        arrays = [np.repeat(np.arange(len(parts)), lengths), *cell.T, frame, *columns.T]
        content = pa.table({name: arrow.column(array) for name, array in zip([*KEYS, *names], arrays, strict=True)})
        text = json.dumps({"schema": SCHEMA, "kind": "InfluenceSums", **about})
        with atomic_path(path) as temporary:
            pq.write_table(content.replace_schema_metadata({"semstab": text}), temporary, compression="zstd")

    @classmethod
    def load(cls, path: str | Path) -> InfluenceSums:
        """Read what `save` wrote. Raises DataError where the file is missing, damaged or of another kind."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            with pq.ParquetFile(path) as file:  # pq.read_table imports pandas
                content = file.read()
            about = parse_json((content.schema.metadata or {})[b"semstab"])
            if (about.pop("kind"), about.pop("schema")) != ("InfluenceSums", SCHEMA):
                raise DataError("of another kind or version")
            about = dataclasses.asdict(from_json(About, about, path))
            part, *keys = (_key(arrow.values_of(content.column(name)), name) for name in KEYS)
            columns = np.stack([*map(arrow.values_of, content.columns[len(KEYS) :])], axis=1)
            if columns.shape[1] != width(about["K"], truth=about["truth"]):
                raise DataError(f"{columns.shape[1]} columns of sums for {about['K']} classes")
            if np.any(np.abs(columns) > LARGEST_SUM):
                raise DataError("a sum is larger than a map can have it")
            found: list[InfluenceSums | None] = []
            for number in range(3):
                own = part == number
                cell, frame = np.stack([key[own] for key in keys[:3]], axis=1), keys[3][own]
                some = about | ({"truth": False} if number else {})
                sums = columns[own, : width(about["K"], truth=some["truth"])].astype(np.float64)
                made = cls(cell.astype(np.int32), frame.astype(np.int32), sums, **some)
                found.append(made if own.any() or not number else None)
            whole, seen, limit = found
            if seen is not None and (limit is None or not _same_rows(seen, limit)):
                raise DataError("what was seen of the sample and its limit are of other rows")
        except (OSError, LookupError, TypeError, ValueError, OverflowError, pa.ArrowException) as error:
            raise DataError(f"{path}: not a file of influence sums ({one_line(error)})") from error
        assert whole is not None
        return dataclasses.replace(whole, seen=seen, limit=limit)


KEYS = ("part", "ix", "iy", "iz", "frame")
"""The columns of the file before the sums; part 0 is the map, 1 what was seen of the sample, 2 its limit."""


@dataclass(frozen=True)
class About:
    """What the file says of its sums; see `InfluenceSums`."""

    edge: float
    step: int
    voxel_size: float
    K: int
    classes: tuple[str, ...]
    truth: bool

    def __post_init__(self) -> None:
        if not (0 < self.voxel_size < math.inf and self.K > 0 and len(self.classes) in (0, self.K)):
            raise DataError(f"{self.K} classes, {len(self.classes)} names, voxels of {self.voxel_size:g} m")
        if not (EDGES[0] <= self.edge <= EDGES[1] and math.frexp(self.edge)[0] == 0.5):
            raise DataError(f"cubes of {self.edge:g} m, which is no power of 2 from {EDGES[0]:g} to {EDGES[1]:g}")
        if not (0 <= self.step <= MOST_STEP and self.step & (self.step - 1) == 0):
            raise DataError(f"groups of {self.step} frames, which is no power of 2 up to {MOST_STEP}")


def _joined(index: Int32, times: float) -> Int64:
    """Which cubes, or groups of frames, these are where so many are one; -1 of frames stays."""
    wide: Int64 = index.astype(np.int64) // round(min(times, 2.0**40))
    return wide


def _key(values: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
    """A column of whole numbers that fit; raises DataError where it is not."""
    if values.dtype.kind not in "iu" or not np.array_equal(values, values.astype(np.int32)):
        raise DataError(f"a number of column '{name}' is out of range")
    return values


def _same_rows(one: InfluenceSums, other: InfluenceSums) -> bool:
    return np.array_equal(one.cell, other.cell) and np.array_equal(one.frame, other.frame)


def merged(*parts: InfluenceSums) -> InfluenceSums:
    """The sums of a map from those of its parts. Raises DataError where they differ in classes or voxel size."""
    parts = aligned(*parts)
    together = dataclasses.replace(
        parts[0],
        cell=np.concatenate([part.cell for part in parts]),
        frame=np.concatenate([part.frame for part in parts]),
        columns=np.concatenate([part.columns for part in parts]),
        seen=_merged([part.seen for part in parts]),
        limit=_merged([part.limit for part in parts]),
    )
    return _known(together.coarsened(together.edge, together.step).bounded())


def _known(sums: InfluenceSums) -> InfluenceSums:
    """Where one part does not tell what frames have to do with a class, all of them do not."""
    by_class = [own for name, own in layout(sums.K, truth=sums.truth).items() if name in ("class_own", "class_apart")]
    if not any(np.isnan(sums.columns[:, own]).any() for own in by_class):
        return sums
    columns = sums.columns.copy()
    for own in by_class:
        columns[sums["voxels"][:, 0] != 0, own] = np.nan
    return dataclasses.replace(sums, columns=columns)


def _merged(parts: Sequence[InfluenceSums | None]) -> InfluenceSums | None:
    there = [part for part in parts if part is not None]
    return merged(*there) if len(there) == len(parts) else None


def aligned(*parts: InfluenceSums) -> tuple[InfluenceSums, ...]:
    """The sums at the finest cubes and groups of frames that all of them have.

    Raises DataError where they differ in what their columns are.
    """
    if len({(part.K, part.classes, part.truth) for part in parts}) > 1:
        raise DataError("sums of maps of different classes, or with and without ground truth, do not fit together")
    edge, steps = max(part.edge for part in parts), [part.step for part in parts]
    step = max(steps) if all(steps) else 0
    return tuple(part if (part.edge, part.step) == (edge, step) else part.coarsened(edge, step) for part in parts)


# --- What follows from the sums ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Functional:
    """A number that is a smooth function of sums over a map.

    names      of the sums
    of         the number (...,) from these sums (..., C)
    low, high  its range
    scale      of its interval: a 'share' or mean of numbers from 0 to 1, an 'agreement', at most 1, or 'plain'
    sampled    it is of the sample's sums beside those of its limit
    pairs      the first sum is of pairwise agreement, which of a place that two frames saw neither has for itself alone

    The second sum counts what the first is a sum of.
    """

    names: tuple[str, ...]
    of: Statistic
    low: float = 0.0
    high: float = 1.0
    scale: Scale = "share"
    pairs: bool = False
    sampled: bool = False


def class_alpha_of(sums: Float64) -> Float64:
    """Alpha (...,) of one class against all others, from the sums apart, observations, evidence and own squares."""
    apart, n, total, squares = np.moveaxis(sums, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = 2 * ((n - 1) * total - total**2 + squares) / (n * (n - 1))
        value: Float64 = 1 - (apart / n) / np.where(expected.real > ONE_HOT, expected, np.nan)
    return value


def class_between_of(sums: Float64) -> Float64:
    """The same of alpha between frames, which forgives what is within one."""
    apart, n, total, squares = np.moveaxis(sums, -1, 0)
    return class_of(np.stack([apart - 2 * (total - squares), n, squares, total], axis=-1))


def reached_of(of: Statistic) -> Statistic:
    """The share of its ceiling that a number reaches; NaN where that is no better than chance."""

    def ratio(sums: Float64) -> Float64:
        seen, limit = np.split(sums, 2, axis=-1)
        ceiling = of(limit)
        with np.errstate(invalid="ignore"):  # of complex sums, by which slopes are found
            share: Float64 = of(seen) / np.where(ceiling.real > 0, ceiling, np.nan)
        return share

    return ratio


ALPHA_SUMS = ("agreeing", "observations", "own", "evidence")
CLASS_SUMS = ("class_apart", "observations", "evidence", "class_own")

FUNCTIONALS: Mapping[str, Functional] = {
    "psa": Functional(("psa", "voxels"), ratio_of, pairs=True),
    "alpha": Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=True),
    "alpha_between": Functional(ALPHA_SUMS, between_of, -1.0, 1.0, "agreement", pairs=True),
    "reached": Functional(ALPHA_SUMS, reached_of(between_of), -math.inf, math.inf, "plain", sampled=True),
    "vss": Functional(("vss", "recurrent"), ratio_of),
    "entropy": Functional(("entropy", "voxels"), ratio_of),
    "accuracy": Functional(("right", "known"), ratio_of),
    "look_accuracy": Functional(("looks_right", "looks"), ratio_of),
    "wrong_of_stable": Functional(("stable_wrong", "stable"), ratio_of),
    "sbd_excess": Functional(("sbd_excess", "sbd_known"), ratio_of, -1.0, 1.0, "plain"),
    "miou": Functional(("known", "known", "class_right", "class_known", "class_predicted"), miou_of, scale="plain"),
    "ece": Functional(("judged", "judged", "gap"), ece_of, scale="plain"),
}
"""By key: PSA, both alphas, the share of its ceiling that alpha between frames reaches, and entropy at OP >= 2, VSS at
OP >= 3, SBD less that in random order where that is known; with ground truth the accuracy of the fused labels at
OP >= 2 and of single looks, the wrong among the stable places at OP >= 3, mean intersection over union and expected
calibration error at OP >= 2."""

BY_CLASS: Mapping[str, Functional] = {
    "alpha": Functional(CLASS_SUMS, class_alpha_of, -1.0, 1.0, "agreement"),
    "alpha_between": Functional(CLASS_SUMS, class_between_of, -1.0, 1.0, "agreement"),
    "reached": Functional(CLASS_SUMS, reached_of(class_between_of), -math.inf, math.inf, "plain", sampled=True),
    "accuracy": Functional(("class_right", "class_known"), ratio_of),
    "precision": Functional(("class_right", "class_predicted"), ratio_of),
    "iou": Functional(("class_right", "known", "class_known", "class_predicted"), iou_of),
}
"""Of one class: alphas against all others, accuracy where it is the true one (recall) and where it is predicted
(precision), and intersection over union."""


def of_places_alone(key: str, k: int | None = None) -> bool:
    """Whether a number says nothing of frames, so that its intervals are for this map."""
    return set(functional(key, k).names) <= set(OF_PLACES)


def functional(key: str, k: int | None = None) -> Functional:
    """What a key stands for: of all classes, or of class k."""
    return FUNCTIONALS[key] if k is None else BY_CLASS[key]


def parts_of(sums: InfluenceSums, number: Functional) -> tuple[InfluenceSums, ...]:
    """The sums that a number is of: the map's, or those of the sample and its limit; none where they are not there."""
    parts = (sums.seen, sums.limit) if number.sampled else (sums,)
    there = tuple(part for part in parts if part is not None)
    known = all(set(number.names) <= set(layout(part.K, truth=part.truth)) for part in there)
    return there if known and len(there) == len(parts) else ()


def columns_of(sums: InfluenceSums, key: str, k: int | None = None) -> Float64:
    """The sums (m, C) that a number is of; (0, 0) where they are not there."""
    number = functional(key, k)
    own = [part[name] for part in parts_of(sums, number) for name in number.names]
    if not own:
        return np.zeros((0, 0))
    if k is not None:
        own = [columns[:, min(k, columns.shape[1] - 1)][:, None] for columns in own]
    return np.concatenate(own, axis=1)


def value(sums: InfluenceSums, key: str, k: int | None = None) -> float:
    """The number; NaN where undefined."""
    columns = columns_of(sums, key, k)
    return float(functional(key, k).of(columns.sum(axis=0))) if columns.size else math.nan
