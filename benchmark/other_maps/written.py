"""Write a comparison with other programs' maps: tables, places as CSV and GeoJSON, pictures, and a recording."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semstab.core.files import keep_only, write_json, write_text
from semstab.data.results import slug
from semstab.data.topdown import top_down
from semstab.exports.places import degrees_of, geojson, places_table
from semstab.other_maps.agreement import ONLY_OTHER, ONLY_RUN, OTHER, SAME, DifferingPlace, Voxelwise
from semstab.other_maps.placing import centers
from semstab.other_maps.tables import short, tables
from semstab.report.figures.located import Located
from semstab.report.figures.maps import draw_kinds, framed, locate, map_panels, number_places
from semstab.report.figures.style import LETTERS, Figure, mark_panel
from semstab.report.figures.topdown import best_view_of
from semstab.report.tables import write_tables

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from semstab.other_maps import MapComparison

RECORDING = "recording.rrd"
FIGURES = "figures"

MOST_NUMBERED = 9
"""The most places that are named in a picture and in the viewer."""

KINDS = {SAME: "same class", OTHER: "other class", ONLY_RUN: "run only", ONLY_OTHER: "map only"}
LEGEND = "grey: same class, orange: other class, blue: run only, purple: map only"
RIGHT = ("unknown", "both wrong", "map right", "run right", "both right")

GREY, ORANGE, BLUE, PURPLE, DARK, PALE = (
    (196, 196, 196), (213, 94, 0), (0, 114, 178), (204, 121, 167), (50, 50, 50), (236, 236, 236),
)  # fmt: skip
OF_KIND, OF_RIGHT = (GREY, ORANGE, BLUE, PURPLE), (PALE, DARK, PURPLE, BLUE, GREY)


def write(comparison: MapComparison, out: Path) -> list[Path]:
    """Write OUT/tables, OUT/places.csv and .geojson, OUT/figures and OUT/recording.rrd; return the paths."""
    from semstab.recording.other_maps import Colored, record_maps

    written = [*write_tables(tables(comparison.agreements, comparison.run.name), out), *_write_places(comparison, out)]
    figure_paths = [path for figure in pictures(comparison) for path in figure.save(out / FIGURES)]
    keep_only(figure_paths, out / FIGURES)
    unions = {voxelwise.agreement.name: voxelwise.laid_together(comparison.run) for voxelwise in comparison.maps}
    palette, size = comparison.first.colors, comparison.run.grid.size
    views = {
        name: [
            Colored("difference", LEGEND, union.index, np.array(OF_KIND, np.uint8)[union.kind]),
            Colored("map", name, union.index[union.theirs >= 0], palette[union.theirs[union.theirs >= 0]]),
            Colored("run", comparison.run.name, comparison.run.grid.index, palette[comparison.run.grid.label]),
        ]
        for name, union in unions.items()
    }
    places = {
        agreement.name: [
            (f"{place.number} {place.ours} / {place.theirs}", place.centre)
            for place in agreement.places[:MOST_NUMBERED]
        ]
        for agreement in comparison.agreements
    }
    record_maps(out / RECORDING, comparison.scene, views, places, size, comparison.first.up)
    return [*written, *figure_paths, out / RECORDING]


def _write_places(comparison: MapComparison, out: Path) -> list[Path]:
    first = comparison.first
    named_places = [(agreement.name, place) for agreement in comparison.agreements for place in agreement.places]
    if not named_places:
        for name in ("places.csv", "places.geojson"):
            (out / name).unlink(missing_ok=True)
        return []
    points = first.in_file(np.array([place.centre for _, place in named_places]))
    rows = [
        _row(name, place, point, first.georeference) for (name, place), point in zip(named_places, points, strict=True)
    ]
    degrees = None if first.georeference is None else degrees_of(points, first.georeference, out / "places.geojson")
    write_text(out / "places.csv", places_table(rows, degrees))
    write_json(out / "places.geojson", geojson(rows, points.tolist(), degrees, first))
    return [out / "places.csv", out / "places.geojson"]


def _row(name: str, place: DifferingPlace, point: Any, georeference: Any) -> dict[str, Any]:
    return {
        "map": name, "number": place.number, "class": place.ours, "class_of_map": place.theirs,
        "true_class": place.true, "voxels": place.voxels, "size_m": round(place.size, 3),
        **dict(zip("xyz", (round(float(c), 3) for c in point), strict=True)),
        "crs": "" if georeference is None else georeference.name,
    }  # fmt: skip


def pictures(comparison: MapComparison) -> list[Figure]:
    """Return a picture of each map: its classes against the run's, and their correctness with ground truth."""
    return [
        Figure(
            slug("maps", voxelwise.agreement.name),
            f"{voxelwise.agreement.name} and {comparison.run.name}",
            "In each column of voxels the one that differs most is shown; numbers name the largest places.",
            f"The maps of {comparison.scene}: where {voxelwise.agreement.name} and {comparison.run.name}"
            " give other classes.",
            partial(draw, comparison, voxelwise),
        )
        for voxelwise in comparison.maps
    ]


RANK_OF_KIND = np.array([0.0, 3.0, 1.0, 2.0])
RANK_OF_RIGHT = np.array([0.0, 3.0, 4.0, 4.0, 1.0])
"""Ranks of kinds: a column of voxels shows the voxel with the highest rank."""


def draw(comparison: MapComparison, voxelwise: Voxelwise) -> Canvas:
    """Return the picture of a map next to the run's."""
    union, run, georeference = voxelwise.laid_together(comparison.run), comparison.run, comparison.first.georeference
    size, up = run.grid.size, comparison.first.up or (0.0, 0.0, 1.0)
    laid = centers(union.index, size)
    visible, axis, view = best_view_of(laid, size, up)
    laid = laid[visible]
    panels: list[tuple[str, Any, Any, Any, Any]] = [
        (
            f"{short(voxelwise.agreement.name)}, {view}",
            union.kind[visible],
            RANK_OF_KIND,
            OF_KIND,
            tuple(KINDS.values()),
        )
    ]
    if union.right is not None:
        panels.append(("which is right", union.right[visible], RANK_OF_RIGHT, OF_RIGHT, RIGHT))
    projections = [top_down(laid, size, axis, rank[values]) for _, values, rank, _, _ in panels]
    figure, axes = map_panels(projections[0].rows, len(panels))
    for panel, letter, (title, values, _, colors, names), (rows, cell, corner) in zip(
        axes, LETTERS, panels, projections, strict=False
    ):
        draw_kinds(figure, panel, rows, values, colors, names)
        located = Located.seen_along(axis, corner, (rows.shape[1] * cell, rows.shape[0] * cell), laid, georeference)
        mark_panel(panel, letter, title)
        framed(panel)
        locate(panel, located, rows.shape, numbers=panel is axes[0])
        listed = voxelwise.agreement.places[:MOST_NUMBERED]
        number_places(
            panel, [place.number for place in listed], [place.centre for place in listed], [""] * len(listed), located,
            rows.shape,
        )  # fmt: skip
    return figure
