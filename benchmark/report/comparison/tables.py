"""The tables of a comparison."""

from __future__ import annotations

import dataclasses
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from semstab.comparison.locations import MOST
from semstab.comparison.quantities import BY_CLASS, COVERAGE, FLICKER, HEADLINES, IOU, RECALL, by_name
from semstab.core.console import Console
from semstab.core.types import SCOPE_WORDS
from semstab.data.contrast import (
    Against,
    Area,
    Basis,
    ComparedObservations,
    Contrast,
    FrameShare,
    MapCoverage,
    RunComparison,
)
from semstab.data.measures import Quantity
from semstab.data.statistics import CONFIDENCE, Interval
from semstab.report.tables.table import Column, Group, Row, Table, to_terminal
from semstab.report.terminal import WIDTH
from semstab.statistics.agreement import ALPHA, PSA
from semstab.statistics.intervals import LEAST_FRAMES

ALL_SCENES = "all scenes"
NAMED_FRAMES = 5

IN_CLASSES = (ALPHA, PSA, RECALL, IOU)
"""Measures that the table of classes shows side by side."""

ANSWERS = (
    f"Brackets hold {CONFIDENCE:.0%} intervals, for this scene flown again if it has {LEAST_FRAMES} frames or more,"
    " else for these frames, that is, for other locations in the same frames. p (Holm) is the p-value of no difference."
    " For alpha it is corrected for the number of runs, for all other measures for their number in the scene or over"
    " all scenes."
)


def tables(comparison: RunComparison) -> list[Table]:
    """Return all tables that have rows."""
    covered = {scene.scene: scene.coverage for scene in comparison.scenes if scene.coverage}
    observations = {scene.scene: scene.observations for scene in comparison.scenes if scene.observations is not None}
    made = [_differences(comparison), _by_class(comparison), _areas(comparison), _frames(comparison)]
    made += [coverage_table(covered), ignored_table(observations)]
    return [table for table in made if any(group.rows for group in table.groups)] + [everything(comparison)]


def scopes(comparison: RunComparison) -> Iterator[tuple[str, Against]]:
    """Yield each run against the base: over all scenes if the runs have several, then scene by scene."""
    if len(comparison.scenes) > 1:
        yield from ((ALL_SCENES, against) for against in comparison.overall)
    for scene in comparison.scenes:
        yield from ((scene.scene, against) for against in scene.against)


def heading(comparison: RunComparison, scope: str, against: Against) -> str:
    """Return the heading of a run's differences."""
    return f"{scope}: {against.other} minus {comparison.base}"


def scope(row: Contrast) -> str:
    """Return the scope of a difference, or why it claims nothing, in a word or two."""
    return "undecided" if row.difference.undecided else row.difference.scope


# --- Parts ------------------------------------------------------------------------------------------------------------


def _differences(comparison: RunComparison) -> Table:
    columns = (
        Column("measure", "Measure"), Column("base", comparison.base, 4), Column("other", _others(comparison), 4),
        Column("difference", "Difference", 4, signed=True), Column("p_holm", "p (Holm)", 4),
        Column("answers", "Answers for"), Column("change", "Change"),
    )  # fmt: skip
    groups = tuple(
        Group(heading(comparison, scope, against), _rows(against, HEADLINES)) for scope, against in scopes(comparison)
    )
    macro = " Over all scenes each scene with an interval counts once." if len(comparison.scenes) > 1 else ""
    caption = (
        "Alpha counts the observations that all runs made. Flicker is measured in each run's images. All other"
        " measures are means over the voxels that all runs saw twice or more. Coverage is the number of voxels that a"
        " run saw twice or more, divided by the number of the base. A difference is undecided if the frames are too"
        " few, or if errors reach as far as the scene."
        f" {ANSWERS}{macro}"
    )
    return Table("comparison", "Differences", caption, columns, groups, "scope")


def _others(comparison: RunComparison) -> str:
    """Return the heading of the numbers that are compared with the base's: the name of the other run, or 'Other'."""
    return comparison.runs[1].name if len(comparison.runs) == 2 else "Other"


def _rows(against: Against, quantities: Sequence[Quantity]) -> tuple[Row, ...]:
    keys = by_name(quantities)
    return tuple(
        (_titled(keys[row.measure]), row.base, row.other, row.difference, row.p_holm, scope(row), _change(row))
        for row in against.contrasts
        if row.measure in keys
    )


def _change(row: Contrast) -> str:
    """Return 'better' or 'worse'; for coverage, which is neither, 'more' or 'fewer'."""
    return COUNTED.get(row.change, "") if row.measure == COVERAGE.name else row.change


