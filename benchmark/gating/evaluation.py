"""Evaluate a rule of a gate on runs: which data it needs, its number in each run, and the interval that decides it."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.comparison.differences import flicker_difference, sums_difference
from semstab.comparison.entries import Entry, RunHandle
from semstab.comparison.features import FEATURE_ALPHA, other_network
from semstab.comparison.pairing import on_common_observations
from semstab.comparison.quantities import COVERAGE, FLICKER, RECURRENT_VSS, SBD_EXCESS
from semstab.config import nearest
from semstab.core.types import OTHER_SCENES, THESE_FRAMES, THIS_SCENE, Scope
from semstab.data.measures import Measure
from semstab.data.statistics import ORDER_KNOWN, Interval
from semstab.data.statistics.intervals import short
from semstab.errors import ConfigError, DataError
from semstab.gating.result import Judgement, negative, verdict
from semstab.gating.rules import GateRule
from semstab.report.comparison.sentences import LEAST_LEFT_OUT, left_out
from semstab.statistics.agreement import ALPHA, PSA, VOXEL_ALPHA
from semstab.statistics.cluster_sums import ClusterSums, chance_of, functional, parts_of, value
from semstab.statistics.correctness import ECE
from semstab.statistics.intervals import counted, estimate, mean_of, mean_over_frames, shares_of, within_a_flight
from semstab.statistics.verdict import LEAST_CLASSES


def require_data(rule: GateRule, new: RunHandle, base: RunHandle | None, scenes: Sequence[str]) -> None:
    """Raise ConfigError or DataError for a rule whose scene, class, baseline or sums the runs do not have."""
    if rule.change is not None and base is None:
        raise ConfigError(f"rule '{rule.text}': a {rule.change} needs a baseline; give --against RUN")
    if rule.scene is not None and rule.scene not in scenes:
        raise ConfigError(f"rule '{rule.text}': no scene '{rule.scene}'; {nearest(rule.scene, scenes)}")
    for scene in [rule.scene] if rule.scene else scenes:
        entries = [run.scenes[scene] for run in (new, base) if run is not None and (run is new or rule.change)]
        if rule.class_name is not None and rule.class_name not in entries[0].classes:
            raise ConfigError(
                f"rule '{rule.text}': no class '{rule.class_name}'; {nearest(rule.class_name, entries[0].classes)}"
            )
        for entry in entries:
            if not _has(rule, entry):
                if not entry.sums.layout:
                    raise ConfigError(
                        f"rule '{rule.text}': {scene} is a video, without depth and poses; a rule may bound its flicker"
                    )
                name, few = rule.measure.name, _few_known(rule, entry)
                raise ConfigError(
                    f"rule '{rule.text}': {entry.where} has no {name} of {scene}{few}; {rule.measure.if_missing}"
                )
        changes_features = rule.measure.quantity is FEATURE_ALPHA and rule.change is not None
        if changes_features and base is not None and (why := other_network(base, new, scene)):
            raise ConfigError(
                f"rule '{rule.text}': {why}, and features of different networks cannot be compared by size; bound the"
                f" value itself, as '{rule.measure.name} > .6'"
            )
        if len({entry.sums.voxel_size for entry in entries}) > 1:
            sizes = [entry.sums.voxel_size for entry in entries]
            raise DataError(
                f"{new.where}: its voxels have {sizes[0]:g} m, those of the baseline {sizes[1]:g} m; run it with"
                f" --voxel-size {sizes[1]:g}"
            )


def _has(rule: GateRule, entry: Entry) -> bool:
    """Return whether a run has the data of a measure."""
    if rule.measure.quantity is FLICKER:
        return len(entry.flicker) > 1
    if rule.measure.quantity is COVERAGE:
        return bool(entry.sums.layout)
    key, k = rule.measure.quantity.key, _k(rule, entry)
    if not parts_of(entry.sums, functional(key, k)):
        return False
    if rule.measure.quantity is not SBD_EXCESS:
        return True
    num_with_null, locations = _order_known(entry.sums)
    return num_with_null > 0 and num_with_null >= ORDER_KNOWN * locations


def _order_known(sums: ClusterSums) -> tuple[float, int]:
    """Return at how many locations SBD in random order is known, and of how many."""
    return float(sums["sbd_known"].sum()), round(float(sums["voxels"].sum()))


def _few_known(rule: GateRule, entry: Entry) -> str:
    """Return at how few locations SBD in random order is known, which are no random sample; empty for other rules."""
    num_with_null, locations = _order_known(entry.sums) if rule.measure.quantity is SBD_EXCESS else (0.0, 0)
    few = f", which is known at {num_with_null:,.0f} of {locations:,} locations, fewer than {ORDER_KNOWN:.0%}"
    return few if num_with_null > 0 else ""


Pair = tuple[Entry, Entry | None]


def _k(rule: GateRule, entry: Entry) -> int | None:
    return None if rule.class_name is None else entry.classes.index(rule.class_name)


@dataclass(frozen=True, eq=False)
class GateRuns:
    """The new run and its baseline, on the scenes of both."""

    new: RunHandle
    base: RunHandle | None
    scenes: tuple[str, ...]

    def on_common(self, rule: GateRule) -> bool:
        """Return whether a rule is on a change of alpha, which is of common observations."""
        return self.base is not None and rule.change is not None and rule.measure.quantity is ALPHA

    @functools.cached_property
    def common(self) -> tuple[Mapping[str, Pair], tuple[str, ...]]:
        """The runs on each scene with the observations that both made, and notes on the share that one left out."""
        pairs: dict[str, Pair] = {}
        notes: list[str] = []
        base = self.base.scenes if self.base is not None else {}
        for scene in filter(base.get, self.scenes):
            new, old = self.new.scenes[scene], base[scene]
            paired = on_common_observations({"the baseline": old, "the run": new})
            if paired is not None:
                (old, new), compared, of_pairing = paired
                notes += [f"{scene}: {text}" for text in (*left_out(compared), *of_pairing)]
            pairs[scene] = new, old
        return pairs, tuple(notes)

    def pairs(self, rule: GateRule) -> list[Pair]:
        """Return the runs on each scene that a rule is about; for a rule on a value only the new one."""
        scenes = [rule.scene] if rule.scene else self.scenes
        if self.on_common(rule):
            return [self.common[0][scene] for scene in scenes]
        base = self.base.scenes if self.base is not None and rule.change else {}
        return [(self.new.scenes[scene], base.get(scene)) for scene in scenes]


def with_values(rules: Sequence[GateRule], runs: GateRuns) -> tuple[tuple[GateRule, ...], dict[str, list[str]]]:
    """Return the rules of classes that have a value everywhere, and the other classes by the run that has none.

    A class that only the baseline has stays: the run has lost it, and no drop of a measure shows that. Where no class
    is left all rules are returned, and the first of them raises the error.
    """
    with_value, absent = list[GateRule](), dict[str, list[str]]()
    for rule in rules:
        pairs = runs.pairs(rule)
        entries = (entry for pair in pairs for entry in pair if entry is not None)
        lacking = next((entry.where for entry in entries if math.isnan(value_of(rule, entry))), None)
        if lacking is None or is_lost(rule, pairs):
            with_value.append(rule)
        else:
            absent.setdefault(lacking, []).append(str(rule.class_name))
    return tuple(with_value or rules), absent if with_value else {}


LOST = "the baseline has this class, and the run gives it to no location that was seen twice"


def is_lost(rule: GateRule, pairs: Sequence[Pair]) -> bool:
    """Return whether a class has a value in the baseline of a scene, and none in the run."""
    return any(
        old is not None and math.isnan(value_of(rule, new)) and not math.isnan(value_of(rule, old))
        for new, old in pairs
    )


NOTHING = "no location that it needs was seen twice"
SCORES = "one run has labels and the other scores, which spread their evidence; run both as labels"

OF_EVIDENCE = (PSA, VOXEL_ALPHA, RECURRENT_VSS, SBD_EXCESS, ECE)
"""Measures that depend on the output of a model, labels or scores, as do all measures of the register."""


def require_values(rule: GateRule, pairs: Sequence[Pair]) -> None:
    """Raise ConfigError for a rule that cannot be evaluated, with advice."""
    for new, old in pairs:
        for entry in (new, old):
            if entry is not None and _of_all_alpha(rule) and _is_nearly_one_class(entry.sums):
                continue  # undecided, whatever alpha is
            if entry is not None and rule.measure.quantity is not COVERAGE and math.isnan(value_of(rule, entry)):
                measure_text = f"{rule.measure.name} of {rule.class_name}" if rule.class_name else rule.measure.name
                raise ConfigError(
                    f"rule '{rule.text}': {entry.where} has no {measure_text}: {NOTHING}; {rule.measure.if_missing}"
                )
        mixed = old is not None and (new.record.reduced is None) != (old.record.reduced is None)
        if mixed and (rule.measure.quantity in OF_EVIDENCE or isinstance(rule.measure.quantity, Measure)):
            raise ConfigError(f"rule '{rule.text}': {SCORES}")


def assess(rule: GateRule, pairs: Sequence[Pair], level: float, scope: Scope) -> Judgement:
    """Assess a rule by the mean of the scenes, whose errors are independent, or in the scene that it names."""
    result = mean_of([_interval_of(rule, new, old, level, scope) for new, old in pairs])
    values = [[math.nan if entry is None else value_of(rule, entry) for entry in pair] for pair in pairs]
    return Judgement(rule, verdict(rule, result), result, *(float(mean) for mean in np.mean(values, axis=0)))


def value_of(rule: GateRule, entry: Entry) -> float:
    """Return the number of a rule's measure in a run on a scene; NaN if undefined."""
    if rule.measure.quantity is FLICKER:
        return float(np.mean(list(entry.flicker.values())))
    if rule.measure.quantity is COVERAGE:
        return math.nan
    number = value(entry.sums, rule.measure.quantity.key, _k(rule, entry))
    return entry.pairs.of_all(number) if bounds_alpha(rule) else number


