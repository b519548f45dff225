"""The rules of a gate as text, such as 'alpha drop < 0.02', and the measures that they may name."""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from semstab.comparison.features import FEATURE_ALPHA
from semstab.comparison.quantities import (
    COVERAGE,
    FLICKER,
    IOU,
    MISLEADING,
    PRECISION,
    RECALL,
    RECURRENT_VSS,
    SBD_EXCESS,
)
from semstab.config import nearest
from semstab.data.measures import ENTROPY, Quantity
from semstab.errors import ConfigError
from semstab.statistics.agreement import ALPHA, ALPHA_BY_MEANING, PSA, VOXEL_ALPHA
from semstab.statistics.cluster_sums import summed
from semstab.statistics.correctness import ACCURACY, ECE, MIOU

# Rules are about the numbers that follow from the sums of a run; each has advice for runs that do not have it.

TRUTH = "run it on a scene with ground truth, without --no-truth"
OBSERVATION_ACCURACY = Quantity(
    key="observation_accuracy", title="Accuracy of observations", better="higher", needs="truth", op=2
)


@dataclass(frozen=True)
class GateMeasure:
    """A number that rules may name.

    Attributes:
        quantity: Its key among cluster sums, its title, and its better direction.
        name: Its name in rules; `also` has other names.
        of_all, of_class: True if it has a value of all classes, or of one class.
        only_change: True if it has no value by itself.
        if_missing: Advice where a run does not have it.
    """

    quantity: Quantity
    name: str
    also: tuple[str, ...] = ()
    of_all: bool = True
    of_class: bool = False
    only_change: bool = False
    if_missing: str = "run it again with more overlap between frames"


MEASURES = (
    GateMeasure(PSA, "psa"),
    GateMeasure(ALPHA, "alpha", of_class=True),
    GateMeasure(ALPHA_BY_MEANING, "alpha by meaning", if_missing="run it with distances between classes (--distances)"),
    GateMeasure(FEATURE_ALPHA, "alpha of features", (FEATURE_ALPHA.key,), if_missing="run a model that gives features"),
    GateMeasure(RECURRENT_VSS, "vss"),
    GateMeasure(VOXEL_ALPHA, "voxel alpha", of_class=True),
    GateMeasure(ENTROPY, "entropy"),
    GateMeasure(SBD_EXCESS, "sbd excess", if_missing="run it with --statistics, which keeps the order of observations"),
    GateMeasure(FLICKER, "flicker", if_missing="run it again with two frames or more"),
    GateMeasure(COVERAGE, "coverage", only_change=True),
    GateMeasure(ACCURACY, "accuracy", if_missing=TRUTH),
    GateMeasure(OBSERVATION_ACCURACY, "observation accuracy", ("look accuracy",), if_missing=TRUTH),
    GateMeasure(MIOU, "miou", if_missing=TRUTH),
    GateMeasure(ECE, "ece", if_missing=TRUTH),
    GateMeasure(MISLEADING, "wrong of consistent", ("wrong of stable", "stable-and-wrong"), if_missing=TRUTH),
    GateMeasure(RECALL, "recall", of_all=False, of_class=True, if_missing=TRUTH),
    GateMeasure(PRECISION, "precision", of_all=False, of_class=True, if_missing=TRUTH),
    GateMeasure(IOU, "iou", of_all=False, of_class=True, if_missing=TRUTH),
)
"""Measures in the order of lists; the measures of the register follow."""


def gate_measures() -> tuple[GateMeasure, ...]:
    """Return all measures in the order of lists."""
    return (*MEASURES, *(GateMeasure(measure, _plain(measure.key), if_missing="run it again") for measure in summed()))


def _plain(name: str) -> str:
    return re.sub(r"[\s_-]+", " ", name.strip()).lower()


def measure_named(name: str, where: str) -> GateMeasure:
    """Return a measure by any of its names.

    Raises:
        ConfigError: If there is no such measure; the message starts with `where`.
    """
    measures = gate_measures()
    measure_by_word = {
        _plain(word): measure
        for measure in reversed(measures)
        for word in (measure.name, measure.quantity.title, *measure.also)
    }
    if _plain(name) not in measure_by_word:
        raise ConfigError(
            f"{where}: no measure '{name}'; {nearest(_plain(name), [measure.name for measure in measures])}"
        )
    return measure_by_word[_plain(name)]


