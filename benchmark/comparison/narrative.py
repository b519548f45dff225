"""What a comparison found, in sentences: on the terminal, in Markdown and above the report."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence

from rich.console import Console

from semstab.comparison.places import MOST
from semstab.comparison.tables import BY_CLASS, HEADLINES, VERDICT, blamed, by_key, tables
from semstab.model.contrast import Against, Basis, Contrast, Place, RunComparison, SceneComparison
from semstab.model.measures import Quantity
from semstab.model.statistics import NEXT_FLIGHT
from semstab.report.tables.table import to_terminal
from semstab.report.terminal import WIDTH

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


# --- In a terminal of 80 columns --------------------------------------------------------------------------------------

SHOWN = {
    "comparison": ("measure", "base", "other", "difference", "change"),
    "comparison_classes": ("class", "worse", "better", VERDICT.key, "alpha_between"),
    "comparison_places": ("what", "class", "instead", "voxels", "loss", "x", "y", "z"),
}
"""The columns of each table that fit; files have all of them."""


def print_comparison(found: RunComparison, console: Console) -> None:
    """The answer in sentences, then the differences, the classes and the locations that got worse."""
    for sentence in sentences(found):
        console.print(sentence, highlight=False, markup=False)
    for table in tables(found):
        if table.name in SHOWN:
            text = to_terminal(dataclasses.replace(table.only(*SHOWN[table.name]), caption=""), WIDTH)
            console.print(f"\n{text}", highlight=False, markup=False, soft_wrap=True)
