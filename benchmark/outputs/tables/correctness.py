"""Right beside stable where ground truth tells: geometry's part, correctness, quadrants, rules of fusion."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from semstab.metrics import macro_mean
from semstab.model.measures import VSS, Quantity, measures
from semstab.model.records import Result
from semstab.model.statistics import Correctness, Estimate, Losses, Quadrants, RuleMeans, RuleOutcome
from semstab.outputs.tables.stability import of_measures, settings
from semstab.outputs.tables.statistics import INTERVALS, SEEN_TWICE, Number, by_scene, grouped, judged_records
from semstab.outputs.tables.table import Column, Group, Row, Table
from semstab.statistics.correctness import ACCURACY, BRIER, ECE, MIOU

RIGHT = (ACCURACY, MIOU, ECE, BRIER)
"""How right fused labels are, in the order of the columns."""


def ceiling(result: Result) -> list[Table]:
    """Disagreement that the ground truth's labels have too, and the rest."""
    columns = (
        Column("disagreement", "1 - PSA", 4, "lower"),
        Column("geometry", "geometry's", 4),
        Column("model", "the model's", 4, "lower"),
        Column("geometry_percent", "geometry's (%)", 0),
    )
    numbers = (
        _lost(lambda losses: losses.total),
        _lost(lambda losses: losses.geometry),
        _lost(lambda losses: losses.model),
        _lost(lambda losses: 100 * losses.share.value),
    )
    caption = (
        "Over the voxels that both the predictions and the ground truth saw twice or more. Geometry's: the disagreement"
        " 1 - PSA that the ground truth's labels have under the same poses, depth and noise; the rest is the model's,"
        f" negative where it errs alike in all views. {INTERVALS}"
    )
    return by_scene(result, "ceiling", "Geometry or model", caption, columns, numbers)


def correctness(result: Result) -> list[Table]:
    """Right beside stable: by stratum of OP, and the four quadrants."""
    return [*_correct_by_stratum(result), *_quadrants(result)]


def _correct_by_stratum(result: Result) -> list[Table]:
    judged = {
        name: [found.correctness.strata for _, found in rows if found.correctness is not None]
        for name, rows in judged_records(result).items()
    }
    if not any(judged.values()):
        return []
    columns = (
        Column("persistence", "Persistence"),
        Column("voxels", "Voxels", 0),
        *map(Column.of, RIGHT),
    )
    groups = tuple(Group(name, _stratum_rows(strata)) for name, strata in judged.items() if strata)
    caption = (
        f"{settings(result.select())} Voxels with a true class: more than half of the ground truth's evidence is for"
        " it. ECE: expected calibration error of the largest belief; Brier: 0 to 2. Macro means: each scene counts"
        " once; voxels are those of all scenes."
    )
    return [Table("correctness", "Right beside stable, by observation persistence", caption, columns, groups)]


def _quadrants(result: Result) -> list[Table]:
    columns = (
        Column("voxels", "Voxels", 0),
        Column("stable_right_percent", "right", 1, "higher", over="Stable (%)"),
        Column("stable_wrong_percent", "wrong", 1, "lower", over="Stable (%)"),
        Column("unstable_right_percent", "right", 1, over="Unstable (%)"),
        Column("unstable_wrong_percent", "wrong", 1, "lower", over="Unstable (%)"),
        Column("wrong_of_stable_percent", "Of the stable, wrong (%)", 1, "lower"),
    )
    numbers = (
        _quadrant(lambda found: found.voxels),
        _quadrant(lambda found: found.stable_right.percent),
        _quadrant(lambda found: found.stable_wrong.percent),
        _quadrant(lambda found: found.unstable_right.percent),
        _quadrant(lambda found: found.unstable_wrong.percent),
        _quadrant(lambda found: found.wrong_of_stable.percent),
    )
    caption = (
        "Over the voxels with OP>=3 and a true class. Stable: PSA >= 0.8, of ten frames one may disagree; right: the"
        " dominant class is the true one. Stable and wrong is the dangerous one: no second look reveals it."
        f" {INTERVALS}"
    )
    return by_scene(result, "quadrants", "Stable and right", caption, columns, numbers)


