"""Labels that views give spots of the surface: alpha, its intervals and comparisons follow from them."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core import arrays
from semstab.core.files import atomic_path, parse_json
from semstab.core.types import Float32, Float64, Int32, Int64, Mask, UInt16, UInt32
from semstab.data import parquet
from semstab.data.events import Events
from semstab.data.evidence import Evidence
from semstab.data.measures import dominant, mean
from semstab.data.voxels import index_columns
from semstab.errors import DataError
from semstab.statistics.cluster_sums.index import distinct_rows
from semstab.statistics.votes import OF_SPOTS, SpotVotes

# The views from which the frames of a sample were taken.

VIEW = 6
"""Numbers of a view: frame, centre, time stamp, footprint."""


@dataclass(frozen=True, eq=False)
class Views:
    """Distinct views: frames that a camera took from one position count as one, the first of them.

    Attributes:
        frame: (V,) indices of frames.
        centre: (V, 3) camera centres in metres.
        timestamp: (V,) time stamps in seconds, NaN if unknown.
        footprint: (V,) median width of a pixel on the surface that it shows, in metres.
    """

    frame: Int64
    centre: Float64
    timestamp: Float64
    footprint: Float64

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def from_rows(cls, rows: Sequence[Sequence[float]] | Float64) -> Views:
        """Build views from rows (V, 6).

        Raises:
            ValueError: If the rows have another shape, or an index is not a finite number.
        """
        table = np.asarray(rows, np.float64).reshape(len(rows), VIEW)
        if not np.isfinite(table[:, 0]).all():
            raise ValueError("a frame without an index")
        return cls(table[:, 0].astype(np.int64), table[:, 1:4].copy(), table[:, 4].copy(), table[:, 5].copy())

    @classmethod
    def joined(cls, parts: Sequence[Views]) -> Views:
        """Return the views of several parts, one after the other."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))

    def rows(self) -> Float64:
        """Return rows (V, 6), as `of` takes them."""
        time_and_footprint = self.timestamp[:, None], self.footprint[:, None]
        return np.concatenate([self.frame[:, None], self.centre, *time_and_footprint], axis=1)

    def take(self, rows: Int64) -> Views:
        """Return some of the views."""
        return Views(*(column[rows] for column in vars(self).values()))

    def rank(self, frame: npt.NDArray[np.integer]) -> Int64:
        """Return the positions (m,) of views by the indices (m,) of their frames."""
        order = np.argsort(self.frame)
        return np.asarray(order[np.searchsorted(self.frame, frame, sorter=order)], np.int64)


TYPES: Mapping[str, type[np.generic]] = {
    "spot": np.int32, "view": np.int32, "label": np.uint16, "neighbour": np.uint16, "beyond": np.uint16,
    "near": np.float32, "far": np.float32,
}  # fmt: skip
"""Columns of answers."""

COLUMNS = tuple(TYPES)

SCHEMA = 1

PARTS = 64
"""Parts of the spacing in which the place of a spot is told in a log."""


