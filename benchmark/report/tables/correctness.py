"""Compare stability with accuracy by ground truth: geometry's part, correctness, quadrants."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from semstab.data.records import Result
from semstab.data.statistics import (
    CONFIDENCE,
    Correctness,
    Correlogram,
    Estimate,
    LagBin,
    Losses,
    MapStatistics,
    Quadrants,
)
from semstab.metrics import macro_mean
from semstab.report.tables.stability import settings
from semstab.report.tables.statistics import INTERVALS, Number, assessed_records, by_scene, grouped
from semstab.report.tables.table import OF_ROW, Column, Group, Row, Table
from semstab.statistics.correctness import ACCURACY, BRIER, ECE, MIOU
from semstab.statistics.correlogram import STANDARD
from semstab.statistics.intervals import LEAST_FRAMES

RIGHT = (ACCURACY, MIOU, ECE, BRIER)
"""The measures of the correctness of fused labels, in the order of the columns."""


def ceiling(result: Result) -> list[Table]:
    """Return the disagreement that the ground truth's labels also have, and the rest."""
    columns = (
        Column("disagreement", "1 - PSA", 4, "lower"),
        Column("geometry", "of geometry", 4),
        Column("model", "of the model", 4, "lower"),
        Column("geometry_percent", "of geometry (%)", 0),
    )
    numbers = (
        _lost(lambda losses: losses.total),
        _lost(lambda losses: losses.geometry),
        _lost(lambda losses: losses.model),
        _lost(lambda losses: 100 * losses.share.value),
    )
    caption = (
        "The table shows the voxels that both the predictions and the ground truth saw twice or more. The disagreement"
        " of geometry is 1 - PSA of the ground truth's labels under the same poses, depth and noise. The rest is of the"
        f" model; it is negative where the model makes the same error in all views. {INTERVALS}"
    )
    return by_scene(result, "ceiling", "Geometry or model", caption, columns, numbers)


def correctness(result: Result) -> list[Table]:
    """Return stability vs. accuracy: by stratum of OP, and the four quadrants."""
    return [*_correct_by_stratum(result), *_quadrants(result)]


def _correct_by_stratum(result: Result) -> list[Table]:
    by_model = {
        name: [stats.correctness.strata for _, stats in rows if stats.correctness is not None]
        for name, rows in assessed_records(result).items()
    }
    if not any(by_model.values()):
        return []
    columns = (
        Column("persistence", "Persistence"),
        Column("voxels", "Voxels", 0),
        *(Column.for_quantity(quantity, over=OF_ROW) for quantity in RIGHT),
    )
    groups = tuple(Group(name, _stratum_rows(strata)) for name, strata in by_model.items() if strata)
    caption = (
        f"{settings(result.select())} The table shows the voxels with a true class, for which more than half of the"
        " ground truth's evidence is. ECE is the expected calibration error of the largest belief; Brier is the Brier"
        " score, 0 to 2. They are macro means: each scene counts once. The number of voxels is that of all scenes."
    )
    return [Table("correctness", "Stability vs. accuracy, by observation persistence", caption, columns, groups)]


def _quadrants(result: Result) -> list[Table]:
    columns = (
        Column("voxels", "Voxels", 0),
        Column("consistent_right_percent", "right", 1, "higher", over="Consistent (%)"),
        Column("consistent_wrong_percent", "wrong", 1, "lower", over="Consistent (%)"),
        Column("inconsistent_right_percent", "right", 1, over="Inconsistent (%)"),
        Column("inconsistent_wrong_percent", "wrong", 1, "lower", over="Inconsistent (%)"),
        Column("wrong_of_consistent_op3_percent", "Wrong of consistent (%)", 1, "lower"),
    )
    numbers = (
        _quadrant(lambda quadrants: quadrants.voxels),
        _quadrant(lambda quadrants: quadrants.consistent_right.percent),
        _quadrant(lambda quadrants: quadrants.consistent_wrong.percent),
        _quadrant(lambda quadrants: quadrants.inconsistent_right.percent),
        _quadrant(lambda quadrants: quadrants.inconsistent_wrong.percent),
        _quadrant(lambda quadrants: quadrants.wrong_of_consistent_op3.percent),
    )
    caption = (
        "The table shows the voxels with OP>=3 and a true class. A voxel is consistent if PSA >= 0.8: one of ten frames"
        " may disagree. It is right if its dominant class is the true one. A voxel that is consistent but wrong is"
        f" dangerous: no further observation reveals the error. {INTERVALS}"
    )
    return by_scene(result, "quadrants", "Consistent and right", caption, columns, numbers)


