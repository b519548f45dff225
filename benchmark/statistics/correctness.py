"""Right beside stable: accuracy and calibration of fused labels where ground truth exists, and what is stably wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.metrics import strata
from semstab.metrics.matching import shared_rows
from semstab.model.information import normalise
from semstab.model.measures import MeasureMeans, Quantity, dominant, measures
from semstab.model.results import RECURRENT
from semstab.model.statistics import UNKNOWN, Correctness, Interval, Quadrants, Reliability, RuleMeans
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import STABLE, psa, ratio_of
from semstab.statistics.fusion_rules import Fused
from semstab.statistics.sampling.places import Places

Float64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

ACCURACY = Quantity(key="accuracy", title="Accuracy", better="higher", needs="truth")
MIOU = Quantity(key="miou", title="mIoU", better="higher", needs="truth")
ECE = Quantity(key="ece", title="ECE", better="lower", needs="truth")
BRIER = Quantity(key="brier", title="Brier", better="lower", needs="truth")

PURE = 0.5
"""A voxel has a true class where more than this share of its ground truth evidence is of one class."""

BINS = 15


@dataclass(frozen=True, eq=False)
class Truth:
    """The true class of a map's voxels.

    known  (n,) whether the ground truth saw the voxel and has a majority there
    label  (n,) the true class; -1 where it is not known
    """

    known: Mask
    label: npt.NDArray[np.int64]


def join_truth(table: VoxelTable, truth: VoxelTable) -> Truth:
    """The true class of each voxel of `table`, from the map `truth` of the ground truth labels of the same frames.

    Raises DataError where the maps differ in K or voxel size.
    """
    rows, true_rows = shared_rows(table, truth)
    belief = normalise(truth.evidence[true_rows])
    rows, true_rows = rows[pure := belief.max(axis=1) > PURE], true_rows[pure]
    label = np.full(len(table), -1, dtype=np.int64)
    label[rows] = dominant(truth)[true_rows]
    return Truth(label >= 0, label)


def correctness(belief: Float64, label: npt.NDArray[np.int64], name: str = "all") -> Correctness:
    """Of beliefs (n, K) and true classes (n,)."""
    if not len(belief):
        return Correctness(name, 0, math.nan, math.nan, math.nan, math.nan)
    right = belief.argmax(axis=1) == label
    bins = reliability(belief, label)
    ece = sum(row.voxels * abs(row.accuracy - row.confidence) for row in bins if row.voxels) / len(belief)
    brier = ((belief - np.eye(belief.shape[1])[label]) ** 2).sum(axis=1).mean()
    return Correctness(name, len(belief), float(right.mean()), miou(belief, label), float(ece), float(brier))


def rule_means(fused: Fused, where: Mask, truth: Truth | None) -> RuleMeans:
    """Means over the voxels of a map, fused by some rule, for which `where` (n,) holds."""
    values = {measure: measure.of(fused) for measure in measures()}
    means = MeasureMeans.over(values, fused.op, where)
    if truth is None:
        return RuleMeans(means)
    known = where & truth.known
    right = correctness(fused.belief[known], truth.label[known])
    return RuleMeans(means, right.accuracy, right.miou, right.ece, right.brier)


def miou(belief: Float64, label: npt.NDArray[np.int64]) -> float:
    """Mean intersection over union of the dominant classes of beliefs (n, K) with true classes (n,)."""
    K = belief.shape[1]
    confusion = np.bincount(label * K + belief.argmax(axis=1), minlength=K * K).reshape(K, K)
    union = confusion.sum(axis=0) + confusion.sum(axis=1) - confusion.diagonal()
    present = union > 0
    return float((confusion.diagonal()[present] / union[present]).mean()) if present.any() else math.nan


def reliability(belief: Float64, label: npt.NDArray[np.int64]) -> tuple[Reliability, ...]:
    """The bins of the reliability diagram (Guo et al. 2017, ICML) of beliefs (n, K) and true classes (n,)."""
    confidence = belief.max(axis=1)
    right = belief.argmax(axis=1) == label
    of = np.clip(np.ceil(confidence * BINS - 1e-9).astype(np.int64) - 1, 0, BINS - 1)
    count = np.bincount(of, minlength=BINS)
    with np.errstate(invalid="ignore"):
        mean_confidence = np.bincount(of, weights=confidence, minlength=BINS) / count
        accuracy = np.bincount(of, weights=right, minlength=BINS) / count
    return tuple(
        Reliability(b / BINS, (b + 1) / BINS, int(count[b]), float(mean_confidence[b]), float(accuracy[b]))
        for b in range(BINS)
    )


def by_stratum(table: VoxelTable, truth: Truth, edges: Sequence[int]) -> tuple[Correctness, ...]:
    """Correctness of all voxels with a true class, then of each stratum of OP."""
    belief = normalise(table.evidence)
    groups = [("all", 1, np.iinfo(np.int32).max), *strata(edges)]
    rows = [(name, truth.known & (table.op >= low) & (table.op <= high)) for name, low, high in groups]
    return tuple(correctness(belief[where], truth.label[where], name) for name, where in rows)


def quadrants(table: VoxelTable, truth: Truth, places: Places, *, stable: float = STABLE) -> Quadrants:
    """Count voxels by stability and correctness, never those with OP < 3: two frames agree by chance too easily.

    `places` are those of all of the table's voxels.
    """
    counted, steady, right = _masks(table, truth, stable)
    if not counted.any():
        return Quadrants(0, *[UNKNOWN] * 5)

    def share(where: Mask, of: Mask) -> Interval:
        return places.estimate(np.stack([where & of, of], axis=1).astype(np.float64), ratio_of)

    return Quadrants(
        voxels=int(counted.sum()),
        stable_right=share(steady & right, counted),
        stable_wrong=share(steady & ~right, counted),
        unstable_right=share(~steady & right, counted),
        unstable_wrong=share(~steady & ~right, counted),
        wrong_of_stable=share(~right, counted & steady),
    )


def stable_wrong(table: VoxelTable, truth: Truth, *, stable: float = STABLE) -> Mask:
    """(n,) the dangerous voxels: OP >= 3, all frames nearly agree, and they are wrong."""
    counted, steady, right = _masks(table, truth, stable)
    return counted & steady & ~right


def _masks(table: VoxelTable, truth: Truth, stable: float) -> tuple[Mask, Mask, Mask]:
    counted = truth.known & (table.op >= RECURRENT)
    with np.errstate(invalid="ignore"):
        return counted, psa(table) >= stable - 1e-9, dominant(table) == truth.label
