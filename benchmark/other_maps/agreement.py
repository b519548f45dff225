"""Compare another program's map with a run's, voxel by voxel: coverage, equal labels, correctness, and areas."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.comparison.locations import connected
from semstab.core.types import Int32, Int64, Mask
from semstab.data.records import Record
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError
from semstab.metrics import strata
from semstab.metrics.correctness import mean_iou
from semstab.metrics.summary import groups_of
from semstab.other_maps.classes import NONE
from semstab.other_maps.placing import Grid, MapPlacement, centers
from semstab.statistics.correctness import join_truth

EDGES = (1, 2, 5)
"""Upper edges of the strata of OP."""


@dataclass(frozen=True, eq=False)
class RunMap:
    """The map of a run: its voxels with their dominant class, OP (n,), and true class (n,), NONE if it is unknown.

    Attributes:
        true: None without ground truth.
    """

    name: str
    classes: tuple[str, ...]
    grid: Grid
    op: Int32
    true: Int64 | None

    @classmethod
    def from_record(cls, record: Record, classes: tuple[str, ...]) -> RunMap:
        """Read the map of a unit, and its ground truth if the run fused it.

        Raises:
            ConfigError: If the run stored no map.
            DataError: For damaged files.
        """
        if record.voxels_file is None:
            raise ConfigError(f"{record.unit.slug}: its voxels were not stored; run it with a folder")
        columns = VoxelTable.columns(record.voxels_file, ["ix", "iy", "iz", "op", "label"])
        index = np.stack([columns[name] for name in ("ix", "iy", "iz")], axis=1)
        size = next(VoxelTable.iter_tiles(record.voxels_file)).voxel_size
        grid = Grid(index, columns["label"].astype(np.int64), size)
        return cls(record.unit.model, classes, grid, columns["op"], _true(record, grid))


def _true(record: Record, grid: Grid) -> Int64 | None:
    if record.truth_file is None or not record.truth_file.exists():
        return None
    true = np.full(len(grid), NONE, np.int64)
    for table in VoxelTable.iter_tiles(record.truth_file):
        at = grid.rows(table.index)
        true[at[at != NONE]] = join_truth(table, table).label[at != NONE]
    return true


@dataclass(frozen=True)
class ClassMatch:
    """Voxels of a class of the run that both maps hold and label.

    Attributes:
        voxels: Their number.
        same: The share that has this class in the other map, too.
        instead: The class that the other map gives most often instead, '' if it gives none.
        recall: The share of the voxels of this true class that have it in the run, and in the other map.
    """

    name: str
    voxels: int
    same: float
    instead: str
    recall: tuple[float, float]


@dataclass(frozen=True)
class StratumAgreement:
    """Voxels of the run in a stratum of OP.

    Attributes:
        voxels: Their number.
        covered: The share that the other map holds.
        same: The share of those that both label that has one class.
        accuracy: The share of them with the true class, in the run and in the other map.
    """

    name: str
    voxels: int
    covered: float
    same: float
    accuracy: tuple[float, float]


@dataclass(frozen=True)
class DifferingPlace:
    """Neighbouring voxels to which the maps give different classes, the same two for all.

    Attributes:
        ours, theirs: Classes in the run and in the other map.
        true: The true class of most of them; '' if it is unknown.
        centre: (3,) in the scene, metres.
        size: Metres from end to end.
    """

    number: int
    ours: str
    theirs: str
    true: str
    voxels: int
    centre: tuple[float, float, float]
    size: float


@dataclass(frozen=True)
class MapAgreement:
    """The agreement of another program's map with a run's.

    Attributes:
        name: Of the file.
        points: Number of points; `outside` is the share that lies in no voxel of the run, `unlabelled` without class.
        voxels: Number of voxels that hold its points.
        covers: The share of the run's voxels that it holds; `covered`: the share of its voxels that the run holds.
        compared: Number of voxels that both hold and label; `same`: the share with one class.
        known: Number of these with a true class; `accuracy`, `miou`: in the run, and in the other map.
        better: A placement under which it fits much better, in a line; '' for none.
    """

    name: str
    points: int
    outside: float
    unlabelled: float
    voxels: int
    covers: float
    covered: float
    compared: int
    same: float
    known: int
    accuracy: tuple[float, float]
    miou: tuple[float, float]
    classes: tuple[ClassMatch, ...]
    strata: tuple[StratumAgreement, ...]
    places: tuple[DifferingPlace, ...]
    notes: tuple[str, ...] = ()
    better: str = ""


SAME, OTHER, ONLY_RUN, ONLY_OTHER = range(4)
"""Kinds of voxels of two maps: one class (or the other map has none), two classes, or a voxel of one map only."""


@dataclass(frozen=True, eq=False)
class Union:
    """The voxels of a run and another map, those of the run first.

    Attributes:
        index: (n, 3).
        kind: (n,) SAME, OTHER, ONLY_RUN or ONLY_OTHER.
        right: (n,) 0 if it is unknown, 1 both are wrong, 2 the other map alone is right, 3 the run alone, 4 both; None
            without ground truth.
        theirs: (n,) the class in the other map.
    """

    index: Int32
    kind: Int64
    right: Int64 | None
    theirs: Int64


@dataclass(frozen=True, eq=False)
class Voxelwise:
    """A comparison with its voxels, for pictures.

    Attributes:
        theirs: The other map.
        at: (m,) the run's row of each of its voxels, NONE if the run does not hold it.
        area: (n,) number of the place that each of the run's voxels is in; 0 in none.
    """

    agreement: MapAgreement
    theirs: Grid
    at: Int64
    area: Int64
    placement: MapPlacement

    def laid_together(self, run: RunMap) -> Union:
        """Return the voxels of both maps."""
        alone, ours = self.at == NONE, run.grid.label
        theirs = _theirs_in_run(run, self.theirs, self.at)
        held = np.zeros(len(ours), np.bool_)
        held[self.at[~alone]] = True
        kind = np.where(~held, ONLY_RUN, np.where((ours == theirs) | (theirs == NONE), SAME, OTHER))
        right = None
        if run.true is not None:
            counted = held & (theirs != NONE) & (run.true != NONE)
            right = np.where(counted, 1 + 2 * (ours == run.true) + (theirs == run.true), 0)
            right = np.concatenate([right, np.zeros(np.count_nonzero(alone), np.int64)])
        index = np.concatenate([run.grid.index, self.theirs.index[alone]])
        kind = np.concatenate([kind, np.full(np.count_nonzero(alone), ONLY_OTHER)])
        return Union(index, kind, right, np.concatenate([theirs, self.theirs.label[alone]]))


def _theirs_in_run(run: RunMap, theirs: Grid, at: Int64) -> Int64:
    label = np.full(len(run.grid), NONE, np.int64)
    label[at[at != NONE]] = theirs.label[at != NONE]
    return label


def share(where: Mask, among: Mask) -> float:
    """Return the share of the voxels among which (n,) something holds (n,); NaN if there are none."""
    n = int(np.count_nonzero(among))
    return int(np.count_nonzero(where & among)) / n if n else math.nan


def agreement(
    run: RunMap, theirs: Grid, name: str, points: int, outside: float, unlabelled: float, placement: MapPlacement
) -> Voxelwise:
    """Compare the voxels of another map with the run's."""
    at, ours = run.grid.rows(theirs.index), run.grid.label
    label, held = _theirs_in_run(run, theirs, at), np.zeros(len(ours), np.bool_)
    held[at[at != NONE]] = True
    labelled, same, K = (ours != NONE) & (label != NONE), ours == label, len(run.classes)
    true = np.full(len(ours), NONE, np.int64) if run.true is None else run.true
    has_truth = labelled & (true != NONE)
    area, places = _places(run, label, labelled & ~same, true)
    accuracy = share(ours == true, has_truth), share(label == true, has_truth)
    result = MapAgreement(
        name, points, outside, unlabelled, len(theirs), share(held, np.ones_like(held)), float(np.mean(at != NONE)),
        int(np.count_nonzero(labelled)), share(same, labelled), int(np.count_nonzero(has_truth)), accuracy,
        (_miou(ours, true, has_truth, K), _miou(label, true, has_truth, K)),
        tuple(_by_class(run, label, labelled, true)), tuple(_by_op(run, label, held, labelled, true)), places,
    )  # fmt: skip
    return Voxelwise(result, theirs, at, area, placement)


