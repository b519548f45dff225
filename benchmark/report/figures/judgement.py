"""Which figures of the statistics there are: what a study's records have them for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial, reduce
from operator import add
from typing import TYPE_CHECKING

from semstab.model.records import Record, Result
from semstab.model.results import Unit, slug
from semstab.model.statistics import Correlogram, Estimate, MapStatistics, Reliability
from semstab.report.averages import by_backbone, levels, swept
from semstab.report.figures.maps import Views, draw_uncertainty, kept_of, right_or_wrong
from semstab.report.figures.statistics import (
    DriftByOP,
    Rows,
    draw_agreement,
    draw_correlogram,
    draw_drift,
    draw_intervals,
    draw_reliability,
)
from semstab.report.figures.style import Figure
from semstab.statistics.agreement import ALPHA, PSA
from semstab.statistics.intervals import LEAST_FRAMES
from semstab.statistics.model_comparison import compared
from semstab.statistics.verdict import LIMITS

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


Judged = Sequence[tuple[Unit, MapStatistics]]


def statistics_figures(result: Result, kept: Sequence[Record], views: Views) -> list[Figure]:
    """Every one for which the study has records; `kept` are the base ones whose voxels were kept."""
    judged = [(record.unit, record.statistics) for record in result.select() if record.statistics is not None]
    return [
        *_agreement(judged),
        *_correlograms(judged),
        *_drift([record for record in kept if record.statistics is not None], views),
        *_reliability(judged),
        *_comparison(result),
        *_maps(result, kept, views),
        *_sweeps(result),
    ]


def _agreement(judged: Judged) -> Iterator[Figure]:
    if judged:
        yield Figure(
            "temporal_agreement",
            "Agreement of the frames, with intervals",
            "Pairwise agreement (PSA) and Krippendorff's alpha of the voxels seen twice or more, with intervals at"
            " 95% for these frames. Dotted: alpha from which conclusions are tentative (0.667),"
            " and from which data are reliable (0.8).",
            "Two panels with one interval a scene and backbone: pairwise agreement and Krippendorff's alpha.",
            lambda: draw_intervals(
                {
                    PSA.word: _estimates(judged, lambda found: found.agreement.psa),
                    ALPHA.word: _estimates(judged, lambda found: found.agreement.alpha),
                },
                {ALPHA.word: (LIMITS.usable, LIMITS.stable)},
            ),
        )


def _correlograms(judged: Judged) -> Iterator[Figure]:
    scenes: dict[str, dict[str, Correlogram]] = {}
    for unit, found in judged:
        if found.correlogram is not None and found.correlogram.time:
            scenes.setdefault(unit.scene, {})[unit.backbone] = found.correlogram
    for scene, backbones in scenes.items():
        yield Figure(
            slug("correlogram", scene),
            f"Agreement by distance of the looks: {scene}",
            "Alpha between frames of pairs of looks at a place, by how far apart they are in time, angle, range and"
            f" baseline, with bands at 95%: for this scene flown again if {LEAST_FRAMES} frames of a bin tell of it,"
            " else (open points) for these frames. Bins with few pairs are left out.",
            f"Four panels of {scene}, one curve a backbone with its band: agreement against frames"
            " apart, degrees between the views, ratio of the ranges, and metres between the cameras.",
            partial(draw_correlogram, backbones),
        )


def _estimates(judged: Judged, take: Callable[[MapStatistics], Estimate]) -> Rows:
    rows: dict[str, dict[str, Estimate]] = {}
    for unit, found in judged:
        rows.setdefault(unit.scene, {})[unit.backbone] = take(found)
    return rows


def _drift(kept: Sequence[Record], views: Views) -> Iterator[Figure]:
    def pooled(records: Sequence[Record]) -> DriftByOP:
        return reduce(add, (views.sums(record).drift for record in records))

    if kept:
        yield Figure(
            "drift",
            "Belief drift beside random order",
            "Mean SBD of the voxels with that OP (above 8 in bins that widen by a quarter), all scenes together, and"
            " what the same observations give in the mean of all their orders. Where both coincide, the fall of SBD"
            " with OP is arithmetic. Voxels whose expectation is not known are left out.",
            "One panel a backbone: mean SBD against OP on a logarithmic axis, and a dashed line for random order.",
            lambda: draw_drift({name: pooled(records) for name, records in by_backbone(kept).items()}),
        )


def _reliability(judged: Judged) -> Iterator[Figure]:
    bins: dict[str, list[Reliability]] = {}
    for unit, found in judged:
        if found.correctness is not None:
            bins.setdefault(unit.backbone, []).extend(found.correctness.reliability)
    if bins:
        yield Figure(
            "correctness",
            "Reliability of the fused belief",
            "Accuracy of the voxels by their largest belief, all scenes together, over the voxels seen twice or more"
            " with a true class; open: fewer than 1,000 voxels. Below the diagonal the belief is too sure. Beneath:"
            " how many voxels there are.",
            "Accuracy against the largest belief, one curve a backbone with the diagonal, and bars that count voxels.",
            lambda: draw_reliability(bins),
        )


def _comparison(result: Result) -> Iterator[Figure]:
    words = {quantity.key: quantity.word for quantity in compared(truth=True)}
    panels: dict[str, dict[str, dict[str, Estimate]]] = {}
    for found in result.comparisons:
        for row in found.paired.differences:
            panels.setdefault(words[row.measure], {}).setdefault(found.scene, {})[f"{row.a} less {row.b}"] = (
                row.difference
            )
    if panels:
        yield Figure(
            "comparison",
            "Differences on the same places",
            "Differences of the backbones on the voxels that all of them saw twice or more, with intervals at 95%"
            " whose question stands in the table. An interval that holds 0 decides nothing.",
            "One panel a measure with the difference of each pair of backbones in each scene and its interval, and 0.",
            lambda: draw_intervals(
                panels,
                dict.fromkeys(panels, (0.0,)),
            ),
        )


def _maps(result: Result, kept: Sequence[Record], views: Views) -> Iterator[Figure]:
    """Of the studies that were asked for statistics: they kept what the maps show beside the voxels."""
    for record in kept:
        scene, backbone = record.unit.scene, record.unit.backbone
        if scene in result.up and record.statistics is not None and record.statistics.fusion_rules:
            yield Figure(
                slug("uncertainty_map", scene, backbone),
                f"Where the uncertainty comes from: {scene}, {backbone}",
                "The topmost voxel of each column along the up axis: its entropy within frames (borders, voxels larger"
                " than things, unsure scores) and between them (their disagreement), in units of log K, grey where seen"
                " once; and where ground truth is known, which voxels are stable and which right.",
                f"Maps of {scene} from above with the two parts of the entropy of {backbone}'s voxels, and whether they"
                " are right.",
                partial(_draw_map, record, result.up[scene], views),
                unit=record.unit.slug,
            )


def _draw_map(record: Record, up: tuple[float, float, float], views: Views) -> Canvas:
    above = views.above(record, up)
    known = kept_of(record, above.table, ("true_label", "stable"))
    return draw_uncertainty(above, None if known is None else right_or_wrong(above.table, *known))


def _sweeps(result: Result) -> Iterator[Figure]:
    for sweep in swept(result):
        by_name = {name: levels(result, sweep.name, name) for name in result.backbones}
        found = {name: rows for name, rows in by_name.items() if any(level.judged for level in rows)}
        if found:
            yield Figure(
                f"sensitivity_agreement_{sweep.name}",
                f"Agreement against {sweep.title}",
                "VSS over all voxels, beside what random thinning of the frames does not change: pairwise agreement"
                " (PSA) and Krippendorff's alpha of the voxels seen twice or more, macro means of the scenes; and"
                " their SBD as seen and in random order. Bars: the 95% interval over blocks of space for these frames,"
                " of VSS the standard deviation over repeats. (a) to (c) span 0.1 or more, (d) begins at 0.",
                f"Four panels against {sweep.title}: VSS, pairwise agreement, alpha, and SBD with its null.",
                partial(draw_agreement, sweep, found),
            )
