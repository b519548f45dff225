"""Gates, which decide if a new model may ship: each rule passes, fails, or is undecided by the data."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from semstab.comparison.differences import flicker_difference, sums_difference
from semstab.comparison.pairing import on_common_observations
from semstab.comparison.runs import Entry, RunHandle, open_run, shared_scenes
from semstab.comparison.tables import (
    COVERAGE,
    FLICKER,
    IOU,
    MISLEADING,
    PRECISION,
    RECALL,
    RECURRENT_VSS,
    SBD_EXCESS,
    left_out,
)
from semstab.config import nearest, read_yaml, validated
from semstab.config.settings import ScopeSetting
from semstab.core.types import OTHER_SCENES, THESE_FRAMES, THIS_SCENE, Scope
from semstab.data.measures import ENTROPY, Measure, Quantity
from semstab.data.statistics import ORDER_KNOWN, UNKNOWN, Interval
from semstab.errors import ConfigError, DataError
from semstab.statistics.agreement import ALPHA, PSA, VOXEL_ALPHA
from semstab.statistics.cluster_sums import (
    ClusterSums,
    chance_of,
    columns_of,
    functional,
    of_space_alone,
    parts_of,
    summed,
    value,
)
from semstab.statistics.correctness import ACCURACY, ECE, MIOU
from semstab.statistics.intervals import (
    LEAST_FRAMES,
    counted,
    estimate,
    mean_of,
    mean_over_frames,
    shares_of,
    standard_error,
    within_a_flight,
)
from semstab.statistics.verdict import LEAST_CLASSES

# Rules are about the numbers that follow from the sums of a run; each has advice for runs that do not have it.

TRUTH = "run it with --statistics, on a scene with ground truth"
OBSERVATION_ACCURACY = Quantity(
    key="observation_accuracy", title="Accuracy of observations", better="higher", needs="truth"
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
"""Measures in the order of lists, before those of the register."""


def gate_measures() -> tuple[GateMeasure, ...]:
    """Return all measures in the order of lists."""
    return (*MEASURES, *(GateMeasure(each, _plain(each.key), if_missing="run it again") for each in summed()))


NOTHING = "no location that it needs was seen twice"
SCORES = "one run has labels and the other scores, which spread their evidence; run both as labels"

OF_EVIDENCE = (PSA, VOXEL_ALPHA, RECURRENT_VSS, SBD_EXCESS, ECE)
"""Measures that depend on the output of a model, labels or scores, as do those of the register."""


def _plain(name: str) -> str:
    return re.sub(r"[\s_-]+", " ", name.strip()).lower()


def measure_named(name: str, where: str) -> GateMeasure:
    """Return a measure by any of its names.

    Raises:
        ConfigError: If there is no such measure; the message starts with `where`.
    """
    known = gate_measures()
    named = {_plain(own): each for each in reversed(known) for own in (each.name, each.quantity.title, *each.also)}
    if _plain(name) not in named:
        raise ConfigError(f"{where}: no measure '{name}'; {nearest(_plain(name), [each.name for each in known])}")
    return named[_plain(name)]


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
class Rule:
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

    def of_each(self, classes: Sequence[str]) -> tuple[Rule, ...]:
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


def parse(text: str) -> Rule:
    """Return a rule from its text.

    Raises:
        ConfigError: If the text is no rule; the message has the grammar.
    """
    result = RULE.fullmatch(text)
    if result is None:
        raise ConfigError(f"rule '{text}': not understood; write {GRAMMAR}, e.g. 'alpha drop < 0.02'")
    measure = measure_named(result["measure"], f"rule '{text}'")
    limit = float(result["limit"])
    if result["percent"] and measure.quantity.unit != "%":
        limit /= 100
    change: Change | None = None
    if result["change"]:
        change = "drop" if result["change"].lower() == "drop" else "rise"
    relation = result["relation"]
    rule = Rule(
        text.strip(), measure, change, relation[0] == "<", limit, result["scene"], result["class"], len(relation) > 1
    )
    _check_rule(rule)
    return rule


def _check_rule(rule: Rule) -> None:
    name = rule.measure.name
    if not math.isfinite(rule.limit):
        raise ConfigError(f"rule '{rule.text}': its number is too large")
    if rule.class_name is None and not rule.measure.of_all:
        raise ConfigError(f"rule '{rule.text}': {name} is of one class; write 'class NAME: {rule.text}'")
    if rule.class_name is not None and not rule.measure.of_class:
        raise ConfigError(f"rule '{rule.text}': {name} is of all classes; leave 'class {rule.class_name}:' out")
    if rule.change is None and rule.measure.only_change:
        raise ConfigError(f"rule '{rule.text}': {name} is relative to a baseline; write '{name} drop < 0.05'")


# The verdict on one rule, for one scene or over all.

Verdict = Literal["passes", "fails", "undecided"]


def verdict(rule: Rule, interval: Interval) -> Verdict:
    """Return the verdict on a rule from an interval, each end of which is missed with the gate's level.

    A rule passes where the whole interval is within the limit, and fails where none of it is; a loss fails as soon as
    it is shown and not shown to be smaller than the limit. A number that is known is not undecided.
    """
    if interval.undecided or math.isnan(interval.low) or math.isnan(interval.high):
        return "undecided"
    if interval.low == interval.high == rule.limit:
        return "passes" if rule.or_equal else "fails"
    shown, limit = (interval, rule.limit) if rule.below else (negative(interval), -rule.limit)
    low, high = shown.low, shown.high
    if high < limit:
        return "passes"
    return "fails" if low > (min(limit, 0.0) if rule.bounds_a_loss else limit) else "undecided"


def bounded(
    rule: Rule,
    new: ClusterSums,
    base: ClusterSums | None = None,
    *,
    k: int | None = None,
    level: float = 0.05,
    scope: Scope = THIS_SCENE,
) -> Interval:
    """Return the value, drop or rise that a rule bounds, from sums; each end is missed with probability `level`."""
    key, both = rule.measure.quantity.key, 1 - 2 * level
    if base is None or rule.change is None:
        return estimate(new, key, k, THESE_FRAMES if of_space_alone(key, k) else scope, both)
    same_frames = True if scope == THESE_FRAMES else None
    result = sums_difference(key, new, base, k, scope=scope, same_frames=same_frames, level=both)
    return result if rule.change == "rise" else negative(result)


def negative(interval: Interval) -> Interval:
    """Return the interval of the opposite number."""
    return dataclasses.replace(interval, value=0.0 - interval.value, low=0.0 - interval.high, high=0.0 - interval.low)


# The settings of a gate: its rules, the level, and the outcome of undecided rules.

Undecided = Literal["report", "pass", "fail"]


class GateConfig(BaseModel):
    """The content of gate.yaml.

    Attributes:
        rules: Rules such as 'alpha drop < 0.02'; docs/gate.md has their form.
        level: Largest probability that a rule that holds fails, or that one that does not hold passes.
        undecided: The outcome of a gate with undecided rules: 'report' them, so that it neither passes nor fails;
            'pass', 'fail'.
        scope: The data for which rules are assessed: 'this scene' flown again, 'these frames', or 'other scenes' like
            these.

    Examples:
        >>> rules = semstab.GateConfig(rules=("alpha drop < 0.02", "flicker < 15"), undecided="fail")
        >>> semstab.gate("run:sim-flicker", "run:sim-steady", rules).passed
        False
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    rules: tuple[str, ...] = ()
    level: float = Field(0.05, ge=1e-4, le=0.25)
    undecided: Undecided = "report"
    scope: ScopeSetting = THIS_SCENE


