"""Filters over a model beside each other: how stable, how right, how late, what is left, what it costs."""

from __future__ import annotations

from semstab.data.records import Result
from semstab.report.filter_study import FilterResult, FilterStudy, filter_studies
from semstab.report.tables.table import Column, Group, Row, Table

COLUMNS = (
    Column("filter", "Filter"),
    Column("flicker_percent", "Flicker (%)", 2, "lower", over="Steady?"),
    Column("alpha", "alpha", 3, over="Steady?"),
    Column("next_frame_percent", "Next frame (%)", 2, "higher", over="Right?"),
    Column("accuracy_percent", "Accuracy (%)", 2, "higher", over="Right?"),
    Column("miou_percent", "mIoU (%)", 2, "higher", over="Right?"),
    Column("consistent_wrong_percent", "Consistent, wrong (%)", 2, "lower", over="Right?"),
    Column("lag_frames", "Lag (frames)", 2, "lower", over="Price"),
    Column("coverage_percent", "Coverage (%)", 1, over="Price"),
    Column("milliseconds", "ms", 1, "lower", over="Price"),
)
CAPTION = (
    "Flicker: of the places that two frames in a row see, those whose label changes (camera motion taken out). Alpha:"
    " agreement of two views at the same spot; it rises with any memory of frames before, as frames that share one"
    " are no longer independent: of a filter that remembers a high alpha says nothing. Next frame: of the places that"
    " the next frame sees, those whose label the unfiltered model gives them there; no filter has seen that frame, so"
    " what it merely repeats does not count. Accuracy and mean IoU: of the labelled pixels of single frames. Stable,"
    " wrong: of the places seen again, those that keep a label that is wrong. Lag: frames by which labels follow a true"
    " change of what is seen later than the model (at most 8). Coverage: labelled pixels for one of the model's. ms:"
    " CPU time a frame. Means over scenes."
)


def filter_tables(result: Result) -> list[Table]:
    """Return one table of all models, where filters were judged."""
    studies = filter_studies(result)
    if not studies:
        return []
    groups = tuple(Group(each.model, tuple(map(row, [each.unfiltered, *each.filtered]))) for each in studies)
    best = [f"{each.best.filters} over {each.model}" if each.best else f"none over {each.model}" for each in studies]
    return [
        Table(
            "filters",
            "Which filter makes the labels more stable",
            f"{CAPTION} To use: {', '.join(best)}.",
            COLUMNS,
            groups,
            "model",
        )
    ]


def row(result: FilterResult) -> Row:
    """Return its cells."""
    return (
        result.filters or "none",
        100 * result.flicker,
        result.alpha,
        100 * result.next_frame,
        100 * result.accuracy,
        100 * result.miou,
        100 * result.consistent_wrong,
        result.lag,
        100 * result.coverage,
        result.milliseconds,
    )


def marked(study: FilterStudy, result: FilterResult) -> str:
    """Return '*' for the one to use, '!' for one that is steadier and worse."""
    return "*" if result == study.best else "!" if result in study.misleading else ""