COUNTED = {"better": "more", "worse": "fewer"}


def _titled(quantity: Quantity) -> str:
    unit = f", {quantity.unit}" if quantity.unit else ""
    return f"{quantity.named}{unit}"


def _by_class(comparison: RunComparison) -> Table:
    measured = {row.measure for _, against in scopes(comparison) for row in against.by_class}
    quantities = [quantity for quantity in IN_CLASSES if quantity.name in measured]
    columns = (Column("class", "Class"), *(Column(q.name, q.named, 3, q.better, signed=True) for q in quantities))
    worse = Column("worse", "Worse"), Column("better", "Better")
    groups = tuple(
        Group(heading(comparison, scope, against), _class_rows(against, quantities))
        for scope, against in scopes(comparison)
    )
    caption = (
        "The measures are alpha of the class against all others, PSA of its locations (by the ground truth, or else by"
        " all runs together), recall and IoU. Worse and better list the measures that differ when the p-values are"
        f" corrected for all measures and classes. {ANSWERS}"
    )
    return Table("comparison_classes", "By class", caption, (columns[0], *worse, *columns[1:]), groups, "scope")


def _class_rows(against: Against, quantities: Sequence[Quantity]) -> tuple[Row, ...]:
    words = by_name(BY_CLASS)
    rows = []
    for name in dict.fromkeys(row.of for row in against.by_class):
        by_measure = {row.measure: row for row in against.by_class if row.of == name}
        cells = [by_measure[q.name].difference if q.name in by_measure else math.nan for q in quantities]
        changed = {
            change: ", ".join(
                words[row.measure].symbol if row.measure in words else row.measure
                for row in by_measure.values()
                if row.change == change
            )
            for change in ("worse", "better")
        }
        rows.append((name, changed["worse"], changed["better"], *cells))
    return tuple(rows)


def _areas(comparison: RunComparison) -> Table:
    columns = (
        Column("number", "Area", 0), Column("what", "Lost"), Column("class", "Class"),
        Column("confused_with", "Confused with"), Column("voxels", "Voxels", 0), Column("loss", "Loss", 2),
        *(Column(axis, axis, 2, over="Centre (m)") for axis in "xyz"), Column("size", "Size (m)", 2),
        Column("improved_alike", "Improved as much", 0), Column("frames", "Top contributing frames"),
    )  # fmt: skip
    groups = tuple(
        Group(heading(comparison, scene.scene, against), tuple(_area_row(area) for area in against.areas))
        for scene in comparison.scenes
        for against in scene.against
    )
    caption = (
        "An area is neighbouring voxels of one class that got worse: by agreement, they lost a fifth or more of the"
        " agreement between frames; by truth, they were right in the base and are wrong now. Loss is the mean loss."
        " 'Confused with' is the class that these frames show instead. 'Improved as much' counts the areas that"
        " improved by as much; if nothing changed, they are as many. Top contributing frames are those whose"
        " observations turned away from the class, with their share."
    )
    systems = {scene.crs for scene in comparison.scenes if scene.crs}
    caption += f" Centres are in {' and '.join(sorted(systems)) if systems else 'the coordinates of the scene'}."
    return Table("comparison_areas", "Areas that got worse", caption, columns, groups, "scope")


def _area_row(area: Area) -> Row:
    return (
        area.number, area.what, area.of, area.confused_with, area.voxels, area.loss, *area.centre, area.size,
        area.improved_alike, top_frames(area.frames),
    )  # fmt: skip


def top_frames(frames: Sequence[FrameShare]) -> str:
    """Return '13 (30%), 4 (26%) and 7 more'."""
    listed = ", ".join(f"{frame.name or frame.frame} ({frame.share:.0%})" for frame in frames[:NAMED_FRAMES])
    return listed + (f" and {len(frames) - NAMED_FRAMES} more" if len(frames) > NAMED_FRAMES else "")


def _frames(comparison: RunComparison) -> Table:
    columns = (Column("frame", "Frame"), Column("share_percent", "Share of what was lost (%)", 1))
    groups = tuple(
        Group(
            heading(comparison, scene.scene, against),
            tuple((frame.name or str(frame.frame), 100 * frame.share) for frame in against.top_frames),
        )
        for scene in comparison.scenes
        for against in scene.against
    )
    caption = "The shares are of all areas together whose frames agree less."
    return Table("comparison_frames", "Top contributing frames", caption, columns, groups, "scope")


