"""The folder of two visits: numbers for programs, a page for people, and a map of what changed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semstab.core.files import keep_only, write_json, write_text
from semstab.core.types import Int64
from semstab.data.results import slug
from semstab.data.topdown import top_down
from semstab.report.figures.located import Located
from semstab.report.figures.maps import draw_kinds, framed, locate, map_panels, number_places
from semstab.report.figures.style import Figure, mark_panel
from semstab.report.figures.topdown import best_view_of
from semstab.report.html import blocks, filled
from semstab.report.tables import write_tables
from semstab.report.tables.table import Table, relations
from semstab.statistics.visits import GONE, MOVED, NEW, STAYED, VisitedSpots
from semstab.two_visits.tables import notes, sentences, tables

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from semstab.two_visits import ChangedPlace, VisitComparison, Visited

CONTENT, REPORT, FIGURES = "visits.json", "report.html", "figures"

KINDS = ("not told", "same class", "other class", "gone", "new", "moved")
COLORS = ((236, 236, 236), (196, 196, 196), (213, 94, 0), (0, 114, 178), (0, 158, 115), (204, 121, 167))
RANK = np.array([0.0, 1.0, 3.0, 4.0, 5.0, 2.0])
"""Ranks of the kinds: a column shows its spot with the highest rank."""

COARSER = 2.0
"""Edge of a cell of the map, in mean distances of spots."""

MOST_NUMBERED = 9
"""Most places whose numbers stand in the map."""

TOPICS = (
    ("agreement", "Agreement", ("visits", "visits_classes")),
    ("changes", "What changed", ("visits_changes", "visits_places", "visits_map")),
)


def write(comparison: VisitComparison, visited: Mapping[str, Visited], out: Path) -> None:
    """Write visits.json, tables, the map of each scene, and report.html."""
    made, figures = tables(comparison), pictures(comparison, visited)
    write_json(out / CONTENT, comparison)
    write_tables(made, out)
    keep_only([path for figure in figures for path in figure.save(out / FIGURES)], out / FIGURES)
    write_text(out / REPORT, page(comparison, made, figures, out))


def page(comparison: VisitComparison, made: Sequence[Table], drawn: Sequence[Figure], out: Path) -> str:
    """Return report.html."""
    topics = []
    for key, title, names in TOPICS:
        topic_tables = [table for table in made if table.name in names]
        topic_figures = [figure for figure in drawn if figure.name.partition("__")[0] in names]
        topics.append(
            {"id": key, "title": title, "charts": [], "blocks": list(blocks(topic_tables, topic_figures, out))}
        )
    return filled(
        "comparison.html.j2",
        title=" and ".join(visit.name for visit in comparison.visits),
        runs=comparison.visits,
        scenes=[scene.scene for scene in comparison.scenes],
        reading=[relations(text) for text in (*sentences(comparison), *notes(comparison))],
        models=[],
        topics=topics,
        areas=[],
    )


def kinds(visited: VisitedSpots) -> Int64:
    """Return the kind (n,) of each spot, a row of KINDS."""
    kind = np.zeros(len(visited.spots.point), np.int64)
    kind[visited.common | (visited.change == STAYED)] = KINDS.index("same class")
    kind[visited.relabelled] = KINDS.index("other class")
    for change, name in ((GONE, "gone"), (NEW, "new"), (MOVED, "moved")):
        kind[visited.change == change] = KINDS.index(name)
    return kind


def pictures(comparison: VisitComparison, visited: Mapping[str, Visited]) -> list[Figure]:
    """Return the map of each scene."""
    return [
        Figure(
            slug("visits_map", scene.scene),
            f"What changed: {scene.scene}",
            "In each column of spots the one that changed most is shown; numbers name the largest places.",
            f"The map of {scene.scene}: spots with the same class in both visits, another one, gone, new or moved.",
            partial(draw, visited[scene.scene], scene.places[:MOST_NUMBERED]),
        )
        for scene in comparison.scenes
        if len(visited[scene.scene].spots.spots.point)
    ]


def draw(visit: Visited, places: Sequence[ChangedPlace]) -> Canvas:
    """Return the map of a scene."""
    visited = visit.spots
    asked = np.flatnonzero(visited.counts.sum(axis=0) > 0)
    size = COARSER * visited.spots.spacing * math.sqrt((1 << 32) / visited.spots.share)
    point, kind = visited.spots.point[asked], kinds(visited)[asked]
    visible, axis, view = best_view_of(point, size, visit.up)
    point, kind = point[visible], kind[visible]
    rows, cell, corner = top_down(point, size, axis, RANK[kind])
    figure, (panel,) = map_panels(rows, 1)
    draw_kinds(figure, panel, rows, kind, COLORS, KINDS)
    located = Located.seen_along(axis, corner, (rows.shape[1] * cell, rows.shape[0] * cell), point, visit.georeference)
    mark_panel(panel, "a", f"spots, {view}")
    framed(panel)
    locate(panel, located, rows.shape)
    centres = np.array([place.centre for place in places]).reshape(-1, 3)
    if visit.georeference is not None:
        centres = visit.georeference.in_scene(centres)
    at: list[Any] = centres.tolist()
    number_places(panel, [place.number for place in places], at, [""] * len(places), located, rows.shape)
    return figure
