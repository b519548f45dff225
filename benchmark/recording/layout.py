"""Build the viewer's layout of a recording: maps left, camera right, series below, a tab for each scene."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from semstab.core.types import Float64, UInt8
from semstab.data.labels import Color, LabelSpace
from semstab.data.measures import RECURRENT
from semstab.data.results import UnitName
from semstab.data.voxels import VoxelTable
from semstab.engine.units import Plan
from semstab.metrics import CATEGORIES, CATEGORY_COLORS
from semstab.recording.drift import PICTURES
from semstab.recording.target import Target, flush
from semstab.recording.timeline import OF_VIDEOS, SERIES, entity, path
from semstab.recording.voxel_maps import (
    CHUNKS,
    DIFFERENCE,
    MOVED,
    chunk,
    color_modes,
    defaults,
    mode_of,
    packed,
    thinned,
    visualizer,
)
from semstab.task import Task

# A view shows a map from the camera pose from which the map fills it.

FIELD_OF_VIEW = math.radians(55)
"""The viewer's field of view, from bottom to top, radians."""

MARGIN = 0.96
"""The share of a view's half height and half width that the map fills."""

OUTLIERS = 0.005
"""The share of a map's voxels that may lie beyond each edge of its view."""

BACKGROUND = (72, 72, 78)
"""The colour behind the maps, in which both ends of the colour maps are visible."""


@dataclass(frozen=True, eq=False)
class SceneBounds:
    """Points and cameras that the views of a scene's maps show.

    Attributes:
        points: (n, 3) metres, of the voxels or a sample of them.
        cameras: (m, 4, 4) poses in the same world.
        up: (3,), if it is known.
    """

    points: Float64
    cameras: Float64
    up: Float64 | None


@functools.lru_cache(maxsize=16)  # the maps of a scene share it
def camera_pose(bounds: SceneBounds | None, aspect: float) -> rrb.EyeControls3D | None:
    """Return the pose of a view of a scene, of that width by height; None if the viewer chooses it."""
    if bounds is None:
        return None
    target, distance = fit(bounds, aspect)
    toward, up = direction(bounds)
    return rrb.EyeControls3D(position=target + distance * toward, look_target=target, eye_up=up)


def direction(bounds: SceneBounds) -> tuple[Float64, Float64]:
    """Return unit vectors from a scene to the eye, and up.

    Where the world's up is known, the eye is above the points, across their longest extent; else it is on the cameras'
    side.
    """
    points, cameras, up = bounds.points, bounds.cameras, bounds.up
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    side = (cameras[:, :3, 3] - middle).mean(axis=0) if len(cameras) else np.zeros(3)
    if up is None:
        up = -cameras[:, :3, 1].mean(axis=0) if len(cameras) else np.array([0.0, -1.0, 0.0])  # the images' top
        toward = side / max(float(np.linalg.norm(side)), 1e-9) + 0.3 * up
    else:
        flat = (points - middle) - np.outer((points - middle) @ up, up)
        across = np.cross(np.linalg.eigh(flat.T @ flat)[1][:, 2], up)
        if np.linalg.norm(across) < 1e-9:  # a single column of voxels extends along no side
            across = np.linalg.svd(up[None])[2][1]
        toward = across * (1 if across @ side > 0 else -1) + up
    return toward / np.linalg.norm(toward), up / np.linalg.norm(up)


def fit(bounds: SceneBounds, aspect: float) -> tuple[Float64, float]:
    """Return the target of an eye, and its distance, at which points and cameras fill a view of that width by height.

    A point has the depth z towards the eye and the position (x, y) across; h is the tangent of half the field of view.
    The view holds the point if |x - x0| <= aspect * h * (d - z) and |y - y0| <= h * (d - z). So the extremes of
    x - aspect * h * z and x + aspect * h * z give the least d, and the extremes of y -+ h * z do so as well.
    """
    toward, up = direction(bounds)
    right = np.cross(up, toward)
    right /= np.linalg.norm(right)
    across = np.stack([right, np.cross(toward, right)])
    half = MARGIN * math.tan(FIELD_OF_VIEW / 2) * np.array([aspect, 1.0])

    def edges(points: Float64, trimmed: float) -> tuple[Any, Any]:
        projected, near = points @ across.T, np.outer(points @ toward, half)
        return np.quantile(projected - near, trimmed, axis=0), np.quantile(projected + near, 1 - trimmed, axis=0)

    low, high = edges(bounds.points, OUTLIERS)
    if len(bounds.cameras):
        first, last = edges(bounds.cameras[:, :3, 3], 0.0)
        low, high = np.minimum(low, first), np.maximum(high, last)
    distance = float(((high - low) / (2 * half)).max())
    middle = float(np.median(bounds.points @ toward))
    return (low + high) / 2 @ across + middle * toward, distance - middle


