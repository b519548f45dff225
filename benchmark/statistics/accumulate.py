"""Sums by frame and cube of space, from a map and its log in one pass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import stable_order
from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data.events import Events
from semstab.data.evidence import ByEntry, Evidence
from semstab.data.information import by_group
from semstab.data.measures import RECURRENT, dominant, entropy, vss
from semstab.data.statistics import Interval
from semstab.data.voxels import VoxelTable
from semstab.metrics.correctness import BINS, confidence_bin
from semstab.statistics.agreement import consistency_posterior, one_hot_where, psa
from semstab.statistics.cluster_sums import (
    DRIFT,
    MOST_CLASSES,
    ClusterSums,
    FirstColumns,
    FrameGroups,
    Functional,
    Scale,
    Statistic,
    cubes_of,
    layout,
    most_groups,
    of_measure,
    summed,
    width,
)
from semstab.statistics.intervals import estimate
from semstab.statistics.meaning import add_meaning
from semstab.statistics.observations import SpotObservations

# Cubes of space over any set of voxels, and intervals for these frames of any statistic of their sums.


@dataclass(frozen=True, eq=False)
class Cubes:
    """The cubes of voxels, and sums over those in each.

    Attributes:
        cell: (G, 3) int32 the cubes, sorted.
        at: (n,) int32 row of the cube that holds each voxel, -1 for those that are left out.
        edge: Metres, a power of 2.
    """

    cell: Int32
    at: Int32
    edge: float

    @classmethod
    def from_table(cls, table: VoxelTable, edge: float | None = None, *, where: Mask | None = None) -> Cubes:
        """Return the cubes of a table, without the voxels for which `where` (n,), OP >= 2 if not given, does not hold.

        There are at most MOST_CELLS cubes, unless their edge is given, in metres.
        """
        counted = table.op >= 2 if where is None else where
        return cls(*cubes_of((table.ix, table.iy, table.iz), table.voxel_size, edge, counted))

    @classmethod
    def of_log(cls, events: Events, edge: float | None = None) -> Cubes:
        """Return the same of the voxels of a log."""
        again = np.diff(events.bounds) >= 2
        return cls(*cubes_of((events.ix, events.iy, events.iz), events.voxel_size, edge, again))

    def rows(self, rows: Any) -> Cubes:
        """Return the same cubes, in which only a part of the voxels counts."""
        return replace(self, at=self.at[rows])

    @property
    def count(self) -> int:
        """Return how many cubes there are."""
        return len(self.cell)

    def sums(self, columns: Float64) -> Float64:
        """Return the sums (G, C) of columns (n, C) over the voxels of each cube, without NaN."""
        return by_group(self.at, columns.astype(np.float64, copy=False).T, self.count)[0]

    def means(self, values: Mapping[str, npt.NDArray[Any]]) -> dict[str, Float64]:
        """Return (G, 2) by name: the sum and the count of the values (n,) that are defined in each cube."""
        sums_and_counts = by_group(self.at, [*values.values()], self.count)
        return {
            name: np.stack(pair, axis=1)
            for name, *pair in zip(values, sums_and_counts[0].T, sums_and_counts[1].T, strict=True)
        }

    def sums_by_class(self, evidence: Evidence, *values: ByEntry) -> list[Float64]:
        """Return (G, K) for values of the entries of the voxels' evidence: their sums by cube and class."""
        return evidence.sums_by_class(self.at, self.count, *values)

    def sums_by_name(self, sums: Mapping[str, Float64]) -> ClusterSums:
        """Return sums (G, C) over these cubes by name."""
        return ClusterSums.of_cubes(self.cell, self.edge, sums)

    def estimate(
        self,
        columns: Float64,
        statistic: Statistic,
        bounds: tuple[float, float] = (0.0, 1.0),
        scale: Scale = "share",
    ) -> Interval:
        """Return the statistic of sums of columns (n, C), the second of which counts, with its interval."""
        return estimate(self.sums_by_name({"": self.sums(columns)}), Functional(("",), statistic, *bounds, scale))


# --- Sums of a map ----------------------------------------------------------------------------------------------------


def cluster_sums_of(
    table: VoxelTable,
    events: Events | None = None,
    true_label: Int64 | None = None,
    *,
    spots: SpotObservations | None = None,
    sbd_excess: Float64 | None = None,
    edge: float | None = None,
    cubes: Cubes | None = None,
    consistent: Float64 | None = None,
) -> ClusterSums:
    """Return the sums of a map.

    Args:
        table: The map.
        events: Its log; without it a location counts as a whole, and the frames are unknown.
        true_label: (n,) the true class of each voxel, -1 for an unknown class.
        spots: Labels that views give spots, from which alpha follows.
        sbd_excess: (n,) SBD of each voxel minus its SBD in random order, NaN if the latter is unknown.
        edge: Edge of the cubes in metres, a power of 2, where several maps must have the same; the smallest that
            leaves at most MOST_CELLS by default.
        cubes: The cubes, if they are known already.
        consistent: (n,) the stability posterior, if it is known already.
    """
    cubes = Cubes.from_table(table, edge) if cubes is None else cubes
    likely = (
        None
        if true_label is None
        else np.nan_to_num(consistency_posterior(table) if consistent is None else consistent)
    )
    if events is None:
        sums = _sums_of_table(table, cubes, true_label, likely)
    else:
        sums = _sums_of_log(events, cubes, dominant(table), true_label, likely)
    sums = _with_frameless_sums(sums, table, cubes, true_label, sbd_excess)
    sums = sums.coarsened(sums.edge, sums.step)  # one row for each cube and group of frames, in order
    return sums if spots is None else with_spots(sums, spots)


