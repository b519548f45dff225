"""Stability vs. accuracy: correctness and calibration of fused labels with ground truth, and lasting errors."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data.evidence import Evidence
from semstab.data.measures import RECURRENT, Quantity, dominant
from semstab.data.statistics import UNKNOWN, Correctness, Interval, Quadrants, Reliability
from semstab.data.voxels import VoxelTable
from semstab.metrics import strata
from semstab.metrics.agreement import require_same_grid, same_voxels, shared_rows
from semstab.metrics.correctness import BINS, calibration_error, confidence_bin, mean_iou
from semstab.metrics.summary import groups_of
from semstab.statistics.accumulate import Cubes
from semstab.statistics.agreement import CONSISTENT, LIKELY, consistency_posterior
from semstab.statistics.cluster_sums import mean_functional
from semstab.statistics.intervals import estimate

ACCURACY = Quantity(key="accuracy", title="Accuracy", better="higher", needs="truth", op=2)
MIOU = Quantity(key="miou", title="mIoU", better="higher", needs="truth", op=2)
ECE = Quantity(key="ece", title="ECE", better="lower", needs="truth", op=2)
BRIER = Quantity(key="brier", title="Brier", better="lower", needs="truth", op=2)

PURE = 0.5 + 1e-9
"""A voxel has a true class where more than this share of its ground truth evidence is of one class: exactly a half
is not enough, however it is rounded."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The true class of a map's voxels.

    Attributes:
        known: (n,) true where the ground truth saw the voxel and has a majority there.
        label: (n,) the true class; -1 for an unknown class.
    """

    known: Mask
    label: Int64


def join_truth(table: VoxelTable, truth: VoxelTable) -> Truth:
    """Return the true class of each voxel of `table`, from the map `truth` of ground truth labels.

    Raises:
        DataError: If the maps differ in K or voxel size.
    """
    require_same_grid(table, truth)
    result = truth.evidence.concentration
    label = np.where(result.largest > PURE, result.label.astype(np.int64), -1)
    if not same_voxels(table, truth):
        (rows, true_rows), true = shared_rows(table, truth), label
        label = np.full(len(table), -1)
        label[rows] = true[true_rows]
    return Truth(label >= 0, label)


@dataclass(frozen=True, eq=False)
class Predictions:
    """Beliefs with the true classes, (n,) each.

    Attributes:
        label, predicted: The true and the most likely class.
        confidence: Belief in the latter.
        error: Squared distance of the belief from certainty of the true class, for Brier's score.
        K: Number of classes.
    """

    label: Int64
    predicted: Int64
    confidence: Float64
    error: Float64
    K: int

    @classmethod
    def from_evidence(cls, evidence: Float64 | Evidence, label: Int64) -> Predictions:
        """Return predictions from evidence (n, K), up to a factor; they mean nothing where the label is -1."""
        evidence = Evidence.from_rows(evidence)
        spread, of = evidence.concentration, np.repeat(np.arange(len(evidence)), np.diff(evidence.starts))
        total = np.bincount(of, weights=evidence.weight, minlength=len(evidence))
        hit, hits = evidence.label == label[of], np.zeros(len(evidence))
        hits[of[hit]] = evidence.weight[hit]
        error = spread.squares / total**2 - 2 * hits / total + 1
        return cls(label, spread.label.astype(np.int64), spread.largest, error, evidence.K)

    @property
    def right(self) -> Mask:
        """(n,) true where the most likely class is the true one."""
        same: Mask = self.predicted == self.label
        return same


def correctness(belief: Float64 | Evidence, label: Int64, name: str = "all") -> Correctness:
    """Return accuracy and calibration of beliefs (n, K) whose true classes are (n,)."""
    return correctness_of(prediction_sums(Predictions.from_evidence(belief, label), label >= 0), name)


@dataclass(frozen=True, eq=False)
class PredictionSums:
    """Sums over predictions, from which their correctness and calibration follow; sums of disjoint parts add up.

    Attributes:
        error: Sum of the squared distances, for Brier's score.
        voxels_of_bin, confidence_of_bin, right_of_bin: (BINS,) by bin of confidence the voxels, the sum of their
            confidence, and the right ones.
        right_of_class, true_of_class, predicted_of_class: (K,) by class the right voxels, those of which it is the true
            class, and those of which it is the most likely one.
    """

    error: float
    voxels_of_bin: Float64
    confidence_of_bin: Float64
    right_of_bin: Float64
    right_of_class: Float64
    true_of_class: Float64
    predicted_of_class: Float64

    def __add__(self, other: PredictionSums) -> PredictionSums:
        """Return the sums over both."""
        return PredictionSums(*(getattr(self, column.name) + getattr(other, column.name) for column in fields(self)))

    @property
    def voxels(self) -> int:
        """Number of voxels."""
        return int(self.voxels_of_bin.sum())

    @property
    def right(self) -> int:
        """Number of right voxels."""
        return int(self.right_of_bin.sum())


def prediction_sums(predictions: Predictions, where: Mask) -> PredictionSums:
    """Return the sums over the voxels for which `where` (n,) holds."""
    (sums,) = _prediction_sums_by_group(predictions, where - np.int64(1), 1)
    return sums


def _prediction_sums_by_group(predictions: Predictions, group: Int64, groups: int) -> list[PredictionSums]:
    """Return the sums of each group; -1 is none."""
    rows, K = np.flatnonzero(group >= 0), predictions.K
    of, label, predicted, confidence = (
        group[rows],
        predictions.label[rows],
        predictions.predicted[rows],
        predictions.confidence[rows],
    )
    right = predictions.right[rows].astype(np.float64)
    bins = confidence_bin(confidence)

    def sums(width: int, within: Any, weights: Any = None) -> Float64:
        result = np.bincount(of * width + within, weights=weights, minlength=groups * width)
        return result.astype(np.float64).reshape(groups, width)

    of_groups = zip(
        sums(1, 0, predictions.error[rows]),
        sums(BINS, bins), sums(BINS, bins, confidence), sums(BINS, bins, right),
        sums(K, label, right), sums(K, label), sums(K, predicted), strict=True,
    )  # fmt: skip
    return [PredictionSums(float(error), *of_bins_and_classes) for (error,), *of_bins_and_classes in of_groups]


def correctness_of(sums: PredictionSums, name: str = "all") -> Correctness:
    """Return the correctness of the voxels with these sums."""
    n = sums.voxels
    if not n:
        return Correctness(name, 0, math.nan, math.nan, math.nan, math.nan)
    ece = calibration_error(sums.right_of_bin - sums.confidence_of_bin, np.asarray(n))
    miou = mean_iou(sums.right_of_class, sums.true_of_class, sums.predicted_of_class)
    return Correctness(name, n, sums.right / n, float(miou), float(ece), sums.error / n)


def reliability_of(sums: PredictionSums) -> tuple[Reliability, ...]:
    """Return the bins of the reliability diagram of the voxels with these sums."""
    count = sums.voxels_of_bin
    with np.errstate(invalid="ignore"):
        confidence, accuracy = sums.confidence_of_bin / count, sums.right_of_bin / count
    return tuple(
        Reliability(b / BINS, (b + 1) / BINS, int(count[b]), float(confidence[b]), float(accuracy[b]))
        for b in range(BINS)
    )


def reliability(belief: Float64 | Evidence, label: Int64) -> tuple[Reliability, ...]:
    """Return the bins of the reliability diagram (Guo et al. 2017, ICML) of beliefs (n, K) and true classes (n,)."""
    return reliability_of(prediction_sums(Predictions.from_evidence(belief, label), label >= 0))


def by_stratum(predictions: Predictions, op: Int32, has_truth: Mask, edges: Sequence[int]) -> tuple[Correctness, ...]:
    """Return the correctness of all voxels whose true class is known (n,), by stratum of OP (n,), then of OP >= 2."""
    sums = _prediction_sums_by_group(predictions, np.where(has_truth, groups_of(op, edges), -1), len(edges) + 1)
    names = ["all", *(name for name, _, _ in strata(edges))]
    total = functools.reduce(operator.add, sums)
    repeated = prediction_sums(predictions, has_truth & (op >= 2))
    sums_and_names = zip([total, *sums, repeated], [*names, "OP>=2"], strict=True)
    return tuple(correctness_of(of_group, name) for of_group, name in sums_and_names)


QUADRANTS = ("consistent_right", "consistent_wrong", "inconsistent_right", "inconsistent_wrong")


def quadrants(table: VoxelTable, truth: Truth, consistent: Float64, edge: float, wrong: Interval) -> Quadrants:
    """Count voxels by stability and correctness, never those with OP < 3: two frames agree by chance too easily.

    Args:
        table: The map.
        truth: The true classes of its voxels.
        consistent: (n,) how probable it is that each is consistent (`consistency_posterior`), by which it counts:
            the shares do not depend on how often locations were seen.
        edge: Edge of the cubes that intervals rest on, in metres.
        wrong: The share of the consistent voxels that are wrong, with the interval of the headline.
    """
    counted, likely, right = _masks(table, truth, consistent)
    if not (counted.any() and table.counts_frames):
        return Quadrants(0, *[UNKNOWN] * 5)
    cubes = Cubes.from_table(table, edge, where=counted)
    parts = (likely * right, likely * ~right, (1 - likely) * right, (1 - likely) * ~right)
    sums = cubes.sums_by_name(cubes.means(dict(zip(QUADRANTS, parts, strict=True))))
    shares = {name: estimate(sums, mean_functional(name)) for name in QUADRANTS}
    return Quadrants(int(counted.sum()), **shares, wrong_of_consistent_op3=wrong)


def consistent_wrong(table: VoxelTable, truth: Truth, *, consistent: float = CONSISTENT) -> Mask:
    """Return (n,) the dangerous voxels: OP >= 3, more likely consistent than not, and wrong."""
    return wrong_where_consistent(table, truth, consistency_posterior(table, consistent=consistent))


def wrong_where_consistent(table: VoxelTable, truth: Truth, consistent: Float64) -> Mask:
    """Return (n,) the dangerous voxels, by the probability (n,) that each is consistent."""
    counted, likely, right = _masks(table, truth, consistent)
    return counted & (likely >= LIKELY) & ~right


def _masks(table: VoxelTable, truth: Truth, consistent: Float64) -> tuple[Mask, Float64, Mask]:
    """Return (n,) the voxels that count, the consistency posterior (0 where unknown), and the right voxels."""
    counted = truth.known & (table.op >= RECURRENT)
    return counted, np.nan_to_num(consistent), dominant(table) == truth.label