# --- Parts ------------------------------------------------------------------------------------------------------------


def _lost(take: Callable[[Losses], float | Estimate]) -> Number:
    """Return a function that takes a number of geometry's part; NaN if geometry's part is unknown."""
    return lambda stats: math.nan if stats.geometry is None else take(stats.geometry)


def _quadrant(take: Callable[[Quadrants], float | Estimate]) -> Number:
    """Return a function that takes a number of the quadrants; NaN without ground truth."""
    return lambda stats: math.nan if stats.correctness is None else take(stats.correctness.quadrants)


def _stratum_rows(strata: Sequence[Sequence[Correctness]]) -> tuple[Row, ...]:
    return tuple(
        (name, sum(row.voxels for row in rows), *_right(rows))
        for name, rows in grouped((row for unit in strata for row in unit), lambda row: row.name).items()
    )


def _right(rows: Sequence[Correctness]) -> list[float]:
    """Return the macro mean of each of RIGHT."""
    values = [(row.accuracy, row.miou, row.ece, row.brier) for row in rows]
    return [macro_mean(column) for column in zip(*values, strict=True)]


# Agreement at a stated distance of two observations, and of the nearest and the farthest observations.


def correlogram(result: Result) -> list[Table]:
    """Return alpha where views differ by a stated angle, and for the nearest and the farthest observations."""
    low, high = STANDARD
    stated = f"{low:g} to {high:g} degrees apart"
    columns = (
        Column("standard", "alpha", 3, "higher", over=stated),
        Column("standard_pairs", "pairs", 0, over=stated),
        *(Column(f"{axis}_{end}", f"{end}", 3, over=f"By {axis}") for axis in _AXES for end in ("nearest", "farthest")),
    )
    numbers = (
        _of(lambda correlogram: correlogram.standard.alpha),
        _of(lambda correlogram: correlogram.standard.pairs or math.nan),
        *(_of(_end(axis, last)) for axis in _AXES for last in (0, -1)),
    )
    caption = (
        "The table shows alpha of pairs of views of a spot, by their distance. Models and flights are compared"
        " at a stated angle between the directions of view, not over all pairs that a flight has. Nearest and farthest"
        " are the first and the last bin with enough pairs in time (frames), angle, ratio of the ranges, and distance"
        " of the cameras. Alpha of each bin is read at the spot itself, as alpha of all pairs is. Intervals are at"
        f" {CONFIDENCE:.0%}, for this scene flown again if a bin has {LEAST_FRAMES} frames, else for these frames."
    )
    return by_scene(result, "correlogram", "Agreement by distance of the observations", caption, columns, numbers)


_AXES = ("time", "angle", "range", "baseline")


def _of(take: Callable[[Correlogram], float | Estimate]) -> Callable[[MapStatistics], float | Estimate]:
    return lambda stats: math.nan if stats.correlogram is None else take(stats.correlogram)


def _end(axis: str, last: int) -> Callable[[Correlogram], float]:
    def value(correlogram: Correlogram) -> float:
        bins: Sequence[LagBin] = getattr(correlogram, axis)
        return bins[last].alpha.value if len(bins) > 1 else math.nan

    return value