# The legend shows the classes of a scene's maps and their colours, in a grid.

WIDTH, LINE, LETTER = 780.0, 24.0, 7.0
"""The width of the legend, the height of a line and the width of a letter, in points of a window of 1500."""

DOT, GAP = 20.0, 34.0
"""The widths of a dot and of the space around a name."""

LABEL = -13.5
"""The offset from the middle of a label to its point: the viewer draws a label below its point."""

LINES = 2
"""The lines of the legend that is always visible; all classes are in a tab."""


class Legend:
    """The names and colours of a scene's classes, those with the most voxels first."""

    def __init__(self, spaces: Iterable[LabelSpace]) -> None:
        spaces = list(spaces)
        self._voxels = {entry: 0 for space in spaces for entry in zip(space.classes, space.colors, strict=True)}
        longest = max(len(name) for name, _ in self._voxels)
        self._columns = max(1, int(WIDTH / (DOT + GAP + LETTER * longest)))

    def see(self, classes: LabelSpace, label: npt.NDArray[np.integer]) -> None:
        """Count the voxels (n,) of a finished map by dominant class."""
        voxels = np.bincount(label, minlength=len(classes)).tolist()
        for entry, n in zip(zip(classes.classes, classes.colors, strict=True), voxels, strict=True):
            self._voxels[entry] += n

    @property
    def entries(self) -> list[tuple[str, Color]]:
        """Return all names and colours."""
        return sorted(self._voxels, key=lambda entry: -self._voxels[entry])

    @property
    def room(self) -> int:
        """Return how many classes the legend that is always visible can hold."""
        return LINES * self._columns

    def height(self, lines: int | None = None) -> float:
        """Return the height of that many lines at most, of all if not given."""
        needed = math.ceil(len(self._voxels) / self._columns)
        return LINE * (needed if lines is None else min(needed, lines))

    def log(self, stream: rr.RecordingStream, scene: str) -> None:
        """Log the classes."""
        log_names(stream, path(scene, "legend"), self.entries[: self.room], self._columns)
        log_names(stream, path(scene, "all_classes"), self.entries, self._columns)


def log_categories(stream: rr.RecordingStream, scene: str) -> None:
    """Log the names of the stability categories, the stable one first."""
    entries = list(zip(CATEGORIES, CATEGORY_COLORS, strict=True))[::-1]
    log_names(stream, path(scene, "categories"), entries, len(entries))


