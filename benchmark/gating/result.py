"""The result of a gate: the verdict on each rule with its numbers, and the outcome of all."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from semstab.comparison.quantities import COVERAGE
from semstab.core.types import THESE_FRAMES, Scope
from semstab.data.statistics import Interval
from semstab.data.statistics.intervals import without_zero
from semstab.gating.rules import GateMeasure, GateRule
from semstab.statistics.intervals import LEAST_FRAMES, standard_error

# The verdict on one rule, for one scene or over all.

Verdict = Literal["passes", "fails", "undecided"]


# The settings of a gate: its rules, the level, and the outcome of undecided rules.

Undecided = Literal["report", "pass", "fail"]


EXIT_CODES: Mapping[Verdict, int] = {"passes": 0, "fails": 4, "undecided": 5}
"""Exit codes of the command, by the outcome."""


def verdict(rule: GateRule, interval: Interval) -> Verdict:
    """Return the verdict on a rule from an interval, each end of which is missed with the gate's level.

    A rule passes if the whole interval is within the limit, and fails if the whole interval is outside. A loss fails as
    soon as it is shown and not shown to be smaller than the limit. A number that is known is not undecided.
    """
    if interval.undecided or math.isnan(interval.low) or math.isnan(interval.high):
        return "undecided"
    if interval.low == interval.high == rule.limit:
        return "passes" if rule.or_equal else "fails"
    oriented, limit = (interval, rule.limit) if rule.below else (negative(interval), -rule.limit)
    low, high = oriented.low, oriented.high
    if high < limit:
        return "passes"
    return "fails" if low > (min(limit, 0.0) if rule.bounds_a_loss else limit) else "undecided"


def negative(interval: Interval) -> Interval:
    """Return the interval of the opposite number."""
    return dataclasses.replace(interval, value=0.0 - interval.value, low=0.0 - interval.high, high=0.0 - interval.low)


# The result of a gate, rule by rule and for the new run as a whole.


POWER = 0.8
"""Probability of a decision on a rule for which frames are planned."""


@dataclass(frozen=True)
class Judgement:
    """The verdict on a rule.

    Attributes:
        interval: The change, or the number itself, that the rule bounds, with one-sided ends at the gate's level.
        new, base: The numbers of both runs, NaN without a number.
    """

    rule: GateRule
    verdict: Verdict
    interval: Interval
    new: float
    base: float

    def __repr__(self) -> str:
        return f"<Judgement {self.stated}>"

    @property
    def stated(self) -> str:
        """The verdict, the rule and its numbers: 'passes: alpha > 0.6: .933 [.920, .944]'."""
        return f"{self.verdict}: {self.rule.text}: {self.values}"

    @property
    def about(self) -> Scope:
        """The scope of the interval, see `Interval`."""
        return self.interval.scope

    def frames_needed(self, level: float) -> int | None:
        """Return the number of frames that decide the rule with a probability of POWER, or None if no number does.

        A rule on a change has to pass if nothing changed; a rule on a value has to be decided if the value is the
        measured value. The standard error falls with the square root of the frames of this scene.
        """
        from scipy import special

        error = standard_error(self.interval)
        margin = abs(self.rule.limit - (0.0 if self.rule.change else self.interval.value))
        if self.interval.scope == THESE_FRAMES or not (error > 0 and margin > 0):
            return None
        z = float(special.ndtri(1 - level) + special.ndtri(POWER))
        return max(LEAST_FRAMES, math.ceil(self.interval.frames * (z * error / margin) ** 2))

    @property
    def counted(self) -> bool:
        """Return whether the number was counted, and is no estimate."""
        return (
            self.rule.measure.quantity is COVERAGE and self.interval.decided and self.interval.low == self.interval.high
        )

    @property
    def reason(self) -> str:
        """The reason of the verdict, in a few words."""
        if self.counted:
            return "counted"
        if self.verdict == "passes":
            return "the whole interval is within the limit"
        if self.verdict == "fails":
            if self.rule.bounds_a_loss and self.interval.low <= self.rule.limit:
                return "there is a loss, and it may exceed the limit"
            return "the whole interval is beyond the limit"
        more = "locations" if self.interval.scope == THESE_FRAMES else "frames"
        return self.interval.undecided or f"the limit is in the interval; more {more} may decide"

    def digits(self, value: float) -> str:
        """Return a number of the rule's measure."""
        measure: GateMeasure = self.rule.measure
        return "-" if math.isnan(value) else without_zero(f"{value:z.{measure.quantity.digits[0]}f}")

    @property
    def values(self) -> str:
        """The numbers with their population: 'OP>=3: .481 to .462, drop .019 [.012, .026]'."""
        population = self.rule.measure.quantity.population
        return f"{population}: {self._numbers}" if population else self._numbers

    @property
    def _numbers(self) -> str:
        ends = f"[{self.digits(self.interval.low)}, {self.digits(self.interval.high)}]"
        if self.counted:
            return f"{self.rule.change} {self.digits(self.interval.value)}"
        if self.rule.change is None:
            return f"{self.digits(self.interval.value)} {ends}"
        change = f"{self.rule.change} {self.digits(self.interval.value)} {ends}"
        if math.isnan(self.base):
            return change
        return f"{self.digits(self.base)} to {self.digits(self.new)}, {change}"


@dataclass(frozen=True)
class GateResult:
    """The whole result of a gate.

    Attributes:
        new, against: The run, and the baseline, empty without a baseline.
        undecided: The outcome of undecided rules, see `GateConfig`.
        notes: Further remarks for the reader.
    """

    new: str
    against: str
    scenes: tuple[str, ...]
    level: float
    undecided: Undecided
    judgements: tuple[Judgement, ...]
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        against = f" against {self.against}" if self.against else ""
        lines = [f"<GateResult: {self.outcome}; {self.new}{against} on {', '.join(self.scenes)}>"]
        return "\n".join([*lines, *(f"  {judgement.stated}" for judgement in self.judgements)])

    def count(self, verdict: Verdict) -> int:
        """Return how many rules have this verdict."""
        return sum(judgement.verdict == verdict for judgement in self.judgements)

    @property
    def failed(self) -> bool:
        """Return whether a rule fails, or is undecided where that fails."""
        return self.outcome == "fails"

    @property
    def passed(self) -> bool:
        """Return whether all rules pass, or are undecided where that passes: only then a baseline is saved."""
        return self.outcome == "passes"

    @property
    def outcome(self) -> Verdict:
        """Outcome of all rules together; undecided rules count by the setting `undecided`."""
        if self.count("fails"):
            return "fails"
        if not self.count("undecided") or self.undecided == "pass":
            return "passes"
        return "fails" if self.undecided == "fail" else "undecided"

    @property
    def exit_code(self) -> int:
        """Exit code of the command: 0 if the gate passes, 4 if it fails, 5 if it is undecided."""
        return EXIT_CODES[self.outcome]