def _miou(label: Int64, true: Int64, has_truth: Mask, K: int) -> float:
    right = has_truth & (label == true)
    counts = [
        np.bincount(of[where], minlength=K) for of, where in ((true, right), (true, has_truth), (label, has_truth))
    ]
    return float(mean_iou(*counts)) if has_truth.any() else math.nan


def _by_class(run: RunMap, label: Int64, labelled: Mask, true: Int64) -> list[ClassMatch]:
    ours, K = run.grid.label, len(run.classes)
    confusion = np.bincount(ours[labelled] * K + label[labelled], minlength=K * K).reshape(K, K)
    rows = []
    for k, name in enumerate(run.classes):
        n, confused = int(confusion[k].sum()), np.where(np.arange(K) == k, 0, confusion[k])
        of_class = labelled & (true == k)
        if n or of_class.any():
            instead = run.classes[int(confused.argmax())] if confused.any() else ""
            recall = share(ours == k, of_class), share(label == k, of_class)
            rows.append(ClassMatch(name, n, int(confusion[k, k]) / n if n else math.nan, instead, recall))
    return rows


def _by_op(run: RunMap, label: Int64, held: Mask, labelled: Mask, true: Int64) -> list[StratumAgreement]:
    ours, group, rows = run.grid.label, groups_of(run.op, EDGES), []
    for k, (name, _, _) in enumerate(strata(EDGES)):
        in_stratum = group == k
        if in_stratum.any():
            has_truth = in_stratum & labelled & (true != NONE)
            accuracy = share(ours == true, has_truth), share(label == true, has_truth)
            same = share(ours == label, in_stratum & labelled)
            rows.append(
                StratumAgreement(name, int(np.count_nonzero(in_stratum)), share(held, in_stratum), same, accuracy)
            )
    return rows


def _places(run: RunMap, label: Int64, differs: Mask, true: Int64) -> tuple[Int64, tuple[DifferingPlace, ...]]:
    """Return the number (n,) of each voxel's place, the largest first, 0 in none, and the places."""
    ours, K, size = run.grid.label, len(run.classes), run.grid.size
    area, count = connected(run.grid.index, ours * K + label, np.ones(len(ours)), differs)
    order = np.argsort(area, kind="stable")
    edges = np.searchsorted(area[order], np.arange(1, len(count) + 2))
    places = []
    for k in range(len(count)):
        rows = order[edges[k] : edges[k + 1]]
        points = centers(run.grid.index[rows], size)
        x, y, z = points.mean(axis=0).tolist()
        extent = float(np.linalg.norm(np.ptp(points, axis=0) + size))
        first = rows[0]
        class_names = run.classes[ours[first]], run.classes[label[first]], _most(true[rows], run.classes)
        places.append(DifferingPlace(k + 1, *class_names, len(rows), (x, y, z), extent))
    return area, tuple(places)


def _most(true: Int64, classes: Sequence[str]) -> str:
    labels = true[true != NONE]
    return classes[int(np.bincount(labels).argmax())] if len(labels) else ""
