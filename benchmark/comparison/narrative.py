"""What a comparison found, in sentences: on the terminal, in Markdown and above the report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from semstab.comparison.places import MOST
from semstab.comparison.tables import (
    ALL_SCENES,
    BY_CLASS,
    HEADLINES,
    IN_CLASSES,
    VERDICT,
    blamed,
    by_key,
    heading,
    scopes,
)
from semstab.model.contrast import Against, Basis, Contrast, Place, RunComparison, SceneComparison
from semstab.model.measures import Quantity
from semstab.model.statistics import NEXT_FLIGHT
from semstab.report.terminal import narrow_table

MOST_CLASSES = 4
"""Classes that are told of in a sentence."""

BASES: dict[Basis, str] = {
    "looks": "paired on the looks (a place in a frame) that all runs made, each with the same weight",
    "voxels": "paired on the voxels that all runs saw twice or more",
    "cubes": "paired on cubes of space",
    "flights": "not paired",
}


def sentences(found: RunComparison) -> list[str]:
    """One run after the other, then what could not be compared."""
    told = [sentence for own in found.overall for sentence in _of_run(found, own)]
    return [*told, *(sentence for scene in found.scenes for sentence in _what(scene))]


def _of_run(found: RunComparison, own: Against) -> Iterator[str]:
    yield _steadiness(found, own)
    if changes := _changes(own.contrasts, by_key(HEADLINES)):
        yield f"{own.other}: {changes}."
    classes = {
        name: [row for row in own.by_class if row.of == name] for name in dict.fromkeys(r.of for r in own.by_class)
    }
    told = {name: _changes(rows, by_key(BY_CLASS)) for name, rows in classes.items()}
    if listed := [f"{name} {text}" for name, text in told.items() if text]:
        more = f"; and {len(listed) - MOST_CLASSES} more classes" if len(listed) > MOST_CLASSES else ""
        yield f"{own.other} by class: {'. '.join(listed[:MOST_CLASSES])}{more}."
    for scene in found.scenes:
        mine = next(each for each in scene.against if each.other == own.other)
        for what in ("agreement", "truth"):
            if places := [place for place in mine.places if place.what == what]:
                yield f"{own.other} in {scene.scene}: {_of_places(places)}."


def _steadiness(found: RunComparison, own: Against) -> str:
    """What the share of the ceiling says, on which verdicts rest, or the first measure that is known."""
    rows = {row.measure: row for row in own.contrasts}
    quantity = next((each for each in HEADLINES if each.key in rows), VERDICT)
    row = rows.get(quantity.key)
    if row is None:
        return f"{own.other} and {found.base} have nothing that can be compared."
    where = f" over {len(found.scenes)} scenes" if len(found.scenes) > 1 else ""
    numbers = f"{quantity.word} {row.base:.3f} and {row.other:.3f}{where}"
    if row.difference.value == row.difference.low == row.difference.high == 0:
        return f"{own.other} is as steady as {found.base}: {numbers}, the same in every place."
    interval = f"{row.difference.value:+z.3f} ({row.difference.low:+z.3f} to {row.difference.high:+z.3f})"
    p = "" if math.isnan(row.p_holm) else f", p {row.p_holm:.2g}"
    whose = "the next flight" if row.difference.question == NEXT_FLIGHT else "these frames"
    said = {"better": "is steadier than", "worse": "is less steady than"}
    if row.change:
        return f"{own.other} {said[row.change]} {found.base}: {numbers}, {interval}{p}, for {whose}."
    why = f"; undecided: {row.difference.undecided}" if row.difference.undecided else ""
    return (
        f"Over all classes no difference in steadiness between {own.other} and {found.base} is shown: {numbers},"
        f" {interval}{p}, for {whose}{why}."
    )


def _changes(rows: Sequence[Contrast], known: Mapping[str, Quantity]) -> str:
    """'worse in mIoU, recall; better in flicker'."""
    listed = {
        change: [known[row.measure].word for row in rows if row.change == change and row.measure in known]
        for change in ("worse", "better")
    }
    return "; ".join(f"{change} in {', '.join(names)}" for change, names in listed.items() if names)


def _of_places(places: Sequence[Place]) -> str:
    first = places[0]
    lost = "whose frames agree less" if first.what == "agreement" else "that are wrong now"
    count = f"{MOST} or more places" if len(places) == MOST else f"{len(places)} place{'s' if len(places) > 1 else ''}"
    rivals = f"{first.rivals or 'none'} improved by as much as the largest"
    instead = f", {first.instead} instead" if first.instead else ""
    x, y, z = first.centre
    frames = f"; to blame are the frames {blamed(first.frames)}" if first.frames else ""
    return (
        f"{count} {lost} ({rivals}); the largest is {first.voxels} voxels of"
        f" {first.of}{instead}, at ({x:.2f}, {y:.2f}, {z:.2f}) m{frames}"
    )


def _what(scene: SceneComparison) -> Iterator[str]:
    if scene.basis in ("looks", "voxels"):
        yield f"{scene.scene}: {scene.voxels:,} voxels, {BASES[scene.basis]}."
    yield from (f"{scene.scene}: {remark}." for remark in scene.remarks)


# A comparison in a terminal of 80 columns.

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
