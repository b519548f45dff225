"""What a rule may be about: the numbers that follow from the sums of a run, and what to run for those it lacks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from semstab.comparison.quantities import (
    COVERAGE,
    FLICKER,
    IOU,
    MISLEADING,
    PRECISION,
    REACHED,
    RECALL,
    RECURRENT_VSS,
    SBD_EXCESS,
)
from semstab.config import nearest
from semstab.errors import ConfigError
from semstab.model.measures import ENTROPY, Quantity
from semstab.statistics.agreement import ALPHA, ALPHA_BETWEEN, PSA
from semstab.statistics.correctness import ACCURACY, ECE, MIOU

TRUTH = "run it with --statistics, on a scene with ground truth"
LOOK_ACCURACY = Quantity(key="look_accuracy", title="Accuracy of looks", better="higher", needs="truth")


@dataclass(frozen=True)
class GateMeasure:
    """A number that rules know.

    quantity  its key among influence sums, its title, which way is good
    name      by which a rule calls it; `also` other names
    of_all, of_class  where it has a value: of all classes, of one
    only_change       it has none by itself
    lacking   what to do where a run does not have it
    """

    quantity: Quantity
    name: str
    also: tuple[str, ...] = ()
    of_all: bool = True
    of_class: bool = False
    only_change: bool = False
    lacking: str = "run it again with more overlap between frames"

    @property
    def key(self) -> str:
        """Of the number among the sums."""
        return self.quantity.key


MEASURES = (
    GateMeasure(PSA, "psa"),
    GateMeasure(ALPHA, "alpha", of_class=True),
    GateMeasure(ALPHA_BETWEEN, "alpha between", of_class=True),
    GateMeasure(REACHED, "reached", ("share of ceiling",), of_class=True),
    GateMeasure(RECURRENT_VSS, "vss"),
    GateMeasure(ENTROPY, "entropy"),
    GateMeasure(SBD_EXCESS, "sbd excess", lacking="run it with --statistics, which keeps the order of looks"),
    GateMeasure(FLICKER, "flicker", lacking="run it again with two frames or more"),
    GateMeasure(COVERAGE, "coverage", only_change=True),
    GateMeasure(ACCURACY, "accuracy", lacking=TRUTH),
    GateMeasure(LOOK_ACCURACY, "look accuracy", lacking=TRUTH),
    GateMeasure(MIOU, "miou", lacking=TRUTH),
    GateMeasure(ECE, "ece", lacking=TRUTH),
    GateMeasure(MISLEADING, "wrong of stable", ("stable-and-wrong",), lacking=TRUTH),
    GateMeasure(RECALL, "recall", of_all=False, of_class=True, lacking=TRUTH),
    GateMeasure(PRECISION, "precision", of_all=False, of_class=True, lacking=TRUTH),
    GateMeasure(IOU, "iou", of_all=False, of_class=True, lacking=TRUTH),
)
"""In the order in which they are listed."""

OF_EVIDENCE = (PSA, ALPHA, ALPHA_BETWEEN, REACHED, RECURRENT_VSS, ENTROPY, SBD_EXCESS, ECE)
"""What depends on whether a model gives labels or scores."""


def _plain(name: str) -> str:
    return re.sub(r"[\s_-]+", " ", name.strip()).lower()


NAMED = {_plain(name): each for each in MEASURES for name in (each.name, each.quantity.title, *each.also)}


def measure_named(name: str, where: str) -> GateMeasure:
    """By any of its names. Raises ConfigError, which says where, for one that there is not."""
    found = NAMED.get(_plain(name))
    if found is None:
        raise ConfigError(f"{where}: no measure '{name}'; {nearest(_plain(name), listed())}")
    return found


def listed() -> Sequence[str]:
    """The names of all measures."""
    return [measure.name for measure in MEASURES]
