"""Right beside stable where ground truth tells: geometry's part, correctness, quadrants, rules of fusion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from semstab.measures import measures
from semstab.statistics import number_at
from semstab.statistics.correctness import ACCURACY, BRIER, ECE, MIOU
from semstab.study.results import Record, StudyResult
from semstab.tables.stability import of_measures, settings
from semstab.tables.statistics import (
    INTERVALS,
    SEEN_TWICE,
    by_scene,
    estimate,
    judged_records,
    means,
    number,
    percent,
    rows_of,
)
from semstab.tables.table import Column, Group, Row, Table

RIGHT = (ACCURACY, MIOU, ECE, BRIER)
"""How right fused labels are, in the order of the columns."""


def ceiling(result: StudyResult) -> list[Table]:
    """Disagreement that the ground truth's labels have too, and the rest."""
    columns = (
        Column("disagreement", "1 - PSA", 4, "lower"),
        Column("geometry", "geometry's", 4),
        Column("model", "the model's", 4, "lower"),
        Column("geometry_percent", "geometry's (%)", 0),
    )
    numbers = (
        estimate("geometry", "total"),
        estimate("geometry", "geometry"),
        estimate("geometry", "model"),
        _geometry_percent,
    )
    caption = (
        "Over the voxels that both the predictions and the ground truth saw twice or more. Geometry's: the disagreement"
        " 1 - PSA that the ground truth's labels have under the same poses, depth and noise; the rest is the model's,"
        f" negative where it errs alike in all views. {INTERVALS}"
    )
    return by_scene(result, "ceiling", "Geometry or model", caption, columns, numbers, "geometry")


def correctness(result: StudyResult) -> list[Table]:
    """Right beside stable: by stratum of OP, and the four quadrants."""
    return [*_correct_by_stratum(result), *_quadrants(result)]


def _correct_by_stratum(result: StudyResult) -> list[Table]:
    judged = judged_records(result, "correctness")
    if not judged:
        return []
    columns = (
        Column("persistence", "Persistence"),
        Column("voxels", "Voxels", 0),
        *map(Column.of, RIGHT),
    )
    groups = tuple(Group(name, _stratum_rows(records)) for name, records in judged.items())
    caption = (
        f"{settings(result.select())} Voxels with a true class: more than half of the ground truth's evidence is for"
        " it. ECE: expected calibration error of the largest belief; Brier: 0 to 2. Macro means: each scene counts"
        " once; voxels are those of all scenes."
    )
    return [Table("correctness", "Right beside stable, by observation persistence", caption, columns, groups)]


def _quadrants(result: StudyResult) -> list[Table]:
    columns = (
        Column("voxels", "Voxels", 0),
        Column("stable_right_percent", "right", 1, "higher", over="Stable (%)"),
        Column("stable_wrong_percent", "wrong", 1, "lower", over="Stable (%)"),
        Column("unstable_right_percent", "right", 1, over="Unstable (%)"),
        Column("unstable_wrong_percent", "wrong", 1, "lower", over="Unstable (%)"),
        Column("wrong_of_stable_percent", "Of the stable, wrong (%)", 1, "lower"),
    )
    names = ("stable_right", "stable_wrong", "unstable_right", "unstable_wrong", "wrong_of_stable")
    shares = (percent("correctness", "quadrants", name) for name in names)
    caption = (
        "Over the voxels with OP>=3 and a true class. Stable: PSA >= 0.8, of ten frames one may disagree; right: the"
        " dominant class is the true one. Stable and wrong is the dangerous one: no second look reveals it."
        f" {INTERVALS}"
    )
    numbers = (number("correctness", "quadrants", "voxels"), *shares)
    return by_scene(result, "quadrants", "Stable and right", caption, columns, numbers, "correctness")


def rules(result: StudyResult) -> list[Table]:
    """Other rules of fusion applied to the same log of observations, macro means over scenes."""
    judged = judged_records(result, "fusion_rules")
    if not judged:
        return []
    columns = (
        Column("rule", "Rule"),
        *of_measures(),
        Column("relabelled_percent", "Relabelled (%)", 2),
        *map(Column.of, RIGHT),
    )
    groups = tuple(Group(name, _rule_rows(records)) for name, records in judged.items())
    caption = (
        f"{SEEN_TWICE} Averaging is the paper's rule; majority counts votes; product multiplies the frames' evidence as"
        " Bayes' rule does, geometric is its geometric mean. Relabelled: share of the voxels whose dominant class is"
        f" not that of averaging. Macro means: each scene counts once.{_order_by_rule(judged)}"
    )
    return [Table("rules", "Rules of fusion", caption, columns, groups)]


# --- Parts ------------------------------------------------------------------------------------------------------------


def _stratum_rows(records: Sequence[Record]) -> tuple[Row, ...]:
    return tuple(
        (name, sum(row["voxels"] for row in rows), *means(rows, *(quantity.key for quantity in RIGHT)))
        for name, rows in rows_of(records, "correctness", "strata").items()
    )


def _rule_rows(records: Sequence[Record]) -> tuple[Row, ...]:
    rows: list[Row] = []
    for name, found in rows_of(records, "fusion_rules").items():
        (relabelled,) = means(found, "relabelled_share")
        measured, right = (means(found, *(q.key for q in of)) for of in (measures(), RIGHT))
        rows.append((name, *measured, 100 * relabelled, *right))
    return tuple(rows)


def _order_by_rule(judged: Mapping[str, Sequence[Record]]) -> str:
    """Whether the order of the backbones by VSS and by accuracy depends on the rule, as a sentence."""
    if len(judged) < 2:
        return ""
    changed = []
    for measure, name in (("vss", "VSS"), ("accuracy", "accuracy")):
        by_rule: dict[str, dict[str, float]] = {}
        for backbone, records in judged.items():
            for rule, rows in rows_of(records, "fusion_rules").items():
                by_rule.setdefault(rule, {})[backbone] = means(rows, measure)[0]
        changed += [name] if len({_order(values) for values in by_rule.values()}) > 1 else []
    verb = f"changes by {' and by '.join(changed)}" if changed else "is the same"
    return f" From rule to rule the order of the backbones {verb}."


def _order(values: Mapping[str, float]) -> tuple[str, ...]:
    """The backbones whose value is defined, the highest first."""
    return tuple(
        sorted((name for name, value in values.items() if not math.isnan(value)), key=lambda name: -values[name])
    )


def _geometry_percent(record: Record) -> float:
    return 100 * number_at(record.statistics, "geometry", "share", "value")