def everything(comparison: RunComparison) -> Table:
    """Return all contrasts, one per row."""
    columns = (
        Column("run", "Run"), Column("class", "Class"), Column("measure", "Measure"), Column("base", "Base", 6),
        Column("other", _others(comparison), 6), Column("difference", "Difference", 6, signed=True),
        Column("holds_for", "Holds for"), Column("p", "p", 6), Column("p_holm", "p (Holm)", 6),
        Column("change", "Change"), Column("undecided", "Undecided"),
    )  # fmt: skip
    groups = tuple(Group(scope, tuple(_all_rows(against))) for scope, against in scopes(comparison))
    return Table("comparison_all", "All comparisons", ANSWERS, columns, groups, "scope")


def _all_rows(against: Against) -> Iterator[Row]:
    for row in (*against.contrasts, *against.by_class):
        change: Interval = row.difference
        yield (
            against.other, row.of, row.measure, row.base, row.other, change.ends, change.scope, change.p_value,
            row.p_holm, row.change, change.undecided,
        )  # fmt: skip


def ignored_table(observations: Mapping[str, ComparedObservations]) -> Table:
    """Return the share of pixels that each model left out, by scene."""
    columns = (
        Column("model", "Model"),
        Column("missing_percent", "left out (%)", 1),
        Column("psa_low", "at least", 3, over="Agreement with these"),
        Column("psa_high", "at most", 3, over="Agreement with these"),
        Column("alpha_ignored", "Alpha, left out disagrees", 3),
        Column("order", "Order depends on it"),
    )
    caption = (
        "A pixel is left out if a model gives it no label where another model gives one. The agreement of two views in"
        " a spot has two bounds: these pixels agree never, or always (Manski). For alpha, pixels that are left out"
        " disagree. The order depends on them if that alpha, or the agreement within its bounds, would change"
        " the order of the models."
    )
    groups = tuple(Group(scene, _ignored_rows(comparison)) for scene, comparison in observations.items())
    return Table("comparison_ignored", "Pixels that were left out", caption, columns, groups, "scene")


def _ignored_rows(observations: ComparedObservations) -> tuple[Row, ...]:
    depends = "yes" if observations.depends else "no"
    return tuple(
        (row.model, 100 * row.missing, row.psa_low, row.psa_high, row.alpha, depends) for row in observations.ignored
    )


def coverage_table(covered: Mapping[str, Sequence[MapCoverage]]) -> Table:
    """Return the coverage of each map, by scene."""
    columns = (
        Column("model", "Model"),
        Column("voxels", "Voxels", 0),
        Column("mean_op", "Mean OP", 2),
        Column("repeated", "OP>=2", 0),
        Column("recurrent", "OP>=3", 0),
        Column("common_percent", "in all maps (%)", 1),
        Column("alone", "in no other", 0),
    )
    caption = "A model that ignores hard pixels covers less, and is compared on easier locations."
    groups = tuple(Group(scene, tuple(map(_coverage_row, maps))) for scene, maps in covered.items())
    return Table("comparison_coverage", "Coverage of each map", caption, columns, groups, "scene")


def _coverage_row(row: MapCoverage) -> Row:
    return (
        row.model,
        row.voxels,
        row.mean_op,
        row.repeated,
        row.recurrent,
        100 * row.common_share,
        row.alone,
    )


# The results of a comparison in sentences, for the terminal, Markdown and the top of the report.

MOST_CLASSES = 4
"""Most classes that a sentence names."""

BASES: dict[Basis, str] = {
    "observations": "paired; alpha counts the views of a spot that all runs label",
    "voxels": "paired on the voxels that all runs saw twice or more",
    "cubes": "paired on cubes of space",
    "flights": "not paired",
    "images": "paired on frames",
}


def sentences(comparison: RunComparison) -> list[str]:
    """Return the results of one run after the other, then notes on data that could not be compared."""
    return [*answers(comparison), *(f"caution: {text}." for text in comparison.cautions), *notes(comparison)]


def answers(comparison: RunComparison) -> list[str]:
    """Return the differences, run by run."""
    return [sentence for against in comparison.overall for sentence in _of_run(comparison, against)]


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
            counted = f"alpha is {row.alpha:.3f} if the pixels that it leaves out disagree"
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
    for scene in comparison.scenes:
        of_scene = next(row for row in scene.against if row.other == against.other)
        for what in ("agreement", "truth"):
            if areas := [area for area in of_scene.areas if area.what == what]:
                yield f"{against.other} in {scene.scene}: {_of_areas(areas, scene.crs)}."


