"""The tables of two visits of one place, and what the screen says of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from semstab.core.console import WIDTH, Console, wrapped
from semstab.data.statistics import TwoVisits
from semstab.report.tables.table import Column, Group, Row, Table, to_terminal

if TYPE_CHECKING:
    from semstab.two_visits import VisitComparison, VisitedScene

FEW = 0.1
"""Share of the spots that both visits label below which a note asks whether the frames of reference are the same."""

MOST_NAMED = 4
"""Most classes that a sentence names."""

LEAST_NAMED = 0.01
"""Share of a class with another class in the second visit from which on a sentence names it."""

ON_SCREEN = ("class", "first", "second", "across", "cost", "relabelled")

ALPHAS = (
    "Alpha is agreement beyond chance of two views of the first visit, of two views of the second one, and of a view of"
    " each, at the same spots: those that both visits label twice or more, without those that changed or moved. The"
    " cost is the mean of both within less across. Brackets hold intervals at 95 % for these frames, that is, for other"
    " places."
)


def tables(comparison: VisitComparison) -> list[Table]:
    """Return all tables that have rows."""
    made = [_alphas(comparison), _changes(comparison), _classes(comparison), _places(comparison)]
    return [table for table in made if any(group.rows for group in table.groups)]


def _names(comparison: VisitComparison) -> tuple[str, str]:
    return comparison.visits[0].name, comparison.visits[1].name


def _alphas(comparison: VisitComparison) -> Table:
    first, second = _names(comparison)
    columns = (
        Column("scene", "Scene"), Column("spots", "Spots", 0), Column("first", f"Within {first}", 3),
        Column("second", f"Within {second}", 3), Column("across", "Across", 3), Column("cost", "Cost", 3, signed=True),
    )  # fmt: skip
    rows = list[Row]()
    for scene in comparison.scenes:
        alpha = scene.visits.alpha
        parts = (interval.ends for interval in (alpha.first, alpha.second, alpha.across, alpha.cost))
        rows.append((scene.scene, scene.visits.spots, *parts))
    return Table("visits", "Agreement within and across", ALPHAS, columns, (Group("", tuple(rows)),), "")


def _changes(comparison: VisitComparison) -> Table:
    columns = (
        Column("scene", "Scene"), Column("stayed", "Stayed", 0), Column("gone", "Gone", 0), Column("new", "New", 0),
        Column("moved", "Moved", 0), Column("unknown", "Unknown", 0),
        Column("relabelled_percent", "Other class %", 1), Column("by_chance_percent", "By chance %", 1),
    )  # fmt: skip
    rows = tuple(
        (scene.scene, row.stayed, row.gone, row.new, row.moved, row.unknown, 100 * row.relabelled, 100 * row.by_chance)
        for scene in comparison.scenes
        for row in [scene.visits]
    )
    caption = (
        "Spots by their surface: there in both visits, gone in the second one, new in it, moved within a visit, or not"
        " told by both. Other class: of the spots whose alpha is told, those to which both visits give different"
        " classes; by chance: the same if the views of one visit had answered for both."
    )
    return Table("visits_changes", "What changed", caption, columns, (Group("", rows),), "")


def _classes(comparison: VisitComparison) -> Table:
    first, second = _names(comparison)
    columns = (
        Column("class", "Class"), Column("spots", "Spots", 0), Column("first", first, 3), Column("second", second, 3),
        Column("across", "Across", 3), Column("cost", "Cost", 3, signed=True), Column("gone", "Gone %", 1),
        Column("new", "New %", 1), Column("relabelled", "Other class %", 1), Column("becomes", "Most often"),
    )  # fmt: skip
    groups = tuple(
        Group(
            scene.scene,
            tuple(
                (row.name, row.spots, row.alpha.first.ends, row.alpha.second.ends, row.alpha.across.ends,
                 row.alpha.cost.ends, 100 * row.gone, 100 * row.new, 100 * row.relabelled, row.becomes)
                for row in scene.visits.classes
            ),
        )
        for scene in comparison.scenes
    )  # fmt: skip
    caption = (
        "Alpha of the class against all others. Gone, new, other class: shares of the spots to which most views of a"
        f" visit give the class ({second} if new, else {first}); most often: the class that most of the others have."
    )
    return Table("visits_classes", "By class", caption, columns, groups, "scene")


def _places(comparison: VisitComparison) -> Table:
    columns = (
        Column("number", "Place"), Column("change", "Change"), Column("before", "Before"), Column("after", "After"),
        Column("spots", "Spots", 0), Column("x", "x", 2), Column("y", "y", 2), Column("z", "z", 2),
        Column("size", "Size, m", 1),
    )  # fmt: skip
    groups = tuple(
        Group(
            scene.scene,
            tuple(
                (str(place.number), place.change, place.before, place.after, place.spots, *place.centre, place.size)
                for place in scene.places
            ),
        )
        for scene in comparison.scenes
    )
    caption = (
        "Neighbouring spots that changed in the same way, the most spots first; coordinates are those of the exports,"
        " in metres."
    )
    return Table("visits_places", "Places that changed", caption, columns, groups, "scene")


# --- In words ---------------------------------------------------------------------------------------------------------


def sentences(comparison: VisitComparison) -> list[str]:
    """Return what two visits tell: of each scene agreement, its cost, and what changed."""
    return [text for scene in comparison.scenes for text in _of_scene(comparison, scene)]


def _of_scene(comparison: VisitComparison, scene: VisitedScene) -> Iterator[str]:
    (first, second), visits = _names(comparison), scene.visits
    if not visits.spots:
        yield (
            f"{scene.scene}: no spot that both visits label; are their frames of reference the same? Give points that"
            " both know: --align"
        )
        return
    alpha = visits.alpha
    where = f"at {visits.spots:,} spots that did not change"
    yield (
        f"{scene.scene}: alpha within {first} {alpha.first.text()}, within {second} {alpha.second.text()}, across"
        f" {alpha.across.text()}, {where}."
    )
    yield f"{_cost(visits)}."
    yield f"{_surface(visits)}."
    yield f"{_labels(visits)}."


def _cost(visits: TwoVisits) -> str:
    cost = visits.alpha.cost
    if cost.high < 0:
        return f"Views agree better across the visits than within: a cost of {cost.text()} of alpha, for {cost.scope}"
    if cost.low > 0:
        return f"The other visit costs {cost.text()} of alpha, for {cost.scope}"
    return f"No cost of the other visit is shown: {cost.text()} of alpha, for {cost.scope}"


def _surface(visits: TwoVisits) -> str:
    num_decided = visits.stayed + visits.gone + visits.new
    if not num_decided:
        return "Whether the surface changed is not told: no spot is seen twice by both visits"
    all_spots = num_decided + visits.moved + visits.unknown
    return (
        f"Surface: {visits.gone / num_decided:.1%} gone and {visits.new / num_decided:.1%} new of {num_decided:,} spots"
        f" that both visits tell; {visits.moved / all_spots:.1%} of all spots moved within a visit,"
        f" {visits.unknown / all_spots:.0%} are not told"
    )


def _labels(visits: TwoVisits) -> str:
    text = f"Labels: {visits.relabelled:.1%} of the spots that did not change have another class"
    text += f" ({visits.by_chance:.1%} would by chance)"
    changed = (row for row in visits.classes if row.relabelled >= LEAST_NAMED)
    worst = sorted(changed, key=lambda row: -row.relabelled * row.spots)
    descriptions = [f"{row.relabelled:.0%} of {row.name}, to {row.becomes}" for row in worst[:MOST_NAMED]]
    return f"{text}: {'; '.join(descriptions)}" if descriptions else text


def notes(comparison: VisitComparison) -> Iterator[str]:
    """Yield what to know about the pairing."""
    if comparison.residual is not None:
        yield (
            f"the second visit was turned and moved by {comparison.points} points, between which"
            f" {comparison.residual:.3g} m are left (root mean square)"
        )
    for scene in comparison.scenes:
        visits = scene.visits
        total = visits.stayed + visits.gone + visits.new + visits.moved + visits.unknown
        if total and visits.spots < FEW * total:
            yield (
                f"{scene.scene}: only {visits.spots / total:.1%} of the spots are labelled twice by both visits: are"
                " their frames of reference the same?"
            )
        for visit, count in zip(comparison.visits, visits.misplaced, strict=True):
            if count:
                yield f"{scene.scene}: poses of {count} frames of {visit.name} do not fit (semstab-bench check)"


def print_visits(
    comparison: VisitComparison, console: Console, *, verbose: bool = False, out: Path | None = None
) -> None:
    """Print the answer in sentences and alpha by class; verbose: all tables."""
    for sentence in sentences(comparison):
        console.print(sentence, highlight=False, markup=False)
    for table in tables(comparison):
        if table.name == "visits_classes":
            text = to_terminal(_narrow(table), WIDTH)
        elif verbose:
            text = to_terminal(dataclasses.replace(table, caption=""), WIDTH)
        else:
            continue
        console.print(f"\n{text.rstrip()}", highlight=False, markup=False, soft_wrap=True)
    for note in notes(comparison):
        console.print("\n".join(wrapped(note, console.width)), highlight=False, markup=False)
    more = [*([] if verbose else ["-v: all tables"]), *([] if out else ["--out DIR: report.html, tables, map"])]
    if more:
        console.print(f"  more     {'; '.join(more)}", highlight=False)


def _narrow(table: Table) -> Table:
    """Return the table of classes for a terminal: intervals of the cost alone, classes whose alpha is told."""
    at = {column.key: k for k, column in enumerate(table.columns)}
    groups = []
    for group in table.groups:
        rows = [list(row) for row in group.rows if not math.isnan(getattr(row[at["across"]], "value", math.nan))]
        for row in rows:
            for key in ("first", "second", "across"):
                row[at[key]] = getattr(row[at[key]], "value", math.nan)
        groups.append(Group(group.name, tuple(map(tuple, rows))))
    columns = tuple(
        dataclasses.replace(column, header=column.key.capitalize()) if column.key in ("first", "second") else column
        for column in table.columns
    )
    first, second = (table.columns[at[key]].header for key in ("first", "second"))
    title = f"{table.title} (first: {first}, second: {second})"
    return dataclasses.replace(table, title=title, caption="", columns=columns, groups=tuple(groups)).only(*ON_SCREEN)
