"""The figures of a comparison: differences with their intervals, by scene and by class, and where they lie."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

from semstab.comparison.comparing import Found
from semstab.comparison.places import Changes
from semstab.comparison.tables import ALL_SCENES, HEADLINES, IN_CLASSES, IOU, by_key, scopes
from semstab.model.contrast import Against, RunComparison
from semstab.model.results import slug
from semstab.model.statistics import Estimate
from semstab.report.figures.maps import Panel, draw_changes
from semstab.report.figures.statistics import draw_intervals
from semstab.report.figures.style import Figure
from semstab.statistics.agreement import PSA
from semstab.statistics.correctness import MIOU
from semstab.statistics.intervals import LEAST_FRAMES

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


Panels = dict[str, dict[str, dict[str, Estimate]]]
"""By measure, by scene or class, by run."""

MOST_NUMBERS = 9
"""Places that have their number in a map."""


def figures(found: Found) -> list[Figure]:
    """All that there is something for."""
    return [*_forest(found.result), *_forest_by_class(found.result), *_maps(found)]


def _forest(found: RunComparison) -> Iterator[Figure]:
    shown, panels = by_key(HEADLINES), Panels()
    for scope, own in scopes(found):
        for row in own.contrasts:
            if row.measure in shown:
                panels.setdefault(shown[row.measure].title, {}).setdefault(scope, {})[own.other] = row.difference
    yield Figure(
        "comparison",
        "Differences",
        f"Each run less {found.base}, with intervals at 95%: for the next flight where {LEAST_FRAMES} frames tell"
        " of it, else for this map. An interval that holds 0 decides nothing.",
        f"One panel a measure with the difference of each run from {found.base} and its interval, beside 0.",
        lambda: draw_intervals(panels, dict.fromkeys(panels, (0.0,))),
    )


def _forest_by_class(found: RunComparison) -> Iterator[Figure]:
    """Over all scenes where there are several."""
    overall = found.overall
    panels = Panels()
    for quantity in (quantity for quantity in IN_CLASSES if quantity is not PSA):
        for own in overall:
            for row in (*own.contrasts, *own.by_class):
                if row.measure == (MIOU.key if quantity is IOU and not row.of else quantity.key):
                    classes = panels.setdefault(quantity.title, {})
                    classes.setdefault(row.of or "all classes", {})[own.other] = row.difference
    if any(own.by_class for own in overall):
        where = f", macro means over {ALL_SCENES}" if len(found.scenes) > 1 else ""
        yield Figure(
            "comparison_classes",
            "Differences by class",
            f"Each run less {found.base}{where}, with intervals at 95%. Agreement is that of the class against all"
            " others; of all classes recall is accuracy, and IoU its mean. Classes with few places are left out.",
            f"One panel a measure with the difference of each run from {found.base} in each class, beside 0.",
            lambda: draw_intervals(panels, dict.fromkeys(panels, (0.0,))),
        )


def _maps(found: Found) -> Iterator[Figure]:
    for scene in found.result.scenes:
        for own in scene.against:
            if (scene.scene, own.other) in found.changes and scene.scene in found.up:
                yield Figure(
                    slug("comparison_map", scene.scene, own.other),
                    f"Where it changed: {scene.scene}, {own.other} less {found.result.base}",
                    "The largest change in each column of voxels that both saw twice or more: agreement between frames,"
                    " and where ground truth is known what is wrong now or right now. Numbers are those of the places"
                    " that got worse.",
                    f"Maps of {scene.scene} from above: orange where {own.other} is worse, blue where it is better.",
                    partial(_draw, found.changes[scene.scene, own.other], found.up[scene.scene], own),
                    unit=slug(scene.scene, own.other),
                )


def _draw(changes: Changes, up: tuple[float, float, float], own: Against) -> Canvas:
    shown = changes.shown
    panels = [Panel("agreement", ("lost", "gained"), shown.change, *_numbers(own, "agreement"))]
    if shown.right is not None:
        panels.append(Panel("truth", ("wrong now", "right now"), shown.right.astype(float), *_numbers(own, "truth")))
    return draw_changes(shown.table, up, panels)


def _numbers(own: Against, what: str) -> tuple[list[int], list[tuple[float, float, float]]]:
    shown = [place for place in own.places if place.what == what][:MOST_NUMBERS]
    return [place.number for place in shown], [place.centre for place in shown]