def _flicker(comparison: RunComparison, against: Against) -> str:
    """Return the difference of flicker, the one measure of videos."""
    row = next((row for row in against.contrasts if row.measure == FLICKER.name), None)
    if row is None:
        return f"Flicker of {against.other} and {comparison.base} cannot be compared: run both on the same frames."
    change, p = row.difference, "" if math.isnan(row.p_holm) else f", p {row.p_holm:.2g} (Holm)"
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
    numbers = f"{ALPHA.word} {row.other:.3f} against {row.base:.3f}{where}"
    if row.difference.value == row.difference.low == row.difference.high == 0:
        return f"{against.other} is as stable as {comparison.base}: {numbers}, the same everywhere."
    interval = f"{row.difference.value:+z.3f} ({row.difference.low:+z.3f} to {row.difference.high:+z.3f})"
    p = "" if math.isnan(row.p_holm) else f", p {row.p_holm:.2g} (Holm)"
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
    lost = "whose frames agree less" if first.what == "agreement" else "that are wrong now"
    count = f"{MOST} or more areas" if len(areas) == MOST else f"{len(areas)} area{'s' if len(areas) > 1 else ''}"
    improved_text = f"noise would improve as many; {first.improved_alike or 'none'} improved by as much as the largest"
    confused_with = f", confused with {first.confused_with}" if first.confused_with else ""
    x, y, z = first.centre
    system = f" of {crs}" if crs else ""
    frames = f"; the top contributing frames are {top_frames(first.frames)}" if first.frames else ""
    return (
        f"{count} {lost} ({improved_text}); the largest is {first.voxels:,} voxels of"
        f" {first.of}{confused_with}, at ({x:.2f}, {y:.2f}, {z:.2f}) m{system}{frames}"
    )


# --- In a terminal of 80 columns --------------------------------------------------------------------------------------

SHOWN = {
    "comparison": ("measure", "base", "other", "difference", "p_holm", "change"),
    "comparison_classes": ("class", "worse", "better", ALPHA.name),
    "comparison_areas": ("class", "confused_with", "voxels", "loss", "x", "y", "z"),
}
"""The columns of each table that fit; files have all of them."""

LEGEND = (
    "PSA: share of the pairs of frames that give a voxel one class; SBD excess: SBD minus SBD in random order; ECE:"
    " belief against accuracy; consistent but wrong: share of the voxels whose frames agree on a wrong class; voxel"
    " alpha: alpha of a voxel's frames; coverage: voxels, of the base's; p (Holm): corrected for all measures"
)
"""The meaning of the measures that the screen of a run does not explain."""

LONGEST_NAME = 8
"""The longest names of runs over the columns of their numbers."""


def print_comparison(
    comparison: RunComparison, console: Console, *, verbose: bool = False, out: Path | None = None
) -> None:
    """Print the answer in sentences, the differences and the notes; verbose: also classes and areas.

    `out` is the folder that they were written to.
    """
    for sentence in (*answers(comparison), *(f"caution: {text}." for text in comparison.cautions)):
        console.print(sentence, highlight=False, markup=False)
    for table in tables(comparison):
        if table.name == "comparison" or (verbose and table.name in SHOWN):
            fitting = _fitting(table.only(*SHOWN[table.name]), comparison)
            text = to_terminal(dataclasses.replace(fitting, caption=""), WIDTH)
            console.print(f"\n{text}", highlight=False, markup=False, soft_wrap=True)
        if table.name == "comparison":
            legend = textwrap.wrap(f"  {LEGEND}", WIDTH, subsequent_indent="    ", break_on_hyphens=False)
            console.print("\n".join([*legend, ""]), highlight=False, markup=False)
    for sentence in notes(comparison):
        wrapped = textwrap.wrap(f"  {sentence}", console.width, subsequent_indent="    ")
        console.print("\n".join(wrapped), highlight=False, markup=False)
    more = [*([] if verbose else ["-v: classes and areas"]), *([] if out else ["--out DIR: report.html, tables, maps"])]
    if more:
        console.print(f"  more     {'; '.join(more)}", highlight=False)


def _fitting(table: Table, comparison: RunComparison) -> Table:
    """Return a table with scenes as groups if the base is compared with one run, and with long names in the title."""
    if len(comparison.runs) == 2:
        pair = heading(comparison, "", comparison.overall[0])
        groups = (dataclasses.replace(group, name=group.name.removesuffix(pair)) for group in table.groups)
        table = dataclasses.replace(table, groups=tuple(groups))
    heads = {column.key: column.header for column in table.columns if column.key in ("base", "other")}
    if max(map(len, heads.values()), default=0) <= LONGEST_NAME:
        return table
    short = {"base": "Base", "other": "Other"}
    columns = (dataclasses.replace(column, header=short.get(column.key, column.header)) for column in table.columns)
    other = f", other: {heads['other']}" if heads["other"] != short["other"] else ""
    return dataclasses.replace(table, title=f"{table.title} (base: {comparison.base}{other})", columns=tuple(columns))
