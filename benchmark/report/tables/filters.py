"""Compare filters over a model: stability, correctness, delay, coverage and cost."""

from __future__ import annotations

from semstab.data.records import Result
from semstab.report.filter_study import FilterResult, FilterStudy, filter_studies
from semstab.report.tables.table import Column, Group, Row, Table

COLUMNS = (
    Column("filter", "Filter"),
    Column("changed_percent", "Changed (%)", 2),
    Column("flicker_percent", "Flicker (%)", 2, "lower", over="Stability"),
    Column("alpha", "alpha", 3, over="Stability"),
    Column("next_frame_percent", "Next frame (%)", 2, "higher", over="Correctness"),
    Column("accuracy_percent", "Accuracy (%)", 2, "higher", over="Correctness"),
    Column("miou_percent", "mIoU (%)", 2, "higher", over="Correctness"),
    Column("consistent_wrong_percent", "Consistent, wrong (%)", 2, "lower", over="Correctness"),
    Column("lag_frames", "Lag (frames)", 2, "lower", over="Price"),
    Column("coverage_percent", "Coverage (%)", 1, over="Price"),
    Column("milliseconds", "ms", 1, "lower", over="Price"),
    Column("advice", "Advice"),
)
CAPTION = (
    "Changed is the share of the model's labels to which the filter gives another class, or none. Flicker is the share"
    " of pixels seen in two frames in a row whose label changes, camera motion removed. Alpha is"
    " the agreement of two views at the same spot. It rises with any memory of earlier frames, because frames that"
    " share a memory are not independent: a high alpha of a filter with memory is no evidence. Next frame is the share"
    " of pixels seen in the next frame that have the label that the unfiltered model gives them there; no filter has"
    " seen that frame, so a repeated label does not count. Accuracy and mean IoU are of the labelled pixels of single"
    " frames. Consistent, wrong is the share of pixels seen again that keep a wrong label. Lag is the number of frames"
    " by which labels follow a true change later than the model (at most 8). Coverage is the number of labelled pixels"
    " for each labelled pixel of the model. ms is the CPU time per frame. Worse: less flicker, at the pixel or the"
    " location, and labels that are right less often. All numbers are means over scenes."
)


def filter_tables(result: Result) -> list[Table]:
    """Return one table of all models whose filters were assessed."""
    studies = filter_studies(result)
    if not studies:
        return []
    groups = tuple(
        Group(study.model, tuple(row(study, filtered) for filtered in (study.unfiltered, *study.filtered)))
        for study in studies
    )
    best = [
        f"{study.best.filters} over {study.model}" if study.best else f"none over {study.model}" for study in studies
    ]
    return [
        Table(
            "filters",
            "Filters that make labels more stable",
            f"{CAPTION} Recommended: {', '.join(best)}.",
            COLUMNS,
            groups,
            "model",
        )
    ]


def row(study: FilterStudy, result: FilterResult) -> Row:
    """Return the cells of a filter."""
    return (
        result.filters or "none",
        100 * result.changed,
        100 * result.flicker,
        result.alpha,
        100 * result.next_frame,
        100 * result.accuracy,
        100 * result.miou,
        100 * result.consistent_wrong,
        result.lag,
        100 * result.coverage,
        result.milliseconds,
        "use" if result == study.best else "worse" if result in study.misleading else "",
    )
