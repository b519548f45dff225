"""How the viewer opens a recording, without a click: maps left, camera right, series below, a tab for each scene."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from semstab.backends import REGISTRY
from semstab.labels import LabelSpace
from semstab.plan import Plan, Task
from semstab.recording.entities import path
from semstab.recording.series import OF_THE_BACKBONE, SERIES, entity
from semstab.recording.voxel_maps import TITLES
from semstab.results import Unit

EYE_DISTANCE = 0.55
"""From the middle of a map, in units of its diagonal."""

BACKGROUND = (72, 72, 78)
"""Of the maps: neither end of the colour maps vanishes in it."""

OVERVIEW = ("drift", "compensated_flicker", "map_vss", "map_recurrent")
COMPARED = ("drift", "map_vss", "map_entropy", "map_recurrent", "new_voxels", "fuse_ms")
DIFFERENCE = {"only_first": "in the first only", "only_second": "in the second only", "changed": "|VSS difference|"}

LEGEND_LETTERS = 90
"""In a line of the legend."""

MOST_LAID_OUT, TASK_COST, PAIR_COST = 480, 77, 60
"""Chunks of a blueprint: the most there may be, and those of a backbone on a scene and of a comparison, roughly.

The viewer of rerun 0.41 refuses a file with a blueprint of 900 ('finished without loading a recording'), and opens one
with 490.
"""

Eyes = Mapping[str, rrb.EyeControls3D]


def blueprint(plan: Plan, eyes: Eyes) -> rrb.Blueprint:
    """The layout of a plan; `eyes` says, by scene, where its maps are seen from; else the viewer chooses."""
    scenes = [_scene(scene, tasks, eyes.get(scene)) for scene, tasks in laid_out(plan).items()]
    return rrb.Blueprint(
        rrb.Tabs(*scenes) if len(scenes) > 1 else scenes[0],
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),  # the whole map is at the end
    )


def laid_out(plan: Plan) -> dict[str, list[Task]]:
    """The tasks of the scenes that have a tab: the first ones, as many as the viewer opens without complaint."""
    scenes: dict[str, list[Task]] = {}
    cost = 0
    for scene, group in itertools.groupby(plan.tasks, key=lambda task: task.scene.name):
        tasks = list(group)
        cost += sum(TASK_COST + PAIR_COST * len(compared(task)) for task in tasks)
        if cost > MOST_LAID_OUT and scenes:
            break
        scenes[scene] = tasks
    return scenes


def legend_columns(classes: LabelSpace) -> int:
    """How many names stand beside each other."""
    return max(2, min(7, LEGEND_LETTERS // (max(map(len, classes.classes)) + 3)))


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


def _scene(scene: str, tasks: list[Task], eye: rrb.EyeControls3D | None) -> rrb.Container:
    overview = _overview(scene, tasks, eye)
    pairs = [(task, first, second) for task in tasks for first, second in compared(task)]
    if not pairs:
        return overview
    return rrb.Tabs(overview, *(_comparison(*pair, eye) for pair in pairs), name=scene)


def _overview(scene: str, tasks: list[Task], eye: rrb.EyeControls3D | None) -> rrb.Container:
    maps = rrb.Tabs(*(_maps(name, title, tasks, eye) for name, title in TITLES.items()))
    classes = tasks[0].mapping.target
    columns = legend_columns(classes)
    rows = math.ceil(len(classes) / columns)
    bounds = rrb.VisualBounds2D(x_range=(-0.5, columns - 0.5), y_range=(-0.2, 0.5 * rows - 0.1))
    legend = rrb.Spatial2DView(origin=path(scene, "legend"), name="Classes", visual_bounds=bounds)
    left = rrb.Vertical(maps, legend, row_shares=[8, rows])
    top = rrb.Horizontal(left, _cameras(scene, tasks), column_shares=[5, 4])
    return rrb.Vertical(top, _below(scene, tasks), row_shares=[5, 2], name=scene)


def _below(scene: str, tasks: list[Task]) -> rrb.Container:
    first = rrb.Horizontal(*(_plot(scene, name) for name in OVERVIEW), name="Time series")
    more = [_plot(scene, name) for name in SERIES if name not in OVERVIEW and not name.endswith("_ms")]
    times = [_plot(scene, name) for name in SERIES if name.endswith("_ms")]
    flips = [
        rrb.Horizontal(
            rrb.StateTimelineView(
                origin=path(scene, "flips", task.backbone), name="Dominant class of the voxels that drifted most"
            ),
            rrb.TextDocumentView(origin=path(scene, "flips_report", task.backbone), name="Frames to blame"),
            name=f"Flips: {task.backbone}",
        )
        for task in tasks
    ]
    notes = rrb.TextLogView(origin=path(scene, "log"), name="Notes")
    return rrb.Tabs(
        first, rrb.Horizontal(*more, name="More series"), rrb.Horizontal(*times, name="Milliseconds"), *flips, notes
    )


def _plot(scene: str, name: str) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=name == "map_recurrent")  # there a growing line leaves room
    return rrb.TimeSeriesView(origin=path(scene, "series", name), name=SERIES[name], plot_legend=legend)


def _cameras(scene: str, tasks: list[Task]) -> rrb.Container:
    """Labels and drift of each backbone beside each other; depth in a tab of its own."""
    rows = [rrb.Horizontal(*_camera_views(scene, task), name=task.backbone) for task in tasks]
    pictures = rrb.Vertical(*rows, name="Camera") if len(rows) <= 3 else rrb.Tabs(*rows, name="Camera")
    return rrb.Tabs(pictures, rrb.Spatial2DView(origin=path(scene, "depth"), name="Depth"))


def _camera_views(scene: str, task: Task) -> list[rrb.View]:
    color, labels = path(scene, "camera", "color"), path(scene, "camera", task.backbone, "labels")
    drift, flips = path(scene, "camera", task.backbone, "drift"), path(scene, "flips_at", task.backbone)
    origin = path(scene, "camera")
    seen_through: Any = {labels: rr.SegmentationImage.from_fields(opacity=0.6).visualizer()}
    return [
        rrb.Spatial2DView(
            origin=origin, contents=[color, labels], overrides=seen_through, name=f"{task.backbone}: labels"
        ),
        rrb.Spatial2DView(
            origin=origin, contents=[color, drift, flips], name=f"{task.backbone}: drift that this frame caused"
        ),
    ]


def _maps(name: str, title: str, tasks: list[Task], eye: rrb.EyeControls3D | None) -> rrb.Container:
    views = [_map(name, f"{task.backbone}: {title}", task, drawn(task), eye) for task in tasks]
    if len(views) > 4:
        return rrb.Tabs(*views, name=title)
    return rrb.Grid(*views, grid_columns=1 if len(views) <= 2 else 2, name=title)


def _map(name: str, title: str, task: Task, backend: str, eye: rrb.EyeControls3D | None) -> rrb.Spatial3DView:
    scene = task.scene.name
    chunks = path(scene, "map", task.backbone, backend, name) + "/**"
    around = [path(scene, "camera"), path(scene, "trajectory"), path(scene, "flips_at", task.backbone)]
    return rrb.Spatial3DView(
        origin=path(scene),
        contents=[chunks, *around],
        name=title,
        background=BACKGROUND,
        line_grid=False,
        eye_controls=eye,
    )


def _comparison(task: Task, first: str, second: str, eye: rrb.EyeControls3D | None) -> rrb.Container:
    """Two backends: their maps and where these differ, and the same series side by side."""
    scene, backbone = task.scene.name, task.backbone
    parts = [path(scene, "difference", backbone, f"{first} and {second}", part) for part in DIFFERENCE]
    difference = rrb.Spatial3DView(
        origin=path(scene),
        contents=parts,
        name=f"Difference: orange in {first} only, blue in {second} only, else |VSS difference| (0 to 0.5)",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=eye,
    )
    maps = rrb.Horizontal(
        *(_map("class", f"{backend}: dominant class", task, backend, eye) for backend in (first, second))
    )
    plots = [
        rrb.TimeSeriesView(
            origin=entity(name, Unit(scene, backbone, backend)),
            name=f"{backend}: {SERIES[name]}",
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for name in COMPARED
        if name not in OF_THE_BACKBONE
        for backend in (first, second)
    ]
    return rrb.Horizontal(
        rrb.Vertical(difference, maps, row_shares=[3, 2]),
        rrb.Grid(*plots, grid_columns=2),
        column_shares=[5, 4],
        name=f"{backbone}: {first} and {second}",
    )


def eye_on(
    points: npt.NDArray[Any], cameras: Sequence[npt.NDArray[np.float64]], up: npt.NDArray[Any] | None
) -> rrb.EyeControls3D:
    """An eye on the points (n, 3), so near that they fill the view; cameras are poses (4, 4), where they are known.

    Where the world's up is known it looks down on them, across their longest extent; else from the cameras' side.
    """
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    middle = (low + high) / 2
    poses = np.array(cameras) if len(cameras) else np.eye(4)[None]
    side = poses[:, :3, 3].mean(axis=0) - middle
    if up is None:
        up = -poses[:, :3, 1].mean(axis=0)  # the images' top
        side = side / max(float(np.linalg.norm(side)), 1e-9) + 0.3 * up
    else:
        flat = (points - middle) - np.outer((points - middle) @ up, up)
        across = np.cross(np.linalg.eigh(flat.T @ flat)[1][:, 2], up)
        side = across * (1 if across @ side > 0 else -1) + up
    side *= EYE_DISTANCE * np.linalg.norm(high - low) / np.linalg.norm(side)
    return rrb.EyeControls3D(position=middle + side, look_target=middle, eye_up=up)
