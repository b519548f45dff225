"""What a rule may be about: the numbers that follow from the sums of a run, and what to run for those it lacks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from semstab.config import nearest
from semstab.errors import ConfigError
from semstab.model.measures import Quantity
from semstab.statistics.agreement import ALPHA, ALPHA_BETWEEN, PSA
from semstab.statistics.correctness import ACCURACY, ECE, MIOU

TRUTH = "run it with --statistics, on a scene with ground truth"


@dataclass(frozen=True)
class GateMeasure:
    """A number that rules know.

    quantity  its key among influence sums, its title, which way is good
    names     by which a rule may call it
    where     where it has a value: of all classes, of one, both; or only as a change
    lacking   what to do where a run does not have it
    """

    quantity: Quantity
    names: tuple[str, ...] = ()
    of_all: bool = True
    of_class: bool = False
    only_change: bool = False
    lacking: str = "run it again with more overlap between frames"

    @property
    def key(self) -> str:
        """Of the number, in files and functions."""
        return self.quantity.key


FLICKER = Quantity(key="flicker", title="Flicker", better="lower", unit="%", digits=(2, 2))
COVERAGE = Quantity(key="coverage", title="Coverage", better="higher")

MEASURES = (
    GateMeasure(PSA),
    GateMeasure(ALPHA, of_class=True),
    GateMeasure(ALPHA_BETWEEN, of_class=True),
    GateMeasure(
        Quantity(key="reached", title="Share of the ceiling", better="higher"), ("share of ceiling",), of_class=True,
    ),
    GateMeasure(Quantity(key="vss", title="VSS at OP>=3", better="higher"), ("vss",)),
    GateMeasure(Quantity(key="entropy", title="Entropy at OP>=2", better="lower"), ("entropy",)),
    GateMeasure(
        Quantity(key="sbd_excess", title="SBD excess", better="lower", needs="events"),
        lacking="run it with --statistics, which keeps the order of looks",
    ),
    GateMeasure(FLICKER, lacking="run it again with two frames or more"),
    GateMeasure(COVERAGE, only_change=True),
    GateMeasure(ACCURACY, lacking=TRUTH),
    GateMeasure(
        Quantity(key="look_accuracy", title="Accuracy of looks", better="higher", needs="truth"), ("look accuracy",),
        lacking=TRUTH,
    ),
    GateMeasure(MIOU, lacking=TRUTH),
    GateMeasure(ECE, lacking=TRUTH),
    GateMeasure(
        Quantity(key="wrong_of_stable", title="Stable and wrong", better="lower", needs="truth"),
        ("stable-and-wrong", "wrong of stable"), lacking=TRUTH,
    ),
    GateMeasure(
        Quantity(key="recall", title="Recall", better="higher", needs="truth"), of_all=False, of_class=True,
        lacking=TRUTH,
    ),
    GateMeasure(
        Quantity(key="precision", title="Precision", better="higher", needs="truth"), of_all=False, of_class=True,
        lacking=TRUTH,
    ),
    GateMeasure(
        Quantity(key="iou", title="IoU", better="higher", needs="truth"), of_all=False, of_class=True, lacking=TRUTH,
    ),
)  # fmt: skip
"""In the order in which they are listed."""

SUMS = {"recall": "accuracy"}
"""Keys among influence sums that rules call by the field's word."""


OF_EVIDENCE = ("psa", "alpha", "alpha_between", "reached", "vss", "entropy", "sbd_excess", "ece")
"""Keys of what depends on whether a model gives labels or scores."""


def _plain(name: str) -> str:
    return re.sub(r"[\s_-]+", " ", name.strip()).lower()


NAMED = {
    _plain(name): measure for measure in MEASURES for name in (measure.key, measure.quantity.title, *measure.names)
}


def measure_named(name: str, where: str) -> GateMeasure:
    """By any of its names. Raises ConfigError, which says where, for one that there is not."""
    found = NAMED.get(_plain(name))
    if found is None:
        raise ConfigError(f"{where}: no measure '{name}'; {nearest(_plain(name), list(listed()))}")
    return found


def listed() -> Sequence[str]:
    """The names of all measures."""
    return [measure.key.replace("_", " ") for measure in MEASURES]