def gate_config(
    file: str | Path | None = None,
    rules: Sequence[str] = (),
    level: float | None = None,
    undecided: str | None = None,
    scope: str | None = None,
) -> GateConfig:
    """Build the settings from a YAML file and options, which have priority; rules are added to the file's.

    Raises:
        ConfigError: If a setting is wrong; it names the file and the setting.
    """
    given = {"level": level, "undecided": undecided, "scope": scope}
    options = {name: value for name, value in given.items() if value is not None}
    config = GateConfig() if file is None else validated(GateConfig, read_yaml(file), f"{file}: ")
    config = validated(GateConfig, {**config.model_dump(), **options, "rules": (*config.rules, *rules)}, "gate: ")
    if not config.rules:
        where = f"{file}: rules" if file is not None else "gate"
        raise ConfigError(f"{where}: there is no rule; write e.g. --rule 'alpha drop < 0.02'")
    return config


# The result of a gate, rule by rule and for the new run as a whole.


POWER = 0.8
"""Probability of a decision on a rule for which frames are planned."""


@dataclass(frozen=True)
class Judgement:
    """The verdict on a rule.

    Attributes:
        interval: The change, or the number itself, that the rule bounds, with one-sided ends at the gate's level.
        new, base: The numbers of both runs, NaN where there is none.
    """

    rule: Rule
    verdict: Verdict
    interval: Interval
    new: float
    base: float

    def __repr__(self) -> str:
        return f"<Judgement {self.stated}>"

    @property
    def stated(self) -> str:
        """The verdict, the rule and its numbers: 'passes: alpha > .6: 0.933 [0.920, 0.944]'."""
        return f"{self.verdict}: {self.rule.text}: {self.values}"

    @property
    def about(self) -> str:
        """The scope of the interval: what varies."""
        return self.interval.scope

    def frames_needed(self, level: float) -> int | None:
        """Return the number of frames that decide the rule with a probability of POWER; None where no number does.

        A rule on a change has to pass where nothing changed; one on a value where the value is the measured one. The
        standard error falls with the square root of the frames of this scene.
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
            return "shown"
        if self.verdict == "fails":
            bounded = self.rule.bounds_a_loss and self.interval.low <= self.rule.limit
            return "a loss is shown, but not that it is within the limit" if bounded else "the contrary is shown"
        more = "locations" if self.interval.scope == THESE_FRAMES else "frames"
        return self.interval.undecided or f"neither is shown; more {more} may decide"

    def digits(self, value: float) -> str:
        """Return a number of the rule's measure."""
        measure: GateMeasure = self.rule.measure
        return "-" if math.isnan(value) else f"{value:z.{measure.quantity.digits[0]}f}"

    @property
    def values(self) -> str:
        """'0.481 to 0.462, drop 0.019 [0.012, 0.026]'."""
        ends = f"[{self.digits(self.interval.low)}, {self.digits(self.interval.high)}]"
        if self.counted:
            return f"{self.rule.change} {self.digits(self.interval.value)}"
        if self.rule.change is None:
            return f"{self.digits(self.interval.value)} {ends}"
        change = f"{self.rule.change} {self.digits(self.interval.value)} {ends}"
        if math.isnan(self.base):
            return change
        return f"{self.digits(self.base)} to {self.digits(self.new)}, {change}"


