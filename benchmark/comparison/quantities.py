"""The compared measures, in the order of the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from semstab.data.measures import ENTROPY, RECURRENT, VSS, Quantity, measures
from semstab.statistics.agreement import ALPHA, ALPHA_BY_MEANING, PSA, VOXEL_ALPHA
from semstab.statistics.correctness import ACCURACY, ECE, MIOU

RECURRENT_VSS = Quantity(key="vss", title="VSS", better="higher", op=RECURRENT, digits=VSS.digits)
SBD_EXCESS = Quantity(key="sbd_excess", title="SBD excess", op=2, unit="bits", better="lower", digits=(4, 4))
FLICKER = Quantity(key="compensated_flicker_percent", title="Flicker", unit="%", better="lower", digits=(2, 2))
COVERAGE = Quantity(key="coverage", title="Coverage", better="higher", op=2)
MISLEADING = Quantity(
    key="wrong_of_consistent",
    title="Consistent but wrong",
    short="consistent, wrong",
    better="lower",
    needs="truth",
    op=RECURRENT,
)
RECALL = Quantity(key="accuracy", title="Recall", better="higher", needs="truth", op=2)
PRECISION = Quantity(key="precision", title="Precision", better="higher", needs="truth", op=2)
IOU = Quantity(key="iou", title="IoU", better="higher", needs="truth", op=2)

HEADLINES = (
    ALPHA, ALPHA_BY_MEANING, PSA, RECURRENT_VSS, SBD_EXCESS, FLICKER, COVERAGE, ACCURACY, MIOU, ECE, MISLEADING,
    VOXEL_ALPHA,
)  # fmt: skip
"""Measures that every table shows; verdicts rest on the first."""

BY_CLASS = (ALPHA, VOXEL_ALPHA, PSA, RECURRENT_VSS, SBD_EXCESS, RECALL, PRECISION, IOU, ECE, MISLEADING)
"""Measures that are compared class by class."""


def quantities() -> tuple[Quantity, ...]:
    """Return all compared measures: the headlines, then the mean over voxels of each other measure of the register."""
    return (*HEADLINES, *(measure for measure in measures() if measure is not VSS))


def by_name(chosen: Sequence[Quantity]) -> Mapping[str, Quantity]:
    """Return the measures by their names."""
    return {quantity.name: quantity for quantity in chosen}


IN_SUMS = (
    ALPHA, ALPHA_BY_MEANING, VOXEL_ALPHA, PSA, RECURRENT_VSS, SBD_EXCESS, ENTROPY, ACCURACY, MIOU, ECE, MISLEADING,
)  # fmt: skip
"""Measures that follow from the sums by frame and location alone."""

ONE_AGAINST_ALL = (ALPHA, VOXEL_ALPHA, RECALL, PRECISION, IOU)
"""Measures of a class against all others; others by class are of the locations of that class."""
