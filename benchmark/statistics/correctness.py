"""Right beside stable: accuracy and calibration of fused labels where ground truth exists, and what is stably wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.metrics import strata
from semstab.metrics.agreement import require_same_grid, same_voxels, shared_rows
from semstab.metrics.summary import groups_of
from semstab.model.evidence import Evidence
from semstab.model.information import blockwise, by_group
from semstab.model.measures import Beliefs, MeasureMeans, Quantity, Voxels, dominant, measures
from semstab.model.results import RECURRENT
from semstab.model.statistics import UNKNOWN, Correctness, Quadrants, Reliability, RuleMeans
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import STABLE, ratio_of
from semstab.statistics.order.fusion_rules import Fused
from semstab.statistics.sampling.places import Places, PlaceSums
from semstab.statistics.steady import LIKELY, steady

ACCURACY = Quantity(key="accuracy", title="Accuracy", better="higher", needs="truth")
MIOU = Quantity(key="miou", title="mIoU", better="higher", needs="truth")
ECE = Quantity(key="ece", title="ECE", better="lower", needs="truth")
BRIER = Quantity(key="brier", title="Brier", better="lower", needs="truth")

PURE = 0.5 + 1e-9
"""A voxel has a true class where more than this share of its ground truth evidence is of one class: not where it is a
half, however that is rounded."""

BINS = 15


@dataclass(frozen=True, eq=False)
class Truth:
    """The true class of a map's voxels.

    known  (n,) whether the ground truth saw the voxel and has a majority there
    label  (n,) the true class; -1 where it is not known
    """

    known: Mask
    label: Int64


def join_truth(table: VoxelTable, truth: VoxelTable) -> Truth:
    """The true class of each voxel of `table`, from the map `truth` of the ground truth labels of the same frames.

    Raises DataError where the maps differ in K or voxel size.
    """
    from semstab.statistics.loops.rows import majorities

    require_same_grid(table, truth)
    label = np.empty(len(truth), np.int64)
    majorities(truth.evidence.entries, PURE, label)
    if not same_voxels(table, truth):
        (rows, true_rows), true = shared_rows(table, truth), label
        label = np.full(len(table), -1)
        label[rows] = true[true_rows]
    return Truth(label >= 0, label)


@dataclass(frozen=True, eq=False)
class Predictions:
    """Beliefs beside the true classes, (n,) each.

    label, predicted  the true and the most likely class
    confidence        belief in the latter
    error             squared distance of the belief from certainty of the true class, for Brier's score
    voxels            how many each stands for
    K                 number of classes
    """

    label: Int64
    predicted: Int64
    confidence: Float64
    error: Float64
    voxels: Float64
    K: int

    @classmethod
    def of(cls, evidence: Float64 | Evidence, label: Int64, voxels: Float64 | None = None) -> Predictions:
        """Beliefs as evidence (n, K), up to a factor; what is said where the label is -1 means nothing.

        Each is of so many voxels (n,), of one where that is not given.
        """
        from semstab.statistics.loops.rows import square_errors

        kept = Evidence.of(evidence)
        found, error, rest = kept.concentration, np.empty(len(kept)), kept.unseen
        square_errors(kept.entries, np.zeros(0) if rest is None else rest, kept.K, label, error)
        many = np.ones(len(kept)) if voxels is None else voxels
        return cls(label, found.label.astype(np.int64), found.largest, error, many, kept.K)

    @property
    def right(self) -> Mask:
        """(n,) whether the most likely class is the true one."""
        same: Mask = self.predicted == self.label
        return same


def correctness(belief: Float64 | Evidence, label: Int64, name: str = "all") -> Correctness:
    """Of beliefs (n, K) and true classes (n,)."""
    return _correctness(Predictions.of(belief, label), name)


def _correctness(judged: Predictions, name: str = "all") -> Correctness:
    return correctness_of(judged_sums(judged), name)


def judged_sums(judged: Predictions) -> Float64:
    """(3 + 3 BINS + 3 K,) what all that is said of them is a function of.

    Voxels, right ones and errors; by bin of confidence voxels, confidence and right ones; by class right, true and
    predicted ones.
    """
    return judged_where(judged, np.ones(len(judged.label), np.bool_))


def judged_where(judged: Predictions, where: Mask) -> Float64:
    """`judged_sums` of those for which `where` (n,) holds."""
    sums: Float64 = _judged_by_group(judged, where - np.int64(1), 1)[0]
    return sums


def _judged_by_group(judged: Predictions, group: Int64, groups: int) -> Float64:
    """(G, ...) `judged_sums` of each group; -1 is none."""
    from semstab.statistics.loops.rows import add_judged

    def of(some: slice) -> Float64:
        sums = np.zeros((groups, 3 + 3 * BINS + 3 * judged.K))
        own = (judged.label, judged.predicted, judged.confidence, judged.error, judged.voxels)
        add_judged(group[some], *(values[some] for values in own), BINS, sums)
        return sums

    return blockwise(of, len(group), groups * judged.K)


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
    return rule_means_of(rule_sums(fused, where.astype(np.float64), truth))


def rule_sums(fused: Beliefs, voxels: Float64, truth: Truth | None = None) -> Float64:
    """(3 M,) of each measure its sum, how often it is defined and how often OP is high enough; then `judged_sums`.

    Each of what was fused stands for so many voxels (n,), 0 leaves it out.
    """
    evidence = Evidence.of(fused.evidence).measured()
    fused = Voxels(fused.op, evidence, fused.drift_sum)
    all_of_it = np.zeros(len(voxels), np.int64)
    total, defined = by_group(all_of_it, [measure.of(fused) for measure in measures()], 1, voxels)
    often = [voxels.sum(where=fused.op >= measure.lowest_op) for measure in measures()]
    rows = np.stack([total[0], defined[0], often], axis=1).ravel()
    if truth is None:
        return rows
    return np.concatenate([rows, judged_where(Predictions.of(evidence, truth.label, voxels), truth.known)])


def rule_means_of(sums: Float64) -> RuleMeans:
    """Means from `rule_sums`."""
    n = 3 * len(measures())
    means = MeasureMeans.of_sums(sums[:n])
    if len(sums) == n:
        return RuleMeans(means)
    right = correctness_of(sums[n:])
    return RuleMeans(means, right.accuracy, right.miou, right.ece, right.brier)


def reliability(belief: Float64 | Evidence, label: Int64) -> tuple[Reliability, ...]:
    """The bins of the reliability diagram (Guo et al. 2017, ICML) of beliefs (n, K) and true classes (n,)."""
    return reliability_of(judged_sums(Predictions.of(belief, label)))


def by_stratum(table: VoxelTable, truth: Truth, edges: Sequence[int]) -> tuple[Correctness, ...]:
    """Correctness of all voxels with a true class, then of each stratum of OP."""
    return strata_of(stratum_sums(table, truth, edges), edges)


def stratum_sums(table: VoxelTable, truth: Truth, edges: Sequence[int]) -> Float64:
    """(1 + S, ...) `judged_sums` of all voxels with a true class, then of each stratum of OP."""
    return judged_strata(Predictions.of(table.evidence, truth.label, table.voxels), table.op, truth.known, edges)


def judged_strata(judged: Predictions, op: Int32, known: Mask, edges: Sequence[int]) -> Float64:
    """The same of what is judged already, by OP (n,) and where a true class is known (n,)."""
    group = np.where(known, groups_of(op, edges), -1)
    sums = _judged_by_group(judged, group, len(edges) + 1)
    return np.concatenate([sums.sum(axis=0, keepdims=True), sums])


def strata_of(sums: Float64, edges: Sequence[int]) -> tuple[Correctness, ...]:
    """What is said of them, from `stratum_sums`."""
    names = ["all", *(name for name, _, _ in strata(edges))]
    return tuple(correctness_of(own, name) for own, name in zip(sums, names, strict=True))


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
    places = Places.of(table, edge, where=counted)
    parts = (likely * right, likely * ~right, (1 - likely) * right, (1 - likely) * ~right)
    sums = places.means(dict(zip(QUADRANTS, parts, strict=True)))
    wrong, every = sums["stable_wrong"][:, 0], sums["stable_right"][:, 0] + sums["stable_wrong"][:, 0]
    return PlaceSums(places.cell, edge, sums | {"wrong_of_stable": np.stack([wrong, every], axis=1)})


def quadrants_of(sums: PlaceSums) -> Quadrants:
    """The shares, from `quadrant_sums`."""
    voxels = int(sums["stable_right"][1])
    if not voxels:
        return Quadrants(0, *[UNKNOWN] * 5)
    return Quadrants(voxels, *(sums.estimate(name, ratio_of) for name in (*QUADRANTS, "wrong_of_stable")))


def stable_wrong(table: VoxelTable, truth: Truth, *, stable: float = STABLE) -> Mask:
    """(n,) the dangerous voxels: OP >= 3, more likely stable than not, and wrong."""
    return wrong_of_steady(table, truth, steady(table, stable=stable))


def wrong_of_steady(table: VoxelTable, truth: Truth, stable: Float64) -> Mask:
    """The same, by the probability (n,) that each is stable."""
    counted, likely, right = _masks(table, truth, stable)
    return counted & (likely >= LIKELY) & ~right


def _masks(table: VoxelTable, truth: Truth, stable: Float64) -> tuple[Mask, Float64, Mask]:
    """(n,) which voxels count, with what probability each is stable (0 where none is known), and which are right."""
    counted = truth.known & (table.op >= RECURRENT)
    return counted, np.nan_to_num(stable), dominant(table) == truth.label
