"""The tables of a comparison."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from semstab.comparison.quantities import BY_CLASS, COVERAGE, HEADLINES, IOU, RECALL, by_name
from semstab.data.contrast import Against, Area, ComparedObservations, Contrast, FrameShare, MapCoverage, RunComparison
from semstab.data.measures import Quantity
from semstab.data.statistics import CONFIDENCE, Interval
from semstab.report.tables.table import Column, Group, Row, Table
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
    return f"{quantity.full_title}{unit}"


def _by_class(comparison: RunComparison) -> Table:
    measured = {row.measure for _, against in scopes(comparison) for row in against.by_class}
    quantities = [quantity for quantity in IN_CLASSES if quantity.name in measured]
    columns = (Column("class", "Class"), *(Column(q.name, q.full_title, 3, q.better, signed=True) for q in quantities))
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
        Column("confused_with", "Confused with"), Column("voxels", "Voxels", 0), Column("loss", "Loss", 3),
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