@dataclass(frozen=True, eq=False)
class SpotObservations:
    """Answers of views for spots of the surface: a row (m,) for each spot and frame.

    A spot is a point of the surface; it does not depend on the voxels of a map. The answer of a
    frame is the label of the pixel which the spot falls into. A second and a third answer, of the next two pixels on
    the same surface, tell how agreement falls with the distance of the points that answer: at a border of two classes
    the first one is wrong if the pixel's centre and the spot lie on different sides.

    Attributes:
        spot: (m,) int32 row of `point`.
        view: (m,) int32 row of `views`.
        label: (m,) uint16 class; K for pixels that have no label.
        neighbour, beyond: (m,) uint16 classes of the second and the third answer; the first one if no two pixels to one
            side show the surface.
        near, far: (m,) float32 squared distances of the two pixels' centres from the spot, across the ray, metres^2.
        point: (n, 3) spots in metres.
        drawn: (n,) uint32 hash of the spot's coarse cell; cells below `share` are in the sample.
        views: Distinct views, in order of integration.
        spacing: Distance of spots in metres, a power of 2: a spot stands for its square of surface.
        K: Number of classes.
        share: Sampled share of the coarse cells, times 2^32.
        classes: Names of the classes.
        frames: Number of frames, of which some may share a view.
        distances: (K, K) distances between the classes, symmetric, 0 on the diagonal; None if all are equal.
        votes: How many views see each spot, or see through it; None if that was not asked.
    """

    spot: Int32
    view: Int32
    label: UInt16
    neighbour: UInt16
    beyond: UInt16
    near: Float32
    far: Float32
    point: Float64
    drawn: UInt32
    views: Views
    spacing: float
    K: int
    share: int = 1 << 32
    classes: tuple[str, ...] = ()
    frames: int = 0
    distances: Float64 | None = None
    votes: SpotVotes | None = None

    def __len__(self) -> int:
        return len(self.spot)

    @property
    def cell(self) -> Int64:
        """(n, 3) coarse cell of each spot."""
        return cells_of(self.point, self.spacing)

    def places(self, spots: npt.NDArray[np.integer[Any]]) -> Int64:
        """Return the nearest PARTS-th (n, 3) of the spacing to spots: no two spots have the same one.

        Faces of coarse cells lie halfway between PARTS-ths.
        """
        nearest: Int64 = np.floor(self.point[spots] * (PARTS / self.spacing) + 0.5).astype(np.int64)
        return nearest

    @property
    def distance(self) -> Float64:
        """(m,) metres from the spot to the centre of the view that answers."""
        distance: Float64 = np.linalg.norm(self.point[self.spot] - self.views.centre[self.view], axis=1)
        return distance

    def labelled(self) -> SpotObservations:
        """Return the answers that are a class."""
        return self.only(self.label < self.K)

    def labelled_share(self) -> float:
        """Return the share of the spots seen by two views that have a label in at least half of these views."""
        pairs, of = distinct_rows(np.stack([self.spot, self.view], axis=1))
        answers, labelled = np.bincount(of), np.bincount(of, self.label < self.K)
        _, of = np.unique(pairs[:, 0], return_inverse=True)
        views, with_label = np.bincount(of), np.bincount(of, 2 * labelled >= answers)
        return mean((2 * with_label >= views)[views >= 2].astype(np.float64))

    def without(self, classes: Sequence[int]) -> SpotObservations:
        """Return the answers for spots whose dominant class is not one of these."""
        if not len(classes) or not len(self):
            return self
        log, at = self.observations(), self.of_log()
        left_out = np.zeros(len(self.point), np.bool_)
        left_out[at] = np.isin(dominant(log.table()), classes)
        return self.only(~left_out[self.spot])

    @property
    def moved(self) -> Mask:
        """(m,) answers for spots that moved."""
        if self.votes is None:
            return np.zeros(len(self), np.bool_)
        return np.asarray(self.votes.moved[self.spot], np.bool_)

    def only(self, rows: Any) -> SpotObservations:
        """Return some of the answers."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in COLUMNS}
        return dataclasses.replace(self, **columns)

    def within(self, share: int) -> SpotObservations:
        """Return the answers for the spots of a smaller share of the coarse cells."""
        inside = self.drawn < share
        number = np.cumsum(inside, dtype=np.int32) - 1
        part = self.only(inside[self.spot])
        votes = None if self.votes is None else self.votes.take(inside)
        return dataclasses.replace(
            part, spot=number[part.spot], point=self.point[inside], drawn=self.drawn[inside], share=share, votes=votes
        )

    @classmethod
    def stacked(cls, parts: Sequence[SpotObservations]) -> SpotObservations:
        """Return the answers of several samples of the same spots, with all else from the first."""
        columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS}
        return dataclasses.replace(parts[0], **columns)

    def observations(self) -> Events:
        """Return the log of spots: the class that a view gives each of them, by the first answers."""
        return self._first[0]

    def of_log(self) -> Int64:
        """Return the spot (n,) of each location of that log."""
        return self._by_voxel[1]

    def logs(self) -> tuple[tuple[Events, Float64], ...]:
        """Return the logs of the three answers with (m,) squared distances, metres^2, 0 of the third ones."""
        return self._first, self._second, self._third

    @functools.cached_property
    def _first(self) -> tuple[Events, Float64]:
        return self._log(self.label, self.near)

    @functools.cached_property
    def _second(self) -> tuple[Events, Float64]:
        return self._log(self.neighbour, self.far)

    @functools.cached_property
    def _third(self) -> tuple[Events, Float64]:
        return self._log(self.beyond)

    @functools.cached_property
    def _by_voxel(self) -> tuple[Int64, Int64, Int64, Int64]:
        """(n, 3) indices of the voxels of a log and (n,) their spots; (m,) answers in order, and the voxel of each.

        A spot is a voxel of a PARTS-th of the spacing.
        """
        rows = np.flatnonzero(self.label < self.K)
        spot = self.spot[rows]
        number = np.zeros(len(self.point), np.int64)
        number[spot] = 1
        spots = np.flatnonzero(number)
        index, number[spots] = distinct_rows(self.places(spots))
        at = np.empty(len(index), np.int64)
        at[number[spots]] = spots
        by_view = rows[arrays.stable_order(self.view[rows], len(self.views))]
        in_order = by_view[arrays.stable_order(number[self.spot[by_view]], len(index))]
        return index, at, in_order, number[self.spot[in_order]]

    def _log(self, label: UInt16, square: Float32 | None = None) -> tuple[Events, Float64]:
        """Return a log of these labels, and (m,) squared distances."""
        from semstab.statistics.loops.answers import observe

        index, _, rows, number = self._by_voxel
        view, n = self.view[rows], len(rows)
        first, voxel, starts = np.empty(n, np.int64), np.empty(n, np.int32), np.empty(n + 1, np.int64)
        share, text = np.empty(n), np.empty(n, np.uint16)
        n, m = observe(number, view, label[rows], self.K, first, voxel, starts, text, share)
        first = first[:n]
        log = Events(
            **index_columns(index),
            voxel=voxel[:n],
            frame=self.views.frame.astype(np.int32)[view[first]],
            evidence=Evidence(starts[: n + 1], text[:m], share[:m], self.K),
            pixels=np.ones(n, np.int32),
            voxel_size=self.spacing / PARTS,
            classes=self.classes,
        )
        squares = np.zeros(n) if square is None else square[rows[first]].astype(np.float64)
        return log, squares

    def save(self, path: str | Path) -> None:
        """Write Parquet, atomically: a row for each spot, with lists of its answers."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        order = arrays.stable_order(self.spot, len(self.point))
        ends = np.concatenate([[0], np.cumsum(np.bincount(self.spot, minlength=len(self.point)))]).astype(np.int32)
        columns = dict(zip("xyz", map(arrays.column, self.point.T), strict=True)) | {"drawn": arrays.column(self.drawn)}
        for name in COLUMNS[1:]:
            values = arrays.column(getattr(self, name)[order])
            columns[name] = pa.ListArray.from_arrays(arrays.column(ends), values)
        about: dict[str, Any] = {name: getattr(self, name) for name in ("spacing", "K", "share", "classes", "frames")}
        if self.votes is not None:
            columns |= {name: arrays.column(column) for name, column in self.votes.columns.items()}
            about["votes"] = self.votes.of_views()
        if self.distances is not None:
            about["distances"] = self.distances.tolist()
        content = pa.table(columns)
        text = json.dumps({"schema": SCHEMA, "kind": "SpotObservations", **about, "views": self.views.rows().tolist()})
        packed = {"compression": "zstd", "use_dictionary": False}  # dictionaries take more time, and more space
        with atomic_path(path) as temporary, pq.ParquetWriter(temporary, content.schema, **packed) as file:
            file.write_table(content)
            file.add_key_value_metadata({"semstab": text})  # metadata of a schema would be written twice

    @classmethod
    def load(cls, path: str | Path) -> SpotObservations:
        """Read a file that `save` wrote.

        Raises:
            DataError: If the file is missing, damaged or of another kind.
        """
        import pyarrow as pa

        with parquet.reading(path, "a file of sampled observations"):
            with parquet.opened(path) as file:
                content = file.read()
            about = parse_json((content.schema.metadata or {})[b"semstab"])
            if (about.pop("kind"), about.pop("schema")) != ("SpotObservations", SCHEMA):
                raise DataError("it is of another kind or version; run it again")
            views = Views.from_rows(about.pop("views"))
            about["classes"] = tuple(about["classes"])
            if "distances" in about:
                about["distances"] = np.array(about["distances"], np.float64).reshape(about["K"], about["K"])
            point = np.stack([arrays.values_of(content.column(name)) for name in "xyz"], axis=1)
            lists = {name: content.column(name).combine_chunks() for name in COLUMNS[1:]}
            counts = {
                name: arrays.values_of(pa.chunked_array([values.value_lengths()])) for name, values in lists.items()
            }
            answers = counts["view"].astype(np.int64)
            if not all(np.array_equal(answers, count) for count in counts.values()):
                raise DataError("the lists of a spot's answers have different lengths")
            columns: dict[str, Any] = {
                name: arrays.values_of(pa.chunked_array([values.flatten()])).astype(TYPES[name])
                for name, values in lists.items()
            }
            columns["spot"] = np.repeat(np.arange(len(answers), dtype=np.int32), answers)
            cell_hash = arrays.values_of(content.column("drawn")).astype(np.uint32)
            if "votes" in about:
                counts = {name: arrays.values_of(content.column(name)) for name in OF_SPOTS}
                about["votes"] = SpotVotes.from_columns(counts, about["votes"])
            read = cls(**columns, point=point.astype(np.float64), drawn=cell_hash, views=views, **about)
            read._require_sound()
            return read

    def _require_sound(self) -> None:
        """Raise DataError if a number is one that no sample has."""
        if len(self) and not (self.view.min() >= 0 and self.view.max() < len(self.views)):
            raise DataError("a view that is not there")
        if len(self) and max(self.label.max(), self.neighbour.max(), self.beyond.max()) > self.K:
            raise DataError(f"a label above {self.K}")
        if self.votes is not None and len(self.votes.misplaced) != len(self.views):
            raise DataError("votes of other views")
        if not (np.isfinite(self.point).all() and 0 < self.spacing < np.inf):
            raise DataError("a spot without a place")
        if np.abs(self.point).max(initial=0.0) * PARTS / self.spacing > 2**31:
            raise DataError("a spot that lies too far away")


