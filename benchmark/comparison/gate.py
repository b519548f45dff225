"""May a new model ship? Rules, judged by what the data show: each passes, fails, or is undecided."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from semstab.comparison.pairing import in_share, share_of
from semstab.comparison.runs import Entry, RunHandle, open_run, shared_scenes
from semstab.comparison.tables import (
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
from semstab.config import nearest, read_yaml, validated
from semstab.errors import ConfigError, DataError
from semstab.model.measures import ENTROPY, Quantity
from semstab.model.records import Record
from semstab.model.statistics import THESE_FRAMES, THIS_SCENE, Interval, Scope
from semstab.model.tiles import Tiles, side_by_side
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ALPHA, ALPHA_BETWEEN, PSA
from semstab.statistics.cluster_sums import ClusterSums, of_space_alone, sums_for, value
from semstab.statistics.commit import Commit, calibrate
from semstab.statistics.correctness import ACCURACY, ECE, MIOU, Truth, join_truth
from semstab.statistics.intervals import (
    LEAST_FRAMES,
    TOO_FEW,
    coverage,
    difference,
    difference_over_frames,
    estimate,
    mean_of,
    mean_over_frames,
    same_flight,
)

# What a rule may be about: the numbers that follow from the sums of a run, and what to run for those it lacks.

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


# From a run with ground truth to the evidence from which on its labels may be acted on.


def calibrated(run: str | Path, *, precision: float = 0.95, confidence: float = 0.95) -> Commit:
    """Thresholds from all scenes of a run with ground truth; 'FOLDER:BACKBONE' selects one of several label sources.

    Raises ConfigError and DataError as `open_run`, and for a scene whose ground truth was not fused.
    """
    own = open_run(run)
    maps, sampled = [], 1.0
    for scene, entry in own.scenes.items():
        record = entry.with_voxels("a calibration")
        if record.truth_file is None:
            raise ConfigError(
                f"{own.source}: ground truth of {scene} was not fused; run it with --statistics, on a scene that has it"
            )
        maps.append(_judged_gate_measures(record, record.truth_file))
        sampled = min(sampled, share_of(record.summary.table.voxels))
    first = maps[0][0]
    for table, _ in maps[1:]:
        if (table.classes, table.voxel_size) != (first.classes, first.voxel_size):
            raise DataError(f"{own.source}: its scenes differ in classes or voxel size; calibrate on one at a time")
    on = f"{own.backbone} on {', '.join(own.scenes)}"
    on += f", 1 in {round(1 / sampled)} of the places of a large map" if sampled < 1 else ""
    return calibrate(maps, precision=precision, confidence=confidence, on=on)


def _judged_gate_measures(record: Record, truth_file: Path) -> tuple[VoxelTable, Truth]:
    """A map with its true classes; of a very large one a sample, by a hash of the place."""
    share, parts = share_of(record.summary.table.voxels), []
    files = [file for file in (record.voxels_file, truth_file) if file is not None]
    for table, truth in side_by_side([Tiles.open(file, VoxelTable) for file in files]):
        some = table.rows(in_share(table, share))
        parts.append((some, join_truth(some, truth).label))
    order = np.lexsort(np.concatenate([table.index for table, _ in parts]).T[::-1])
    label = np.concatenate([own for _, own in parts])[order]
    return VoxelTable.joined([table for table, _ in parts]), Truth(label >= 0, label)


def lines(commit: Commit) -> Iterator[str]:
    """For the terminal."""
    yield (
        f"labels that are right with a probability of {commit.precision:g} or more, class by class at a confidence of"
        f" {commit.confidence:g}; calibrated on {commit.calibrated_on}"
    )
    width = min(max(map(len, commit.classes), default=0), 20)
    for name, own in commit.classes.items():
        right = f"{own.by:<6} >= {own.at_least:<5.3g} right in {own.precision:.3f}, at least {own.low:.3f}"
        if not own.voxels:
            yield f"  {name[:width]:<{width}}  never: no label of it has a known truth"
        elif own.never:
            yield f"  {name[:width]:<{width}}  never; best {right} ({own.voxels:,} voxels)"
        else:
            yield f"  {name[:width]:<{width}}  {right}: {own.left:.0%} left"
    yield f"{commit.left:.1%} of the voxels are left"
    if any(own.never for own in commit.classes.values()):
        yield "more places, in other scenes, show more: errors near each other count as few"


# The rules of a gate, as text: 'alpha drop < 0.02', 'class human: recall > 0.6'.

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
    _check_rule(rule)
    return rule


def _check_rule(rule: Rule) -> None:
    name = rule.measure.name
    if not math.isfinite(rule.limit):
        raise ConfigError(f"rule '{rule.text}': its number is too large")
    if rule.class_name is None and not rule.measure.of_all:
        raise ConfigError(f"rule '{rule.text}': {name} is of a class; write 'class NAME: {rule.text}'")
    if rule.class_name is not None and not rule.measure.of_class:
        raise ConfigError(f"rule '{rule.text}': {name} is of all classes; leave 'class {rule.class_name}:' out")
    if rule.change is None and rule.measure.only_change:
        raise ConfigError(f"rule '{rule.text}': {name} is relative to a baseline; write '{name} drop < 0.05'")


# One rule on one scene, or over all: what the data show of it, and what follows.

Verdict = Literal["passes", "fails", "undecided"]
Frames = Literal["random", "fixed"]

LEAST = 8
"""Of fewer frames nothing is concluded: a frame in three may be of a kind that none of them shows."""

NOTHING = "it has no value: nothing that it is of was seen twice"
UNKNOWN_FRAMES = "its frames are not known: run it with --statistics"
SCORES = "labels beside scores, which spread their evidence: run both as labels"
FEW = "{frames} frames are too few: fly {least} or more"


def verdict(rule: Rule, found: Interval) -> Verdict:
    """What an interval, each of whose ends is passed with the gate's level, says of a rule.

    Passes where the whole of it keeps to the limit. Fails where none of it does; a loss fails as soon as it is shown
    and not shown to be smaller than the limit.
    """
    if found.undecided or math.isnan(found.low) or math.isnan(found.high):
        return "undecided"
    low, high, limit = (found.low, found.high, rule.limit) if rule.below else (-found.high, -found.low, -rule.limit)
    if high < limit:
        return "passes"
    return "fails" if low > (min(limit, 0.0) if rule.bounds_a_loss else limit) else "undecided"


def change(
    new: ClusterSums,
    base: ClusterSums,
    measure: GateMeasure,
    k: int | None,
    level: float,
    frames: Frames = "random",
) -> Interval:
    """New less base, each end of its interval missed with probability `level`."""
    key, both = measure.key, 1 - 2 * level
    new, base = comparable(new, base)
    if key == "coverage":
        found = coverage(new, base, both)
    else:
        paired = frames == "fixed" or same_flight(new, base)
        found = difference(new, base, key, k, _scope(key, k, frames), same_frames=paired, level=both)
    return of_frames(found, _frames(new, base))


def rule_value(
    new: ClusterSums, measure: GateMeasure, k: int | None, level: float, frames: Frames = "random"
) -> Interval:
    """The number itself, each end of its interval missed with probability `level`."""
    key = measure.key
    return of_frames(estimate(new, key, k, _scope(key, k, frames), 1 - 2 * level), _frames(new))


def _scope(key: str, k: int | None, frames: Frames) -> Scope:
    return THESE_FRAMES if frames == "fixed" or of_space_alone(key, k) else THIS_SCENE


def comparable(new: ClusterSums, base: ClusterSums) -> tuple[ClusterSums, ClusterSums]:
    """Both without what only one of them knows of the ground truth."""
    if new.truth == base.truth:
        return new, base
    return new.without_truth(), base.without_truth()


def negative(found: Interval) -> Interval:
    """Of the opposite number."""
    return dataclasses.replace(found, value=0.0 - found.value, low=0.0 - found.high, high=0.0 - found.low)


def of_frames(found: Interval, frames: int) -> Interval:
    """With this gate's own least number of frames: a rule is judged for frames like these."""
    few = TOO_FEW.format(least=LEAST_FRAMES)
    reasons = [reason for reason in found.undecided.split("; ") if reason and reason != few]
    if math.isnan(found.value):
        reasons.append(NOTHING)
    if frames < LEAST:
        reasons.append(FEW.format(frames=frames, least=LEAST) if frames else UNKNOWN_FRAMES)
    return dataclasses.replace(found, frames=frames, undecided="; ".join(reasons))


