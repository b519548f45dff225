"""How the viewer opens a recording, without a click: maps left, camera right, series below, a tab for each scene."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from semstab.backends import REGISTRY
from semstab.core.types import Float64
from semstab.engine.units import Plan
from semstab.model.labels import Color, LabelSpace
from semstab.model.measures import ENTROPY, VSS
from semstab.model.results import RECURRENT, Unit
from semstab.recording import drift
from semstab.recording.timeline import SERIES, entity, path
from semstab.recording.voxel_maps import DIFFERENCE, chunk, color_modes, defaults, visualizer
from semstab.task import Task

# The camera pose from which a map fills its view.

FIELD_OF_VIEW = math.radians(55)
"""Of the viewer's eyes, from bottom to top."""

MARGIN = 0.96
"""Of a view's half height and half width, what is seen in it."""

OUTLIERS = 0.005
"""Share of a map's voxels that may lie beyond each edge of its view."""

BACKGROUND = (72, 72, 78)
"""Of the maps: neither end of the colour maps vanishes in it."""


@dataclass(frozen=True, eq=False)
class SceneBounds:
    """What a scene's maps show, from which follows where they are seen from.

    points   (n, 3) metres, of the voxels or a sample of them
    cameras  (m, 4, 4) poses in the same world
    up       (3,), where it is known
    """

    points: Float64
    cameras: Float64
    up: Float64 | None


def camera_pose(bounds: SceneBounds | None, aspect: float) -> rrb.EyeControls3D | None:
    """From where a view of that width by height shows it; None where the viewer chooses."""
    if bounds is None:
        return None
    target, distance = fit(bounds, aspect)
    toward, up = direction(bounds)
    return rrb.EyeControls3D(position=target + distance * toward, look_target=target, eye_up=up)


def direction(bounds: SceneBounds) -> tuple[Float64, Float64]:
    """Unit vectors from a bounds to the eye, and up.

    Where the world's up is known it looks down on the points, across their longest extent; else from the cameras' side.
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
        toward = across * (1 if across @ side > 0 else -1) + up
    return toward / np.linalg.norm(toward), up / np.linalg.norm(up)


@functools.lru_cache(maxsize=256)
def fit(bounds: SceneBounds, aspect: float) -> tuple[Float64, float]:
    """Where an eye looks, and from how far, for a view of that width by height to be full of points and cameras.

    With the depth z of a point towards the eye, and its place (x, y) across, the view holds it where
    |x - x0| <= aspect * h * (d - z) and |y - y0| <= h * (d - z), h the tangent of half the field of view: so the edges
    of x - aspect * h * z and x + aspect * h * z say what d has to be, and likewise those of y.
    """
    toward, up = direction(bounds)
    right = np.cross(up, toward)
    right /= np.linalg.norm(right)
    across = np.stack([right, np.cross(toward, right)])
    half = MARGIN * math.tan(FIELD_OF_VIEW / 2) * np.array([aspect, 1.0])

    def edges(places: Float64, trimmed: float) -> tuple[Any, Any]:
        at, near = places @ across.T, np.outer(places @ toward, half)
        return np.quantile(at - near, trimmed, axis=0), np.quantile(at + near, 1 - trimmed, axis=0)

    low, high = edges(bounds.points, OUTLIERS)
    if len(bounds.cameras):
        first, last = edges(bounds.cameras[:, :3, 3], 0.0)
        low, high = np.minimum(low, first), np.maximum(high, last)
    distance = float(((high - low) / (2 * half)).max())
    middle = float(np.median(bounds.points @ toward))
    return (low + high) / 2 @ across + middle * toward, distance - middle


# The classes of a scene's maps and their colours, laid out like words on lines.

WIDTH, LINE = 780.0, 24.0
"""Of the legend and of one of its lines, in points of a window of 1500."""

LETTER, DOT, GAP = 7.0, 20.0, 34.0
"""Width of a letter, of a dot, and of what is around a name and between it and the next."""

LABEL = -13.5
"""The viewer draws a label below its point: from the middle of the label to its point."""

LINES = 2
"""Of the legend that is always seen; what it leaves out is in a tab."""

Entry = tuple[str, Color]


class Legend:
    """Names and colours of a scene's classes: those of its maps, and in a tab all that a frame may show."""

    def __init__(self, spaces: Iterable[LabelSpace]) -> None:
        self._voxels: dict[Entry, int] = {
            entry: 0 for space in spaces for entry in zip(space.classes, space.colors, strict=True)
        }

    def see(self, classes: LabelSpace, label: npt.NDArray[np.integer]) -> None:
        """A finished map has voxels of these dominant classes."""
        voxels = np.bincount(label, minlength=len(classes)).tolist()
        for entry, n in zip(zip(classes.classes, classes.colors, strict=True), voxels, strict=True):
            self._voxels[entry] += n

    @property
    def entries(self) -> list[Entry]:
        """All, those with the most voxels first."""
        return sorted(self._voxels, key=lambda entry: -self._voxels[entry])

    @property
    def used(self) -> list[Entry]:
        """Those that the maps show; all, while no map is finished."""
        return [entry for entry in self.entries if self._voxels[entry]] or self.entries

    @property
    def shown(self) -> int:
        """How many of these the legend that is always seen has room for."""
        names = [name for name, _ in self.used]
        if _lines(names) <= LINES:
            return len(names)
        return max((n for n in range(len(names)) if _lines([*names[:n], _rest(len(names) - n)]) <= LINES), default=0)

    @property
    def is_whole(self) -> bool:
        """Whether it has all classes."""
        return self.shown == len(self.entries)

    def size(self, *, whole: bool) -> tuple[float, float]:
        """Width and height of the legend that is always seen, or of that of all classes."""
        lines = _lines([name for name, _ in (self.entries if whole else self.used)])
        return WIDTH, LINE * (lines if whole else min(lines, LINES))

    def log(self, stream: rr.RecordingStream, entity: str, all_classes: str) -> None:
        """Both legends, each below an entity of its own."""
        used, shown = self.used, self.shown
        _log(stream, all_classes, self.entries)
        _log(stream, entity, used[:shown], _rest(len(used) - shown) if shown < len(used) else "")