EXIT_CODES: Mapping[Verdict, int] = {"passes": 0, "fails": 4, "undecided": 5}
"""Exit codes of the command, by the outcome."""


@dataclass(frozen=True)
class GateResult:
    """The whole result of a gate.

    Attributes:
        new, against: The run, and the baseline, empty where there is none.
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
        return "\n".join([*lines, *(f"  {each.stated}" for each in self.judgements)])

    def count(self, verdict: Verdict) -> int:
        """Return how many rules have this verdict."""
        return sum(each.verdict == verdict for each in self.judgements)

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
        """Exit code of the command: 0 where the gate passes, 4 where it fails, 5 where it is undecided."""
        return EXIT_CODES[self.outcome]


def gate(new: str | os.PathLike[str], against: str | os.PathLike[str] | None, config: GateConfig) -> GateResult:
    """Assess a run, or 'FOLDER:MODEL', by rules; those on a drop or a rise need a baseline, a run or a small summary.

    Args:
        new: Folder of a run, 'FOLDER:MODEL' where it has several models, or a result in memory.
        against: The baseline: likewise, or a small summary; None where no rule needs one.
        config: The rules.

    Returns:
        The outcome, and the verdict on each rule.

    Raises:
        ConfigError, DataError: For a rule or a folder that cannot be used, and what to do.

    Examples:
        >>> semstab.gate("run:sim-steady", None, semstab.GateConfig(rules=("alpha > 0.6",)))
        <GateResult: passes; sim-steady (run) on scene0>
          passes: alpha > 0.6: 0.94...
    """
    parsed = [parse(text) for text in config.rules]
    own = open_run(new)
    base = None if against is None else open_run(against)
    scenes = tuple(own.scenes) if base is None else shared_scenes([base, own])
    runs, judgements = _Runs(own, base, scenes), list[Judgement]()
    notes = list(_notes(own, base, scenes))
    for given in parsed:
        rules = given.of_each(own.scenes[scenes[0]].classes)
        for rule in rules:
            _check(rule, own, base, scenes)
        if given.class_name == ALL:
            rules, absent = _with_a_value(rules, runs)
            notes += [
                f"{given.text}: left out, as seen nowhere twice in {where}: {', '.join(names)}"
                for where, names in absent.items()
            ]
        for rule in rules:
            pairs = runs.pairs(rule)
            if given.class_name == ALL and _is_lost(rule, pairs):
                base_value = float(np.nanmean([_value(rule, old) for _, old in pairs if old is not None]))
                lost = dataclasses.replace(UNKNOWN, undecided=LOST)
                judgements.append(Judgement(rule, "undecided", lost, math.nan, base_value))
                continue
            _require_values(rule, pairs)
            judgements.append(_assess(rule, pairs, config.level / len(rules), config.scope))
            notes += [*_counts(judgements[-1], pairs), *(runs.common[1] if runs.on_common(rule) else ())]
    notes += _without_frames(judgements, config.scope)
    new_run, against_run = ("" if run is None else str(run) for run in (own, base))
    return GateResult(
        new_run, against_run, scenes, config.level, config.undecided, tuple(judgements), tuple(dict.fromkeys(notes))
    )


def _notes(own: RunHandle, base: RunHandle | None, scenes: Sequence[str]) -> list[str]:
    judged = [
        f"{scene}: {run.name} is {why}"
        for scene in scenes
        for run in (own, base)
        if run is not None and (why := run.scenes[scene].judged)
    ]
    left = [scene for scene in own.scenes if scene not in scenes]
    missing = [scene for scene in (base.scenes if base else ()) if scene not in scenes]
    text = [f"only the run has these scenes, which are left out: {', '.join(left)}"] if left else []
    text += [f"only the baseline has these scenes, which are left out: {', '.join(missing)}"] if missing else []
    return judged + text


def _without_frames(judgements: Sequence[Judgement], wanted: Scope) -> list[str]:
    """Return which rules are judged for these frames, because the run does not tell frames apart in its map."""
    names = [
        each.rule.text
        for each in judgements
        if each.interval.scope == THESE_FRAMES != wanted
        and not each.counted
        and each.rule.measure.quantity not in (FLICKER, COVERAGE)
        and not of_space_alone(each.rule.measure.quantity.key)
    ]
    why = "as the run kept no sums of its map by frame or has few; --statistics, or more frames"
    return [f"judged for these frames, {why}: {', '.join(names)}"] if names else []


# --- Checks before any rule is assessed -------------------------------------------------------------------------------


def _check(rule: Rule, own: RunHandle, base: RunHandle | None, scenes: Sequence[str]) -> None:
    if rule.change is not None and base is None:
        raise ConfigError(f"rule '{rule.text}': a {rule.change} needs a baseline; give --against RUN")
    if rule.scene is not None and rule.scene not in scenes:
        raise ConfigError(f"rule '{rule.text}': no scene '{rule.scene}'; {nearest(rule.scene, scenes)}")
    for scene in [rule.scene] if rule.scene else scenes:
        entries = [run.scenes[scene] for run in (own, base) if run is not None and (run is own or rule.change)]
        if rule.class_name is not None and rule.class_name not in entries[0].classes:
            raise ConfigError(
                f"rule '{rule.text}': no class '{rule.class_name}'; {nearest(rule.class_name, entries[0].classes)}"
            )
        for entry in entries:
            if not _has(rule, entry):
                name, few = rule.measure.name, _few_known(rule, entry)
                raise ConfigError(
                    f"rule '{rule.text}': {entry.where} has no {name} of {scene}{few}; {rule.measure.if_missing}"
                )
        if len({entry.sums.voxel_size for entry in entries}) > 1:
            sizes = [entry.sums.voxel_size for entry in entries]
            raise DataError(
                f"{own.where}: its voxels have {sizes[0]:g} m, those of the baseline {sizes[1]:g} m; run it with"
                f" --voxel-size {sizes[1]:g}"
            )


def _has(rule: Rule, entry: Entry) -> bool:
    """Return whether a run has the data of a measure."""
    if rule.measure.quantity is FLICKER:
        return len(entry.flicker) > 1
    if rule.measure.quantity is COVERAGE:
        return True
    key, k = rule.measure.quantity.key, _k(rule, entry)
    if not parts_of(entry.sums, functional(key, k)):
        return False
    if rule.measure.quantity is not SBD_EXCESS:
        return True
    known, locations = _order_known(entry.sums)
    return known > 0 and known >= ORDER_KNOWN * locations


def _order_known(sums: ClusterSums) -> tuple[float, int]:
    """Return at how many locations SBD in random order is known, and of how many."""
    return float(columns_of(sums, SBD_EXCESS.key)[:, 1].sum()), round(float(sums["voxels"].sum()))


def _few_known(rule: Rule, entry: Entry) -> str:
    """Return at how few locations SBD in random order is known, which are no random sample; empty for other rules."""
    known, locations = _order_known(entry.sums) if rule.measure.quantity is SBD_EXCESS else (0.0, 0)
    few = f", which is known at {known:,.0f} of {locations:,} locations, fewer than {ORDER_KNOWN:.0%}"
    return few if known > 0 else ""


Pair = tuple[Entry, Entry | None]


def _k(rule: Rule, entry: Entry) -> int | None:
    return None if rule.class_name is None else entry.classes.index(rule.class_name)


@dataclass(frozen=True, eq=False)
class _Runs:
    """The new run and its baseline, on the scenes of both."""

    own: RunHandle
    base: RunHandle | None
    scenes: tuple[str, ...]

    def on_common(self, rule: Rule) -> bool:
        """Return whether a rule is on a change of alpha, which is of common observations."""
        return self.base is not None and rule.change is not None and rule.measure.quantity is ALPHA

    @functools.cached_property
    def common(self) -> tuple[Mapping[str, Pair], tuple[str, ...]]:
        """The runs on each scene with the observations that both made, and notes on the share that one left out."""
        pairs: dict[str, Pair] = {}
        notes: list[str] = []
        base = self.base.scenes if self.base is not None else {}
        for scene in filter(base.get, self.scenes):
            new, old = self.own.scenes[scene], base[scene]
            paired = on_common_observations({"the baseline": old, "the run": new})
            if paired is not None:
                (old, new), compared, of_pairing = paired
                notes += [f"{scene}: {text}" for text in (*left_out(compared), *of_pairing)]
            pairs[scene] = new, old
        return pairs, tuple(notes)

    def pairs(self, rule: Rule) -> list[Pair]:
        """Return the runs on each scene that a rule is about; for a rule on a value only the new one."""
        named = [rule.scene] if rule.scene else self.scenes
        if self.on_common(rule):
            return [self.common[0][scene] for scene in named]
        base = self.base.scenes if self.base is not None and rule.change else {}
        return [(self.own.scenes[scene], base.get(scene)) for scene in named]


def _with_a_value(rules: Sequence[Rule], runs: _Runs) -> tuple[tuple[Rule, ...], dict[str, list[str]]]:
    """Return the rules of classes that have a value everywhere, and the other classes by the run that has none.

    A class that only the baseline has stays: the run has lost it, and no drop of a measure shows that. Where no class
    is left the rules stay, of which the first then says what it needs.
    """
    there, absent = list[Rule](), dict[str, list[str]]()
    for rule in rules:
        pairs = runs.pairs(rule)
        entries = (entry for pair in pairs for entry in pair if entry is not None)
        lacking = next((entry.where for entry in entries if math.isnan(_value(rule, entry))), None)
        if lacking is None or _is_lost(rule, pairs):
            there.append(rule)
        else:
            absent.setdefault(lacking, []).append(str(rule.class_name))
    return tuple(there or rules), absent if there else {}


LOST = "the baseline has this class, and the run gives it to no location that was seen twice"


def _is_lost(rule: Rule, pairs: Sequence[Pair]) -> bool:
    """Return whether a class has a value in the baseline of a scene, and none in the run."""
    return any(
        old is not None and math.isnan(_value(rule, new)) and not math.isnan(_value(rule, old)) for new, old in pairs
    )


def _require_values(rule: Rule, pairs: Sequence[Pair]) -> None:
    """Raise ConfigError for a rule that cannot be evaluated, with advice."""
    for new, old in pairs:
        for entry in (new, old):
            if entry is not None and _of_all_alpha(rule) and _is_nearly_one_class(entry.sums):
                continue  # undecided, whatever alpha is
            if entry is not None and rule.measure.quantity is not COVERAGE and math.isnan(_value(rule, entry)):
                named = f"{rule.measure.name} of {rule.class_name}" if rule.class_name else rule.measure.name
                raise ConfigError(
                    f"rule '{rule.text}': {entry.where} has no {named}: {NOTHING}; {rule.measure.if_missing}"
                )
        mixed = old is not None and (new.summary.reduced is None) != (old.summary.reduced is None)
        if mixed and (rule.measure.quantity in OF_EVIDENCE or isinstance(rule.measure.quantity, Measure)):
            raise ConfigError(f"rule '{rule.text}': {SCORES}")


def _assess(rule: Rule, pairs: Sequence[Pair], level: float, scope: Scope) -> Judgement:
    """Assess a rule by the mean of the scenes, whose errors are independent, or in the scene that it names."""
    result = mean_of([_interval_of(rule, new, old, level, scope) for new, old in pairs])
    values = [[math.nan if entry is None else _value(rule, entry) for entry in pair] for pair in pairs]
    return Judgement(rule, verdict(rule, result), result, *(float(mean) for mean in np.mean(values, axis=0)))


def _value(rule: Rule, entry: Entry) -> float:
    if rule.measure.quantity is FLICKER:
        return float(np.mean(list(entry.flicker.values())))
    if rule.measure.quantity is COVERAGE:
        return math.nan
    return value(entry.sums, rule.measure.quantity.key, _k(rule, entry))


def _interval_of(rule: Rule, new: Entry, base: Entry | None, level: float, scope: Scope) -> Interval:
    if rule.measure.quantity is COVERAGE and base is not None and _same_frames(new, base):
        change = counted(_covered(new.sums, base.sums), new.sums)
        return change if rule.change == "rise" else negative(change)
    if rule.measure.quantity is not FLICKER:
        k, before = _k(rule, new), None if base is None else base.sums
        result = bounded(rule, new.sums, before, k=k, level=level, scope=scope)
        if _of_all_alpha(rule) and any(map(_is_nearly_one_class, (new.sums, before))):
            return dataclasses.replace(result, undecided=ONE_CLASS)
        return result
    if scope == OTHER_SCENES:
        raise ConfigError(f"rule '{rule.text}': flicker is known only by frame; assess it with --scope this-scene")
    if base is None:
        mean = mean_over_frames(np.array([*new.flicker]), np.array([*new.flicker.values()]), 1 - 2 * level)
        return dataclasses.replace(mean, low=max(mean.low, 0.0), high=min(mean.high, 100.0))
    result = flicker_difference(new.flicker, base.flicker, level=1 - 2 * level)
    return result if rule.change == "rise" else negative(result)


ONE_CLASS = "nearly the whole map is one class, so that alpha tells nothing"


def _of_all_alpha(rule: Rule) -> bool:
    return rule.measure.quantity is ALPHA and rule.class_name is None


def _is_nearly_one_class(sums: ClusterSums | None) -> bool:
    """Return whether the verdict on the map is 'uninformative'."""
    return sums is not None and sums.fine is not None and chance_of(sums.fine) * LEAST_CLASSES > 1


# --- Coverage, which is counted ---------------------------------------------------------------------------------------


def _same_frames(new: Entry, base: Entry) -> bool:
    """Return whether both are of the same frames, in some of which a model may have given no label."""
    return new.summary.frames == base.summary.frames and within_a_flight(new.sums, base.sums)


def _covered(new: ClusterSums, base: ClusterSums) -> float:
    """Return the change of the count that fell most: of voxels with OP >= 2, or of labelled observations in them.

    A model that gives some locations no label loses voxels; one that gives them a label in fewer frames observations.
    """
    return min(shares_of(new, base).values()) - 1


def _counts(judgement: Judgement, pairs: Sequence[Pair]) -> list[str]:
    """Return the counts for a rule on coverage."""
    if not judgement.counted:
        return []
    shares = [shares_of(new.sums, base.sums) for new, base in pairs if base is not None]
    voxels, observations = (float(np.mean([own[name] for own in shares])) for name in ("voxels", "observations"))
    where = f" of {judgement.rule.scene}" if judgement.rule.scene else ""
    return [
        f"coverage{where}: {100 * voxels:.1f} % of the baseline's voxels with OP >= 2,"
        f" {100 * observations:.1f} % of its labelled observations in such voxels"
    ]