def _frames(*sums: ClusterSums) -> int:
    return min(own.frames * own.step for own in sums)


# The settings of a gate: its rules, the level, what is to become of what is undecided.


class GateConfig(BaseModel):
    """What stands in gate.yaml.

    level   the probability with which a rule may fail that holds, or pass that does not
    frames  'random': rules are judged for other frames like these, and other places; 'fixed': for other places in these
            very frames, which says nothing of this scene flown again
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    rules: tuple[str, ...] = ()
    level: float = Field(0.05, ge=1e-4, le=0.25)
    undecided: Literal["pass", "fail"] = "pass"
    frames: Frames = "random"


def gate_config(
    file: str | Path | None = None,
    rules: Sequence[str] = (),
    level: float | None = None,
    undecided: str | None = None,
    frames: str | None = None,
) -> GateConfig:
    """From a YAML file, and what is given beside it, which counts more; rules are added to the file's.

    Raises ConfigError, which names the file and the setting.
    """
    given = {"level": level, "undecided": undecided, "frames": frames}
    options = {name: value for name, value in given.items() if value is not None}
    config = GateConfig() if file is None else validated(GateConfig, read_yaml(file), f"{file}: ")
    config = validated(GateConfig, {**config.model_dump(), **options, "rules": (*config.rules, *rules)}, "gate: ")
    if not config.rules:
        where = f"{file}: rules" if file is not None else "gate"
        raise ConfigError(f"{where}: there is no rule; write e.g. --rule 'alpha drop < 0.02'")
    return config


# What a gate found: rule by rule, and whether the new run may pass.


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
        if self.found.scope != THIS_SCENE:
            return "other places like these, in these very frames"
        if self.found.frames < LEAST_FRAMES:
            return f"other places and frames like these {self.found.frames}"
        return "this scene"

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


__all__ = ["GateConfig", "GateResult", "gate", "gate_config"]


def gate(new: str | Path, against: str | Path | None, config: GateConfig) -> GateResult:
    """Judge a run, or 'FOLDER:BACKBONE', by rules; those on a drop or a rise need a baseline, a run or a small summary.

    Raises ConfigError and DataError, each with the rule or the folder, and what to do.
    """
    parsed = [parse(text) for text in config.rules]
    own = open_run(new)
    base = None if against is None else open_run(against)
    scenes = tuple(own.scenes) if base is None else shared_scenes([base, own])
    judged: list[Judgement] = []
    for given in parsed:
        rules = given.of_each(own.scenes[scenes[0]].classes)
        for rule in rules:
            _check(rule, own, base, scenes)
        ways = _Ways(config.level / len(rules), config.frames)
        judged += [_judged(rule, own, base, scenes, ways) for rule in rules]
    return GateResult(
        _named(own), "" if base is None else _named(base), scenes, config.level, config.undecided, tuple(judged),
        tuple(_remarks(own, base, scenes)),
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _Ways:
    """How a rule is judged: with what error on either side, for which frames."""

    level: float
    frames: Frames


def _named(run: RunHandle) -> str:
    return f"{run.backbone} ({run.source})"


def _remarks(own: RunHandle, base: RunHandle | None, scenes: Sequence[str]) -> list[str]:
    left = [scene for scene in own.scenes if scene not in scenes]
    missing = [scene for scene in (base.scenes if base else ()) if scene not in scenes]
    said = [f"not in the baseline, and not compared: {', '.join(left)}"] if left else []
    return said + ([f"of the baseline alone, and not compared: {', '.join(missing)}"] if missing else [])


# --- Before anything is judged ----------------------------------------------------------------------------------------


def _check(rule: Rule, own: RunHandle, base: RunHandle | None, scenes: Sequence[str]) -> None:
    if rule.change is not None and base is None:
        raise ConfigError(f"rule '{rule.text}': a {rule.change} is from a baseline; give --against RUN")
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
                name = rule.measure.name
                raise ConfigError(f"rule '{rule.text}': {entry.where} has no {name} of {scene}; {rule.measure.lacking}")
        if len({entry.sums.voxel_size for entry in entries}) > 1:
            sizes = [entry.sums.voxel_size for entry in entries]
            raise DataError(
                f"{own.source}: voxels of {sizes[0]:g} m, the baseline's are of {sizes[1]:g} m; run it with"
                f" --voxel-size {sizes[1]:g}"
            )


def _has(rule: Rule, entry: Entry) -> bool:
    """Whether a run keeps what a measure is of."""
    if rule.measure.quantity is FLICKER:
        return len(entry.flicker) > 1
    if rule.measure.quantity is COVERAGE:
        return True
    columns = sums_for(entry.sums, rule.measure.key, _k(rule, entry))
    return bool(columns.size) and (rule.measure.quantity is not SBD_EXCESS or bool(columns[:, 1].any()))


def _k(rule: Rule, entry: Entry) -> int | None:
    return None if rule.class_name is None else entry.classes.index(rule.class_name)


# --- Rules ------------------------------------------------------------------------------------------------------------


def _judged(rule: Rule, own: RunHandle, base: RunHandle | None, scenes: Sequence[str], ways: _Ways) -> Judgement:
    """Over the mean of the scenes, which err by themselves, or in the one that the rule names."""
    pairs = [
        (own.scenes[scene], None if base is None else base.scenes[scene])
        for scene in ([rule.scene] if rule.scene else scenes)
    ]

    found = mean_of([_found(rule, new, old, ways) for new, old in pairs], 1 - 2 * ways.level)
    return Judgement(
        rule,
        verdict(rule, found),
        found,
        float(np.mean([_value(rule, new) for new, _ in pairs])),
        float(np.mean([math.nan if old is None or not rule.change else _value(rule, old) for _, old in pairs])),
    )


def _value(rule: Rule, entry: Entry) -> float:
    if rule.measure.quantity is FLICKER:
        return float(np.mean(list(entry.flicker.values())))
    if rule.measure.quantity is COVERAGE:
        return math.nan
    return value(entry.sums, rule.measure.key, _k(rule, entry))


def _found(rule: Rule, new: Entry, base: Entry | None, ways: _Ways) -> Interval:
    """What a rule bounds, in one scene."""
    if rule.change is None:
        return _own(rule, new, ways)
    assert base is not None
    if rule.measure.quantity is FLICKER:
        found = _flicker(new, base, ways.level)
    else:
        found = change(new.sums, base.sums, rule.measure, _k(rule, new), ways.level, ways.frames)
    if rule.measure.quantity in OF_EVIDENCE and (new.summary.reduced is None) != (base.summary.reduced is None):
        found = dataclasses.replace(found, undecided=SCORES)
    return found if rule.change == "rise" else negative(found)


def _own(rule: Rule, entry: Entry, ways: _Ways) -> Interval:
    if rule.measure.quantity is not FLICKER:
        return rule_value(entry.sums, rule.measure, _k(rule, entry), ways.level, ways.frames)
    frames, percent = np.array(list(entry.flicker)), np.array(list(entry.flicker.values()))
    return of_frames(mean_over_frames(frames, percent, 1 - 2 * ways.level), len(frames))


def _flicker(new: Entry, base: Entry, level: float) -> Interval:
    """Paired by frame, where both have the same ones; else each by itself."""
    shared = sorted(new.flicker.keys() & base.flicker.keys())
    if len(shared) < 2:
        raise DataError(
            f"{new.where} and {base.where}: no frames in common to compare flicker on; run both on the same"
        )
    found = difference_over_frames(new.flicker, base.flicker, 1 - 2 * level)
    return of_frames(found, len(shared))