def _rest(classes: int) -> str:
    return f"and {classes} more: tab All classes"


def _log(stream: rr.RecordingStream, entity: str, entries: Sequence[Entry], rest: str = "") -> None:
    """Dots in the classes' colours, and their names in white: a label has its point's colour, which may be dark."""
    names = [*(name for name, _ in entries), *([rest] if rest else [])]
    at = _places(names)
    middle = DOT + LETTER / 2 * np.array([len(name) for name in names])
    beside = at + np.stack([middle, np.full(len(at), LABEL)], axis=1)
    dots = rr.Points2D(at[: len(entries)], colors=[color for _, color in entries], radii=rr.Radius.ui_points(5.0))
    words = rr.Points2D(beside, colors=(255, 255, 255), labels=names, radii=0.0, show_labels=True)
    stream.log(entity, dots, static=True)
    stream.log(f"{entity}/names", words, static=True)


def _lines(names: Sequence[str]) -> int:
    return round(float(_places(names)[:, 1].max()) / LINE + 0.5)


def _places(names: Sequence[str]) -> Float64:
    """(n, 2) where the dots are; a name is right of its dot."""
    left, line = 0.0, 0
    at = []
    for name in names:
        width = DOT + LETTER * len(name) + GAP
        if left + width > WIDTH and left > 0:
            left, line = 0.0, line + 1
        at.append((left + DOT / 2, (line + 0.5) * LINE))
        left += width
    return np.array(at)


# The views.

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
class Shown:
    """What the layout of a scene depends on.

    chunks  of how many chunks of a map the views say how they are coloured
    bounds  where its maps are seen from; else the viewer chooses
    spans   by backbone, the lowest and highest value of each of COMPARED in all backends
    """

    legend: Legend
    chunks: int
    bounds: SceneBounds | None = None
    spans: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)


def blueprint(plan: Plan, shown: Mapping[str, Shown]) -> rrb.Blueprint:
    """Return the layout of a plan, with what is known of its scenes so far."""
    by_scene = itertools.groupby(plan.tasks, key=lambda task: task.scene.name)
    scenes = [_scene(scene, list(tasks), shown[scene]) for scene, tasks in by_scene]
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