def cells_of(point: Float64, spacing: float) -> Int64:
    """Return the coarse cells (..., 3) of points (..., 3) for this spacing of spots."""
    from semstab.statistics.loops.cells import EDGE, PHASE

    return np.floor(point / (EDGE * spacing) + PHASE).astype(np.int64)


def numbered_as_one_flight(samples: Sequence[SpotObservations]) -> list[SpotObservations]:
    """Return samples of one flight with its frames numbered as in the first one.

    Programs that give some frames of a flight number them from 0 on. A frame of another number is known by the place
    and the time at which it was taken, if no two views of the first sample have the same ones.
    """
    first, *rest = samples
    number = dict(zip(_taken(first.views), first.views.frame.tolist(), strict=True))
    if len(number) < len(first.views):
        return list(samples)
    same = [first]
    for other in rest:
        keys = _taken(other.views)
        matches = [number.get(key) for key in keys]
        matched_frames = [frame for frame in matches if frame is not None]
        if len(set(matched_frames)) < len(matched_frames) or not matched_frames:
            same.append(other)
            continue
        further = itertools.count(max(number.values(), default=-1) + 1)
        frame = np.array([next(further) if match is None else match for match in matches], np.int64)
        same.append(dataclasses.replace(other, views=dataclasses.replace(other.views, frame=frame)))
    return same


