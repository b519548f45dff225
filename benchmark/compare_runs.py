"""The folder of a comparison: numbers for programs, pages for people, and the changes in each voxel."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from semstab.comparison.differences import ComparisonData, Progress, differences_of
from semstab.comparison.entries import RunHandle
from semstab.comparison.locations import VoxelChanges
from semstab.comparison.opening import open_compared
from semstab.comparison.quantities import HEADLINES, IOU, by_name
from semstab.config.groups import ScopeOption, validated
from semstab.core.files import TEMPORARY, FolderLock, keep_only, read_json, write_json, write_text
from semstab.core.json_form import from_json
from semstab.core.types import THIS_SCENE, Float64
from semstab.data import parquet
from semstab.data.contrast import Against, Area, RunComparison, SceneComparison
from semstab.data.georeference import Georeference
from semstab.data.results import slug
from semstab.data.statistics import Estimate
from semstab.errors import ConfigError
from semstab.exports.area_pictures import area_pictures
from semstab.report.charts import dot_chart, sample
from semstab.report.comparison.sentences import sentences
from semstab.report.comparison.tables import IN_CLASSES, heading, scopes, tables, top_frames
from semstab.report.figures.located import metres
from semstab.report.figures.maps import Panel, draw_changes
from semstab.report.figures.style import Figure
from semstab.report.html import blocks, filled
from semstab.report.tables import write_tables
from semstab.report.tables.table import Table, relations, to_markdown
from semstab.statistics.agreement import PSA
from semstab.statistics.correctness import MIOU

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


# The charts and maps of a comparison: differences with their intervals, by scene and by class, and their locations.

Panels = dict[str, dict[str, list[tuple[int, str, Estimate]]]]
"""The colour of each run, its name and its difference from the base, by measure, then by scene or class."""

MOST_NUMBERS = 9
"""Most areas that have their number in a map."""


def charts(comparison: RunComparison) -> dict[str, list[dict[str, str]]]:
    """Return charts of the differences with their intervals, by the name of the table above them."""
    colors = {run.name: k for k, run in enumerate(comparison.runs[1:])}
    quantities, panels, by_class = by_name(HEADLINES), Panels(), Panels()
    for scope, against in scopes(comparison):
        for row in against.contrasts:
            if row.measure in quantities:
                dot = (colors[against.other], against.other, row.difference)
                panels.setdefault(quantities[row.measure].full_title, {}).setdefault(scope, []).append(dot)
    for quantity in (quantity for quantity in IN_CLASSES if quantity is not PSA):
        for of_run in comparison.overall if any(of_run.by_class for of_run in comparison.overall) else ():
            for row in (*of_run.contrasts, *of_run.by_class):
                if row.measure == (MIOU.name if quantity is IOU and not row.of else quantity.name):
                    dots = by_class.setdefault(quantity.full_title, {}).setdefault(row.of or "all classes", [])
                    dots.append((colors[of_run.other], of_run.other, row.difference))
    less = f"less {comparison.base}"
    return {
        name: [
            {"title": title, "chart": dot_chart(rows, f"{title} {less}", (0.0,))}
            for title, rows in chart_panels.items()
            if any(estimate.value for row in rows.values() for _, _, estimate in row)  # not where nothing differs
        ]
        for name, chart_panels in (("comparison", panels), ("comparison_classes", by_class))
        if chart_panels
    }


def _changed(comparison: ComparisonData) -> Iterator[tuple[SceneComparison, Against, VoxelChanges]]:
    """Yield the scenes and runs with known changes in each voxel."""
    for scene in comparison.result.scenes:
        for against in scene.against:
            if (changes := comparison.changes.get((scene.scene, against.other))) is not None:
                yield scene, against, changes


def _shown(comparison: ComparisonData) -> Iterator[tuple[SceneComparison, Against, VoxelChanges]]:
    """Yield the same without those of which no voxel can be shown, as no two frames see one place in both runs."""
    return (changed for changed in _changed(comparison) if len(changed[2].shown.table))


def maps(
    comparison: ComparisonData, georeferences: Mapping[str, Georeference] = MappingProxyType({})
) -> Iterator[Figure]:
    """Yield a map of each scene and run with known changes, in the coordinates of the exports."""
    for scene, against, changes in _shown(comparison):
        if scene.scene in comparison.up:
            yield Figure(
                slug("comparison_map", scene.scene, against.other),
                f"Changes: {scene.scene}, {against.other} minus {comparison.result.base}",
                "The map shows the largest change in each column of voxels that both saw twice or more: of agreement"
                " between frames and, with ground truth, of correctness. Numbers name the areas that got worse.",
                f"Maps of {scene.scene} from above: {against.other} is worse at orange places, better at blue places.",
                partial(
                    _draw, changes, comparison.up[scene.scene], scene.scene, against, georeferences.get(scene.scene)
                ),
                unit=slug(scene.scene, against.other),
            )


def _draw(
    changes: VoxelChanges,
    up: tuple[float, float, float],
    scene: str,
    against: Against,
    georeference: Georeference | None,
) -> Canvas:
    visible = changes.shown
    panels = [Panel("agreement", ("lost", "gained"), visible.change, *_numbers(scene, against, "agreement"))]
    if visible.right is not None:
        panels.append(
            Panel("truth", ("wrong now", "right now"), visible.right.astype(float), *_numbers(scene, against, "truth"))
        )
    return draw_changes(visible.table, up, panels, georeference)


def _numbers(scene: str, against: Against, what: str) -> tuple[list[int], list[tuple[float, float, float]], list[str]]:
    """Return the numbers of the areas that a map names, their centres, and where the page tells of them."""
    areas = _numbered(against, what)
    links = [f"#{_anchor(scene, against, area)}" for area in areas]
    return [area.number for area in areas], [area.centre for area in areas], links


def _numbered(against: Against, what: str) -> list[Area]:
    return [area for area in against.areas if area.what == what][:MOST_NUMBERS]


def _anchor(scene: str, against: Against, area: Area) -> str:
    return f"area-{slug(scene, against.other)}-{area.what}-{area.number}"


CONTENT, PAGE, REPORT, RECORDING = "comparison.json", "comparison.md", "report.html", "recording.rrd"
KIND = "Changes"
"""Kind of the files with a row per voxel."""


def compare(
    *runs: str | os.PathLike[str],
    out: str | Path | None = None,
    scope: str = THIS_SCENE,
    progress: Progress = lambda what: None,
) -> RunComparison:
    """Compare runs with the first of them, by scene and over all scenes: amounts, p-values and locations.

    Args:
        runs: Folders of runs or studies, 'FOLDER:MODEL' if there are several label sources, small summaries, or results
            in memory (`fuse`); the first is the base. One folder alone: its label sources are compared.
        out: A folder for tables, figures, report.html, comparison.json and .md, columns of voxels, and a recording.
        scope: 'this scene' flown again, 'these frames' or 'other scenes': the scope of intervals and p-values.
        progress: Function that is called with each compared scene.

    Raises:
        ConfigError, DataError: For runs that cannot be opened, or have no scene or no classes in common, in one line;
            for models with features and no labels, which `compare_features` compares.

    Examples:
        >>> semstab.compare("run:sim-steady", "run:sim-flicker")
        <RunComparison with sim-steady on scene0>
          sim-flicker: alpha -.18 ..., p ...; worse in alpha, psa_op2, vss_op3...
    """
    return compare_opened(open_compared(runs), out=out, scope=scope, progress=progress)


def compare_opened(
    handles: Sequence[RunHandle],
    *,
    out: str | Path | None = None,
    scope: str = THIS_SCENE,
    progress: Progress = lambda what: None,
) -> RunComparison:
    """Compare opened runs, as `compare` does."""
    lock = None
    if out is not None:
        _require_own(Path(out))
        lock = FolderLock(Path(out))
    try:
        comparison = differences_of(handles, progress, validated(ScopeOption, {"scope": scope}, "compare: ").scope)
        by_scene = georeferences(handles)
        if out is not None:
            write(comparison, out, by_scene)
    finally:
        if lock is not None:
            lock.release()
            with contextlib.suppress(OSError):
                lock.path.rmdir()  # where nothing was written
    return located(comparison.result, by_scene)


def georeferences(runs: Sequence[RunHandle]) -> Mapping[str, Georeference]:
    """Return the georeferences of scenes by name, from the first run: all that are paired have the same."""
    return {scene: entry.georeference for scene, entry in runs[0].scenes.items() if entry.georeference is not None}


def located(result: RunComparison, georeferences: Mapping[str, Georeference]) -> RunComparison:
    """Return a comparison whose areas are in the coordinates of the exports."""

    def projected(area: Area, georeference: Georeference) -> Area:
        x, y, z = georeference.projected(np.array([area.centre]))[0].tolist()
        return replace(area, centre=(x, y, z))

    def in_scene(scene: SceneComparison) -> SceneComparison:
        if (georeference := georeferences.get(scene.scene)) is None:
            return scene
        against = tuple(
            replace(run_against, areas=tuple(projected(area, georeference) for area in run_against.areas))
            for run_against in scene.against
        )
        return replace(scene, against=against, crs=georeference.name)

    return replace(result, scenes=tuple(map(in_scene, result.scenes)))


def load_comparison(folder: str | Path) -> RunComparison:
    """Return the comparison that `compare` wrote.

    Raises:
        DataError: If it is not there or damaged.
    """
    path = Path(folder) / CONTENT
    return from_json(RunComparison, read_json(path), path)


def write(
    comparison: ComparisonData, out: str | Path, georeferences: Mapping[str, Georeference] = MappingProxyType({})
) -> None:
    """Write the folder, with the georeferences of scenes; nothing of an earlier comparison is left in it."""
    result = located(comparison.result, georeferences)
    folder, made, figures = Path(out), tables(result), list(maps(comparison, georeferences))
    _require_own(folder)
    write_json(folder / CONTENT, result)
    write_text(folder / PAGE, markdown(result, made))
    write_tables(made, folder)
    keep_only([path for figure in figures for path in figure.save(folder / "figures")], folder / "figures")
    _write_columns(comparison, folder)
    write_text(folder / REPORT, page(result, made, figures, folder, _described(comparison, result)))
    if recorded := dict(_recorded(comparison)):
        from semstab.recording import record_changes

        record_changes(folder / RECORDING, recorded, comparison.up, sentences(result))


def markdown(comparison: RunComparison, made: Sequence[Table] | None = None) -> str:
    """Return the comparison for a pull request: sentences, then the tables."""
    printed = [table for table in (made or tables(comparison)) if table.name != "comparison_all"]
    names = ", ".join(run.name for run in comparison.runs[1:])
    head = [f"## {names} against {comparison.base}", "", *(f"- {relations(s)}" for s in sentences(comparison)), ""]
    return "\n".join([*head, *map(to_markdown, printed)])


def page(
    comparison: RunComparison,
    made: Sequence[Table],
    drawn: Sequence[Figure],
    folder: Path,
    areas: Sequence[Mapping[str, Any]] = (),
) -> str:
    """Return report.html; areas are those of `_described`."""
    printed = [table for table in made if table.name != "comparison_all"]
    return filled(
        "comparison.html.j2",
        title=f"{', '.join(run.name for run in comparison.runs[1:])} against {comparison.base}",
        runs=comparison.runs,
        scenes=[scene.scene for scene in comparison.scenes],
        reading=[relations(text) for text in sentences(comparison)],
        models=[(run.name, sample(k)) for k, run in enumerate(comparison.runs[1:])],
        topics=list(_topics(printed, drawn, charts(comparison), folder)),
        areas=areas,
    )


# --- Parts ------------------------------------------------------------------------------------------------------------

TOPICS = (
    ("differences", "Differences", ("comparison",)),
    ("classes", "By class", ("comparison_classes",)),
    ("where", "Where", ("comparison_areas", "comparison_frames", "comparison_map")),
    ("compared", "Compared data", ("comparison_coverage", "comparison_ignored")),
)


def _topics(
    made: Sequence[Table], figures: Sequence[Figure], made_charts: Mapping[str, list[dict[str, str]]], folder: Path
) -> Iterator[dict[str, Any]]:
    for key, title, names in TOPICS:
        topic_tables = [table for table in made if table.name in names]
        topic_figures = [figure for figure in figures if figure.name.partition("__")[0] in names]
        if topic_tables or topic_figures:
            dots = [chart for name in names for chart in made_charts.get(name, ())]
            yield {
                "id": key,
                "title": title,
                "charts": dots,
                "blocks": list(blocks(topic_tables, topic_figures, folder)),
            }


def _described(comparison: ComparisonData, result: RunComparison) -> list[dict[str, Any]]:
    """Return the areas of each scene and run as the page lists them, with pictures where the data is at hand."""
    base, *compared = result.runs
    listed = []
    of_told = {(scene.scene, against.other): (scene, against) for scene in result.scenes for against in scene.against}
    for compared_scene, against, changes in _shown(comparison):
        scene, located_against = of_told[compared_scene.scene, against.other]
        other = next(run for run in compared if run.name == against.other)
        areas = [area for what in ("agreement", "truth") for area in _numbered(located_against, what)]
        points = {k: own_points for k, area in enumerate(areas) if len(own_points := _points(area, changes))}
        pictures = area_pictures(areas, points, (base, other), scene.scene)
        rows = [
            _area(area, scene.crs, pictures.get(k)) | {"id": _anchor(scene.scene, located_against, area)}
            for k, area in enumerate(areas)
        ]
        if rows:
            heading_text = relations(heading(result, scene.scene, against))
            listed.append({"title": heading_text, "areas": rows})
    return listed


def _points(area: Area, changes: VoxelChanges) -> Float64:
    """Return the centres (n, 3) of an area's voxels, in the scene's coordinates."""
    number = changes.area if area.what == "agreement" else changes.wrong_area
    return np.zeros((0, 3)) if number is None else changes.shown.table.centers[number == area.number]


def _area(area: Area, crs: str, picture: Mapping[str, Any] | None) -> dict[str, Any]:
    names = ("east", "north", "height") if crs else ("x", "y", "z")
    text = f"{area.voxels:,} voxels, {area.size:.2g} m from end to end"
    text += f"; frames lost {area.loss:.2f} of their agreement" if area.what == "agreement" else "; wrong now"
    return {
        "number": area.number,
        "what": area.what,
        "title": f"{area.of}, confused with {area.confused_with}" if area.confused_with else area.of,
        "where": ", ".join(f"{name} {metres(round(c, 2))}" for name, c in zip(names, area.centre, strict=True)),
        "text": f"{text}; {area.improved_alike or 'none'} improved by as much",
        "frames": top_frames(area.frames),
        "picture": picture,
    }


def _write_columns(comparison: ComparisonData, folder: Path) -> None:
    written = []
    for _, against, changes in _changed(comparison):
        if against.columns is not None:
            written.append(folder / against.columns)
            table = changes.shown.table
            parquet.write(written[-1], changes.parts(), KIND, table.voxel_size, table.classes)
    if written:
        keep_only(written, written[0].parent)


def _recorded(comparison: ComparisonData) -> Iterator[tuple[tuple[str, str], tuple[Any, ...]]]:
    for scene, against, changes in _shown(comparison):
        areas = [(area.what, f"{area.number} {area.of}", area.centre) for area in against.areas]
        title, visible = heading(comparison.result, scene.scene, against), changes.shown
        yield (scene.scene, against.other), (title, visible.table, visible.change, visible.right, areas)


def _require_own(folder: Path) -> None:
    """Raise ConfigError where the folder holds something else than a comparison, as a run."""
    if folder.is_file():
        raise ConfigError(f"{folder}: it is a file; name a folder")
    if not folder.is_dir() or (folder / CONTENT).exists():
        return
    if any(not file.name.startswith(TEMPORARY) for file in folder.iterdir()):  # a killed comparison leaves those
        raise ConfigError(f"{folder}: it is not empty and holds no comparison; choose another folder")
