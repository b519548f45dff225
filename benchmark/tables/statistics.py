"""What the statistics say of each map: agreement, drift, where uncertainty comes from, the verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from semstab.averages import by_backbone
from semstab.measures import ENTROPY, VSS
from semstab.metrics import macro_mean
from semstab.statistics import Estimate, estimate_at, number_at
from semstab.statistics.agreement import ALPHA, KAPPA, PSA
from semstab.statistics.drift import FLIP_RATE
from semstab.statistics.verdict import ADVICE
from semstab.study.results import Record, StudyResult
from semstab.tables.table import Column, Group, Row, Table

SCENE = Column("scene", "Scene")
REPEATED = Column("repeated_voxels", "Voxels", 0)
INTERVALS = "In brackets: intervals at 95% from a bootstrap over blocks of space."
SEEN_TWICE = "Over the voxels seen twice or more."

Number = Callable[[Record], float | Estimate]


def temporal_agreement(result: StudyResult) -> list[Table]:
    """Do frames agree about a place? Measures that do not depend on OP."""
    columns = (
        REPEATED,
        *map(Column.of, (VSS, PSA, KAPPA, ALPHA, FLIP_RATE)),
    )
    numbers = (
        number("repeated", "voxels"),
        number("agreement", "vss", "value"),
        estimate("agreement", "psa"),
        number("agreement", "kappa", "value"),
        estimate("agreement", "alpha"),
        number("drift", "flips", "rate", "value"),
    )
    caption = (
        f"{SEEN_TWICE} PSA: share of pairs of frames that agree about a voxel; kappa (Fleiss) and alpha (Krippendorff):"
        " the same beyond chance, 1 perfect, 0 chance; flip rate: share of the steps from one observation to the next"
        f" at which the predicted class changes. {INTERVALS}"
    )
    return by_scene(result, "temporal_agreement", "Agreement of the frames", caption, columns, numbers)


def class_agreement(result: StudyResult) -> list[Table]:
    """Alpha of each class against all others, macro means over scenes."""
    judged = judged_records(result)
    if not judged:
        return []
    columns = (
        Column("class", "Class"),
        Column("observations", "Observations", 0),
        *map(Column.of, (KAPPA, ALPHA)),
    )
    groups = tuple(Group(name, _class_rows(records)) for name, records in judged.items())
    caption = (
        f"{SEEN_TWICE} Each class against all others; observations are the evidence for it, in frames, of all scenes."
        " Macro means: each scene counts once."
    )
    return [Table("class_agreement", "Agreement of the frames, by class", caption, columns, groups)]


def drift(result: StudyResult) -> list[Table]:
    """SBD beside what a random order of the same observations gives, and the drift in one direction."""
    columns = (
        Column("voxels", "Voxels", 0),
        Column("sbd", "as seen", 4, over="SBD (bits)"),
        Column("sbd_null", "random order", 4, over="SBD (bits)"),
        Column("sbd_excess", "excess", 4, signed=True, over="SBD (bits)"),
        Column("sbd_p", "p", 3, over="SBD (bits)"),
        Column("trend", "one way", 3, over="Trend"),
        Column("trend_null", "random order", 3, over="Trend"),
        Column("trend_p", "p", 3, over="Trend"),
        Column("drifting_voxels", "drifting", 0, over="Voxels"),
        Column("tested_voxels", "tested", 0, over="Voxels"),
    )
    numbers = (
        number("drift", "voxels"),
        number("drift", "sbd", "value"),
        number("drift", "null", "value"),
        estimate("drift", "excess"),
        number("drift", "tests", "sbd_p"),
        number("drift", "tests", "trend"),
        number("drift", "tests", "trend_null"),
        number("drift", "tests", "trend_p"),
        number("drift", "tests", "drifting_voxels"),
        number("drift", "tests", "tested_voxels"),
    )
    logged = any((record.statistics.get("drift") or {}).get("tests") for record in result.select())
    one_class = f"{SEEN_TWICE[:-1]}, each frame as one class; the others need a log (statistics: true)."
    seen = SEEN_TWICE if logged else one_class
    tests = (
        " Trend: share of the disagreement that goes one way in time. p: of values this far out, from random orders of"
        " the frames. Drifting: voxels whose own trend is significant at a false discovery rate of 5%, of those seen"
        " six times or more."
    )
    caption = (
        f"{seen} Random order: what the same observations give in the mean of all orders; excess: SBD less that."
        f"{tests if logged else ''} {INTERVALS}"
    )
    return by_scene(result, "drift", "Belief drift against random order", caption, columns, numbers)


def uncertainty(result: StudyResult) -> list[Table]:
    """The entropy of the belief, within frames and between them."""
    columns = (
        Column.of(ENTROPY),
        Column("within", "within frames", 4, "lower"),
        Column("between", "between frames", 4, "lower"),
        Column("within_percent", "within (%)", 0),
    )

    def share(record: Record) -> float:
        entropy = number_at(record.statistics, "uncertainty", "entropy", "value")
        within = number_at(record.statistics, "uncertainty", "within", "value")
        return 100 * within / entropy if entropy else math.nan

    numbers = (
        estimate("uncertainty", "entropy"),
        estimate("uncertainty", "within"),
        estimate("uncertainty", "between"),
        share,
    )
    caption = (
        f"{SEEN_TWICE} Entropy of the belief in units of log K, as the sum of what is there within each frame (borders,"
        f" voxels larger than things, unsure scores) and of the frames' disagreement. {INTERVALS}"
    )
    return by_scene(result, "uncertainty", "Where the uncertainty comes from", caption, columns, numbers)


def verdicts(result: StudyResult) -> list[Table]:
    """What the evidence says of each backbone on each scene, and what to do."""
    judged = judged_records(result)
    if not judged:
        return []
    columns = (
        SCENE,
        Column("verdict", "Verdict"),
        Column.of(ALPHA),
        Column("wrong_of_stable_percent", "Of the stable, wrong (%)", 0, "lower"),
        REPEATED,
        Column("repeated_percent", "of the map (%)", 0),
        Column("advice", "What to do"),
    )
    groups = tuple(Group(name, tuple(_verdict_row(record) for record in records)) for name, records in judged.items())
    caption = (
        f"{SEEN_TWICE} Decided by the intervals: stable where alpha is at least 0.8, usable from 0.667, unstable below;"
        " misleading where more than 5% of the stable places are wrong, which only ground truth tells."
        f" {INTERVALS}"
    )
    return [Table("verdicts", "Verdicts", caption, columns, groups)]


# --- Parts ------------------------------------------------------------------------------------------------------------


def by_scene(
    result: StudyResult,
    name: str,
    title: str,
    caption: str,
    columns: Sequence[Column],
    numbers: Sequence[Number],
    section: str = "agreement",
) -> list[Table]:
    """One row a scene, and the macro mean of several; columns that no unit has a number for are left out."""
    judged = judged_records(result, section)
    records = [record for rows in judged.values() for record in rows]
    known = [k for k, take in enumerate(numbers) if not all(math.isnan(_value(take(record))) for record in records)]
    if not known:
        return []

    def row(scene: str, cells: Sequence[float | Estimate]) -> Row:
        return scene, *(cells[k] for k in known)

    groups = tuple(
        Group(
            backbone,
            tuple(row(record.unit.scene, [take(record) for take in numbers]) for record in rows),
            row("Mean", [_mean(take, rows) for take in numbers]) if len(rows) > 1 else None,
        )
        for backbone, rows in judged.items()
    )
    return [Table(name, title, caption, (SCENE, *(columns[k] for k in known)), groups)]


def judged_records(result: StudyResult, section: str = "agreement") -> dict[str, list[Record]]:
    """The base units by backbone whose statistics have that section."""
    return by_backbone(record for record in result.select() if record.statistics.get(section))


def number(*path: str) -> Number:
    """The number at a path of keys in a unit's statistics."""
    return lambda record: number_at(record.statistics, *path)


