"""The backbones beside each other, on the same places and at the same number of observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from semstab.model.records import Result
from semstab.model.statistics.comparison import BackboneComparison, CommonLooks, MapCoverage
from semstab.outputs.tables.statistics import INTERVALS
from semstab.outputs.tables.table import Column, Group, Row, Table
from semstab.statistics.versus.comparison import compared

_COMMON = "On the voxels that every backbone saw twice or more, and on looks (a place in a frame) that all labelled."


def comparison(result: Result) -> list[Table]:
    """Paired differences, ranking, and what each map covers; one group a scene."""
    if not result.comparisons:
        return []
    covered = coverage_table({found.scene: found.coverage for found in result.comparisons})
    looks = {found.scene: found.looks for found in result.comparisons if found.looks is not None}
    return [_differences(result), _ranking(result), covered, *([ignored_table(looks)] if looks else [])]


def _differences(result: Result) -> Table:
    columns = (
        Column("a", "Backbone"),
        Column("b", "less backbone"),
        Column("measure", "Measure"),
        Column("difference", "Difference", 4, signed=True),
        Column("p_holm", "p (Holm)", 4),
        Column("answers", "interval answers"),
    )
    caption = (
        f"{_COMMON} Only the first measure is tested, its p corrected by Holm's method for all pairs of all scenes of"
        f" which something may be claimed; the others describe. {INTERVALS}"
    )
    groups = tuple(Group(found.scene, _difference_rows(found)) for found in result.comparisons)
    return Table("comparison", "Differences on the same places", caption, columns, groups, "scene")


def _difference_rows(found: BackboneComparison) -> tuple[Row, ...]:
    words = {quantity.key: quantity.word for quantity in compared(truth=True)}
    rows = sorted(found.paired.differences, key=lambda row: row.measure != found.paired.primary)
    return tuple(
        (row.a, row.b, words[row.measure], row.difference, row.p_holm, row.undecided or row.question) for row in rows
    )


def _ranking(result: Result) -> Table:
    columns = (
        Column("measure", "Measure"),
        Column("rank", "Rank", 0),
        Column("backbone", "Backbone"),
        Column("range", "95% of resamples"),
        Column("best_percent", "first in (%)", 0),
        Column("value", "Same looks", 4),
        Column("standardised", "Same OP", 4),
    )
    caption = (
        f"Same looks: {_COMMON[0].lower()}{_COMMON[1:]} Same OP: each map with all its voxels seen twice or more, its"
        f" strata of OP weighted by those of all maps together. {INTERVALS}"
    )
    groups = tuple(Group(found.scene, _ranking_rows(found)) for found in result.comparisons)
    return Table("comparison_ranking", "Order of the backbones", caption, columns, groups, "scene")


def _ranking_rows(found: BackboneComparison) -> tuple[Row, ...]:
    quantities = {quantity.key: quantity for quantity in compared(truth=True)}
    return tuple(
        (
            quantities[ranking.measure].word,
            rank.rank,
            rank.backbone,
            f"{rank.low} to {rank.high}",
            100 * rank.best,
            found.paired.of(quantities[ranking.measure])[rank.backbone],
            found.standardised.of(quantities[ranking.measure], rank.backbone),
        )
        for ranking in found.paired.rankings
        for rank in ranking.ranks
    )


def ignored_table(looks: Mapping[str, CommonLooks]) -> Table:
    """What each backbone left out, by scene."""
    columns = (
        Column("backbone", "Backbone"),
        Column("missing_percent", "left out (%)", 1),
        Column("psa_low", "at least", 3, over="PSA with these"),
        Column("psa_high", "at most", 3, over="PSA with these"),
        Column("alpha_ignored", "Alpha, leaving out as a class", 3),
        Column("order", "Order depends on it"),
    )
    caption = (
        "Of the looks that any backbone labelled, what each left out, in pixels; PSA had these agreed never, or always"
        " (Manski); alpha between frames where to leave a place out is a class of its own. The order depends on it"
        " where that alpha, or PSA within its bounds, would order the backbones otherwise."
    )
    groups = tuple(Group(scene, _ignored_rows(found)) for scene, found in looks.items())
    return Table("comparison_ignored", "What was left out", caption, columns, groups, "scene")


def _ignored_rows(found: CommonLooks) -> tuple[Row, ...]:
    depends = "yes" if found.depends else "no"
    return tuple(
        (row.backbone, 100 * row.missing, row.psa_low, row.psa_high, row.alpha, depends) for row in found.ignored
    )


def coverage_table(covered: Mapping[str, Sequence[MapCoverage]]) -> Table:
    """What each map covers, by scene."""
    columns = (
        Column("backbone", "Backbone"),
        Column("voxels", "Voxels", 0),
        Column("mean_op", "Mean OP", 2),
        Column("repeated", "OP>=2", 0),
        Column("recurrent", "OP>=3", 0),
        Column("common_percent", "in all maps (%)", 1),
        Column("alone", "in no other", 0),
    )
    caption = "A backbone that ignores hard pixels covers less, and is compared on easier places."
    groups = tuple(Group(scene, tuple(map(_coverage_row, found))) for scene, found in covered.items())
    return Table("comparison_coverage", "What each map covers", caption, columns, groups, "scene")


def _coverage_row(row: MapCoverage) -> Row:
    return (
        row.backbone,
        row.voxels,
        row.mean_op,
        row.repeated,
        row.recurrent,
        100 * row.common_share,
        row.alone,
    )
