"""The results of a comparison in sentences, for the terminal, Markdown and the top of the report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

from semstab.comparison.locations import MOST
from semstab.comparison.quantities import BY_CLASS, COVERAGE, FLICKER, HEADLINES, by_name
from semstab.core.types import SCOPE_WORDS
from semstab.data.contrast import Against, Area, Basis, ComparedObservations, Contrast, RunComparison, SceneComparison
from semstab.data.measures import Quantity
from semstab.data.statistics import short, without_zero
from semstab.report.comparison.tables import top_frames
from semstab.statistics.agreement import ALPHA

MOST_CLASSES = 4
"""Most classes that a sentence names."""

MOST_SCENES = 4
"""Most scenes whose areas a sentence counts."""

BASES: dict[Basis, str] = {
    "observations": "paired; alpha counts the views of a spot that all runs label",
    "voxels": "paired on the voxels that all runs saw twice or more",
    "cubes": "paired on cubes of space",
    "flights": "not paired",
    "images": "paired on frames",
}


def sentences(comparison: RunComparison) -> list[str]:
    """Return the results of one run after the other, then notes on data that could not be compared."""
    return [*differences(comparison), *(f"caution: {text}." for text in comparison.cautions), *notes(comparison)]


def differences(comparison: RunComparison, *, places: bool = True) -> list[str]:
    """Return the differences, run by run; with places: also the largest areas that got worse, else their number."""
    areas = _largest_areas if places else _number_of_areas
    return [
        sentence
        for against in comparison.overall
        for sentence in (*_of_run(comparison, against), *areas(comparison, against))
    ]


def notes(comparison: RunComparison) -> list[str]:
    """Return the paired data, and notes on data that could not be compared, scene by scene."""
    lines = []
    for scene in comparison.scenes:
        if scene.basis in ("observations", "voxels"):
            lines.append(f"{scene.scene}: {scene.voxels:,} voxels, {BASES[scene.basis]}.")
        if scene.observations is not None:
            lines += [f"{scene.scene}: {text}." for text in left_out(scene.observations)]
        lines += [f"{scene.scene}: {note}." for note in scene.notes]
    return lines


def left_out(observations: ComparedObservations) -> Iterator[str]:
    """Yield the share of the observations that each run left out, and alpha where that counts against it."""
    for row in observations.ignored:
        if row.missing >= LEAST_LEFT_OUT:
            counted = f"alpha is {short(row.alpha, digits=3)} if the pixels that it leaves out disagree"
            yield f"{row.model} gives no label to {row.missing:.1%} of the pixels that others label; {counted}"
    if observations.depends and any(row.missing >= LEAST_LEFT_OUT for row in observations.ignored):
        yield "the order of the runs depends on the pixels that were left out"


LEAST_LEFT_OUT = 0.005
"""Least share of pixels left without a label that is reported."""


def _of_run(comparison: RunComparison, against: Against) -> Iterator[str]:
    yield _stability(comparison, against)
    if changes := _changes(against.contrasts, by_name([row for row in HEADLINES if row is not COVERAGE])):
        yield f"{against.other}: {changes}."
    yield from _coverage(comparison, against)
    classes = {
        name: [row for row in against.by_class if row.of == name]
        for name in dict.fromkeys(r.of for r in against.by_class)
    }
    notes = {name: _changes(rows, by_name(BY_CLASS)) for name, rows in classes.items()}
    if listed := [f"{name} ({text})" for name, text in notes.items() if text]:
        unlisted = len(listed) - MOST_CLASSES
        more = f" and {unlisted} more {'class' if unlisted == 1 else 'classes'}" if len(listed) > MOST_CLASSES else ""
        yield f"{against.other} by class: {', '.join(listed[:MOST_CLASSES])}{more}."


def _largest_areas(comparison: RunComparison, against: Against) -> Iterator[str]:
    """Yield the largest area of each scene, by agreement and by truth."""
    for scene in comparison.scenes:
        for what in KINDS:
            if areas := _areas_that_got_worse(scene, against, what):
                yield f"{against.other} in {scene.scene}: {_of_areas(areas, scene.crs)}."


def _number_of_areas(comparison: RunComparison, against: Against) -> Iterator[str]:
    """Yield the number of areas of all scenes in one sentence."""
    listed = []
    for scene in comparison.scenes:
        counts = [_number(areas) for what in KINDS if (areas := _areas_that_got_worse(scene, against, what))]
        if counts:
            listed.append(f"{scene.scene} ({'; '.join(counts)})")
    if listed:
        more = f" and {len(listed) - MOST_SCENES} more scenes" if len(listed) > MOST_SCENES else ""
        scenes = ", ".join(listed[:MOST_SCENES])
        yield f"{against.other} has areas that got worse in {scenes}{more}; -v shows the largest."


KINDS: tuple[Literal["agreement", "truth"], ...] = ("agreement", "truth")
"""The measures by which an area got worse."""


def _areas_that_got_worse(scene: SceneComparison, against: Against, what: str) -> list[Area]:
    of_scene = next(row for row in scene.against if row.other == against.other)
    return [area for area in of_scene.areas if area.what == what]


def _number(areas: Sequence[Area]) -> str:
    """Return '3 areas whose frames agree less'."""
    wrong = f"that {'is' if len(areas) == 1 else 'are'} wrong now"
    lost = "whose frames agree less" if areas[0].what == "agreement" else wrong
    count = f"{MOST} or more areas" if len(areas) == MOST else f"{len(areas)} area{'s' if len(areas) > 1 else ''}"
    return f"{count} {lost}"


def _flicker(comparison: RunComparison, against: Against) -> str:
    """Return the difference of flicker, the one measure of videos."""
    row = next((row for row in against.contrasts if row.measure == FLICKER.name), None)
    if row is None:
        return f"Flicker of {against.other} and {comparison.base} cannot be compared: run both on the same frames."
    change, p = row.difference, _p_value(row)
    relation = {"better": "flickers less than", "worse": "flickers more than"}.get(
        row.change, "is not shown to differ from"
    )
    return (
        f"{against.other} {relation} {comparison.base}: flicker {row.other:.2f} %"
        f" against {row.base:.2f} %, {change.value:+z.2f} ({change.low:+z.2f} to {change.high:+z.2f}){p}."
    )


def _stability(comparison: RunComparison, against: Against) -> str:
    """Return the difference of alpha, on which verdicts rest."""
    row = next((row for row in against.contrasts if row.measure == ALPHA.name), None)
    if row is None and all(scene.basis == "images" for scene in comparison.scenes):
        return _flicker(comparison, against)
    if row is None:
        return f"Alpha of {against.other} or {comparison.base} is not known: run it with more overlap between frames."
    where = f" over {len(comparison.scenes)} scenes" if len(comparison.scenes) > 1 else ""
    numbers = f"{ALPHA.word} {short(row.other, digits=3)} against {short(row.base, digits=3)}{where}"
    if row.difference.value == row.difference.low == row.difference.high == 0:
        return f"{against.other} is as stable as {comparison.base}: {numbers}, the same everywhere."
    interval, p = row.difference.text("+", digits=3), _p_value(row)
    text = {"better": "is more stable than", "worse": "is less stable than"}
    other, base = pair = against.other, comparison.base
    if silent := [run.name for run in comparison.runs if run.uninformative and run.name in pair]:
        which = f"{' and '.join(silent)} {'is' if len(silent) == 1 else 'are'} nearly one class all over"
        return f"{other} and {base} are not ranked, as {which}: {numbers}, {interval}{p}."
    if row.change:
        return f"{other} {text[row.change]} {base}: {numbers}, {interval}{p}, {_flown_again(comparison, row)}."
    why = f"; undecided: {row.difference.undecided}" if row.difference.undecided else ""
    return (
        f"Over all classes, no difference in stability between {other} and {base} is shown: {numbers},"
        f" {interval}{p}, {_flown_again(comparison, row)}{why}."
    )


def _p_value(row: Contrast) -> str:
    """Return ', p .22 (Holm)'; '' if p is not known."""
    return "" if math.isnan(row.p_holm) else f", p {without_zero(f'{row.p_holm:.2g}')} (Holm)"


def _flown_again(comparison: RunComparison, row: Contrast) -> str:
    """Return what the interval of a difference is for."""
    words = SCOPE_WORDS[row.difference.scope]
    return words.replace("this scene", "these scenes") if len(comparison.scenes) > 1 else words


LEAST_COVERAGE = 0.005
"""Least change of coverage that is reported: it is a count, so that any difference is a fact, however small."""


def _coverage(comparison: RunComparison, against: Against) -> Iterator[str]:
    for row in against.contrasts:
        change = row.difference.value
        if row.measure == COVERAGE.name and abs(change) >= LEAST_COVERAGE:
            more = "more" if change > 0 else "fewer"
            yield f"{against.other} covers {abs(change):.1%} {more} voxels than {comparison.base}."


def _changes(rows: Sequence[Contrast], quantities: Mapping[str, Quantity]) -> str:
    """Return 'worse in mIoU, recall; better in flicker'."""
    listed = {
        change: [quantities[row.measure].word for row in rows if row.change == change and row.measure in quantities]
        for change in ("worse", "better")
    }
    return "; ".join(f"{change} in {', '.join(names)}" for change, names in listed.items() if names)


def _of_areas(areas: Sequence[Area], crs: str) -> str:
    first = areas[0]
    improved_text = f"noise would improve as many; {first.improved_alike or 'none'} improved by as much as the largest"
    confused_with = f", confused with {first.confused_with}" if first.confused_with else ""
    x, y, z = first.centre
    system = f" of {crs}" if crs else ""
    frames = f"; the top contributing frames are {top_frames(first.frames)}" if first.frames else ""
    return (
        f"{_number(areas)} ({improved_text}); the largest is {first.voxels:,} voxels of"
        f" {first.of}{confused_with}, at ({x:.2f}, {y:.2f}, {z:.2f}) m{system}{frames}"
    )
