"""The rerun recording: a run's time series and its final voxels. Only this module imports rerun.

SCENE/series/COLUMN/BACKBONE/BACKEND   Scalars: a column of RUN/frames/*.csv (flicker_percent: no BACKEND)
SCENE/map/BACKBONE/BACKEND/MEASURE     VoxelGridMap: class, vss, sbd, sbd_undefined, entropy, op
SCENE/legend                           Points2D: the classes and their colours
SCENE/log                              TextLog: each unit's final numbers, and what is not drawn as it is
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from semstab.errors import ConfigError
from semstab.frames import Frame
from semstab.labels import LabelSpace
from semstab.metrics import dominant, entropy, op, sbd, vss
from semstab.pipeline import Observer
from semstab.plan import Plan, Task
from semstab.results import RECURRENT, GroupResult, RunResult, Unit, UnitSummary
from semstab.run_folder import FrameRow
from semstab.voxels import VoxelTable

SERIES = {
    "drift": "Mean drift of updates (bits)",
    "flicker_percent": "Flicker (%)",
    "map_vss": "Mean VSS so far (0 to 1)",
    "map_entropy": "Mean entropy so far (0 to 1)",
    "map_recurrent": f"Share OP >= {RECURRENT} so far (0 to 1)",
    "new_voxels": "New voxels",
    "voxels": "Voxels touched",
    "fuse_ms": "Fusion time (ms)",
}
"""The columns of RUN/frames/*.csv that become time series, and the titles of their plots."""

# The largest SBD there is, 0.311 bits: a voxel's second frame sees a class that its first one did not see at all.
SBD_MAX = 1.5 - 0.75 * math.log2(3)
MEASURES = {
    "vss": ("VSS (0 to 1)", rr.components.Colormap.Viridis, (0.0, 1.0)),
    "sbd": (f"SBD (0 to {SBD_MAX:.2f} bits)", rr.components.Colormap.Plasma, (0.0, SBD_MAX)),
    "entropy": ("Entropy (0 to 1)", rr.components.Colormap.Plasma, (0.0, 1.0)),
    "op": ("OP (1 to 10 and more)", rr.components.Colormap.Viridis, (1.0, 10.0)),
}
"""Title, colour map and range of each number per voxel; fixed, so that a colour means the same in every recording."""

MAX_VOXELS = 2_000_000  # drawn of one map; a larger one is thinned
ORIGIN_STEP = 1000.0  # metres; map origins are multiples of it: a scene near its world's origin keeps its coordinates
FIRST_DATE = 1e8  # seconds; timestamps from here on count from 1970 and are shown as dates, smaller ones as durations
# Okabe and Ito's colours without black: distinct with any colour vision, and on the viewer's dark ground.
LINE_COLORS = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167), (213, 94, 0), (0, 114, 178),
)  # fmt: skip
EYE_DISTANCE = 0.55  # in units of the map's diagonal
BACKGROUND = (72, 72, 78)  # of the maps: neither end of the colour maps vanishes in it
LEGEND_COLUMNS = 7


class Recording(Observer):
    """Writes one .rrd file while the run goes on; a killed run leaves what it recorded until a moment before.

    The file is opened at the first fused frame: a start that finds every group kept leaves an earlier recording alone.
    Call `close` where a run does not come to its end. Raises ConfigError where the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._plan: Plan
        self._tasks: dict[tuple[str, str], Task] = {}
        self._stream: rr.RecordingStream | None = None
        self._kept: list[tuple[Task, UnitSummary]] = []  # not logged yet
        self._origins: dict[str, npt.NDArray[np.int64]] = {}
        self._cameras: dict[str, list[npt.NDArray[np.float64]]] = {}  # poses by scene
        self._eyes: dict[str, rrb.EyeControls3D] = {}  # by scene
        self._dated: bool | None = None  # a timeline has one type: the first timestamp decides

    def run_started(self, plan: Plan) -> None:
        """Keep the plan: layout, names and colours follow from it."""
        self._plan = plan
        self._tasks = {(task.scene.name, task.backbone): task for task in plan.tasks}

    def frame_fused(self, unit: Unit, frame: Frame, row: FrameRow) -> None:
        """Log the frame's row of the time series, without what is undefined."""
        stream = self._opened()
        self._set_time(stream, frame.index, frame.timestamp)
        if unit.scene not in self._origins:
            self._log_origin(stream, unit.scene, frame)
        self._cameras.setdefault(unit.scene, []).append(frame.T_wc)
        cells = row.cells()
        for column in _columns(unit, self._tasks[unit.scene, unit.backbone]):
            if cells[column] is not None:
                stream.log(_series_path(column, unit), rr.Scalars(cells[column]))

    def unit_finished(self, unit: Unit, table: VoxelTable, summary: UnitSummary) -> None:
        """Log the unit's voxels and final numbers; the time is still that of its last frame."""
        stream = self._opened()
        factor, index, rows = _thinned(table.index - self._origins[unit.scene])
        classes = self._tasks[unit.scene, unit.backbone].mapping.target
        for name, grid in _grids(table, classes, factor, index, rows):
            stream.log(_path(unit.scene, "map", unit.backbone, unit.backend, name), grid)
        if unit.scene not in self._eyes and len(index):
            cameras = np.array(self._cameras[unit.scene])
            cameras[:, :3, 3] -= self._origins[unit.scene] * table.voxel_size
            up = self._tasks[unit.scene, unit.backbone].scene.up
            self._eyes[unit.scene] = _eye((index + 0.5) * (table.voxel_size * factor), cameras, up)
            stream.send_blueprint(blueprint(self._plan, self._eyes))
        thinned = f"; drawn: one voxel of each block of {factor}x{factor}x{factor}, as large as the block"
        stream.log(_path(unit.scene, "log"), rr.TextLog(_final(summary) + thinned * (factor > 1)))

    def group_kept(self, task: Task, result: GroupResult) -> None:
        """Log the units' final numbers, and that their series and voxels are not in this recording."""
        self._kept.extend((task, summary) for summary in result.runs)
        if self._stream is not None:
            self._log_kept(self._stream)

    def run_finished(self, result: RunResult) -> None:
        """Finish the file."""
        if not self.path.exists():
            self._opened()
        self.close()

    def close(self) -> None:
        """Write out what is pending and close the file; a second call does nothing."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.flush()
            stream.disconnect()

    def _opened(self) -> rr.RecordingStream:
        if self._stream is not None:
            return self._stream
        stream = rr.RecordingStream("semstab")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # In place, not renamed when it is whole: a viewer can follow the run, and a killed run leaves a recording.
            stream.save(self.path)
        except (OSError, RuntimeError) as error:
            raise ConfigError(f"{self.path}: the recording cannot be written ({error})") from error
        stream.set_log_tick_enabled(False)
        stream.set_log_time_enabled(False)
        stream.send_blueprint(blueprint(self._plan, self._eyes))
        _log_static(stream, self._plan)
        self._log_kept(stream)
        self._stream = stream
        return stream

    def _set_time(self, stream: rr.RecordingStream, frame: int, timestamp: float | None = None) -> None:
        stream.reset_time()
        stream.set_time("frame", sequence=frame)
        if timestamp is not None and math.isfinite(timestamp):
            if self._dated is None:
                self._dated = timestamp >= FIRST_DATE
            if self._dated:
                stream.set_time("time", timestamp=timestamp)
            else:
                stream.set_time("time", duration=timestamp)

    def _log_kept(self, stream: rr.RecordingStream) -> None:
        for task, summary in self._kept:
            text = f"{_final(summary)}; finished by an earlier start, series and voxels are not in this recording"
            self._set_time(stream, task.indices[-1])
            stream.log(_path(task.scene.name, "log"), rr.TextLog(text))
        self._kept.clear()

    def _log_origin(self, stream: rr.RecordingStream, scene: str, frame: Frame) -> None:
        """Settle the scene's map origin, in voxels, near the first camera, and say where it is."""
        voxel_size = self._plan.config.voxel_size
        steps = np.round(frame.T_wc[:3, 3] / ORIGIN_STEP).astype(np.int64)
        self._origins[scene] = origin = steps * round(ORIGIN_STEP / voxel_size)
        if steps.any():
            where = ", ".join(f"{name} = {value:.3f} m" for name, value in zip("xyz", origin * voxel_size, strict=True))
            stream.log(_path(scene, "log"), rr.TextLog(f"map coordinates are relative to {where} of the scene's world"))


def blueprint(plan: Plan, eyes: Mapping[str, rrb.EyeControls3D]) -> rrb.Blueprint:
    """How the viewer opens a recording: the maps left, the series right, a tab for each scene.

    eyes holds, by scene, where its maps are seen from; the viewer chooses where there is none.
    """
    groups = itertools.groupby(plan.tasks, key=lambda task: task.scene.name)
    scenes = [_scene_layout(scene, list(tasks), eyes.get(scene)) for scene, tasks in groups]
    return rrb.Blueprint(
        rrb.Tabs(*scenes) if len(scenes) > 1 else scenes[0],
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),  # the voxels are at the end
    )


def _scene_layout(scene: str, tasks: list[Task], eye: rrb.EyeControls3D | None) -> rrb.Container:
    titles = {"class": "Dominant class"} | {name: title for name, (title, _, _) in MEASURES.items()}
    maps = rrb.Tabs(*(_map_views(name, title, tasks, eye) for name, title in titles.items()))
    rows = math.ceil(len(tasks[0].mapping.target) / LEGEND_COLUMNS)
    bounds = rrb.VisualBounds2D(x_range=(-0.5, LEGEND_COLUMNS - 0.5), y_range=(-0.2, 0.5 * rows - 0.1))
    legend = rrb.Spatial2DView(origin=_path(scene, "legend"), name="Classes", visual_bounds=bounds)
    series = [_plot(scene, column) for column in SERIES]
    notes = rrb.TextLogView(origin=_path(scene, "log"), name="Notes")
    left = rrb.Vertical(maps, legend, row_shares=[8, rows])
    right = rrb.Tabs(rrb.Grid(*series, grid_columns=2, name="Time series"), notes)
    return rrb.Horizontal(left, right, column_shares=[5, 4], name=scene)


def _plot(scene: str, column: str) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=column == "map_recurrent")  # there a growing line leaves room
    return rrb.TimeSeriesView(origin=_path(scene, "series", column), name=SERIES[column], plot_legend=legend)


def _map_views(name: str, title: str, tasks: list[Task], eye: rrb.EyeControls3D | None) -> rrb.Container:
    views = [_map_view(name, f"{task.backbone}: {title}", task, eye) for task in tasks]
    if len(views) > 4:
        return rrb.Tabs(*views, name=title)
    return rrb.Grid(*views, grid_columns=1 if len(views) <= 2 else 2, name=title)


def _map_view(name: str, title: str, task: Task, eye: rrb.EyeControls3D | None) -> rrb.Spatial3DView:
    """The first backend's map; the others' maps, which are equal where all is well, are there but hidden."""
    names = ("sbd", "sbd_undefined") if name == "sbd" else (name,)
    paths = [_path(task.scene.name, "map", task.backbone, backend, n) for backend in task.backends for n in names]
    return rrb.Spatial3DView(
        origin=_path(task.scene.name, "map"),
        contents=paths,
        overrides={path: rrb.EntityBehavior(visible=False) for path in paths[len(names) :]},
        name=title,
        background=BACKGROUND,
        line_grid=False,
        eye_controls=eye,
    )


def _eye(points: npt.NDArray[Any], cameras: npt.NDArray[Any], up: npt.NDArray[Any] | None) -> rrb.EyeControls3D:
    """An eye on the points (n, 3), so near that they fill the view; cameras are poses (t, 4, 4).

    Where the world's up is known it looks down on them, across their longest extent; else from the cameras' side.
    """
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    middle = (low + high) / 2
    side = cameras[:, :3, 3].mean(axis=0) - middle
    if up is None:
        up = -cameras[:, :3, 1].mean(axis=0)  # the images' top
        side = side / max(float(np.linalg.norm(side)), 1e-9) + 0.3 * up
    else:
        flat = (points - middle) - np.outer((points - middle) @ up, up)
        across = np.cross(np.linalg.eigh(flat.T @ flat)[1][:, 2], up)
        side = across * (1 if across @ side > 0 else -1) + up
    side *= EYE_DISTANCE * np.linalg.norm(high - low) / np.linalg.norm(side)
    return rrb.EyeControls3D(position=middle + side, look_target=middle, eye_up=up)


def _log_static(stream: rr.RecordingStream, plan: Plan) -> None:
    for scene, task in {task.scene.name: task for task in plan.tasks}.items():
        if (up := task.scene.up) is not None:  # the axis of the world that is nearest to it
            axis = int(np.abs(up).argmax())
            name = f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}"
            stream.log(_path(scene, "map"), getattr(rr.ViewCoordinates, name), static=True)
        _log_legend(stream, _path(scene, "legend"), task.mapping.target)
    units = list(dict.fromkeys((unit.backbone, unit.backend) for task in plan.tasks for unit in task.units))
    for task in plan.tasks:
        for unit in task.units:
            color = LINE_COLORS[units.index((unit.backbone, unit.backend)) % len(LINE_COLORS)]
            # Where backends agree their lines coincide; the viewer draws them by name, so each one is thinner.
            width = 1.5 + 2.5 * sum(backend > unit.backend for backend in task.backends)
            for column in _columns(unit, task):
                name = unit.backbone if column == "flicker_percent" else f"{unit.backbone}, {unit.backend}"
                line = rr.SeriesLines(colors=color, names=name, widths=width)
                stream.log(_series_path(column, unit), line, static=True)


def _log_legend(stream: rr.RecordingStream, path: str, space: LabelSpace) -> None:
    """Dots in the classes' colours, and their names in white: a label has its point's colour, which may be dark."""
    at = np.array([(k % LEGEND_COLUMNS, 0.5 * (k // LEGEND_COLUMNS)) for k in range(len(space))])
    stream.log(path, rr.Points2D(at - (0, 0.06), colors=space.colors, radii=rr.Radius.ui_points(8.0)), static=True)
    names = rr.Points2D(at, colors=(255, 255, 255), labels=space.classes, radii=0.0, show_labels=True)
    stream.log(f"{path}/names", names, static=True)


def _grids(
    table: VoxelTable, classes: LabelSpace, factor: int, index: npt.NDArray[np.int64], rows: npt.NDArray[np.int64]
) -> Iterator[tuple[str, rr.VoxelGridMap]]:
    """The map in its colourings; indices relative to the origin are small, so the viewer's float32 keeps them exact."""

    def grid(at: Any, **look: Any) -> rr.VoxelGridMap:
        return rr.VoxelGridMap(index[at].astype(np.int32), [table.voxel_size * factor] * 3, **look)

    yield "class", grid(..., colors=np.array(classes.colors, dtype=np.uint8)[dominant(table)[rows]])
    measures = {"vss": vss(table), "sbd": sbd(table), "entropy": entropy(table), "op": op(table).astype(np.float64)}
    for name, (_, colormap, value_range) in MEASURES.items():
        value = measures[name][rows].astype(np.float32)
        defined = ~np.isnan(value)
        yield name, grid(defined, values=value[defined], colormap=colormap, value_range=value_range)
        if name == "sbd":  # voxels seen once: in grey, so that no drift yet does not look like no drift
            yield "sbd_undefined", grid(~defined, colors=(150, 150, 150))


def _thinned(index: npt.NDArray[np.int64]) -> tuple[int, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Blocks of factor^3 voxels, few enough to draw: the factor, the blocks, and the row of one voxel in each."""
    factor, blocks, rows = 1, index, np.arange(len(index))
    while len(blocks) > MAX_VOXELS:
        factor, blocks = factor * 2, blocks // 2
        x, y, z = (blocks - blocks.min(axis=0)).T
        _, first = np.unique((x << 42) ^ (y << 21) ^ z, return_index=True)
        blocks, rows = blocks[first], rows[first]
    return factor, blocks, rows


def _final(summary: UnitSummary) -> str:
    unit, table = summary.unit, summary.table
    return (
        f"{unit.backbone}, {unit.backend}: {table.voxels:,} voxels, mean OP {table.mean_op:.2f}, VSS {table.vss:.3f},"
        f" SBD {table.sbd:.4f} bits, H {table.entropy:.4f} (K = {table.K})"
    )


def _columns(unit: Unit, task: Task) -> list[str]:
    """The unit's series: flicker belongs to the backbone, and goes with its first backend."""
    return [column for column in SERIES if column != "flicker_percent" or unit.backend == task.backends[0]]


def _series_path(column: str, unit: Unit) -> str:
    backend = () if column == "flicker_percent" else (unit.backend,)
    return _path(unit.scene, "series", column, unit.backbone, *backend)


def _path(*parts: str) -> str:
    """An entity's path; what a part may not hold is escaped."""
    return "/" + rr.new_entity_path(list(parts))