def log_names(stream: rr.RecordingStream, entity: str, entries: Sequence[tuple[str, Color]], columns: int) -> None:
    """Log dots in the colours of names, in a grid, and the names in white, as a label has its point's colour."""
    names, colors = zip(*entries, strict=True)
    k = np.arange(len(entries))
    positions = np.stack([k % columns * WIDTH / columns + DOT / 2, (k // columns + 0.5) * LINE], axis=1)
    middle = DOT + LETTER / 2 * np.array([len(name) for name in names])
    right_of = positions + np.stack([middle, np.full(len(entries), LABEL)], axis=1)
    dots = rr.Points2D(positions, colors=colors, radii=rr.Radius.ui_points(5.0))
    words = rr.Points2D(right_of, colors=(255, 255, 255), labels=names, radii=0.0, show_labels=True)
    stream.log(entity, dots, static=True)
    stream.log(f"{entity}/names", words, static=True)


# The views.

VERDICT = "verdict"
"""The entity of a scene that holds the answer of the run."""

# The sizes are for a window of 1500 x 850 points, as on laptops; other windows have similar proportions.
LEFT, TITLE = (808, 538), 27
"""The width and height of the left part, and the height of a view's title or of a row of tabs."""
DIFFERENCE_ASPECT, COMPARED_ASPECT, CHANGE_ASPECT, FLIPS_ASPECT = 2.2, 1.6, 1.2, 1.2

SIDE_BY_SIDE = 4
"""The most maps and cameras that are shown at once; more have a tab each."""

OPENED = "category"
"""The colouring of the maps that the viewer opens on."""

OVERVIEW = ("drift", "compensated_flicker_percent", "map_vss_all", "map_recurrent")
COMPARED = ("drift", "map_vss_all", "map_entropy_all", "map_recurrent", "new_voxels", "fuse_ms")
"""The series of two backends that are shown in one plot."""


def blueprint(
    plan: Plan,
    legends: Mapping[str, Legend],
    bounds: Mapping[str, SceneBounds | None],
    not_assessed: Set[tuple[str, str]] = frozenset(),
    with_movers: Set[tuple[str, str]] = frozenset(),
) -> rrb.Blueprint:
    """Return the layout of a plan, with the legends and bounds of its scenes so far.

    `not_assessed` has scenes and models whose maps' categories say nothing, `with_movers` those in whose maps something
    moved.
    """
    by_scene = itertools.groupby(plan.tasks, key=lambda task: task.scene.name)
    scenes = [
        _scene(scene, list(tasks), legends[scene], bounds[scene], not_assessed, with_movers)
        for scene, tasks in by_scene
    ]
    return rrb.Blueprint(
        rrb.Tabs(*scenes) if len(scenes) > 1 else scenes[0],
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),  # the whole map is at the end
    )


def drawn(task: Task) -> str:
    """Return the backend whose map is drawn while it grows: the first that must agree with the others."""
    agreeing = [name for name in task.backends if name not in task.apart]
    return (agreeing or list(task.backends))[0]


def view_3d(
    scene: str, contents: list[str], name: str, bounds: SceneBounds | None, aspect: float, **coloring: Any
) -> rrb.Spatial3DView:
    """Return a view of a scene whose bounds fill that width by height."""
    return rrb.Spatial3DView(
        origin=path(scene), contents=contents, name=name, background=BACKGROUND, line_grid=False,
        eye_controls=camera_pose(bounds, aspect), **coloring,
    )  # fmt: skip


def _scene(
    scene: str,
    tasks: list[Task],
    legend: Legend,
    bounds: SceneBounds | None,
    not_assessed: Set[tuple[str, str]],
    with_movers: Set[tuple[str, str]],
) -> rrb.Container:
    if not tasks[0].scene.posed:
        return _video(scene, tasks)
    flips = [_flips(scene, task, bounds) for task in tasks]
    comparisons = [
        _comparison(task, drawn(task), other, bounds)
        for task in tasks
        for other in task.backends
        if other != drawn(task)
    ]
    return rrb.Tabs(
        _overview(scene, tasks, legend, bounds, not_assessed, with_movers), *flips, *comparisons, name=scene
    )


def _video(scene: str, tasks: list[Task]) -> rrb.Container:
    """Return a video: the image and the label maps above, the answer and the series below."""
    camera = path(scene, "camera")
    views: list[rrb.View] = [rrb.Spatial2DView(origin=camera, contents=[f"{camera}/color"], name="Image")]
    views += [_labels(scene, task) for task in tasks]
    verdict = rrb.TextDocumentView(origin=path(scene, VERDICT), name="Answer")
    plots = [_plot(scene, name, tasks) for name in OF_VIDEOS if not name.endswith("_ms")]
    return rrb.Vertical(rrb.Grid(*views), rrb.Horizontal(verdict, *plots), name=scene, row_shares=[3, 2])


def _overview(
    scene: str,
    tasks: list[Task],
    legend: Legend,
    bounds: SceneBounds | None,
    not_assessed: Set[tuple[str, str]],
    with_movers: Set[tuple[str, str]],
) -> rrb.Container:
    below = legend.height(LINES) + TITLE
    height = LEFT[1] - TITLE - below
    tabs: list[rrb.Container | rrb.View] = [_maps(name, tasks, bounds, height, not_assessed) for name in color_modes()]
    if moved := [task for task in tasks if (scene, task.model) in with_movers]:
        tabs.append(_maps(MOVED, moved, bounds, height, not_assessed))
    opened = [*color_modes()].index(OPENED)
    if len(legend.entries) > legend.room:
        tabs.append(_legend(scene, "all_classes", "All classes", legend.height()))
    classes = _legend(scene, "legend", "Classes", legend.height(LINES))
    left = rrb.Vertical(rrb.Tabs(*tabs, active_tab=opened), classes, row_shares=[LEFT[1] - below, below])
    pictures: list[rrb.Container | rrb.View] = [_cameras(scene, tasks, picture) for picture in PICTURES]
    if not tasks[0].scene.of_scans:
        pictures.append(rrb.Spatial2DView(origin=path(scene, "depth"), name="Depth"))
    right = rrb.Tabs(*pictures)
    top = rrb.Horizontal(left, right, column_shares=[5, 4])
    return rrb.Vertical(top, _below(scene, tasks), row_shares=[5, 2], name="Overview")


def _legend(scene: str, entity: str, name: str, height: float) -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=(0, WIDTH), y_range=(0, height))
    return rrb.Spatial2DView(origin=path(scene, entity), name=name, visual_bounds=bounds)


def _maps(
    name: str,
    tasks: list[Task],
    bounds: SceneBounds | None,
    height: float,
    not_assessed: Set[tuple[str, str]],
) -> rrb.Container:
    """Return the maps of all models, coloured by a measure."""

    def title(task: Task) -> str:
        silent = name == OPENED and (scene, task.model) in not_assessed
        return f"{task.model}: {'not assessed (uninformative)' if silent else mode.title}"

    mode, scene = mode_of(name), tasks[0].scene.name
    height -= (LINE + TITLE) * (name == OPENED)
    in_tabs = len(tasks) > SIDE_BY_SIDE
    columns = 1 if in_tabs else 2 if len(tasks) == SIDE_BY_SIDE else len(tasks)
    rows = 1 if in_tabs else math.ceil(len(tasks) / columns)
    aspect = LEFT[0] / columns / ((height - TITLE * in_tabs) / rows - TITLE)
    views = [_map(title(task), task, drawn(task), bounds, aspect, name) for task in tasks]
    if name != OPENED:
        return rrb.Tabs(*views, name=mode.tab) if in_tabs else rrb.Grid(*views, grid_columns=columns, name=mode.tab)
    maps = rrb.Tabs(*views) if in_tabs else rrb.Grid(*views, grid_columns=columns)
    legend = _legend(scene, "categories", f"Category (low persistence: OP < {RECURRENT})", LINE)
    return rrb.Vertical(maps, legend, row_shares=[height, LINE + TITLE], name=mode.tab)


def _map(
    title: str, task: Task, backend: str, bounds: SceneBounds | None, aspect: float, name: str = "class",
    over: Sequence[str] = (),
) -> rrb.Spatial3DView:  # fmt: skip
    """Return a backend's map, with more of the model over it; a view that is not coloured by class overrides colours.

    The overrides are those of each chunk.
    """
    scene = task.scene.name
    entity = path(scene, "map", task.model, backend)
    around = [path(scene, "camera"), path(scene, "trajectory"), *(path(scene, part, task.model) for part in over)]
    chunks = [] if name == "class" else [chunk(entity, number) for number in range(CHUNKS)]
    coloring = {"defaults": defaults(name), "overrides": dict.fromkeys(chunks, visualizer(name))}
    return view_3d(scene, [f"{entity}/**", *around], title, bounds, aspect, **coloring)


def _cameras(scene: str, tasks: list[Task], picture: str) -> rrb.Container:
    """Return the labels of each model next to a picture of the frame."""
    rows = [rrb.Horizontal(*_camera(scene, task, picture, []), name=task.model) for task in tasks]
    return (rrb.Vertical if len(rows) < SIDE_BY_SIDE else rrb.Tabs)(*rows, name=picture.capitalize())


def _camera(scene: str, task: Task, picture: str, over: list[str]) -> list[rrb.View]:
    origin, color = path(scene, "camera"), path(scene, "camera", "color")
    labels, picture_path = (path(scene, "camera", task.model, name) for name in ("labels", picture))
    if task.scene.of_scans:
        titles = {labels: f"{task.model}: labels of the scan", picture_path: f"{task.model}: {PICTURES[picture]}"}
        return [
            rrb.Spatial3DView(origin=origin, contents=[f"{entity}/points"], background=BACKGROUND, name=title)
            for entity, title in titles.items()
        ]
    title = f"{task.model}: {PICTURES[picture]}"
    return [
        _labels(scene, task),
        rrb.Spatial2DView(origin=origin, contents=[color, picture_path, *over], name=title),
    ]


def _labels(scene: str, task: Task) -> rrb.View:
    """Return the labels of a model over the image."""
    labels = path(scene, "camera", task.model, "labels")
    seen_through: Any = {labels: rr.SegmentationImage.from_fields(opacity=0.6).visualizer()}
    contents = [path(scene, "camera", "color"), labels]
    return rrb.Spatial2DView(
        origin=path(scene, "camera"), contents=contents, overrides=seen_through, name=f"{task.model}: labels"
    )


def _below(scene: str, tasks: list[Task]) -> rrb.Container:
    more = [name for name in SERIES if name not in OVERVIEW and not name.endswith("_ms")]
    times = [name for name in SERIES if name.endswith("_ms")]
    agreement = [rrb.TextDocumentView(origin=path(scene, "agreement", task.model), name=task.model) for task in tasks]
    series = rrb.Tabs(
        rrb.Horizontal(*(_plot(scene, name, tasks) for name in OVERVIEW), name="Time series"),
        rrb.Horizontal(*agreement, name="Agreement of frames"),
        rrb.Horizontal(*(_plot(scene, name, tasks) for name in more), name="More series"),
        rrb.Horizontal(*(_plot(scene, name, tasks) for name in times), name="Milliseconds"),
        rrb.TextLogView(origin=path(scene, "log"), name="Notes"),
    )
    verdict = rrb.TextDocumentView(origin=path(scene, VERDICT), name="Verdict")
    return rrb.Horizontal(verdict, series, column_shares=[2, 5])


def _plot(scene: str, name: str, tasks: list[Task]) -> rrb.TimeSeriesView:
    """Return a series of all models; backends that must agree share one line, except for their times."""
    lines = [
        entity(name, UnitName(scene, task.model, backend))
        for task in tasks
        for backend in task.backends
        if name.endswith("_ms") or backend == drawn(task) or backend in task.apart
    ]
    legend = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=name in ("map_recurrent", "fuse_ms"))
    return rrb.TimeSeriesView(
        origin=path(scene, "series", name),
        contents=list(dict.fromkeys(lines)),
        name=(SERIES | OF_VIDEOS)[name].plot,
        plot_legend=legend,
    )