def rules(result: Result) -> list[Table]:
    """Other rules of fusion applied to the same log of observations, macro means over scenes."""
    judged = {
        name: grouped((row for _, found in rows for row in found.fusion_rules or ()), lambda row: row.rule)
        for name, rows in judged_records(result).items()
    }
    judged = {name: rows for name, rows in judged.items() if rows}
    if not judged:
        return []
    columns = (
        Column("rule", "Rule"),
        *of_measures(),
        Column("relabelled_percent", "Relabelled (%)", 2),
        *map(Column.of, RIGHT),
    )
    groups = tuple(Group(name, _rule_rows(rows)) for name, rows in judged.items())
    caption = (
        f"{SEEN_TWICE} Averaging is the paper's rule; majority counts votes; product multiplies the frames' evidence as"
        " Bayes' rule does, geometric is its geometric mean. Relabelled: share of the voxels whose dominant class is"
        f" not that of averaging. Macro means: each scene counts once.{_order_by_rule(judged)}"
    )
    return [Table("rules", "Rules of fusion", caption, columns, groups)]


# --- Parts ------------------------------------------------------------------------------------------------------------


def _lost(take: Callable[[Losses], float | Estimate]) -> Number:
    """A number of geometry's part; NaN where that is not known."""
    return lambda found: math.nan if found.geometry is None else take(found.geometry)


def _quadrant(take: Callable[[Quadrants], float | Estimate]) -> Number:
    """A number of the quadrants; NaN without ground truth."""
    return lambda found: math.nan if found.correctness is None else take(found.correctness.quadrants)


def _stratum_rows(strata: Sequence[Sequence[Correctness]]) -> tuple[Row, ...]:
    return tuple(
        (name, sum(row.voxels for row in rows), *_right(rows))
        for name, rows in grouped((row for unit in strata for row in unit), lambda row: row.name).items()
    )


def _right(rows: Sequence[Correctness | RuleMeans]) -> list[float]:
    """The macro mean of each of RIGHT."""
    values = [(row.accuracy, row.miou, row.ece, row.brier) for row in rows]
    return [macro_mean(column) for column in zip(*values, strict=True)]


def _rule_rows(by_rule: Mapping[str, Sequence[RuleOutcome]]) -> tuple[Row, ...]:
    return tuple(
        (
            rule,
            *(macro_mean([row.values[measure] for row in rows]) for measure in measures()),
            100 * macro_mean([row.relabelled_share for row in rows]),
            *_right([row.values for row in rows]),
        )
        for rule, rows in by_rule.items()
    )


def _order_by_rule(judged: Mapping[str, Mapping[str, Sequence[RuleOutcome]]]) -> str:
    """Whether the order of the backbones by VSS and by accuracy depends on the rule, as a sentence."""
    if len(judged) < 2:
        return ""
    takers: dict[Quantity, Callable[[RuleMeans], float]] = {
        VSS: lambda row: row[VSS],
        ACCURACY: lambda row: row.accuracy,
    }
    changed = []
    for quantity, take in takers.items():
        by_rule: dict[str, dict[str, float]] = {}
        for backbone, rules_of in judged.items():
            for rule, rows in rules_of.items():
                by_rule.setdefault(rule, {})[backbone] = macro_mean([take(row.values) for row in rows])
        changed += [quantity.word] if len({_order(values) for values in by_rule.values()}) > 1 else []
    verb = f"changes by {' and by '.join(changed)}" if changed else "is the same"
    return f" From rule to rule the order of the backbones {verb}."


def _order(values: Mapping[str, float]) -> tuple[str, ...]:
    """The backbones whose value is defined, the highest first."""
    return tuple(
        sorted((name for name, value in values.items() if not math.isnan(value)), key=lambda name: -values[name])
    )
