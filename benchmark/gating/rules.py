"""The rules of a gate, as text: 'alpha drop < 0.02', 'class human: recall > 0.6'."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from semstab.errors import ConfigError
from semstab.gating.measures import GateMeasure, measure_named

Change = Literal["drop", "rise"]

ALL = "*"
"""Instead of a class' name: a rule of each class."""

GRAMMAR = "[scene NAME:] [class NAME|*:] MEASURE [drop|rise] <|> NUMBER[%]"

RULE = re.compile(
    r"\s*(?:scene\s+(?P<scene>[^:]+?)\s*:\s*)?(?:class\s+(?P<class>.+?)\s*:\s*)?"
    r"(?P<measure>[A-Za-z][\w\s-]*?)(?:\s+(?P<change>drop|rise))?\s*(?P<relation><=|>=|<|>)\s*"
    r"(?P<limit>[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*(?P<percent>%?)\s*",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Rule:
    """What shall hold.

    text     as it was given
    change   of what: how far the measure fell from the baseline's ('drop'), or rose; its own value where none is named
    below    whether that shall be below the limit, or above
    limit    as the measure is given: shares from 0 to 1, flicker in percent
    """

    text: str
    measure: GateMeasure
    change: Change | None
    below: bool
    limit: float
    scene: str | None = None
    class_name: str | None = None

    def of_each(self, classes: Sequence[str]) -> tuple[Rule, ...]:
        """The rules that it stands for: itself, or with 'class *' one for each class."""
        if self.class_name != ALL:
            return (self,)
        return tuple(
            dataclasses.replace(self, text=self.text.replace(ALL, name, 1), class_name=name) for name in classes
        )

    @property
    def bounds_a_loss(self) -> bool:
        """Whether it says how much worse the measure may become."""
        loss = "drop" if self.measure.quantity.better == "higher" else "rise"
        return self.below and self.change == loss


def parse(text: str) -> Rule:
    """A rule from its text. Raises ConfigError with the grammar where it is none."""
    found = RULE.fullmatch(text)
    if found is None:
        raise ConfigError(f"rule '{text}': not understood; write {GRAMMAR}, e.g. 'alpha drop < 0.02'")
    measure = measure_named(found["measure"], f"rule '{text}'")
    limit = float(found["limit"])
    if found["percent"] and measure.quantity.unit != "%":
        limit /= 100
    change: Change | None = None
    if found["change"]:
        change = "drop" if found["change"].lower() == "drop" else "rise"
    rule = Rule(text.strip(), measure, change, found["relation"][0] == "<", limit, found["scene"], found["class"])
    _check(rule)
    return rule


def _check(rule: Rule) -> None:
    name = rule.measure.name
    if not math.isfinite(rule.limit):
        raise ConfigError(f"rule '{rule.text}': its number is too large")
    if rule.class_name is None and not rule.measure.of_all:
        raise ConfigError(f"rule '{rule.text}': {name} is of a class; write 'class NAME: {rule.text}'")
    if rule.class_name is not None and not rule.measure.of_class:
        raise ConfigError(f"rule '{rule.text}': {name} is of all classes; leave 'class {rule.class_name}:' out")
    if rule.change is None and rule.measure.only_change:
        raise ConfigError(f"rule '{rule.text}': {name} is relative to a baseline; write '{name} drop < 0.05'")
