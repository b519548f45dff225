"""From a map and its log to the sums by frame and cube of space, in one pass."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.model.events import Events
from semstab.model.information import by_group
from semstab.model.measures import dominant, entropy, vss
from semstab.model.results import RECURRENT
from semstab.model.statistics import Interval
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import one_hot_where, psa, ratio_of
from semstab.statistics.cluster_sums import (
    BINS,
    MOST_CELLS,
    MOST_CLASSES,
    OF_PLACES,
    ClusterIndex,
    ClusterSums,
    Scale,
    Statistic,
    cubes_of,
    layout,
    most_groups,
    width,
)
from semstab.statistics.intervals import EstimateSpec, confidence_intervals, spec_of_cubes
from semstab.statistics.ranks import SPARSE, distinct, ranked
from semstab.statistics.stability import stability_posterior

# Cubes of space over any set of voxels, and intervals for this map of any statistic of their sums.


@dataclass(frozen=True, eq=False)
class Cubes:
    """The cubes of voxels, and sums over those in each.

    cell  (G, 3) int32 the cubes, sorted
    at    (n,) int32 which of them each voxel is in, -1 for those that are left out
    edge  metres, a power of 2
    """

    cell: Int32
    at: Int32
    edge: float

    @classmethod
    def of(cls, table: VoxelTable, edge: float | None = None, *, where: Mask | None = None) -> Cubes:
        """Of a table, without the voxels for which `where` (n,), OP >= 2 if not given, does not hold.

        There are at most MOST_CELLS cubes, unless their edge is given, in metres.
        """
        some = table.op >= 2 if where is None else where
        return cls(*cubes_of((table.ix, table.iy, table.iz), table.voxel_size, edge, some))

    @classmethod
    def of_log(cls, events: Events, edge: float) -> Cubes:
        """The same of the voxels of a log."""
        again = np.diff(events.bounds) >= 2
        return cls(*cubes_of((events.ix, events.iy, events.iz), events.voxel_size, edge, again))

    def rows(self, rows: Any) -> Cubes:
        """The same cubes, for some of the voxels."""
        return replace(self, at=self.at[rows])

    @property
    def count(self) -> int:
        """How many cubes there are."""
        return len(self.cell)

    def sums(self, columns: Float64) -> Float64:
        """(G, C) over the voxels of each cube of columns (n, C), of what is not NaN."""
        return by_group(self.at, columns.astype(np.float64, copy=False).T, self.count)[0]

    def means(self, values: Mapping[str, npt.NDArray[Any]]) -> dict[str, Float64]:
        """(G, 2) by name: over the voxels of each cube where values (n,) are defined their sum, and how many."""
        both = by_group(self.at, [*values.values()], self.count)
        return {name: np.stack(own, axis=1) for name, *own in zip(values, both[0].T, both[1].T, strict=True)}

    def sums_by_class(self, table: VoxelTable) -> tuple[Float64, Float64]:
        """(G, K) over the voxels of each cube, which are a table's, of their evidence, and of that / OP."""
        from semstab.statistics.loops.rows import add_classes

        by_look, by_place = (np.zeros((self.count, table.K)) for _ in range(2))
        add_classes(self.at, table.evidence.entries, table.op, by_look, by_place)
        return by_look, by_place

    def estimate(
        self,
        columns: Float64,
        statistic: Statistic,
        bounds: tuple[float, float] = (0.0, 1.0),
        scale: Scale | None = None,
    ) -> Interval:
        """The statistic of the sums of the voxels' columns (n, C), the second of which counts, with its interval.

        Where no scale is given, what goes from 0 to 1 is a share.
        """
        return CubeSums(self.cell, self.edge, {"": self.sums(columns)}).estimate("", statistic, bounds, scale)


@dataclass(frozen=True)
class Mean:
    """A statistic of sums (..., C) by name, the second of which counts: a mean, or any other.

    Where no scale is given, what goes from 0 to 1 is a share.
    """

    sums: str
    of: Statistic = ratio_of
    bounds: tuple[float, float] = (0.0, 1.0)
    scale: Scale | None = None

    @property
    def kind(self) -> Scale:
        """The scale of its interval."""
        return self.scale or ("share" if self.bounds == (0.0, 1.0) else "plain")