def _interval_of(rule: GateRule, new: Entry, base: Entry | None, level: float, scope: Scope) -> Interval:
    if rule.measure.quantity is COVERAGE and base is not None and _same_frames(new, base):
        change = counted(_covered(new.sums, base.sums), new.sums)
        return change if rule.change == "rise" else negative(change)
    if rule.measure.quantity is not FLICKER:
        k, before = _k(rule, new), None if base is None else base.sums
        result = bounded(rule, new.sums, before, k=k, level=level, scope=scope)
        if bounds_alpha(rule):
            number, low, high = map(new.pairs.of_all, (result.value, result.low, result.high))
            result = dataclasses.replace(result, value=number, low=low, high=high)
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


def bounded(
    rule: GateRule,
    new: ClusterSums,
    base: ClusterSums | None = None,
    *,
    k: int | None = None,
    level: float = 0.05,
    scope: Scope = THIS_SCENE,
) -> Interval:
    """Return the value, drop or rise that a rule bounds, from sums; each end is missed with probability `level`."""
    key, confidence = rule.measure.quantity.key, 1 - 2 * level
    if base is None or rule.change is None:
        return estimate(new, key, k, THESE_FRAMES if functional(key, k).of_space_alone else scope, confidence)
    same_frames = True if scope == THESE_FRAMES else None
    result = sums_difference(key, new, base, k, scope=scope, same_frames=same_frames, level=confidence)
    return result if rule.change == "rise" else negative(result)