def _flips(scene: str, task: Task, bounds: SceneBounds | None) -> rrb.Container:
    """Return the voxels that drifted most, numbered in the map and in the camera, and their top contributing frames."""
    lanes = rrb.StateTimelineView(
        origin=path(scene, "flips", task.model), name="Dominant class of the voxels that drifted most"
    )
    frames = rrb.TextDocumentView(origin=path(scene, "flips_report", task.model), name="Top contributing frames")
    pictures = rrb.Vertical(*_camera(scene, task, "drift", [path(scene, "camera", task.model, "flips")]))
    where = _map(f"{task.model}: where they lie", task, drawn(task), bounds, FLIPS_ASPECT, over=["flips_at"])
    left = rrb.Vertical(lanes, rrb.Horizontal(frames, where))
    return rrb.Horizontal(left, pictures, column_shares=[5, 4], name=f"Flips: {task.model}")


def _comparison(task: Task, first: str, second: str, bounds: SceneBounds | None) -> rrb.Container:
    """Return two backends: their maps, the difference of the maps, and their series in the same plots."""
    scene, model, pair = task.scene.name, task.model, f"{first} and {second}"
    difference = view_3d(
        scene,
        [path(scene, "difference", model, pair, part) for part in DIFFERENCE],
        f"Differences: orange in {first} only, blue in {second} only, else |VSS difference| (0 to 0.5)",
        bounds,
        DIFFERENCE_ASPECT,
    )
    report = rrb.TextDocumentView(origin=path(scene, "difference_report", model, pair), name="Difference")
    maps = rrb.Horizontal(
        _map(f"{first}: dominant class", task, first, bounds, COMPARED_ASPECT),
        _map(f"{second}: dominant class, at the end", task, second, bounds, COMPARED_ASPECT),
    )
    plots = [
        rrb.TimeSeriesView(
            origin=path(scene, "series", name),
            contents=[entity(name, UnitName(scene, model, backend)) for backend in (first, second)],
            name=SERIES[name].plot,
        )
        for name in COMPARED
    ]
    left = rrb.Vertical(report, difference, maps, row_shares=[1, 5, 4])
    right = rrb.Grid(*plots, grid_columns=2)
    return rrb.Horizontal(left, right, column_shares=[5, 4], name=f"{model}: {pair}")