def _taken(views: Views) -> list[tuple[float, ...]]:
    """Return the place and the time of each view; no time if it is unknown."""
    time = np.nan_to_num(views.timestamp, nan=-1.0)
    return [tuple(row) for row in np.column_stack([views.centre.round(6), time]).tolist()]


def same_spots(samples: Sequence[SpotObservations]) -> list[SpotObservations]:
    """Return the answers for the spots that all samples have; spots and views have the same numbers in all samples.

    Samples of the same frames have the same spots. Of other frames of one flight they have other points of the same
    coarse cells: points of one cell are taken for one spot.
    """
    share, spacing = min(sample.share for sample in samples), max(sample.spacing for sample in samples)
    views = Views.joined([sample.views for sample in samples])
    views = views.take(np.sort(np.unique(views.frame, return_index=True)[1]))
    samples = [sample.within(share) for sample in samples]
    cells = [cells_of(sample.point, spacing) for sample in samples]
    distinct, of = distinct_rows(np.concatenate(cells))
    firsts = []
    for cell_numbers in np.split(of, np.cumsum([len(cell) for cell in cells])[:-1]):
        first = np.full(len(distinct), -1, np.int64)
        first[cell_numbers[::-1]] = np.arange(len(cell_numbers))[::-1]
        firsts.append(first)
    common: Mask = np.all([first >= 0 for first in firsts], axis=0)
    same = []
    for sample, first in zip(samples, firsts, strict=True):
        number = np.full(len(sample.point), -1, np.int32)
        number[first[common]] = np.arange(np.count_nonzero(common), dtype=np.int32)
        subset = sample.only(number[sample.spot] >= 0)
        rank = views.rank(sample.views.frame)
        same.append(
            dataclasses.replace(
                subset, spot=number[subset.spot], view=rank[subset.view].astype(np.int32), views=views, spacing=spacing,
                point=samples[0].point[firsts[0][common]], drawn=samples[0].drawn[firsts[0][common]], votes=None,
            )
        )  # fmt: skip
    return same
