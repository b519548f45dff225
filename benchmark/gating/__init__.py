"""May a new model ship? Rules, judged by what the data show: each passes, fails, or is undecided."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from semstab.comparison.opening import Contender, Entry, open_contender, shared_scenes
from semstab.comparison.quantities import COVERAGE, FLICKER, SBD_EXCESS
from semstab.config import nearest
from semstab.errors import ConfigError, DataError
from semstab.gating import judging
from semstab.gating.config import GateConfig, gate_config
from semstab.gating.measures import OF_EVIDENCE
from semstab.gating.results import GateResult, Judgement
from semstab.gating.rules import Rule, parse
from semstab.model.statistics import Interval
from semstab.statistics.sampling import difference_over_frames, mean_of, mean_over_frames, value
from semstab.statistics.sampling.influence import columns_of

__all__ = ["GateConfig", "GateResult", "gate", "gate_config"]


def gate(new: str | Path, against: str | Path | None, config: GateConfig) -> GateResult:
    """Judge a run, or 'FOLDER:BACKBONE', by rules; those on a drop or a rise need a baseline, a run or a small summary.

    Raises ConfigError and DataError, each with the rule or the folder, and what to do.
    """
    parsed = [parse(text) for text in config.rules]
    own = open_contender(new)
    base = None if against is None else open_contender(against)
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
    frames: judging.Frames


def _named(run: Contender) -> str:
    return f"{run.backbone} ({run.source})"


def _remarks(own: Contender, base: Contender | None, scenes: Sequence[str]) -> list[str]:
    left = [scene for scene in own.scenes if scene not in scenes]
    missing = [scene for scene in (base.scenes if base else ()) if scene not in scenes]
    said = [f"not in the baseline, and not compared: {', '.join(left)}"] if left else []
    return said + ([f"of the baseline alone, and not compared: {', '.join(missing)}"] if missing else [])


# --- Before anything is judged ----------------------------------------------------------------------------------------


def _check(rule: Rule, own: Contender, base: Contender | None, scenes: Sequence[str]) -> None:
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
    columns = columns_of(entry.sums, rule.measure.key, _k(rule, entry))
    return bool(columns.size) and (rule.measure.quantity is not SBD_EXCESS or bool(columns[:, 1].any()))


def _k(rule: Rule, entry: Entry) -> int | None:
    return None if rule.class_name is None else entry.classes.index(rule.class_name)


# --- Rules ------------------------------------------------------------------------------------------------------------


def _judged(rule: Rule, own: Contender, base: Contender | None, scenes: Sequence[str], ways: _Ways) -> Judgement:
    """Over the mean of the scenes, which err by themselves, or in the one that the rule names."""
    pairs = [
        (own.scenes[scene], None if base is None else base.scenes[scene])
        for scene in ([rule.scene] if rule.scene else scenes)
    ]

    def at(level: float) -> Interval:
        chosen = dataclasses.replace(ways, level=level)
        return mean_of([_found(rule, new, old, chosen) for new, old in pairs], 1 - 2 * level)

    found = at(ways.level)
    if judging.doubtful(found):
        strict = dataclasses.replace(at(ways.level * judging.DOUBT), undecided="")
        found = found if judging.verdict(rule, strict) == "undecided" else strict
    return Judgement(
        rule,
        judging.verdict(rule, found),
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
        found = judging.change(new.sums, base.sums, rule.measure, _k(rule, new), ways.level, ways.frames)
    if rule.measure.quantity in OF_EVIDENCE and (new.summary.reduced is None) != (base.summary.reduced is None):
        found = dataclasses.replace(found, undecided=judging.SCORES)
    return found if rule.change == "rise" else judging.negative(found)


def _own(rule: Rule, entry: Entry, ways: _Ways) -> Interval:
    if rule.measure.quantity is not FLICKER:
        return judging.value(entry.sums, rule.measure, _k(rule, entry), ways.level, ways.frames)
    frames, percent = np.array(list(entry.flicker)), np.array(list(entry.flicker.values()))
    return judging.of_frames(mean_over_frames(frames, percent, 1 - 2 * ways.level), len(frames))


def _flicker(new: Entry, base: Entry, level: float) -> Interval:
    """Paired by frame, where both have the same ones; else each by itself."""
    shared = sorted(new.flicker.keys() & base.flicker.keys())
    if len(shared) < 2:
        raise DataError(
            f"{new.where} and {base.where}: no frames in common to compare flicker on; run both on the same"
        )
    found = difference_over_frames(new.flicker, base.flicker, 1 - 2 * level)
    return judging.of_frames(found, len(shared))