@dataclass(frozen=True, eq=False)
class CubeSums:
    """Sums by name over the voxels of cubes; those of a map in parts follow from the parts'.

    cell  (G, 3) int32 the cubes, of an edge in metres, a power of 2
    sums  (G, C) of each name
    """

    cell: Int32
    edge: float
    sums: Mapping[str, Float64]

    def __getitem__(self, name: str) -> Float64:
        """Sums (C,) over all cubes."""
        total: Float64 = self.sums[name].sum(axis=0)
        return total

    def __or__(self, further: Mapping[str, Float64]) -> CubeSums:
        return CubeSums(self.cell, self.edge, {**self.sums, **further})

    def estimate(
        self,
        name: str,
        statistic: Statistic,
        bounds: tuple[float, float] = (0.0, 1.0),
        scale: Scale | None = None,
    ) -> Interval:
        """The statistic of sums (..., C), the second of which counts, with its interval; see `Mean`."""
        return self.estimates({name: Mean(name, statistic, bounds, scale)})[name]

    def estimates(self, means: Mapping[str, Mean]) -> dict[str, Interval]:
        """Several of them, together."""
        return dict(zip(means, confidence_intervals(self.asked(means)), strict=True))

    def asked(self, means: Mapping[str, Mean]) -> Iterator[EstimateSpec]:
        """For `answers`."""
        return (self._asked(own) for own in means.values())

    def _asked(self, mean: Mean) -> EstimateSpec:
        return spec_of_cubes(self._where, self.sums[mean.sums], mean.of, mean.kind, mean.bounds)

    @functools.cached_property
    def _where(self) -> ClusterIndex:
        return ClusterIndex.of(self.cell, None, self.edge)

    @classmethod
    def merged(cls, parts: Sequence[CubeSums]) -> CubeSums:
        """The sums of a map from those of its parts, by the cubes of the whole map."""
        edge = max(part.edge for part in parts)
        cells = np.concatenate([part.cell // round(edge / part.edge) for part in parts])
        while len(np.unique(cells, axis=0)) > MOST_CELLS:
            cells, edge = cells // 2, 2 * edge
        distinct, of = np.unique(cells, axis=0, return_inverse=True)
        sums = {name: np.zeros((len(distinct), own.shape[1])) for name, own in parts[0].sums.items()}
        for name, total in sums.items():
            np.add.at(total, of.ravel(), np.concatenate([part.sums[name] for part in parts]))
        return cls(distinct.astype(np.int32), edge, sums)


def cluster_sums_of(
    table: VoxelTable,
    events: Events | None = None,
    true_label: Int64 | None = None,
    *,
    sample: tuple[Events, Events] | None = None,
    sbd_excess: Float64 | None = None,
    edge: float | None = None,
    places: Cubes | None = None,
    stable: Float64 | None = None,
) -> ClusterSums:
    """The sums of a map.

    events      its log; without it, but with a sample, what frames have to do with it is known of the sampled voxels
                only; without either a place counts as a whole, and the frames are not known
    true_label  (n,) the true class of each voxel, -1 where it is not known
    sample      the same observations of sampled voxels, as they were and as they would be with labels that do not
                depend on the view
    sbd_excess  (n,) SBD of each voxel less that in random order, NaN where that is not known
    edge        of the cubes in metres, a power of 2, where several maps are to have the same; else the smallest that
                leaves at most MOST_CELLS
    places, stable  the cubes, and (n,) the probability of `steady`, where they are known already
    """
    places = Cubes.of(table, edge) if places is None else places
    likely = None if true_label is None else np.nan_to_num(stability_posterior(table) if stable is None else stable)
    about = (places, true_label, likely)
    whole = sums_of_table(table, *about) if events is None else sums_of_log(events, *about)
    whole = with_frameless_sums(whole, table, places, true_label, sbd_excess)
    whole = whole.coarsened(whole.edge, whole.step)  # one row for each cube and group of frames, in order
    return whole if sample is None else with_sample(whole, sample, logged=events is not None)


def with_sample(whole: ClusterSums, sample: tuple[Events, Events], *, logged: bool = False) -> ClusterSums:
    """The sums of a map with those of a sample of its voxels, see `influence_sums`; logged: its frames are known."""
    seen, limit = (
        dataclasses.replace(sums_of_log(log, Cubes.of_log(log, whole.edge)), classes=whole.classes) for log in sample
    )
    whole = whole if logged else _with_frames(whole, seen)
    return dataclasses.replace(whole, seen=seen, limit=limit)


def sums_of_table(
    table: VoxelTable, places: Cubes, true_label: Int64 | None = None, likely: Float64 | None = None
) -> ClusterSums:
    """The sums of a table, whose places with OP >= 2 these are: each place counts as a whole, frames are not known.

    likely (n,) is how likely places are stable, where true classes (n,) are known; None leaves that open.
    """
    columns = _sums_of_table(table, places, true_label, np.zeros(len(table)) if likely is None else likely)
    unknown = np.full(places.count, -1, dtype=np.int32)
    truth = true_label is not None
    return ClusterSums(places.cell, unknown, columns, places.edge, 0, table.voxel_size, table.K, table.classes, truth)


def sums_of_log(
    events: Events,
    places: Cubes,
    true_label: Int64 | None = None,
    likely: Float64 | None = None,
    *,
    groups: FrameGroups | None = None,
) -> ClusterSums:
    """The same by the frames of a log, whose groups are found if they are not given."""
    K = events.K
    groups = FrameGroups.of_log(events) if groups is None else groups
    sums = _sums_of_log(events, places, groups, true_label, likely)
    cell, frame = np.nonzero(sums[:, :, layout(K, truth=False)["observations"].start])
    return ClusterSums(
        places.cell[cell],
        groups.groups[frame].astype(np.int32),
        sums[cell, frame],
        places.edge,
        groups.step,
        events.voxel_size,
        K,
        events.classes,
        true_label is not None,
    )


def _with_frames(whole: ClusterSums, seen: ClusterSums) -> ClusterSums:
    """The sums of a whole map, with the share that each frame has in a cube as in a sample of its voxels.

    What the sample does not account for stands in rows of its own, whose frame is -1.
    """
    cells, row = np.unique(np.concatenate([whole.cell, seen.cell]), axis=0, return_inverse=True)
    mine, theirs = np.split(row.ravel(), [len(whole.cell)])
    count = [np.bincount(of, weights=part["observations"][:, 0], minlength=len(cells))
             for of, part in ((mine, whole), (theirs, seen))]  # fmt: skip
    scale = count[0][theirs] / np.maximum(count[1][theirs], 1.0)
    by_frame = np.zeros((len(seen.cell), whole.columns.shape[1]))
    by_frame[:, : seen.columns.shape[1]] = seen.columns * scale[:, None]
    left = np.zeros((len(cells), whole.columns.shape[1]))
    np.add.at(left, mine, whole.columns)
    np.subtract.at(left, theirs, by_frame)
    return dataclasses.replace(
        whole,
        cell=np.concatenate([seen.cell, cells]).astype(np.int32),
        frame=np.concatenate([seen.frame, np.full(len(cells), -1)]).astype(np.int32),
        columns=np.concatenate([by_frame, left]),
        step=seen.step,
    )


def with_frameless_sums(
    sums: ClusterSums,
    table: VoxelTable,
    places: Cubes,
    true_label: Int64 | None = None,
    sbd_excess: Float64 | None = None,
) -> ClusterSums:
    """With rows for the sums that belong to no frame: SBD less that in random order, and how far beliefs are right."""
    at, of = places.cell, places.at
    columns, own = np.zeros((len(at), sums.columns.shape[1])), layout(sums.K, truth=sums.truth)
    if sbd_excess is not None:
        for name, values in zip(OF_PLACES[:2], by_group(of, [sbd_excess], len(at)), strict=True):
            columns[:, own[name]] = values
    if true_label is not None:
        confidence, right = vss(table), dominant(table) == true_label
        bins = np.clip(np.ceil(confidence * BINS - 1e-9).astype(np.int64) - 1, 0, BINS - 1)
        judged = np.where((of >= 0) & (true_label >= 0), of * BINS + bins, -1)
        gap, known = by_group(judged, [right - confidence], len(at) * BINS)
        columns[:, own["gap"]] = gap.reshape(-1, BINS)
        columns[:, own["judged"]] = known.reshape(-1, BINS).sum(axis=1, keepdims=True)
    some = columns.any(axis=1)
    return dataclasses.replace(
        sums,
        classes=table.classes,
        cell=np.concatenate([sums.cell, at[some]]),
        frame=np.concatenate([sums.frame, np.full(some.sum(), -1, np.int32)]),
        columns=np.concatenate([sums.columns, columns[some]]),
    )


@dataclass(frozen=True, eq=False)
class FrameGroups:
    """The frames of a log, some of which are taken together.

    step    how many
    groups  (G,) their frames // step, ascending
    of      (F,) and (m,): a table of groups, and the number in it of each observation
    """

    step: int
    groups: Int64
    of: tuple[Int64, Int32]

    @classmethod
    def of_log(cls, events: Events) -> FrameGroups:
        """So many together that there are not too many groups."""
        frame, seen = events.frame, distinct(events.frame)
        step, left = 1, seen
        while len(left) > most_groups(events.K):
            step, left = 2 * step, np.unique(left // 2)
        groups, number = np.unique(seen // step, return_inverse=True)
        if not len(seen) or seen[0] < 0 or seen[-1] > SPARSE * len(frame):
            return cls(step, groups, (np.arange(len(groups)), np.searchsorted(groups, frame // step).astype(np.int32)))
        of = np.zeros(int(seen[-1]) + 1, np.int64)
        of[seen] = number
        return cls(step, groups, (of, frame))


def _sums_of_log(
    events: Events,
    places: Cubes,
    groups: FrameGroups,
    true_label: Int64 | None,
    likely: Float64 | None,
) -> Float64:
    """(cells, groups, C) by the compiled pass."""
    from semstab.core.compiled import in_chunks
    from semstab.statistics.loops import clusters

    K, cells, again = events.K, places.count, np.flatnonzero(places.at >= 0)
    count = len(groups.groups)
    sums = np.zeros((cells, count, width(K, truth=true_label is not None)))
    of = places.at[again]
    order = again[ranked(of)]
    bounds = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=cells))])
    options = (K <= MOST_CLASSES, true_label is not None)
    in_chunks(
        clusters.add_influences,
        order,
        bounds,
        (events.starts, events.ends),
        int((events.ends - events.starts).max(initial=0)),
        events.evidence.entries,
        K,
        groups.of,
        np.zeros(0, np.int64) if true_label is None else true_label,
        np.zeros(0) if likely is None else likely,
        *options,
        count,
        sums.reshape(cells * count, sums.shape[2]),
    )
    return sums


def _sums_of_table(table: VoxelTable, places: Cubes, true_label: Int64 | None, likely: Float64) -> Float64:
    """(cells, C) from the rows of the voxels that are in one of (n,); by class NaN for evidence that is not one-hot."""
    from semstab.statistics.loops.rows import add_apart

    K, T, agreement, of, cells = table.K, table.op.astype(np.float64), psa(table), places.at, places.count
    recurrent, twice = (table.op >= RECURRENT).astype(np.float64), np.where(table.op == 2, T, 0.0)
    values: dict[str, npt.NDArray[Any]] = {
        "voxels": np.ones(len(T)), "psa": agreement, "observations": T, "agreeing": T * agreement,
        "own": table.self_sum, "twice": twice, "twice_agreeing": twice * agreement, "recurrent": recurrent,
        "vss": recurrent * vss(table), "entropy": entropy(table),
    }  # fmt: skip
    shares, apart = np.zeros((cells, K)), np.zeros((cells, K))
    add_apart(of, table.evidence.entries, table.op, shares, apart)
    by_class = {"evidence": shares}
    if K <= MOST_CLASSES:
        one_hot = one_hot_where(table, of >= 0)
        by_class |= {"class_own": shares, "class_apart": apart} if one_hot else _unknown(shares)
    if true_label is not None:
        plain, further = _with_truth(table, places, true_label, likely * recurrent)
        values, by_class = values | plain, by_class | further
    sums, own = np.zeros((cells, width(K, truth=true_label is not None))), layout(K, truth=true_label is not None)
    for name, column in zip(values, by_group(of, [*values.values()], cells)[0].T, strict=True):
        sums[:, own[name].start] = column
    for name, columns in by_class.items():
        sums[:, own[name]] = columns
    return sums


def _unknown(shares: Float64) -> dict[str, Float64]:
    return {name: np.full_like(shares, np.nan) for name in ("class_own", "class_apart")}


def _with_truth(
    table: VoxelTable, places: Cubes, label: Int64, likely: Float64
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Float64]]:
    """What of `_sums_of_table` needs the true classes (n,): of each voxel (n,), and sums by class (cells, K)."""
    from semstab.statistics.loops.rows import weight_of

    looks, found, T = np.empty(len(label)), dominant(table), table.op
    weight_of(table.evidence.entries, label, looks)
    known, right = label >= 0, label == found
    stable, counted = known * likely, known & (places.at >= 0)
    values: dict[str, npt.NDArray[Any]] = {
        "known": known, "right": known & right, "looks": known * T, "looks_right": known * looks,
        "stable": stable, "stable_wrong": stable * ~right,
    }  # fmt: skip

    def by_class(which: Int64, where: Mask) -> Float64:
        group = places.at[where] * table.K + which[where]
        count = np.bincount(group, minlength=places.count * table.K).astype(np.float64)
        return count.reshape(places.count, table.K)

    if table.K > MOST_CLASSES:
        return values, {}
    return values, {
        "class_known": by_class(label, counted),
        "class_right": by_class(label, counted & right),
        "class_predicted": by_class(found, counted),
    }
