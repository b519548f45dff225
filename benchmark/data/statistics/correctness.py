"""Right and wrong labels: accuracy, calibration, stability against accuracy, and the errors of geometry."""

from __future__ import annotations

from dataclasses import dataclass

from semstab.data.statistics.intervals import UNKNOWN, Estimate, Interval


@dataclass(frozen=True)
class Reliability:
    """One bin of the reliability diagram: voxels whose largest belief lies in (low, high]."""

    low: float
    high: float
    voxels: int
    confidence: float
    accuracy: float


@dataclass(frozen=True)
class Correctness:
    """Accuracy of the fused labels of a group of voxels; NaN without voxels of a known true class.

    Attributes:
        miou: Mean over the classes that are true or predicted somewhere, of intersection over union.
        ece: Expected calibration error: mean |accuracy - confidence| over 15 bins of the largest belief, by voxels.
        brier: Mean over voxels of sum_k (p_k - y_k)^2, 0 to 2.
    """

    name: str
    voxels: int
    accuracy: float
    miou: float
    ece: float
    brier: float


@dataclass(frozen=True)
class Quadrants:
    """Shares of the voxels with OP >= 3 and a true class that are consistent or not, right or wrong.

    wrong_of_consistent_op3 is the share of the consistent voxels that are wrong: the error where the map looks safe.
    """

    voxels: int
    consistent_right: Interval
    consistent_wrong: Interval
    inconsistent_right: Interval
    inconsistent_wrong: Interval
    wrong_of_consistent_op3: Interval


@dataclass(frozen=True)
class CorrectnessStatistics:
    """Stability vs. accuracy of the fused labels.

    Attributes:
        accuracy_op2, miou_op2: Of the voxels seen twice or more, as `compare` and gates have them.
        strata: All voxels with a true class, then each stratum of OP.
    """

    accuracy_op2: Interval
    strata: tuple[Correctness, ...]
    reliability: tuple[Reliability, ...]
    quadrants: Quadrants
    miou_op2: Interval = UNKNOWN


@dataclass(frozen=True)
class Losses:
    """The pairwise disagreement 1 - PSA over voxels with OP >= 2 in both maps, and its sources.

    share is geometry's part of the total. A negative part of the model means that its labels agree better than
    view-independent labels: the model makes the same errors in all views.
    """

    voxels: int
    total: Estimate
    geometry: Estimate
    model: Estimate
    share: Estimate
