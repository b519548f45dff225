"""Right beside stable: accuracy and calibration of fused labels where ground truth exists, and what is stably wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.metrics import strata
from semstab.metrics.matching import shared_rows
from semstab.model.evidence import Evidence, row_chunks
from semstab.model.information import normalise
from semstab.model.measures import MeasureMeans, Quantity, dominant, measures, vss
from semstab.model.results import RECURRENT
from semstab.model.statistics import UNKNOWN, Correctness, Interval, Quadrants, Reliability, RuleMeans
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import STABLE, ratio_of
from semstab.statistics.order.fusion_rules import Fused
from semstab.statistics.sampling.places import Places
from semstab.statistics.steady import LIKELY, steady

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
    pure = vss(truth)[true_rows] > PURE
    label = np.full(len(table), -1, dtype=np.int64)
    label[rows[pure]] = dominant(truth)[true_rows[pure]]
    return Truth(label >= 0, label)


@dataclass(frozen=True, eq=False)
class Judged:
    """Beliefs beside the true classes, (n,) each.

    label, predicted  the true and the most likely class
    confidence        belief in the latter
    error             squared distance of the belief from certainty of the true class, for Brier's score
    K                 number of classes
    """

    label: npt.NDArray[np.int64]
    predicted: npt.NDArray[np.int64]
    confidence: Float64
    error: Float64
    K: int

    @classmethod
    def of(cls, evidence: Float64 | Evidence, label: npt.NDArray[np.int64]) -> Judged:
        """Beliefs as evidence (n, K), up to a factor; what is said where the label is -1 means nothing."""
        n, K = evidence.shape
        predicted, confidence, error = np.zeros(n, np.int64), np.zeros(n), np.zeros(n)
        for some in row_chunks(n, K):
            belief = normalise(evidence[some])
            predicted[some], confidence[some] = belief.argmax(axis=1), belief.max(axis=1)
            belief[np.arange(len(belief)), label[some]] -= 1
            error[some] = (belief**2).sum(axis=1)
        return cls(label, predicted, confidence, error, K)

    def rows(self, where: Mask) -> Judged:
        """Those for which `where` (n,) holds."""
        return Judged(self.label[where], self.predicted[where], self.confidence[where], self.error[where], self.K)

    @property
    def right(self) -> Mask:
        """(n,) whether the most likely class is the true one."""
        same: Mask = self.predicted == self.label
        return same


def correctness(belief: Float64 | Evidence, label: npt.NDArray[np.int64], name: str = "all") -> Correctness:
    """Of beliefs (n, K) and true classes (n,)."""
    return _correctness(Judged.of(belief, label), name)


def _correctness(judged: Judged, name: str = "all") -> Correctness:
    n = len(judged.label)
    if not n:
        return Correctness(name, 0, math.nan, math.nan, math.nan, math.nan)
    ece = sum(row.voxels * abs(row.accuracy - row.confidence) for row in _bins(judged) if row.voxels) / n
    return Correctness(name, n, float(judged.right.mean()), _miou(judged), float(ece), float(judged.error.mean()))


def rule_means(fused: Fused, where: Mask, truth: Truth | None) -> RuleMeans:
    """Means over the voxels of a map, fused by some rule, for which `where` (n,) holds."""
    values = {measure: measure.of(fused) for measure in measures()}
    means = MeasureMeans.over(values, fused.op, where)
    if truth is None:
        return RuleMeans(means)
    known = where & truth.known
    right = _correctness(Judged.of(fused.evidence, truth.label).rows(known))
    return RuleMeans(means, right.accuracy, right.miou, right.ece, right.brier)


def _miou(judged: Judged) -> float:
    """Mean intersection over union of the most likely classes with the true ones."""
    K = judged.K
    confusion = np.bincount(judged.label * K + judged.predicted, minlength=K * K).reshape(K, K)
    union = confusion.sum(axis=0) + confusion.sum(axis=1) - confusion.diagonal()
    present = union > 0
    return float((confusion.diagonal()[present] / union[present]).mean()) if present.any() else math.nan


def reliability(belief: Float64 | Evidence, label: npt.NDArray[np.int64]) -> tuple[Reliability, ...]:
    """The bins of the reliability diagram (Guo et al. 2017, ICML) of beliefs (n, K) and true classes (n,)."""
    return _bins(Judged.of(belief, label))


def _bins(judged: Judged) -> tuple[Reliability, ...]:
    confidence, right = judged.confidence, judged.right
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
    judged = Judged.of(table.evidence, truth.label)
    groups = [("all", 1, np.iinfo(np.int32).max), *strata(edges)]
    rows = [(name, truth.known & (table.op >= low) & (table.op <= high)) for name, low, high in groups]
    return tuple(_correctness(judged.rows(where), name) for name, where in rows)


def quadrants(table: VoxelTable, truth: Truth, places: Places, *, stable: float = STABLE) -> Quadrants:
    """Count voxels by stability and correctness, never those with OP < 3: two frames agree by chance too easily.

    A voxel counts as stable by the probability that it is (`steady`), so that the shares do not depend on how often
    places were seen. `places` are those of all of the table's voxels.
    """
    counted, likely, right = _masks(table, truth, stable)
    if not counted.any():
        return Quadrants(0, *[UNKNOWN] * 5)

    def share(part: Float64, of: Float64) -> Interval:
        return places.estimate(np.stack([part * of, of], axis=1), ratio_of)

    every = counted.astype(np.float64)
    return Quadrants(
        voxels=int(counted.sum()),
        stable_right=share(likely * right, every),
        stable_wrong=share(likely * ~right, every),
        unstable_right=share((1 - likely) * right, every),
        unstable_wrong=share((1 - likely) * ~right, every),
        wrong_of_stable=share((~right).astype(np.float64), every * likely),
    )


def stable_wrong(table: VoxelTable, truth: Truth, *, stable: float = STABLE) -> Mask:
    """(n,) the dangerous voxels: OP >= 3, more likely stable than not, and wrong."""
    counted, likely, right = _masks(table, truth, stable)
    return counted & (likely >= LIKELY) & ~right


def _masks(table: VoxelTable, truth: Truth, stable: float) -> tuple[Mask, Float64, Mask]:
    """(n,) which voxels count, with what probability each is stable (0 where none is known), and which are right."""
    counted = truth.known & (table.op >= RECURRENT)
    return counted, np.nan_to_num(steady(table, stable=stable)), dominant(table) == truth.label
