"""How the viewer opens a recording, without a click: maps left, camera right, series below, a tab for each scene."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, field
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from semstab.backends import REGISTRY
from semstab.engine.units import Plan
from semstab.model.measures import ENTROPY, VSS
from semstab.model.results import RECURRENT, Unit
from semstab.recording import camera
from semstab.recording.changes import DIFFERENCE
from semstab.recording.entities import Legend, path
from semstab.recording.eye import BACKGROUND, Scenery, eye, fit
from semstab.recording.series import SERIES, entity
from semstab.recording.voxel_maps import chunk, defaults, looks, visualizer
from semstab.task import Task

# In a window of 1500 x 850 points, as laptops have it; in others the proportions are alike.
LEFT, TITLE = (808, 538), 27
"""Width and height of what is left of the camera, and the height of a view's title or of a row of tabs."""
DRIFT_LEGEND = TITLE + 70
"""Height of the legend of drift, with its title."""
DIFFERENCE_ASPECT, COMPARED_ASPECT = 2.2, 1.6

MOST_BESIDE = 4
"""Maps that are seen at once; more have a tab each."""

OVERVIEW = ("drift", "compensated_flicker", "map_vss", "map_recurrent")
COMPARED = {
    "drift": "Drift (bits)",
    "map_vss": VSS.title,
    "map_entropy": ENTROPY.title,
    "map_recurrent": f"OP >= {RECURRENT}",
    "new_voxels": "New voxels",
    "fuse_ms": "Fusion (ms)",
}
"""Series of two backends that are seen side by side, and short titles: a backend's name may be long."""


@dataclass
class Known:
    """What is known of a run so far, and the layout depends on.

    legends    by scene
    sceneries  by scene, say where its maps are seen from; else the viewer chooses
    chunks     by scene, of how many chunks of a map the views say how they are coloured
    spans      by scene and backbone, the lowest and highest value of each of COMPARED in all backends
    """

    legends: dict[str, Legend] = field(default_factory=dict)
    sceneries: dict[str, Scenery] = field(default_factory=dict)
    chunks: dict[str, int] = field(default_factory=dict)
    spans: dict[tuple[str, str], dict[str, tuple[float, float]]] = field(default_factory=dict)


def blueprint(plan: Plan, known: Known) -> rrb.Blueprint:
    """The layout of a plan, with what is known so far."""
    by_scene = itertools.groupby(plan.tasks, key=lambda task: task.scene.name)
    scenes = [_scene(scene, list(tasks), known) for scene, tasks in by_scene]
    return rrb.Blueprint(
        rrb.Tabs(*scenes) if len(scenes) > 1 else scenes[0],
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),  # the whole map is at the end
    )


def drawn(task: Task) -> str:
    """The backend whose map is drawn while it grows: the first that fuses as the recorder's tracker does."""
    alike = [name for name in task.backends if is_pointwise(name)]
    return (alike or list(task.backends))[0]


@functools.cache
def is_pointwise(backend: str) -> bool:
    """Whether a backend fuses as the reference does."""
    return bool(getattr(REGISTRY.load(backend), "pointwise", True))


def compared(task: Task) -> list[tuple[str, str]]:
    """Pairs of backends whose maps are compared: the drawn one with each other one."""
    return [(drawn(task), other) for other in task.backends if other != drawn(task)]


def distinct(task: Task) -> list[str]:
    """The backends whose series are drawn over each other: of those that fuse alike one, as their lines coincide."""
    return [name for name in task.backends if name == drawn(task) or not is_pointwise(name)]


def _scene(scene: str, tasks: list[Task], known: Known) -> rrb.Container:
    flips = [_flips(scene, task) for task in tasks]
    comparisons = [_comparison(task, *pair, known) for task in tasks for pair in compared(task)]
    overview = _overview(scene, tasks, known)
    return rrb.Tabs(overview, *flips, *comparisons, name=scene)