# Changes between two maps: the change of each voxel, and the numbers of the locations that became worse.

WORSE, SAME, BETTER, WHITE = (213, 94, 0), (150, 150, 150), (86, 180, 233), (255, 255, 255)
LEAST = 0.05
"""The least change of a voxel that is drawn as a change."""

CHANGES = {"agreement": "Agreement between frames", "truth": "Right and wrong"}

Change = tuple[str, VoxelTable, npt.NDArray[Any], npt.NDArray[Any] | None, Sequence[tuple[str, str, tuple[float, ...]]]]
"""A title, the voxels, their gains (n,), -1 to 1, in agreement and, with truth, in correctness; and locations: the one
of the two in which they lost, their names and centres."""


def record_changes(
    file: Path,
    changes: Mapping[tuple[str, str], Change],
    up: Mapping[str, tuple[float, float, float]],
    sentences: Sequence[str],
) -> None:
    """Write a recording with a tab for each scene and run, and the sentences next to it."""
    file.unlink(missing_ok=True)
    stream = Target(file).open()
    text = "\n".join(f"- {text}" for text in sentences)
    stream.log("/results", rr.TextDocument(text, media_type="text/markdown"), static=True)
    tabs = [_log_change(stream, *names, change, up.get(names[0])) for names, change in changes.items()]
    results = rrb.TextDocumentView(origin="/results", name="Results")
    content = rrb.Horizontal(rrb.Tabs(*tabs) if len(tabs) > 1 else tabs[0], results, column_shares=[3, 1])
    stream.send_blueprint(rrb.Blueprint(content, collapse_panels=True), make_default=True, make_active=True)
    flush(stream, file)
    stream.disconnect()


