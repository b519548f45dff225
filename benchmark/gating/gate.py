"""Gates, which decide if a new model may ship: each rule passes, fails, or is undecided by the data."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from semstab.comparison.entries import RunHandle, shared_scenes
from semstab.comparison.features import FEATURE_ALPHA
from semstab.comparison.opening import open_run
from semstab.comparison.quantities import COVERAGE, FLICKER
from semstab.config import read_yaml, validated
from semstab.config.groups import ScopeSetting
from semstab.core.types import THESE_FRAMES, THIS_SCENE, Scope
from semstab.data.statistics import UNKNOWN
from semstab.errors import ConfigError
from semstab.gating.evaluation import (
    LOST,
    GateRuns,
    Pair,
    assess,
    coverage_counts,
    is_lost,
    require_data,
    require_values,
    silence_notes,
    value_of,
    with_values,
)
from semstab.gating.result import GateResult, Judgement, Undecided
from semstab.gating.rules import ALL, GateRule, parse
from semstab.statistics.cluster_sums import functional


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
    settings = {"level": level, "undecided": undecided, "scope": scope}
    options = {name: value for name, value in settings.items() if value is not None}
    config = GateConfig() if file is None else validated(GateConfig, read_yaml(file), f"{file}: ")
    config = validated(GateConfig, {**config.model_dump(), **options, "rules": (*config.rules, *rules)}, "gate: ")
    if not config.rules:
        where = f"{file}: rules" if file is not None else "gate"
        raise ConfigError(f"{where}: there is no rule; write e.g. --rule 'alpha drop < 0.02'")
    return config


def gate(new: str | os.PathLike[str], against: str | os.PathLike[str] | None, config: GateConfig) -> GateResult:
    """Assess a run, or 'FOLDER:MODEL', by rules; those on a drop or a rise need a baseline, a run or a small summary.

    Args:
        new: Folder of a run, 'FOLDER:MODEL' if it has several models, or a result in memory.
        against: The baseline: a run, as `new`, or a small summary; None if no rule needs a baseline.
        config: The rules.

    Returns:
        The outcome, and the verdict on each rule.

    Raises:
        ConfigError, DataError: For a rule or a folder that cannot be used, and what to do.

    Examples:
        >>> semstab.gate("run:sim-steady", None, semstab.GateConfig(rules=("alpha > 0.6",)))
        <GateResult: passes; sim-steady (run) on scene0>
          passes: alpha > 0.6: .8...
    """
    parsed = [parse(text) for text in config.rules]
    of_features = all(rule.measure.quantity is FEATURE_ALPHA for rule in parsed)
    run = open_run(new)
    base = None if against is None else open_run(against)
    for handle in () if of_features else filter(None, (run, base)):
        handle.require_labels()
    scenes = tuple(run.scenes) if base is None else shared_scenes([base, run])
    runs, judgements, notes = GateRuns(run, base, scenes), list[Judgement](), _notes(run, base, scenes)
    for parsed_rule in parsed:
        rules, notes_of_rules = _rules(parsed_rule, runs)
        notes += notes_of_rules
        for rule in rules:
            pairs = runs.pairs(rule)
            if parsed_rule.class_name == ALL and is_lost(rule, pairs):
                judgements.append(_of_lost_class(rule, pairs))
                continue
            require_values(rule, pairs)
            judgements.append(assess(rule, pairs, config.level / len(rules), config.scope))
            notes += [*silence_notes(rule, pairs), *coverage_counts(judgements[-1], pairs)]
            notes += runs.common[1] if runs.on_common(rule) else ()
    notes += _without_frames(judgements, config.scope)
    baseline = "" if base is None else str(base)
    return GateResult(
        str(run), baseline, scenes, config.level, config.undecided, tuple(judgements), tuple(dict.fromkeys(notes))
    )


def _rules(parsed_rule: GateRule, runs: GateRuns) -> tuple[tuple[GateRule, ...], list[str]]:
    """Return the rules that a parsed rule stands for, all of which the runs have data for, and notes on others."""
    rules = parsed_rule.of_each(runs.new.scenes[runs.scenes[0]].classes)
    for rule in rules:
        require_data(rule, runs.new, runs.base, runs.scenes)
    if parsed_rule.class_name != ALL:
        return rules, []
    rules, absent = with_values(rules, runs)
    return rules, [
        f"{parsed_rule.text}: left out, as seen nowhere twice in {where}: {', '.join(names)}"
        for where, names in absent.items()
    ]


def _of_lost_class(rule: GateRule, pairs: Sequence[Pair]) -> Judgement:
    """Return an undecided judgement on a rule, with the baseline's mean over the scenes in which it has the class."""
    base = float(np.nanmean([value_of(rule, old) for _, old in pairs if old is not None]))
    return Judgement(rule, "undecided", dataclasses.replace(UNKNOWN, undecided=LOST), math.nan, base)


def _notes(run: RunHandle, base: RunHandle | None, scenes: Sequence[str]) -> list[str]:
    """Return notes on maps that say little, and on scenes that only one of the runs has."""
    warned = [
        f"{scene}: {handle.name} is {why}"
        for scene in scenes
        for handle in (run, base)
        if handle is not None and (why := handle.scenes[scene].caveat)
    ]
    unpaired = [scene for scene in run.scenes if scene not in scenes]
    missing = [scene for scene in (base.scenes if base else ()) if scene not in scenes]
    text = [f"only the run has these scenes, which are left out: {', '.join(unpaired)}"] if unpaired else []
    text += [f"only the baseline has these scenes, which are left out: {', '.join(missing)}"] if missing else []
    return warned + text


def _without_frames(judgements: Sequence[Judgement], scope: Scope) -> list[str]:
    """Return a note on rules whose intervals are for these frames, because the run has no sums by frame."""
    names = [
        judgement.rule.text
        for judgement in judgements
        if judgement.interval.scope == THESE_FRAMES != scope
        and not judgement.counted
        and judgement.rule.measure.quantity not in (FLICKER, COVERAGE)
        and not functional(judgement.rule.measure.quantity.key).of_space_alone
    ]
    why = "as the run kept no sums of its map by frame or has few; --statistics, or more frames"
    return [f"judged for these frames, {why}: {', '.join(names)}"] if names else []