def with_spots(whole: ClusterSums, spots: SpotObservations, edge: float | None = None) -> ClusterSums:
    """Return the sums with sums of spots: of their first, second and third answers.

    Args:
        whole: Sums of the map.
        spots: Labels that views give spots.
        edge: Edge of the cubes of the spots in metres, a power of 2; the smallest that leaves at most MOST_CELLS by
            default, whatever the voxels of the map.
    """
    logs = spots.logs()
    cubes = Cubes.of_log(logs[0][0], edge)
    answers = (
        replace(_sums_of_log(log, cubes, square=square, distances=spots.distances), classes=whole.classes)
        for log, square in logs
    )
    return replace(whole, answers=tuple(answers))


def sums_of_spots(spots: SpotObservations, edge: float | None = None) -> ClusterSums:
    """Return sums of spots alone, without a map.

    Args:
        spots: Labels that views give spots.
        edge: Edge of the cubes in metres, a power of 2; the smallest that leaves at most MOST_CELLS by default.
    """
    none, frame = np.zeros((0, 3), np.int32), np.zeros(0, np.int32)
    slices = layout(spots.K, truth=False)
    columns = np.zeros((0, width(slices)))
    empty = ClusterSums(none, frame, columns, slices, spots.spacing, 0, spots.spacing, spots.classes)
    return with_spots(empty, spots, edge)


def _sums_of_log(
    events: Events,
    cubes: Cubes,
    fused: Int64 | None = None,
    true_label: Int64 | None = None,
    likely: Float64 | None = None,
    square: Float64 | None = None,
    distances: Float64 | None = None,
) -> ClusterSums:
    """Return the sums by cube and group of frames of the locations of a log, whose dominant classes are `fused`.

    square (m,) are the squared distances of answers from their spots, whose sums are kept, too; distances (K, K) are
    those between classes, whose sums are kept, too.
    """
    from semstab.core.compiled import in_chunks
    from semstab.statistics.loops.clusters import add_influences

    K, truth = events.K, true_label is not None
    groups, of, step, frames = FrameGroups.at_most(most_groups(K), events.frame)
    group = of.astype(np.int32)
    again = np.flatnonzero(cubes.at >= 0)
    order = again[stable_order(cubes.at[again], cubes.count)]
    bounds = np.concatenate([[0], np.cumsum(np.bincount(cubes.at[again], minlength=cubes.count))])
    slices = layout(K, truth=truth, meaning=distances is not None)
    sums = np.zeros((cubes.count * len(groups), width(slices)))
    longest = int((events.ends - events.starts).max(initial=0))
    fused_label = np.zeros(0, np.int64) if fused is None else fused
    label = np.zeros(0, np.int64) if true_label is None else true_label
    consistent = np.zeros(0) if likely is None else likely
    in_chunks(
        add_influences, order, bounds, (events.starts, events.ends), longest, events.evidence.entries, K, group,
        fused_label, label, consistent, FirstColumns.for_classes(K, truth=truth), len(groups), sums,
    )  # fmt: skip
    if square is not None:
        counted = np.flatnonzero(cubes.at[events.voxel] >= 0)
        at = cubes.at[events.voxel[counted]].astype(np.int64) * len(groups) + group[counted]
        sums[:, slices["square"].start] = np.bincount(at, square[counted], len(sums))
    if distances is not None:
        add_meaning(events, cubes.at, group, len(groups), distances, slices, sums)
    rows = np.flatnonzero(sums[:, slices["observations"].start])
    cell, frame = np.divmod(rows, max(len(groups), 1))
    return ClusterSums(
        cubes.cell[cell],
        groups[frame].astype(np.int32),
        sums[rows],
        slices,
        cubes.edge,
        step,
        events.voxel_size,
        events.classes,
        frames,
    )


