"""What is compared, in the order of the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from semstab.model.measures import ENTROPY, VSS, Quantity, measures
from semstab.statistics.agreement import ALPHA, ALPHA_BETWEEN, PSA
from semstab.statistics.correctness import ACCURACY, ECE, MIOU

REACHED = Quantity(key="reached", title="Share of the ceiling", short="of ceiling", better="higher", digits=(3, 4))
RECURRENT_VSS = Quantity(key="vss", title="VSS at OP>=3", better="higher", digits=VSS.digits)
SBD_EXCESS = Quantity(key="sbd_excess", title="SBD excess", unit="bits", better="lower", digits=(4, 4))
FLICKER = Quantity(key="flicker_percent", title="Flicker", unit="%", better="lower", digits=(2, 2))
COVERAGE = Quantity(key="coverage", title="Coverage", better="higher")
MISLEADING = Quantity(
    key="wrong_of_stable", title="Stable and wrong", short="stable, wrong", better="lower", needs="truth"
)
RECALL = Quantity(key="accuracy", title="Recall", better="higher", needs="truth")
PRECISION = Quantity(key="precision", title="Precision", better="higher", needs="truth")
IOU = Quantity(key="iou", title="IoU", better="higher", needs="truth")

VERDICT = REACHED
"""What a verdict rests on, and so the first row."""

HEADLINES = (
    VERDICT, ALPHA_BETWEEN, ALPHA, PSA, RECURRENT_VSS, SBD_EXCESS, FLICKER, COVERAGE, ACCURACY, MIOU, ECE, MISLEADING,
)  # fmt: skip
"""What every table shows."""

BY_CLASS = (VERDICT, ALPHA_BETWEEN, ALPHA, PSA, RECURRENT_VSS, SBD_EXCESS, RECALL, PRECISION, IOU, ECE, MISLEADING)
"""What is compared class by class."""


def quantities() -> tuple[Quantity, ...]:
    """All that is compared: the headlines, then the mean over voxels of each other measure of the register."""
    return (*HEADLINES, *(measure for measure in measures() if measure is not VSS))


def by_key(chosen: Sequence[Quantity]) -> Mapping[str, Quantity]:
    """The same by their keys."""
    return {quantity.key: quantity for quantity in chosen}


IN_SUMS = (ALPHA_BETWEEN, ALPHA, PSA, RECURRENT_VSS, SBD_EXCESS, ENTROPY, ACCURACY, MIOU, ECE, MISLEADING)
"""Of these the sums by frame and place tell all."""

ONE_AGAINST_ALL = (VERDICT, ALPHA_BETWEEN, ALPHA, RECALL, PRECISION, IOU)
"""By class: of that class against all others; the rest is of the places of that class."""
