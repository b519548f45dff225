"""Make the table of names that were left out of a vocabulary, added to it or renamed."""

from __future__ import annotations

import math
from collections.abc import Iterator

from semstab.comparison.prompts import ChangedVocabulary, Effect, changed_vocabularies
from semstab.data.records import Record, Result
from semstab.data.statistics import UNKNOWN, Estimate
from semstab.predict.prompts import VocabularyChanges
from semstab.report.tables.statistics import INTERVALS, SCENE
from semstab.report.tables.table import Column, Group, Row, Table
from semstab.statistics.agreement import ALPHA


def prompts(result: Result) -> list[Table]:
    """Return what each change of names does, the largest gain of alpha first."""
    by_vocabulary: dict[str, list[ChangedVocabulary]] = {}
    for changed in changed_vocabularies(result):
        by_vocabulary.setdefault(changed.full, []).append(changed)
    if not by_vocabulary:
        return []
    several = len(result.scenes) > 1
    groups = []
    for name, rows in by_vocabulary.items():
        rows.sort(key=lambda changed: -changed.effect.difference.value)
        full = [_row(record, several=several) for record in result.select(model=name)]
        changed_rows = [_row(row.record, row.changes, row.effect, several=several) for row in rows]
        groups.append(Group(name, (*full, *changed_rows)))
    columns = (
        *((SCENE,) if several else ()), Column("prompt", "Prompt"), Column.for_quantity(ALPHA),
        Column("alpha_change", "Change", 3, "higher", signed=True), Column("changed_percent", "Labels changed (%)", 1),
        Column("most", "Most of them"), Column("most_percent", "(%)", 0),
    )  # fmt: skip
    caption = (
        "Each row has the vocabulary with that change of its names. Change is its alpha minus alpha of the full"
        " vocabulary, where both give a label. Labels changed is the share of the labels of views, at spots that lie"
        " evenly over the surface, that become another name; of these the most frequent change and its share are named."
        f" The largest gain comes first. {INTERVALS}"
    )
    return [Table("prompts", "Names removed, added and renamed", caption, columns, tuple(groups), by="vocabulary")]


def _row(
    record: Record, changes: VocabularyChanges | None = None, effect: Effect | None = None, *, several: bool
) -> Row:
    """Return the row of a change, or of the full vocabulary."""
    scene = (record.unit.scene,) if several else ()
    alpha = UNKNOWN if record.statistics is None else record.statistics.headline.alpha
    if changes is None or effect is None:
        return (*scene, "all names", alpha, math.nan, math.nan, "", math.nan)
    difference = Estimate(effect.difference.value, effect.difference.low, effect.difference.high)
    changed, share = 100 * effect.changed, 100 * effect.share if effect.most else math.nan
    return (*scene, "; ".join(_words(changes)), alpha, difference, changed, effect.most, share)


def _words(changes: VocabularyChanges) -> Iterator[str]:
    """Yield changes as the table says them."""
    yield from (f"without {name}" for name in changes.without)
    yield from (f"with {name}" for name in changes.add)
    yield from (f"{old} as {new}" for old, new in changes.rename)
