"""The numbers that follow from cluster sums: alpha, PSA, accuracy, mean IoU and others, of all classes or of one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from semstab.core.types import Float64
from semstab.data.measures import Measure, measures
from semstab.statistics.agreement import ONE_HOT, alpha_of, ratio_of
from semstab.statistics.cluster_sums.columns import WITHOUT_FRAMES, of_measure
from semstab.statistics.cluster_sums.sums import ClusterSums

Statistic = Callable[[Float64], Float64]
Scale = Literal["share", "agreement", "plain"]


Part = Literal["map", "fine", "coarse"]


def iou_of(sums: Float64) -> Float64:
    """Return intersection over union (...,) of a class from the right, a count, the true and the predicted."""
    right, _, true, predicted = np.moveaxis(sums, -1, 0)
    union = true + predicted - right
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio: Float64 = np.where(union.real > 0, right / union, np.nan)
    return ratio


def miou_of(sums: Float64) -> Float64:
    """Return mean intersection over union (...,) over the classes that are true or predicted anywhere.

    The sums (..., 2 + 3 K) are a count twice, then of each class the right, the true and the predicted.
    """
    right, true, predicted = np.split(sums[..., 2:], 3, axis=-1)
    union = true + predicted - right
    defined = union.real > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        mean: Float64 = np.where(defined, right / np.where(defined, union, 1), 0).sum(axis=-1) / defined.sum(axis=-1)
    return mean


def ece_of(sums: Float64) -> Float64:
    """Return expected calibration error (...,) from a count twice, and right less confidence in each bin."""
    gap = sums[..., 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        error: Float64 = (np.sign(gap.real) * gap).sum(axis=-1) / sums[..., 1]
    return error


def class_alpha_of(sums: Float64) -> Float64:
    """Return alpha (...,) of a class against all others from the sums `CLASS_SUMS` (..., 4)."""
    apart, n, total, squares = np.moveaxis(sums, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = 2 * ((n - 1) * total - total**2 + squares) / (n * (n - 1))
        value: Float64 = 1 - (apart / n) / np.where(expected.real > ONE_HOT, expected, np.nan)
    return value


@dataclass(frozen=True)
class Functional:
    """A number that is a smooth function of sums over a map.

    The second sum counts the terms of the first.

    Attributes:
        names: Names of the sums.
        of: The number (...,) from these sums (..., C).
        low, high: Its range.
        scale: Scale of its interval: a 'share' or mean of numbers from 0 to 1, an 'agreement', at most 1, or 'plain'.
        parts: The parts that its sums come from, each with its weight: a map, or sampled cells.
        pairs: The first sum is of pairwise agreement; at a location that two frames saw, neither frame has it for
            itself alone.
        by_location: What a location adds is no frame's more than another's, so that frames do not show how much the
            number varies between flights: its intervals are for these frames (docs/validity.md).
    """

    names: tuple[str, ...]
    of: Statistic
    low: float = 0.0
    high: float = 1.0
    scale: Scale = "share"
    pairs: bool = False
    parts: tuple[tuple[Part, float], ...] = (("map", 1.0),)
    by_location: bool = False


CELLS: tuple[tuple[Part, float], ...] = (("fine", 2.0), ("coarse", -1.0))
"""2 alpha(h) - alpha(2 h): alpha falls with the size of cells, to first order linearly, as they mix more surfaces."""


ALPHA_SUMS = ("agreeing", "observations", "own", "evidence")
CLASS_SUMS = ("class_apart", "observations", "evidence", "class_own")

FUNCTIONALS: Mapping[str, Functional] = {
    "psa": Functional(("psa", "voxels"), ratio_of, pairs=True),
    "alpha": Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=True, parts=CELLS),
    "voxel_alpha": Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=True),
    "vss": Functional(("vss", "recurrent"), ratio_of),
    "entropy": Functional(("entropy", "voxels"), ratio_of, by_location=True),
    "accuracy": Functional(("right", "known"), ratio_of),
    "observation_accuracy": Functional(("observed_right", "observed"), ratio_of),
    "wrong_of_consistent": Functional(("consistent_wrong", "consistent"), ratio_of, by_location=True),
    "sbd_excess": Functional(("sbd_excess", "sbd_known"), ratio_of, -1.0, 1.0, "plain"),
    "miou": Functional(("known", "known", "class_right", "class_known", "class_predicted"), miou_of, scale="plain"),
    "ece": Functional(("calibrated", "calibrated", "gap"), ece_of, scale="plain"),
}
"""Numbers by key: alpha, of cells that two views saw or more; PSA, Krippendorff's alpha of voxels and entropy at
OP >= 2, VSS at OP >= 3, SBD less that in random order where that is known; with ground truth the accuracy of the fused
labels at OP >= 2 and of single observations, the wrong among the consistent locations at OP >= 3, mean intersection
over union and expected calibration error at OP >= 2."""

BY_CLASS: Mapping[str, Functional] = {
    "alpha": Functional(CLASS_SUMS, class_alpha_of, -1.0, 1.0, "agreement", parts=CELLS),
    "voxel_alpha": Functional(CLASS_SUMS, class_alpha_of, -1.0, 1.0, "agreement"),
    "accuracy": Functional(("class_right", "class_known"), ratio_of),
    "precision": Functional(("class_right", "class_predicted"), ratio_of),
    "iou": Functional(("class_right", "known", "class_known", "class_predicted"), iou_of),
}
"""Numbers of one class by key: alphas against all others, accuracy where it is the true one (recall) and where it is
predicted (precision), and intersection over union."""


def summed() -> tuple[Measure, ...]:
    """Return the measures of the register whose sums are over voxels; the other ones have sums over observations."""
    return tuple(measure for measure in measures() if measure.key not in FUNCTIONALS)


def mean_over_voxels(measure: Measure) -> Functional:
    """Return the mean of a measure of the register over the voxels with OP >= 2 where it is defined."""
    scale: Scale = "share" if measure.largest == 1 else "plain"
    return Functional(of_measure(measure.key), ratio_of, 0.0, measure.largest, scale, by_location=True)


def functional(key: str, k: int | None = None) -> Functional:
    """Return the number that a key stands for: of all classes, or of class k."""
    if k is not None:
        return BY_CLASS[key]
    if key in FUNCTIONALS:
        return FUNCTIONALS[key]
    return mean_over_voxels({measure.key: measure for measure in summed()}[key])


def parts_of(sums: ClusterSums, number: Functional) -> tuple[tuple[ClusterSums, float], ...]:
    """Return the sums that a number is of, each with its weight; none where they are missing."""
    of = {"map": sums, "fine": sums.fine, "coarse": sums.coarse}
    present = [(part, weight) for name, weight in number.parts if (part := of[name]) is not None]
    known = all(set(number.names) <= set(part.layout) for part, _ in present)
    return tuple(present) if known and len(present) == len(number.parts) else ()


def columns_of(part: ClusterSums, key: str, k: int | None = None) -> Float64:
    """Return the sums (m, C) of a part that a number is of."""
    selected = [part[name] for name in functional(key, k).names]
    if k is not None:
        selected = [columns[:, min(k, columns.shape[1] - 1)][:, None] for columns in selected]
    return np.concatenate(selected, axis=1)


def value(sums: ClusterSums, key: str, k: int | None = None) -> float:
    """Return the number; NaN where undefined."""
    number = functional(key, k)
    parts = parts_of(sums, number)
    weighted = [weight * float(number.of(columns_of(part, key, k).sum(axis=0))) for part, weight in parts]
    return sum(weighted) if weighted else math.nan


def frames_of(sums: ClusterSums, key: str, k: int | None = None) -> int:
    """Return how many frames, or views, a number is of, about; 0 where they are unknown."""
    parts = parts_of(sums, functional(key, k))
    return parts[0][0].frame_count if parts else 0


def chance_of(cells: ClusterSums) -> float:
    """Return the probability that two observations from anywhere, of different views, agree; NaN for fewer than two."""
    evidence, n = cells["evidence"].sum(axis=0), float(cells["observations"].sum())
    return float((evidence**2).sum() - cells["own"].sum()) / (n * (n - 1)) if n > 1 else math.nan


def of_space_alone(key: str, k: int | None = None) -> bool:
    """Return whether frames do not show how much a number varies, so that its intervals are for these frames."""
    number = functional(key, k)
    return number.by_location or set(number.names) <= set(WITHOUT_FRAMES)