def _overview(scene: str, tasks: list[Task], known: Known) -> rrb.Container:
    legend, scenery, chunks = known.legends[scene], known.sceneries.get(scene), known.chunks[scene]
    _, height = legend.size(whole=False)
    area = LEFT[0], LEFT[1] - TITLE - (height + TITLE)
    all_classes = [] if legend.is_whole else [_legend(scene, "all_classes", "All classes", legend.size(whole=True))]
    maps = rrb.Tabs(*(_maps(name, tasks, scenery, area, chunks) for name in looks()), *all_classes)
    classes = _legend(scene, "legend", "Classes", legend.size(whole=False))
    left = rrb.Vertical(maps, classes, row_shares=[LEFT[1] - height - TITLE, height + TITLE])
    levels = rrb.VisualBounds2D(x_range=camera.LEGEND[0], y_range=camera.LEGEND[1])
    drift_view = rrb.Spatial2DView(
        origin=path(scene, "drift_legend"), name="Drift of a frame at each pixel", visual_bounds=levels
    )
    right = rrb.Vertical(_cameras(scene, tasks), drift_view, row_shares=[LEFT[1] - DRIFT_LEGEND, DRIFT_LEGEND])
    top = rrb.Horizontal(left, right, column_shares=[5, 4])
    return rrb.Vertical(top, _below(scene, tasks), row_shares=[5, 2], name="Overview")


def _legend(scene: str, entity: str, name: str, size: tuple[float, float]) -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=(0, size[0]), y_range=(0, size[1]))
    return rrb.Spatial2DView(origin=path(scene, entity), name=name, visual_bounds=bounds)


def _below(scene: str, tasks: list[Task]) -> rrb.Container:
    first = rrb.Horizontal(*(_plot(scene, name, tasks) for name in OVERVIEW), name="Time series")
    more = [_plot(scene, name, tasks) for name in SERIES if name not in OVERVIEW and not name.endswith("_ms")]
    times = [_plot(scene, name, tasks) for name in SERIES if name.endswith("_ms")]
    notes = rrb.TextLogView(origin=path(scene, "log"), name="Notes")
    agreement = [
        rrb.TextDocumentView(origin=path(scene, "agreement", task.backbone), name=task.backbone) for task in tasks
    ]
    return rrb.Tabs(
        first,
        rrb.Horizontal(*agreement, name="Agreement of frames"),
        rrb.Horizontal(*more, name="More series"),
        rrb.Horizontal(*times, name="Milliseconds"),
        notes,
    )


def _plot(scene: str, name: str, tasks: list[Task]) -> rrb.TimeSeriesView:
    legend_at = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=name in ("map_recurrent", "fuse_ms"))
    lines = [
        entity(name, Unit(scene, task.backbone, backend))
        for task in tasks
        for backend in (task.backends if name.endswith("_ms") else distinct(task))
    ]
    return rrb.TimeSeriesView(
        origin=path(scene, "series", name), contents=list(dict.fromkeys(lines)), name=SERIES[name],
        plot_legend=legend_at,
    )  # fmt: skip


def _flips(scene: str, task: Task) -> rrb.Container:
    """The voxels that drifted most and the frames to blame, beside what the camera saw."""
    lanes = rrb.StateTimelineView(
        origin=path(scene, "flips", task.backbone), name="Dominant class of the voxels that drifted most"
    )
    blamed = rrb.TextDocumentView(origin=path(scene, "flips_report", task.backbone), name="Frames to blame")
    left = rrb.Vertical(lanes, blamed)
    right = rrb.Vertical(*_camera_views(scene, task))
    return rrb.Horizontal(left, right, column_shares=[5, 4], name=f"Flips: {task.backbone}")


def _cameras(scene: str, tasks: list[Task]) -> rrb.Container:
    """Labels and drift of each backbone beside each other; depth in a tab of its own."""
    rows = [rrb.Horizontal(*_camera_views(scene, task), name=task.backbone) for task in tasks]
    pictures = rrb.Vertical(*rows, name="Camera") if len(rows) <= 3 else rrb.Tabs(*rows, name="Camera")
    return rrb.Tabs(pictures, rrb.Spatial2DView(origin=path(scene, "depth"), name="Depth"))


def _camera_views(scene: str, task: Task) -> list[rrb.View]:
    color, labels = path(scene, "camera", "color"), path(scene, "camera", task.backbone, "labels")
    drift, flips = (path(scene, "camera", task.backbone, name) for name in ("drift", "flips"))
    origin = path(scene, "camera")
    seen_through: Any = {labels: rr.SegmentationImage.from_fields(opacity=0.6).visualizer()}
    return [
        rrb.Spatial2DView(
            origin=origin, contents=[color, labels], overrides=seen_through, name=f"{task.backbone}: labels"
        ),
        rrb.Spatial2DView(origin=origin, contents=[color, drift, flips], name=f"{task.backbone}: drift of this frame"),
    ]


