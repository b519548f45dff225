"""The numbers that follow from cluster sums: alpha, PSA, accuracy, mean IoU and others, of all classes or of one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from semstab.core.types import Float64
from semstab.data.measures import Measure, measures
from semstab.metrics.correctness import calibration_error, iou, mean_iou
from semstab.statistics.agreement import alpha_of, class_alpha_of, meaning_alpha_of, ratio_of
from semstab.statistics.cluster_sums.columns import WITHOUT_FRAMES, of_measure
from semstab.statistics.cluster_sums.sums import ClusterSums

Statistic = Callable[[Float64], Float64]
Scale = Literal["share", "agreement", "plain"]


def iou_of(sums: Float64) -> Float64:
    """Return intersection over union (...,) of a class from the right, a count, the true and the predicted."""
    right, _, true, predicted = np.moveaxis(sums, -1, 0)
    return iou(right, true, predicted)


def miou_of(sums: Float64) -> Float64:
    """Return mean IoU (...,) from a count twice, then of each class the right, the true and the predicted."""
    return mean_iou(*np.split(sums[..., 2:], 3, axis=-1))


def ece_of(sums: Float64) -> Float64:
    """Return expected calibration error (...,) from a count twice, and right less confidence in each bin."""
    return calibration_error(sums[..., 2:], sums[..., 1])


@dataclass(frozen=True)
class Functional:
    """A number that is a smooth function of sums over clusters.

    The second column of its sums counts the terms of the first.

    Attributes:
        names: Names of the sums.
        of: The number (...,) from these sums (..., C).
        low, high: Its range.
        scale: Scale of its interval: a 'share' or mean of numbers from 0 to 1, an 'agreement', at most 1, or 'plain'.
        of_spots: Its sums are of the answers of spots, not of a map; see `parts_of`.
        of_features: Its sums are of features at spots.
        pairs: Names of the part of the first two sums that is of pairs alone, where the first is of pairwise
            agreement: at a location that two frames saw, neither frame has it for itself alone.
        pair_weight: Weight of an observation of these pairs in the first two sums.
        by_location: What a location adds is no frame's more than another's, so that frames do not show how much the
            number varies between flights: its intervals are for these frames (docs/validity.md).
        k: The class whose columns are taken from sums by class; None for the columns of all classes.
    """

    names: tuple[str, ...]
    of: Statistic
    low: float = 0.0
    high: float = 1.0
    scale: Scale = "share"
    pairs: tuple[str, ...] = ()
    pair_weight: float = 1.0
    of_spots: bool = False
    of_features: bool = False
    by_location: bool = False
    k: int | None = None

    @property
    def of_space_alone(self) -> bool:
        """Return whether frames do not show how much the number varies, so that its intervals are for these frames."""
        return self.by_location or set(self.names) <= set(WITHOUT_FRAMES)


def lever_of(answers: Sequence[ClusterSums]) -> float:
    """Return by how much of the fall from first to second answers alpha lies above alpha of the first ones.

    The parabola through disagreement D, D', D'' at the root mean square distances d < d' < d'' of three answers is read
    at 0: lever = (D - D(0)) / (D' - D). A sharp border of classes gives a line, one that models place differently by
    more than a pixel a parabola, and labels finer than pixels a curve that levels off.
    """
    first, second, _ = answers
    n = float(first["observations"].sum())
    if not n > 0:
        return 0.0
    agreeing = [float(part["agreeing"].sum()) / n for part in answers]
    return lever_from(float(first["square"].sum()), float(second["square"].sum()), agreeing)


LEAST_FALL, LARGEST_RATIO = 1e-3, 3.0
"""Fall of agreement from first to second answers from on which its form is told, else it is a line; and the largest
ratio of the further fall to it, which a parabola around 0 has."""


def lever_from(near: float, far: float, agreeing: Sequence[float]) -> float:
    """Return the lever from sums of squared distances of first and second answers, and three agreements.

    It is 0 if the second answers are the first ones.
    """
    if not far > SAME * near > 0:
        return 0.0
    first, second, third = agreeing
    d, d1 = 1.0, math.sqrt(far / near)
    d2 = math.sqrt(1 + 4 * (d1**2 - 1))  # the third answer is two steps away, not one
    ratio = (second - third) / (first - second) if first - second > LEAST_FALL else (d2 - d1) / (d1 - d)
    at_second, at_third = d * d2 / ((d - d1) * (d2 - d1)), d * d1 / ((d - d2) * (d1 - d2))
    return -at_second - at_third - at_third * min(max(ratio, 0.0), LARGEST_RATIO)


SAME = 1.2
"""Second answers are farther than first ones if their squared distances are larger by this factor."""


ALPHA_SUMS = ("agreeing", "observations", "own", "evidence")
CLASS_SUMS = ("class_apart", "observations", "evidence", "class_own")
PAIRS = ("twice_agreeing", "twice")
MEANING_SUMS = ("similar", "observations", "similar_own", "norm", "toward", "against")

FUNCTIONALS: Mapping[str, Functional] = {
    "psa": Functional(("psa", "voxels"), ratio_of, pairs=PAIRS, pair_weight=0.5),
    "alpha": Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=PAIRS, of_spots=True),
    "alpha_by_meaning": Functional(
        MEANING_SUMS, meaning_alpha_of, -1.0, 1.0, "agreement", pairs=("twice_similar", "twice"), of_spots=True
    ),
    "feature_alpha": Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=PAIRS, of_features=True),
    "voxel_alpha": Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=PAIRS),
    "vss": Functional(("vss", "recurrent"), ratio_of),
    "entropy_op2": Functional(("entropy", "voxels"), ratio_of, by_location=True),
    "accuracy": Functional(("right", "known"), ratio_of),
    "observation_accuracy": Functional(("observed_right", "observed"), ratio_of),
    "wrong_of_consistent": Functional(("consistent_wrong", "consistent"), ratio_of, by_location=True),
    "sbd_excess": Functional(("sbd_excess", "sbd_known"), ratio_of, -1.0, 1.0, "plain"),
    "miou": Functional(("known", "known", "class_right", "class_known", "class_predicted"), miou_of, scale="plain"),
    "ece": Functional(("calibrated", "calibrated", "gap"), ece_of, scale="plain"),
}
"""Numbers by key: alpha, of spots that two views saw or more, and the same with distances between classes, and of
features; PSA,
Krippendorff's alpha of voxels and entropy at OP >= 2 (`entropy_op2`); VSS at OP >= 3; SBD minus SBD in random order if
the order is known. With ground truth: accuracy of the fused labels at OP >= 2 and of single observations, the wrong
among the consistent locations at OP >= 3, mean intersection over union and expected calibration error at OP >= 2."""

BY_CLASS: Mapping[str, Functional] = {
    "alpha": Functional(CLASS_SUMS, class_alpha_of, -1.0, 1.0, "agreement", of_spots=True),
    "voxel_alpha": Functional(CLASS_SUMS, class_alpha_of, -1.0, 1.0, "agreement"),
    "accuracy": Functional(("class_right", "class_known"), ratio_of),
    "precision": Functional(("class_right", "class_predicted"), ratio_of),
    "iou": Functional(("class_right", "known", "class_known", "class_predicted"), iou_of),
}
"""Numbers of one class by key: alphas against all others, accuracy over its true voxels (recall) and over its
predicted voxels (precision), and intersection over union."""


def summed() -> tuple[Measure, ...]:
    """Return the measures of the register whose sums are over voxels; the other ones have sums over observations."""
    return tuple(measure for measure in measures() if measure.key not in FUNCTIONALS)


def mean_over_voxels(measure: Measure) -> Functional:
    """Return the mean of a measure of the register over the voxels with OP >= 3 that have a value."""
    scale: Scale = "share" if measure.largest == 1 else "plain"
    return Functional(of_measure(measure.key), ratio_of, 0.0, measure.largest, scale, by_location=True)


def mean_functional(name: str, low: float = 0.0, high: float = 1.0) -> Functional:
    """Return the mean of values from low to high, whose sums and numbers are the two columns of a name."""
    return Functional((name,), ratio_of, low, high, "share" if (low, high) == (0, 1) else "plain")


def functional(key: str | Functional, k: int | None = None) -> Functional:
    """Return the number that a key stands for: of all classes, or of class k; a number stands for itself."""
    if isinstance(key, Functional):
        return key
    if k is not None:
        return dataclasses.replace(BY_CLASS[key], k=k)
    if key in FUNCTIONALS:
        return FUNCTIONALS[key]
    return mean_over_voxels({measure.key: measure for measure in summed()}[key])


def parts_of(sums: ClusterSums, number: Functional) -> tuple[tuple[ClusterSums, float], ...]:
    """Return the sums that a number is of, each with its weight; none where they are missing.

    Of spots it is alpha + lever (alpha - alpha'), with alpha' of the second answers: agreement falls with the distance
    of the points that answer from the spot, as a border of two classes may lie between them.
    """
    parts: tuple[tuple[ClusterSums, float], ...] = ((sums, 1.0),)
    if number.of_features:
        parts = () if sums.features is None else ((sums.features, 1.0),)
    elif number.of_spots:
        if not sums.answers:
            return ()
        first, second, _ = sums.answers
        lever = lever_of(sums.answers)
        parts = (first, 1 + lever), (second, -lever)
    return parts if all(set(number.names) <= set(part.layout) for part, _ in parts) else ()


def columns_of(part: ClusterSums, number: Functional) -> Float64:
    """Return the sums (m, C) of a part that a number is of."""
    selected, k = [part[name] for name in number.names], number.k
    if k is not None:
        selected = [columns[:, min(k, columns.shape[1] - 1)][:, None] for columns in selected]
    return np.concatenate(selected, axis=1)


def value(sums: ClusterSums, key: str | Functional, k: int | None = None) -> float:
    """Return the number, within its range although alpha is extrapolated to the spot itself; NaN if undefined."""
    number = functional(key, k)
    parts = parts_of(sums, number)
    if not parts:
        return math.nan
    result = float(sum(weight * number.of(columns_of(part, number).sum(axis=0)) for part, weight in parts))
    return result if math.isnan(result) else min(max(result, number.low), number.high)


def frames_of(sums: ClusterSums, key: str | Functional, k: int | None = None) -> int:
    """Return how many frames, or views, a number is of, about; 0 where they are unknown."""
    parts = parts_of(sums, functional(key, k))
    return parts[0][0].frame_count if parts else 0


def chance_of(spots: ClusterSums) -> float:
    """Return the probability that two observations from anywhere, of different views, agree; NaN for fewer than two."""
    evidence, n = spots["evidence"].sum(axis=0), float(spots["observations"].sum())
    return float((evidence**2).sum() - spots["own"].sum()) / (n * (n - 1)) if n > 1 else math.nan