def _with_frameless_sums(
    sums: ClusterSums, table: VoxelTable, cubes: Cubes, true_label: Int64 | None, sbd_excess: Float64 | None
) -> ClusterSums:
    """Return the sums with rows that belong to no frame.

    These are of the measures, of SBD less that in random order, and of calibration of beliefs.
    """
    recurrent = table.op >= RECURRENT
    values = {measure.key: np.where(recurrent, measure.of(table), np.nan) for measure in summed()}
    measured = tuple(values)
    slices = layout(sums.K, truth=sums.truth, measured=measured)
    columns = np.zeros((cubes.count, width(slices)))
    for key, sum_and_count in cubes.means(values).items():
        for name, column in zip(of_measure(key), sum_and_count.T, strict=True):
            columns[:, slices[name].start] = column
    if sbd_excess is not None:
        for name, values in zip(DRIFT, cubes.means({"": sbd_excess})[""].T, strict=True):
            columns[:, slices[name].start] = values
    if true_label is not None:
        confidence, right = vss(table), dominant(table) == true_label
        group = np.where((cubes.at >= 0) & (true_label >= 0), cubes.at * BINS + confidence_bin(confidence), -1)
        gap, count = by_group(group, [right - confidence], cubes.count * BINS)
        columns[:, slices["gap"]] = gap.reshape(-1, BINS)
        columns[:, slices["calibrated"]] = count.reshape(-1, BINS).sum(axis=1, keepdims=True)
    filled = columns.any(axis=1)
    of_frames = np.zeros((len(sums.columns), columns.shape[1]))
    of_frames[:, : sums.columns.shape[1]] = sums.columns
    return replace(
        sums,
        classes=table.classes,
        layout=slices,
        cell=np.concatenate([sums.cell, cubes.cell[filled]]),
        frame=np.concatenate([sums.frame, np.full(filled.sum(), -1, np.int32)]),
        columns=np.concatenate([of_frames, columns[filled]]),
    )


OF_FRAMES = ("psa", "agreeing", "own", "twice_agreeing", "observed_right", "consistent", "consistent_wrong")
"""Sums that are unknown where evidence does not count frames."""


def _sums_of_table(table: VoxelTable, cubes: Cubes, true_label: Int64 | None, likely: Float64 | None) -> ClusterSums:
    """Return the sums of the locations of a table: each counts as a whole, and frames are unknown.

    Sums by class are NaN for evidence that is not one-hot.
    """
    K, T, agreement, truth = table.K, table.op.astype(np.float64), psa(table), true_label is not None
    recurrent, twice = (table.op >= RECURRENT).astype(np.float64), np.where(table.op == 2, T, 0.0)
    values: dict[str, npt.NDArray[Any]] = {
        "voxels": np.ones(len(T)), "psa": agreement, "observations": T, "agreeing": T * agreement,
        "own": table.self_sum, "twice": twice, "twice_agreeing": twice * agreement, "recurrent": recurrent,
        "vss": recurrent * vss(table), "entropy": entropy(table),
    }  # fmt: skip
    num_others = np.maximum(T - 1, 1)

    def disagreement(weight: Float64, voxel: Int64) -> Float64:  # of each observation
        return 2.0 * (num_others[voxel] * weight - weight * weight + weight) / num_others[voxel]

    shares, apart = cubes.sums_by_class(table.evidence, lambda weight, _: weight, disagreement)
    by_class = {"evidence": shares}
    if K <= MOST_CLASSES:
        one_hot = np.where(one_hot_where(table, cubes.at >= 0), 1.0, np.nan)
        by_class |= {"class_own": one_hot * shares, "class_apart": one_hot * apart}
    if true_label is not None:
        likely = recurrent if likely is None else likely * recurrent
        plain, further = _sums_with_truth(table, cubes, true_label, likely)
        values, by_class = values | plain, by_class | further
    slices = layout(K, truth=truth)
    sums = np.zeros((cubes.count, width(slices)))
    for name, column in zip(values, by_group(cubes.at, [*values.values()], cubes.count)[0].T, strict=True):
        sums[:, slices[name].start] = column
    if not table.counts_frames:
        for name in {*values} & {*OF_FRAMES}:
            sums[:, slices[name].start] = np.nan
    for name, columns in by_class.items():
        sums[:, slices[name]] = columns
    unknown = np.full(cubes.count, -1, dtype=np.int32)
    return ClusterSums(cubes.cell, unknown, sums, slices, cubes.edge, 0, table.voxel_size, table.classes)


def _sums_with_truth(
    table: VoxelTable, cubes: Cubes, label: Int64, likely: Float64
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Float64]]:
    """Return the part of `_sums_of_table` that needs true classes (n,).

    These are values (n,) of voxels, and sums by class (G, K).
    """
    evidence, predicted, T = table.evidence, dominant(table), table.op
    of = np.repeat(np.arange(len(table)), np.diff(evidence.starts))
    hit = evidence.label == label[of]
    observed_right = np.bincount(of[hit], weights=evidence.weight[hit], minlength=len(table))
    has_truth, right = label >= 0, label == predicted
    consistent, counted = has_truth * likely, has_truth & (cubes.at >= 0)
    values: dict[str, npt.NDArray[Any]] = {
        "known": has_truth, "right": has_truth & right, "observed": has_truth * T,
        "observed_right": has_truth * observed_right, "consistent": consistent, "consistent_wrong": consistent * ~right,
    }  # fmt: skip

    def by_class(which: Int64, where: Mask) -> Float64:
        group = cubes.at[where].astype(np.int64) * table.K + which[where]
        return np.bincount(group, minlength=cubes.count * table.K).reshape(cubes.count, table.K).astype(np.float64)

    if table.K > MOST_CLASSES:
        return values, {}
    return values, {
        "class_known": by_class(label, counted),
        "class_right": by_class(label, counted & right),
        "class_predicted": by_class(predicted, counted),
    }
