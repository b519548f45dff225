"""A comparison in a terminal of 80 columns."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from semstab.comparison.quantities import HEADLINES, by_key
from semstab.comparison.reading import sentences
from semstab.comparison.tables import ALL_SCENES, IN_CLASSES, heading, scopes
from semstab.model.measures import Quantity
from semstab.model.statistics.contrast import Against, Contrast, Place, RunComparison
from semstab.outputs.terminal.summary import narrow_table

MOST_SCENES = 4
"""Scenes that are shown each by itself; of more the report has them."""

MOST_PLACES = 8
"""Places of a run in a scene that are shown; the others are in the tables."""

FAR = 10.0
"""Metres from which on coordinates are rounded to decimetres."""

LOST = {"agreement": "agrees less from frame to frame", "truth": "is wrong now"}
COLORS = {"worse": "[red]worse[/]", "better": "[green]better[/]", "": ""}


def print_comparison(found: RunComparison, console: Console) -> None:
    """Differences over all scenes and by scene, by class, the places that got worse, and how to read them."""
    few = len(found.scenes) <= MOST_SCENES
    for scope, own in scopes(found):
        if few or scope == ALL_SCENES:
            console.print(_differences(heading(found, scope, own), own))
    for own in found.overall:
        if own.by_class:
            console.print(_classes(f"by class: {own.other} less {found.base}", own))
    for scene in found.scenes if few else ():
        for own in scene.against:
            for what, title in LOST.items():
                if places := [place for place in own.places if place.what == what]:
                    console.print(_places(f"{scene.scene}: places where {own.other} {title}", places))
    if not few:
        console.print(f"{len(found.scenes)} scenes: each by itself, with its places, is in the report (--out DIR)\n")
    for sentence in sentences(found):
        console.print(f"- {sentence}", highlight=False, markup=False)


def _differences(title: str, own: Against) -> Table:
    shown = by_key(HEADLINES)
    rows = [row for row in own.contrasts if row.measure in shown]
    title = f"{title}{_answers(rows)}"
    table = narrow_table(escape(title), ("",), ("base", "run", "less", "95%", "p\n(Holm)", ""))
    table.columns[0].no_wrap = True
    for row in rows:
        quantity = shown[row.measure]
        said = "undecided" if row.difference.undecided else COLORS[row.change]
        table.add_row(
            escape(quantity.symbol), _number(quantity, row.base), _number(quantity, row.other),
            *_difference(quantity, row), _p_value(row.p_holm), said,
        )  # fmt: skip
    return table


def _answers(rows: Sequence[Contrast]) -> str:
    """What the intervals answer, where it is one for all that are decided."""
    questions = {row.difference.question for row in rows if row.difference.decided}
    return f", for {questions.pop()}" if len(questions) == 1 else ""


def _difference(quantity: Quantity, row: Contrast) -> tuple[str, str]:
    found = row.difference
    ends = "-" if math.isnan(found.low) else f"{_number(quantity, found.low)} {_number(quantity, found.high)}"
    return _signed(_number(quantity, found.value)), ends


def _number(quantity: Quantity, value: float) -> str:
    return "-" if math.isnan(value) else f"{value:z.{quantity.digits[0]}f}"


def _signed(text: str) -> str:
    return text if text.startswith("-") or not any(digit in text for digit in "123456789") else f"+{text}"


def _p_value(p: float) -> str:
    if math.isnan(p):
        return "-"
    return "<.001" if p < 0.001 else f"{p:.3f}".removeprefix("0")


def _classes(title: str, own: Against) -> Table:
    """The difference of each class; what is claimed has a colour."""
    there = {row.measure for row in own.by_class}
    shown = [quantity for quantity in IN_CLASSES if quantity.key in there]
    table = narrow_table(escape(title), ("class",), [f"{quantity.symbol}" for quantity in shown])
    for name in dict.fromkeys(row.of for row in own.by_class):
        rows = {row.measure: row for row in own.by_class if row.of == name}
        table.add_row(escape(name), *(_colored(quantity, rows.get(quantity.key)) for quantity in shown))
    return table


def _colored(quantity: Quantity, row: Contrast | None) -> str:
    if row is None:
        return "-"
    text = _signed(_number(quantity, row.difference.value))
    mark = {"worse": f"[red]{text} worse[/]", "better": f"[green]{text} better[/]"}
    return mark.get(row.change, text)


def _places(title: str, places: Sequence[Place]) -> Table:
    numbers = ("voxels", "loss", "x", "y", "z (m)", "rivals")
    table = narrow_table(escape(title), ("class", "instead"), numbers)
    table.add_column("frames\nto blame", vertical="bottom", no_wrap=True)
    digits = 1 if any(abs(value) >= FAR for place in places for value in place.centre) else 2
    for place in places[:MOST_PLACES]:
        centre = (f"{value:z.{digits}f}" for value in place.centre)
        frames = ", ".join(str(own.frame) for own in place.frames[:3]) + (", ..." if len(place.frames) > 3 else "")
        table.add_row(
            escape(place.of), escape(place.instead), f"{place.voxels:,}", f"{place.loss:.2f}", *centre,
            str(place.rivals), frames,
        )  # fmt: skip
    if len(places) > MOST_PLACES:
        table.caption = f"and {len(places) - MOST_PLACES} more"
    return table