ONE_CLASS = "nearly the whole map is one class, so that alpha tells nothing"


def _of_all_alpha(rule: GateRule) -> bool:
    return rule.measure.quantity is ALPHA and rule.class_name is None


def bounds_alpha(rule: GateRule) -> bool:
    """Return whether a rule bounds alpha itself, for which what has no label counts as disagreeing."""
    return _of_all_alpha(rule) and rule.change is None


def silence_notes(rule: GateRule, pairs: Sequence[Pair]) -> list[str]:
    """Return how alpha of a rule differs from that of what the run labels."""
    if not bounds_alpha(rule):
        return []
    return [
        f"{new.record.unit.scene}: the run gives no label in {1 - new.pairs.share:.1%} of the pairs of views, which"
        f" count as disagreeing: alpha is {short(value_of(rule, new), digits=3)}, and"
        f" {short(value(new.sums, ALPHA.key), digits=3)} of what it labels"
        for new, _ in pairs
        if 1 - new.pairs.share >= LEAST_LEFT_OUT
    ]


def _is_nearly_one_class(sums: ClusterSums | None) -> bool:
    """Return whether the verdict on the map is 'uninformative'."""
    return sums is not None and bool(sums.answers) and chance_of(sums.answers[0]) * LEAST_CLASSES > 1


def _same_frames(new: Entry, base: Entry) -> bool:
    """Return whether both are of the same frames, in some of which a model may have given no label."""
    return new.record.frames == base.record.frames and within_a_flight(new.sums, base.sums)


def _covered(new: ClusterSums, base: ClusterSums) -> float:
    """Return the change of the count that fell most: of voxels with OP >= 2, or of labelled observations in them.

    A model that gives some locations no label loses voxels; one that gives them a label in fewer frames observations.
    """
    return min(shares_of(new, base).values()) - 1


def coverage_counts(judgement: Judgement, pairs: Sequence[Pair]) -> list[str]:
    """Return the counts for a rule on coverage."""
    if not judgement.counted:
        return []
    shares = [shares_of(new.sums, base.sums) for new, base in pairs if base is not None]
    voxels, observations = (float(np.mean([share[name] for share in shares])) for name in ("voxels", "observations"))
    where = f" of {judgement.rule.scene}" if judgement.rule.scene else ""
    return [
        f"coverage{where}: {100 * voxels:.1f} % of the baseline's voxels with OP >= 2,"
        f" {100 * observations:.1f} % of its labelled observations in such voxels"
    ]