def _log_change(
    stream: rr.RecordingStream, scene: str, run: str, change: Change, up: tuple[float, float, float] | None
) -> rrb.Container:
    title, table, agreement, right, locations = change
    origin = np.round(table.index.mean(axis=0)).astype(np.int64) if len(table) else np.zeros(3, np.int64)
    index = table.index.astype(np.int64) - origin
    factor, rows = thinned(index)
    points = ((index[rows] + 0.5) * table.voxel_size).astype(np.float64)
    bounds = SceneBounds(points, np.zeros((0, 4, 4)), None if up is None else np.array(up))
    views = []
    for (name, what), values in zip(CHANGES.items(), (agreement, right), strict=True):
        if values is None:
            continue
        entity = path(scene, "change", run, name)
        changed = np.abs(values[rows]) >= LEAST
        cells = (index[rows][changed] // factor).astype(np.int32)
        colors = packed(_shades(values[rows][changed]))
        stream.log(entity, rr.VoxelGridMap(cells, [table.voxel_size * factor] * 3, colors=colors), static=True)
        rest = rr.Points3D(
            points[~changed], colors=SAME, radii=rr.Radius.ui_points(1.0)
        )  # small points do not hide the others
        stream.log(f"{entity}/same", rest, static=True)
        if labelled_centres := [(label, centre) for where, label, centre in locations if where == name]:
            labels, centres = zip(*labelled_centres, strict=True)
            positions = np.array(centres) - origin * table.voxel_size
            numbers = rr.Points3D(positions, labels=labels, colors=WHITE, radii=rr.Radius.ui_points(4.0))
            stream.log(f"{entity}/locations", numbers, static=True)
        caption = f"{what}: orange worse, blue better, grey points as before"
        views.append(view_3d(scene, [f"{entity}/**"], caption, bounds, CHANGE_ASPECT))
    return rrb.Vertical(*views, name=title)


def _shades(values: npt.NDArray[Any]) -> UInt8:
    """Return colours (n, 3) from orange by grey to blue."""
    share = np.clip(np.abs(values), 0, 1)[:, None]
    end = np.where((values < 0)[:, None], WORSE, BETTER)
    shades: UInt8 = np.round(share * end + (1 - share) * np.array(SAME)).astype(np.uint8)
    return shades