def _maps(
    name: str, tasks: list[Task], scenery: Scenery | None, area: tuple[float, float], chunks: int
) -> rrb.Container:
    columns, aspect = _arrangement(len(tasks), scenery, area)
    look, colored = looks()[name], 0 if name == "class" else chunks
    views = [
        _map(f"{task.backbone}: {look.title}", task, drawn(task), scenery, aspect, name, colored) for task in tasks
    ]
    if len(views) > MOST_BESIDE:
        return rrb.Tabs(*views, name=look.tab)
    return rrb.Grid(*views, grid_columns=columns, name=look.tab)


def _arrangement(views: int, scenery: Scenery | None, area: tuple[float, float]) -> tuple[int, float]:
    """In how many columns so many views of a scenery show it largest, and how much wider than high each one is."""
    if views > MOST_BESIDE:
        return 1, area[0] / (area[1] - 2 * TITLE)
    cells = {}
    for columns in range(1, views + 1):
        height = area[1] / math.ceil(views / columns) - TITLE
        aspect = area[0] / columns / height
        scale = height if scenery is None else height / fit(scenery, aspect)[1]
        cells[columns] = scale, aspect
    best = max(cells, key=lambda columns: cells[columns][0])
    return best, cells[best][1]


def _map(
    title: str, task: Task, backend: str, scenery: Scenery | None, aspect: float, name: str = "class", chunks: int = 0
) -> rrb.Spatial3DView:
    """A backend's map; coloured other than by class, the views say so of each of its chunks."""
    scene = task.scene.name
    entity = path(scene, "map", task.backbone, backend)
    around = [path(scene, "camera"), path(scene, "trajectory"), path(scene, "flips_at", task.backbone)]
    return rrb.Spatial3DView(
        origin=path(scene),
        contents=[f"{entity}/**", *around],
        defaults=defaults(name),
        overrides=dict.fromkeys([chunk(entity, number) for number in range(chunks)], visualizer(name)),
        name=title,
        background=BACKGROUND,
        line_grid=False,
        eye_controls=eye(scenery, aspect),
    )


def _comparison(task: Task, first: str, second: str, known: Known) -> rrb.Container:
    """Two backends: their maps and where these differ, and the same series side by side, in the same range."""
    scene, backbone = task.scene.name, task.backbone
    scenery, spans = known.sceneries.get(scene), known.spans.get((scene, backbone), {})
    pair = f"{first} and {second}"
    difference = rrb.Spatial3DView(
        origin=path(scene),
        contents=[path(scene, "difference", backbone, pair, part) for part in DIFFERENCE],
        name=f"Where they differ: orange in {first} only, blue in {second} only, else |VSS difference| (0 to 0.5)",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=eye(scenery, DIFFERENCE_ASPECT),
    )
    found = rrb.TextDocumentView(origin=path(scene, "difference_report", backbone, pair), name="What differs")
    maps = rrb.Horizontal(
        _map(f"{first}: dominant class", task, first, scenery, COMPARED_ASPECT),
        _map(f"{second}: dominant class, at the end", task, second, scenery, COMPARED_ASPECT),
    )
    plots = [
        rrb.TimeSeriesView(
            origin=entity(name, Unit(scene, backbone, backend)),
            name=f"{title}: {backend}",
            axis_y=_axis(spans.get(name)),
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for name, title in COMPARED.items()
        for backend in (first, second)
    ]
    return rrb.Horizontal(
        rrb.Vertical(found, difference, maps, row_shares=[1, 5, 4]),
        rrb.Grid(*plots, grid_columns=2),
        column_shares=[5, 4],
        name=f"{backbone}: {pair}",
    )


def _axis(span: tuple[float, float] | None) -> rrb.ScalarAxis | None:
    """From the lowest to the highest value, with a margin; where they are one, the viewer chooses."""
    if span is None or span[0] == span[1]:
        return None
    low, high = span
    margin = 0.05 * (high - low)
    return rrb.ScalarAxis(range=(low - margin, high + margin))