# The rules of a gate, as text: 'alpha drop < 0.02', 'class human: recall > 0.6'.

Change = Literal["drop", "rise"]

ALL = "*"
"""The name instead of a class' name for a rule of each class."""

GRAMMAR = "[scene NAME:] [class NAME|*:] MEASURE [drop|rise] <|> NUMBER[%]"

RULE = re.compile(
    r"\s*(?:scene\s+(?P<scene>[^:]+?)\s*:\s*)?(?:class\s+(?P<class>.+?)\s*:\s*)?"
    r"(?P<measure>[A-Za-z][\w\s-]*?)(?:\s+(?P<change>drop|rise))?\s*(?P<relation><=|>=|<|>)\s*"
    r"(?P<limit>[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*(?P<percent>%?)\s*",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class GateRule:
    """A condition on a measure.

    Attributes:
        text: The rule as it was written.
        change: The change from the baseline that is limited, a 'drop' or a 'rise'; None for the value itself.
        below: True for a number below the limit, false for one above.
        limit: The limit in the unit of the measure: shares from 0 to 1, flicker in percent.
        or_equal: True if the number may be the limit itself, which only counts can show.
    """

    text: str
    measure: GateMeasure
    change: Change | None
    below: bool
    limit: float
    scene: str | None = None
    class_name: str | None = None
    or_equal: bool = False

    def of_each(self, classes: Sequence[str]) -> tuple[GateRule, ...]:
        """Return the rules that this one stands for: itself, or with 'class *' one for each class."""
        if self.class_name != ALL:
            return (self,)
        return tuple(
            dataclasses.replace(self, text=self.text.replace(ALL, name, 1), class_name=name) for name in classes
        )

    @property
    def bounds_a_loss(self) -> bool:
        """Return whether the rule limits how much worse the measure may become."""
        loss = "drop" if self.measure.quantity.better == "higher" else "rise"
        return self.below and self.change == loss


def parse(text: str) -> GateRule:
    """Return a rule from its text.

    Raises:
        ConfigError: If the text is no rule; the message has the grammar.
    """
    result = RULE.fullmatch(text)
    if result is None:
        raise ConfigError(f"rule '{text}': not understood; write {GRAMMAR}, e.g. 'alpha drop < 0.02'")
    if (meant := _change_meant(result["measure"])) is not None:
        word, change_word = meant
        raise ConfigError(f"rule '{text}': no change '{word}'; did you mean '{change_word}'?")
    measure = measure_named(result["measure"], f"rule '{text}'")
    limit = float(result["limit"])
    if result["percent"] and measure.quantity.unit != "%":
        limit /= 100
    change: Change | None = None
    if result["change"]:
        change = "drop" if result["change"].lower() == "drop" else "rise"
    relation = result["relation"]
    rule = GateRule(
        text.strip(), measure, change, relation[0] == "<", limit, result["scene"], result["class"], len(relation) > 1
    )
    _check_rule(rule)
    return rule


def _change_meant(name: str) -> tuple[str, str] | None:
    """Return the last word after a measure's name, which is no change, and the change that is meant; None else."""
    measure, _, word = name.rpartition(" ")
    names = {
        _plain(alias)
        for gate_measure in gate_measures()
        for alias in (gate_measure.name, gate_measure.quantity.title, *gate_measure.also)
    }
    near = difflib.get_close_matches(word.lower(), get_args(Change), n=1)
    return (word, near[0]) if near and _plain(measure) in names and _plain(name) not in names else None


def _check_rule(rule: GateRule) -> None:
    name = rule.measure.name
    if not math.isfinite(rule.limit):
        raise ConfigError(f"rule '{rule.text}': its number is too large")
    if rule.class_name is None and not rule.measure.of_all:
        raise ConfigError(f"rule '{rule.text}': {name} is of one class; write 'class NAME: {rule.text}'")
    if rule.class_name is not None and not rule.measure.of_class:
        raise ConfigError(f"rule '{rule.text}': {name} is of all classes; leave 'class {rule.class_name}:' out")
    if rule.change is None and rule.measure.only_change:
        raise ConfigError(f"rule '{rule.text}': {name} is relative to a baseline; write '{name} drop < 0.05'")