def estimate(*path: str) -> Number:
    """The estimate at a path of keys in a unit's statistics."""
    return lambda record: estimate_at(record.statistics, *path)


def percent(*path: str) -> Number:
    """The estimate of a share at a path of keys, in percent."""

    def hundredfold(record: Record) -> Estimate:
        share = estimate_at(record.statistics, *path)
        return Estimate(100 * share.value, 100 * share.low, 100 * share.high)

    return hundredfold


def _value(found: float | Estimate) -> float:
    return found.value if isinstance(found, Estimate) else found


def _mean(take: Number, records: Sequence[Record]) -> float:
    return macro_mean([_value(take(record)) for record in records])


def rows_of(records: Sequence[Record], *path: str) -> dict[str, list[Mapping[str, Any]]]:
    """The rows of a list in the units' statistics by their first entry, a name."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        rows: Any = record.statistics
        for key in path:
            rows = rows[key]
        for row in rows:
            found.setdefault(next(iter(row.values())), []).append(row)
    return found


def means(rows: Sequence[Mapping[str, Any]], *keys: str) -> list[float]:
    """The macro mean of each of these entries."""
    return [macro_mean([number_at(row, key) for row in rows]) for key in keys]


def _class_rows(records: Sequence[Record]) -> tuple[Row, ...]:
    return tuple(
        (name, sum(number_at(row, "observations") for row in rows), *means(rows, "kappa", "alpha"))
        for name, rows in rows_of(records, "agreement", "classes").items()
    )


def _verdict_row(record: Record) -> Row:
    level = str(record.statistics["verdict"]["level"])
    return (
        record.unit.scene,
        level,
        estimate_at(record.statistics, "agreement", "alpha"),
        percent("correctness", "quadrants", "wrong_of_stable")(record),
        number_at(record.statistics, "repeated", "voxels"),
        100 * number_at(record.statistics, "repeated", "share"),
        ADVICE[level],
    )