def _scene(scene: str, tasks: list[Task], shown: Shown) -> rrb.Container:
    flips = [_flips(scene, task) for task in tasks]
    comparisons = [_comparison(task, *pair, shown) for task in tasks for pair in compared(task)]
    overview = _overview(scene, tasks, shown)
    return rrb.Tabs(overview, *flips, *comparisons, name=scene)


def _overview(scene: str, tasks: list[Task], shown: Shown) -> rrb.Container:
    legend, bounds, chunks = shown.legend, shown.bounds, shown.chunks
    _, height = legend.size(whole=False)
    area = LEFT[0], LEFT[1] - TITLE - (height + TITLE)
    all_classes = [] if legend.is_whole else [_legend(scene, "all_classes", "All classes", legend.size(whole=True))]
    maps = rrb.Tabs(*(_maps(name, tasks, bounds, area, chunks) for name in color_modes()), *all_classes)
    classes = _legend(scene, "legend", "Classes", legend.size(whole=False))
    left = rrb.Vertical(maps, classes, row_shares=[LEFT[1] - height - TITLE, height + TITLE])
    levels = rrb.VisualBounds2D(x_range=drift.LEGEND[0], y_range=drift.LEGEND[1])
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
    """The voxels that drifted most and their top contributing frames, next to the camera."""
    lanes = rrb.StateTimelineView(
        origin=path(scene, "flips", task.backbone), name="Dominant class of the voxels that drifted most"
    )
    frames = rrb.TextDocumentView(origin=path(scene, "flips_report", task.backbone), name="Top contributing frames")
    left = rrb.Vertical(lanes, frames)
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
    name: str, tasks: list[Task], bounds: SceneBounds | None, area: tuple[float, float], chunks: int
) -> rrb.Container:
    columns, aspect = _arrangement(len(tasks), bounds, area)
    mode, colored = color_modes()[name], 0 if name == "class" else chunks
    views = [_map(f"{task.backbone}: {mode.title}", task, drawn(task), bounds, aspect, name, colored) for task in tasks]
    if len(views) > MOST_BESIDE:
        return rrb.Tabs(*views, name=mode.tab)
    return rrb.Grid(*views, grid_columns=columns, name=mode.tab)


def _arrangement(views: int, bounds: SceneBounds | None, area: tuple[float, float]) -> tuple[int, float]:
    """In how many columns so many views of a bounds show it largest, and how much wider than high each one is."""
    if views > MOST_BESIDE:
        return 1, area[0] / (area[1] - 2 * TITLE)
    cells = {}
    for columns in range(1, views + 1):
        height = area[1] / math.ceil(views / columns) - TITLE
        aspect = area[0] / columns / height
        scale = height if bounds is None else height / fit(bounds, aspect)[1]
        cells[columns] = scale, aspect
    best = max(cells, key=lambda columns: cells[columns][0])
    return best, cells[best][1]


def _map(
    title: str,
    task: Task,
    backend: str,
    bounds: SceneBounds | None,
    aspect: float,
    name: str = "class",
    chunks: int = 0,
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
        eye_controls=camera_pose(bounds, aspect),
    )


def _comparison(task: Task, first: str, second: str, shown: Shown) -> rrb.Container:
    """Two backends: their maps and where these differ, and the same series side by side, in the same range."""
    scene, backbone = task.scene.name, task.backbone
    bounds, spans = shown.bounds, shown.spans.get(backbone, {})
    pair = f"{first} and {second}"
    difference = rrb.Spatial3DView(
        origin=path(scene),
        contents=[path(scene, "difference", backbone, pair, part) for part in DIFFERENCE],
        name=f"Where they differ: orange in {first} only, blue in {second} only, else |VSS difference| (0 to 0.5)",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=camera_pose(bounds, DIFFERENCE_ASPECT),
    )
    report = rrb.TextDocumentView(origin=path(scene, "difference_report", backbone, pair), name="Difference")
    maps = rrb.Horizontal(
        _map(f"{first}: dominant class", task, first, bounds, COMPARED_ASPECT),
        _map(f"{second}: dominant class, at the end", task, second, bounds, COMPARED_ASPECT),
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
        rrb.Vertical(report, difference, maps, row_shares=[1, 5, 4]),
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
