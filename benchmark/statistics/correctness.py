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
from semstab.model.measures import Beliefs, MeasureMeans, Quantity, dominant, measures, vss
from semstab.model.results import RECURRENT
from semstab.model.statistics import UNKNOWN, Correctness, Quadrants, Reliability, RuleMeans
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import STABLE, ratio_of
from semstab.statistics.order.fusion_rules import Fused
from semstab.statistics.sampling.places import Places, PlaceSums
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
    return correctness_of(judged_sums(judged), name)


def judged_sums(judged: Judged) -> Float64:
    """(3 + 3 BINS + 3 K,) what all that is said of them is a function of.

    Voxels, right ones and errors; by bin of confidence voxels, confidence and right ones; by class right, true and
    predicted ones.
    """
    right, K = judged.right, judged.K
    of = np.clip(np.ceil(judged.confidence * BINS - 1e-9).astype(np.int64) - 1, 0, BINS - 1)
    bins = [np.bincount(of, weights=values, minlength=BINS) for values in (None, judged.confidence, right)]
    kinds = [np.bincount(label, minlength=K) for label in (judged.label[right], judged.label, judged.predicted)]
    total = np.array([len(right), np.count_nonzero(right), judged.error.sum()])
    return np.concatenate([total, *bins, *kinds])


def correctness_of(sums: Float64, name: str = "all") -> Correctness:
    """What is said of voxels of these sums, see `judged_sums`."""
    n, right, error = sums[:3]
    if not n:
        return Correctness(name, 0, math.nan, math.nan, math.nan, math.nan)
    ece = sum(row.voxels * abs(row.accuracy - row.confidence) for row in reliability_of(sums) if row.voxels) / n
    hit, true, predicted = sums[3 + 3 * BINS :].reshape(3, -1)
    union = true + predicted - hit
    miou = float((hit[union > 0] / union[union > 0]).mean())
    return Correctness(name, int(n), float(right / n), miou, float(ece), float(error / n))


def reliability_of(sums: Float64) -> tuple[Reliability, ...]:
    """The bins of the reliability diagram of voxels of these sums, see `judged_sums`."""
    count, confidence, right = sums[3 : 3 + 3 * BINS].reshape(3, BINS)
    with np.errstate(invalid="ignore"):
        confidence, accuracy = confidence / count, right / count
    return tuple(
        Reliability(b / BINS, (b + 1) / BINS, int(count[b]), float(confidence[b]), float(accuracy[b]))
        for b in range(BINS)
    )


def rule_means(fused: Fused, where: Mask, truth: Truth | None) -> RuleMeans:
    """Means over the voxels of a map, fused by some rule, for which `where` (n,) holds."""
    return rule_means_of(rule_sums(fused, where, truth))


def rule_sums(fused: Beliefs, where: Mask, truth: Truth | None) -> Float64:
    """(3 M,) of each measure its sum, how often it is defined and how often OP is high enough; then `judged_sums`."""
    rows: list[float] = []
    for measure in measures():
        values = measure.of(fused)[where]
        defined = values[~np.isnan(values)]
        rows += [defined.sum(), len(defined), float(np.count_nonzero(where & (fused.op >= measure.lowest_op)))]
    if truth is None:
        return np.array(rows)
    return np.concatenate([rows, judged_sums(Judged.of(fused.evidence, truth.label).rows(where & truth.known))])


def rule_means_of(sums: Float64) -> RuleMeans:
    """Means from `rule_sums`."""
    n = 3 * len(measures())
    means = MeasureMeans.of_sums(sums[:n])
    if len(sums) == n:
        return RuleMeans(means)
    right = correctness_of(sums[n:])
    return RuleMeans(means, right.accuracy, right.miou, right.ece, right.brier)


def reliability(belief: Float64 | Evidence, label: npt.NDArray[np.int64]) -> tuple[Reliability, ...]:
    """The bins of the reliability diagram (Guo et al. 2017, ICML) of beliefs (n, K) and true classes (n,)."""
    return reliability_of(judged_sums(Judged.of(belief, label)))


def by_stratum(table: VoxelTable, truth: Truth, edges: Sequence[int]) -> tuple[Correctness, ...]:
    """Correctness of all voxels with a true class, then of each stratum of OP."""
    return strata_of(stratum_sums(table, truth, edges), edges)


def stratum_sums(table: VoxelTable, truth: Truth, edges: Sequence[int]) -> Float64:
    """(1 + S, ...) `judged_sums` of all voxels with a true class, then of each stratum of OP."""
    judged = Judged.of(table.evidence, truth.label)
    groups = [truth.known & (table.op >= low) & (table.op <= high) for _, low, high in _groups(edges)]
    return np.stack([judged_sums(judged.rows(where)) for where in groups])


def strata_of(sums: Float64, edges: Sequence[int]) -> tuple[Correctness, ...]:
    """What is said of them, from `stratum_sums`."""
    return tuple(correctness_of(own, name) for own, (name, _, _) in zip(sums, _groups(edges), strict=True))


def _groups(edges: Sequence[int]) -> list[tuple[str, int, int]]:
    return [("all", 1, np.iinfo(np.int32).max), *strata(edges)]


def quadrants(table: VoxelTable, truth: Truth, places: Places, *, stable: float = STABLE) -> Quadrants:
    """Count voxels by stability and correctness, never those with OP < 3: two frames agree by chance too easily.

    A voxel counts as stable by the probability that it is (`steady`), so that the shares do not depend on how often
    places were seen. `places` are those of all of the table's voxels.
    """
    return quadrants_of(quadrant_sums(table, truth, steady(table, stable=stable), places.edge))


QUADRANTS = ("stable_right", "stable_wrong", "unstable_right", "unstable_wrong")


def quadrant_sums(table: VoxelTable, truth: Truth, stable: Float64, edge: float) -> PlaceSums:
    """What `quadrants_of` is a function of, over cubes of that edge, by the probability (n,) that each is stable."""
    counted, likely, right = _masks(table, truth, stable)
    every, places = counted.astype(np.float64), Places(table.index, table.voxel_size, edge)
    parts = (likely * right, likely * ~right, (1 - likely) * right, (1 - likely) * ~right)
    columns = {name: np.stack([part * every, every], axis=1) for name, part in zip(QUADRANTS, parts, strict=True)} | {
        "wrong_of_stable": np.stack([~right * every * likely, every * likely], axis=1)
    }
    return PlaceSums(places.cell, edge, {name: places.sums(values) for name, values in columns.items()})


def quadrants_of(sums: PlaceSums) -> Quadrants:
    """The shares, from `quadrant_sums`."""
    voxels = int(sums["stable_right"][1])
    if not voxels:
        return Quadrants(0, *[UNKNOWN] * 5)
    return Quadrants(voxels, *(sums.estimate(name, ratio_of) for name in (*QUADRANTS, "wrong_of_stable")))


def stable_wrong(table: VoxelTable, truth: Truth, shares: Float64 | None = None, *, stable: float = STABLE) -> Mask:
    """(n,) the dangerous voxels: OP >= 3, more likely stable than not, and wrong. For `shares` see `steady`."""
    counted, likely, right = _masks(table, truth, steady(table, shares, stable=stable))
    return counted & (likely >= LIKELY) & ~right


def _masks(table: VoxelTable, truth: Truth, stable: Float64) -> tuple[Mask, Float64, Mask]:
    """(n,) which voxels count, with what probability each is stable (0 where none is known), and which are right."""
    counted = truth.known & (table.op >= RECURRENT)
    return counted, np.nan_to_num(stable), dominant(table) == truth.label
