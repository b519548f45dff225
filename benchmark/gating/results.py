"""What a gate found: rule by rule, and whether the new run may pass."""

from __future__ import annotations

import math
from dataclasses import dataclass

from semstab.gating.judging import Verdict
from semstab.gating.measures import GateMeasure
from semstab.gating.rules import Rule
from semstab.model.statistics import NEXT_FLIGHT, Interval
from semstab.statistics.sampling import LEAST_FRAMES


@dataclass(frozen=True)
class Judgement:
    """What became of a rule.

    found    what it bounds: the change or the number itself, with one-sided ends at the gate's level
    new, base  the numbers of both, NaN where there is none
    """

    rule: Rule
    verdict: Verdict
    found: Interval
    new: float
    base: float

    @property
    def about(self) -> str:
        """What was random: for which other data the ends are."""
        if self.found.question != NEXT_FLIGHT:
            return "other places like these, in these very frames"
        if self.found.frames < LEAST_FRAMES:
            return f"other places and frames like these {self.found.frames}"
        return "the next flight"

    @property
    def reason(self) -> str:
        """Why, in a few words."""
        if self.verdict == "passes":
            return "shown"
        if self.verdict == "fails":
            bounded = self.rule.bounds_a_loss and self.found.low <= self.rule.limit
            return "a loss is shown, and not that it is within the limit" if bounded else "the contrary is shown"
        return self.found.undecided or "the data show neither"

    def digits(self, value: float) -> str:
        """A number of the rule's measure."""
        measure: GateMeasure = self.rule.measure
        return "-" if math.isnan(value) else f"{value:z.{measure.quantity.digits[0]}f}"

    @property
    def values(self) -> str:
        """'0.481 to 0.462, drop 0.019 [0.012, 0.026]'."""
        ends = f"[{self.digits(self.found.low)}, {self.digits(self.found.high)}]"
        if self.rule.change is None:
            return f"{self.digits(self.found.value)} {ends}"
        change = f"{self.rule.change} {self.digits(self.found.value)} {ends}"
        if math.isnan(self.base):
            return change
        return f"{self.digits(self.base)} to {self.digits(self.new)}, {change}"


@dataclass(frozen=True)
class GateResult:
    """Everything that a gate found.

    new, against  what was judged, and the baseline, empty where there is none
    remarks       what a reader has to know beside
    """

    new: str
    against: str
    scenes: tuple[str, ...]
    level: float
    undecided: str
    judgements: tuple[Judgement, ...]
    remarks: tuple[str, ...] = ()

    def count(self, verdict: Verdict) -> int:
        """How many rules came out so."""
        return sum(each.verdict == verdict for each in self.judgements)

    @property
    def failed(self) -> bool:
        """Whether a rule fails, or is undecided where that fails."""
        return self.count("fails") > 0 or (self.undecided == "fail" and self.count("undecided") > 0)
