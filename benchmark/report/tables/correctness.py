"""Compare stability with accuracy by ground truth: geometry's part, correctness, quadrants."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from semstab.data.contrast import ComparedObservations, MapCoverage, ModelComparison
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
from semstab.report.tables.table import Column, Group, Row, Table
from semstab.statistics.correctness import ACCURACY, BRIER, ECE, MIOU
from semstab.statistics.correlogram import STANDARD
from semstab.statistics.intervals import LEAST_FRAMES
from semstab.statistics.model_comparison import compared

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
        *map(Column.of, RIGHT),
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
        Column("wrong_of_consistent_percent", "Wrong of consistent (%)", 1, "lower"),
    )
    numbers = (
        _quadrant(lambda quadrants: quadrants.voxels),
        _quadrant(lambda quadrants: quadrants.consistent_right.percent),
        _quadrant(lambda quadrants: quadrants.consistent_wrong.percent),
        _quadrant(lambda quadrants: quadrants.inconsistent_right.percent),
        _quadrant(lambda quadrants: quadrants.inconsistent_wrong.percent),
        _quadrant(lambda quadrants: quadrants.wrong_of_consistent.percent),
    )
    caption = (
        "The table shows the voxels with OP>=3 and a true class. A voxel is consistent if PSA >= 0.8: one of ten frames"
        " may disagree. It is right if its dominant class is the true one. A voxel that is consistent but wrong is"
        f" dangerous: no further observation reveals the error. {INTERVALS}"
    )
    return by_scene(result, "quadrants", "Consistent and right", caption, columns, numbers)


# --- Parts ------------------------------------------------------------------------------------------------------------


def _lost(take: Callable[[Losses], float | Estimate]) -> Number:
    """Return a function that takes a number of geometry's part; NaN where that is not known."""
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


# The models side by side, on the same locations and at the same number of observations.

THIN = 0.1
"""The share of the weight in strata that hardly overlap from which on the table reports it."""

_COMMON = (
    "Alpha is of the answers (a spot in a view) to which all models gave a label, the rest of the voxels that all saw"
    " twice or more."
)


def comparison(result: Result) -> list[Table]:
    """Return paired differences, ranking, and what each map covers; one group a scene."""
    if not result.comparisons:
        return []
    covered = coverage_table({comparison.scene: comparison.coverage for comparison in result.comparisons})
    shared = {
        comparison.scene: comparison.observations
        for comparison in result.comparisons
        if comparison.observations is not None
    }
    return [_differences(result), _ranking(result), covered, *([ignored_table(shared)] if shared else [])]


def _differences(result: Result) -> Table:
    columns = (
        Column("a", "Model"),
        Column("b", "less model"),
        Column("measure", "Measure"),
        Column("difference", "Difference", 4, signed=True),
        Column("p_holm", "p (Holm)", 4),
        Column("answers", "interval is for"),
    )
    caption = (
        f"{_COMMON} Only the first measure is tested. Its p is corrected by Holm's method for all pairs of all scenes"
        f" that allow a claim; the other measures describe. {INTERVALS}"
    )
    groups = tuple(Group(comparison.scene, _difference_rows(comparison)) for comparison in result.comparisons)
    return Table("comparison", "Differences on the same locations", caption, columns, groups, "scene")


def _difference_rows(comparison: ModelComparison) -> tuple[Row, ...]:
    words = {quantity.key: quantity.word for quantity in compared(truth=True)}
    rows = sorted(comparison.paired.differences, key=lambda row: row.measure != comparison.paired.primary)
    return tuple(
        (row.a, row.b, words.get(row.measure, row.measure), row.difference, row.p_holm, row.undecided or row.scope)
        for row in rows
    )


def _ranking(result: Result) -> Table:
    columns = (
        Column("measure", "Measure"),
        Column("rank", "Rank", 0),
        Column("model", "Model"),
        Column("range", f"{CONFIDENCE:.0%} of resamples"),
        Column("best_percent", "first in (%)", 0),
        Column("value", "In common", 4),
        Column("standardised", "Same OP", 4),
    )
    caption = (
        f"The column 'In common' is of shared data. {_COMMON} The column 'Same OP' is of all voxels of each map that"
        f" were seen twice or more, with its strata of OP weighted as in all maps together. {INTERVALS}"
    )
    thin = max(comparison.standardised.thin for comparison in result.comparisons)
    if thin > THIN:
        caption += f" {thin:.0%} of the weight is in strata of OP that hardly overlap."
    groups = tuple(Group(comparison.scene, _ranking_rows(comparison)) for comparison in result.comparisons)
    return Table("comparison_ranking", "Order of the models", caption, columns, groups, "scene")


def _ranking_rows(comparison: ModelComparison) -> tuple[Row, ...]:
    quantities = {quantity.key: quantity for quantity in compared(truth=True)}
    return tuple(
        (
            quantities[ranking.measure].word,
            rank.rank,
            rank.model,
            f"{rank.low} to {rank.high}",
            100 * rank.best,
            comparison.paired.of(quantities[ranking.measure])[rank.model],
            comparison.standardised.of(quantities[ranking.measure], rank.model),
        )
        for ranking in comparison.paired.rankings
        for rank in ranking.ranks
    )


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
