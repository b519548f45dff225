"""The observer that records a run."""

from __future__ import annotations

import contextlib
import logging
import math
import threading
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.frames import Frame
from semstab.metrics import compensated_flicker
from semstab.pipeline import Observer
from semstab.plan import Plan, Task
from semstab.recording import legend, series
from semstab.recording.camera import IMAGE_SIDE, Camera, drift_context, drift_levels, label_context, stride_of
from semstab.recording.difference import log_difference
from semstab.recording.entities import Clock, path
from semstab.recording.flips import FlipLog
from semstab.recording.layout import Scenery, blueprint, drawn, is_pointwise
from semstab.recording.target import DEFAULT_URL, Target
from semstab.recording.tracker import Tracker
from semstab.recording.voxel_maps import GrowingMap
from semstab.results import GroupResult, RunResult, Unit, UnitSummary
from semstab.run_folder import FrameRow
from semstab.voxels import VoxelTable

SAMPLING = 2
"""In large pictures drift and motion-compensated flicker are looked up for every second pixel of each axis."""

SAMPLE = 20_000
"""Voxels of a scene from which it follows where its maps are seen from."""

ORIGIN_STEP = 1000.0
"""Metres; map origins are multiples of it: a scene near its world's origin keeps its coordinates."""


class Recording(Observer):
    """Writes one recording while the run goes on; a killed run leaves what it recorded until a moment before.

    target  a file, or a `Target`: a file and a viewer
    run     the run folder, from which the recording of a resumed run takes what an earlier start finished

    The file is opened at the first fused frame: a start that finds every group kept leaves an earlier recording alone.
    Call `close` where a run does not come to its end. Raises ConfigError where the file cannot be written.
    """

    def __init__(self, target: str | Path | Target, run: Path | None = None) -> None:
        self.target = target if isinstance(target, Target) else Target(Path(target))
        self._run = run
        self._plan: Plan
        self._tasks: dict[tuple[str, str], Task] = {}
        self._stream: rr.RecordingStream | None = None
        self._clock = Clock()
        self._kept: list[tuple[Task, GroupResult]] = []  # not logged yet
        self._origins: dict[str, npt.NDArray[np.int64]] = {}
        self._cameras: dict[str, Camera] = {}
        self._sceneries: dict[str, Scenery] = {}
        self._group: _Group | None = None  # the backbone on a scene that is being fused

    def run_started(self, plan: Plan) -> None:
        """Keep the plan: layout, names and colours follow from it."""
        self._plan = plan
        self._tasks = {(task.scene.name, task.backbone): task for task in plan.tasks}

    def frame_fused(self, unit: Unit, frame: Frame, row: FrameRow) -> None:
        """Log the unit's row of the time series; with the frame's last unit, what the camera and the map show."""
        stream = self._opened()
        task = self._tasks[unit.scene, unit.backbone]
        self._clock.set(stream, frame.index, frame.timestamp)
        origin = self._origin(stream, task, frame.T_wc[:3, 3])
        if self._group is None or self._group.task is not task:
            self._group = _Group(task, self._plan.config.voxel_size, origin)
        series.log_row(stream, unit, task, row.cells())
        self._group.follow(row)
        if unit.backend == task.backends[-1]:
            self._cameras[unit.scene].log(stream, frame, self._clock)
            self._group.log(stream, frame)

    def unit_finished(self, unit: Unit, table: VoxelTable, summary: UnitSummary) -> None:
        """Log the unit's voxels and final numbers; the time is that of its last frame."""
        stream = self._opened()
        group = self._group
        assert group is not None
        group.set_last_time(stream, self._clock)
        self._log_map(stream, group, unit, table, summary)
        if unit.backend == group.task.backends[-1]:
            group.log_flips(stream, self._clock)
            group.set_last_time(stream, self._clock)

    def group_kept(self, task: Task, result: GroupResult) -> None:
        """Log the units' series and voxels from the run folder: their pictures are not in this recording."""
        self._kept.append((task, result))
        if self._stream is not None:
            self._log_kept(self._stream)

    def run_finished(self, result: RunResult) -> None:
        """Finish the file; where the recording is served, `serve` or `close` does that."""
        if not self.target.file.exists():
            self._opened()
        if self.target.viewer != "serve":
            self.close()

    def serve(self) -> None:
        """Wait for viewers until the user interrupts, where the recording is served; else return at once."""
        if self._stream is None:
            return
        logging.getLogger("semstab").warning("serving at %s until interrupted (Ctrl-C)", DEFAULT_URL)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
        self.close()

    def close(self) -> None:
        """Write out what is pending and close the file; a second call does nothing."""
        stream, self._stream = self._stream, None
        if stream is not None:
            for camera in self._cameras.values():
                camera.close()
                if camera.unread is not None:
                    stream.log(path(camera.scene.name, "log"), rr.TextLog(f"without colour: {camera.unread}"))
            stream.flush()
            stream.disconnect()

    def _opened(self) -> rr.RecordingStream:
        if self._stream is None:
            self._stream = stream = self.target.open()
            _log_static(stream, self._plan)
            stream.send_blueprint(blueprint(self._plan, self._sceneries))
            self._log_kept(stream)
        return self._stream

    def _log_map(
        self, stream: rr.RecordingStream, group: _Group, unit: Unit, table: VoxelTable, summary: UnitSummary
    ) -> None:
        remark = group.log_map(stream, unit, table, self._plan.config.tolerance)
        stream.log(path(unit.scene, "log"), rr.TextLog(_final(summary) + remark))
        if unit.scene not in self._sceneries and len(table):
            some = table.index[:: math.ceil(len(table) / SAMPLE)]
            poses = np.reshape(self._cameras[unit.scene].poses, (-1, 4, 4))
            points = ((some - group.origin + 0.5) * table.voxel_size).astype(np.float64)
            self._sceneries[unit.scene] = Scenery(points, poses, group.task.scene.up)
            stream.send_blueprint(
                blueprint(self._plan, self._sceneries), make_default=True, make_active=not self.target.live
            )

    def _log_kept(self, stream: rr.RecordingStream) -> None:
        kept, self._kept = self._kept, []
        for task, result in kept:
            group: _Group | None = None
            for summary in result.runs:
                self._clock.set(stream, task.indices[-1])
                if self._run is None:
                    text = (
                        f"{_final(summary)}; finished by an earlier start, series and voxels are not in this recording"
                    )
                    stream.log(path(task.scene.name, "log"), rr.TextLog(text))
                    continue
                unit = summary.unit
                table = VoxelTable.load(self._run / "voxels" / f"{unit.slug}.parquet")
                if group is None:
                    at = table.centers.mean(axis=0)
                    group = _Group(task, table.voxel_size, self._origin(stream, task, at))
                series.send_rows(stream, unit, task, self._run / "frames" / f"{unit.slug}.csv", self._clock)
                self._clock.set(stream, task.indices[-1])
                self._log_map(stream, group, unit, table, summary)

    def _origin(self, stream: rr.RecordingStream, task: Task, position: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """The scene's map origin, in voxels: settled near the first position that is known, and said."""
        scene, voxel_size = task.scene.name, self._plan.config.voxel_size
        if scene in self._origins:
            return self._origins[scene]
        steps = np.round(position / ORIGIN_STEP).astype(np.int64)
        self._origins[scene] = origin = steps * round(ORIGIN_STEP / voxel_size)
        self._cameras[scene] = Camera(task.scene, origin * voxel_size)
        if steps.any():
            where = ", ".join(f"{name} = {value:.3f} m" for name, value in zip("xyz", origin * voxel_size, strict=True))
            stream.log(path(scene, "log"), rr.TextLog(f"map coordinates are relative to {where} of the scene's world"))
        return origin


class _Group:
    """What is recorded of one backbone on a scene."""

    def __init__(self, task: Task, voxel_size: float, origin: npt.NDArray[np.int64]) -> None:
        self.task = task
        self.origin = origin
        self._classes = task.mapping.target
        self._translation = origin * voxel_size
        self._tracker = Tracker(voxel_size, len(self._classes))
        self._followed = False  # the frame went into a map of the run that the tracker follows
        self._flips = FlipLog()
        self._maps: dict[str, GrowingMap] = {}
        self._tables: dict[str, VoxelTable] = {}
        self._previous: Frame | None = None
        self._entity = path(task.scene.name, "camera", task.backbone)
        self._last: tuple[int, float | None] = (task.indices[-1], None)

    def follow(self, row: FrameRow) -> None:
        """A unit of the group fused the frame."""
        self._followed = self._tracker.follow(row.report) or self._followed

    def log(self, stream: rr.RecordingStream, frame: Frame) -> None:
        """All units of the group fused the frame: log what it shows and what it changed."""
        if not self._followed:
            self._tracker.integrate(frame)
        self._tracker.note()
        self._followed = False
        self._last = frame.index, frame.timestamp
        stride = stride_of(frame.shape)
        self._log_pictures(stream, frame, stride)
        self._log_flicker(stream, frame, stride)
        self._flips.update(self._tracker, frame)
        if is_pointwise(drawn(self.task)):
            self._map(drawn(self.task)).update(stream, self._tracker.map)
        self._previous = frame

    def log_map(self, stream: rr.RecordingStream, unit: Unit, table: VoxelTable, tolerance: float) -> str:
        """Log a unit's final voxels, and where they differ from those of the drawn unit; say how they were thinned."""
        first = drawn(self.task)
        self._tables[unit.backend] = table
        if first in self._tables:
            for backend in self._tables if unit.backend == first else [unit.backend]:
                self._compare(stream, first, backend, tolerance)
        return self._map(unit.backend).finish(stream, table)

    def log_flips(self, stream: rr.RecordingStream, clock: Clock) -> None:
        """Log which frames changed the voxels that drifted most."""
        suspects = list(self._flips.suspects(self._tracker))
        self._flips.log(
            stream, self.task.scene.name, self.task.backbone, suspects, self._classes, self._translation, clock
        )

    def set_last_time(self, stream: rr.RecordingStream, clock: Clock) -> None:
        """What is logged from now on belongs to the last frame."""
        clock.set(stream, *self._last)

    def _compare(self, stream: rr.RecordingStream, first: str, second: str, tolerance: float) -> None:
        if first == second:
            return
        scene, backbone = self.task.scene.name, self.task.backbone
        entity = path(scene, "difference", backbone, f"{first} and {second}")
        tables = {name: self._tables[name] for name in (first, second)}
        found = log_difference(stream, entity, tables, self.origin, tolerance)
        stream.log(path(scene, "log"), rr.TextLog(f"{backbone}: {found}"))
        report = rr.TextDocument(f"{found}.", media_type=rr.MediaType.MARKDOWN)
        stream.log(path(scene, "difference_report", backbone, f"{first} and {second}"), report, static=True)

    def _log_pictures(self, stream: rr.RecordingStream, frame: Frame, stride: int) -> None:
        labels: Any = np.ascontiguousarray(frame.predicted[::stride, ::stride])
        stream.log(f"{self._entity}/labels", rr.SegmentationImage(labels, draw_order=-10))
        step = _sampling(labels.shape)
        drift = drift_levels(*self._tracker.drift_at(frame, step * stride))
        drift = drift.repeat(step, axis=0).repeat(step, axis=1)[: labels.shape[0], : labels.shape[1]]
        stream.log(f"{self._entity}/drift", rr.SegmentationImage(drift, draw_order=-10))

    def _log_flicker(self, stream: rr.RecordingStream, frame: Frame, stride: int) -> None:
        """Motion-compensated flicker: of a sample of the frame's pixels, looked up in the whole frame before."""
        if self._previous is None:
            return
        sample = frame.every(stride)
        flicker = compensated_flicker(self._previous, sample.every(_sampling(sample.shape))).flicker_percent
        if math.isfinite(flicker):
            unit = self.task.units[0]
            stream.log(series.entity("compensated_flicker", unit), rr.Scalars(flicker))

    def _map(self, backend: str) -> GrowingMap:
        if backend not in self._maps:
            entity = path(self.task.scene.name, "map", self.task.backbone, backend)
            self._maps[backend] = GrowingMap(entity, self._classes, self.origin, len(self.task.indices))
        return self._maps[backend]


def _sampling(shape: tuple[int, ...]) -> int:
    """Every how many pixels a picture of that shape is sampled."""
    return SAMPLING if max(shape) > IMAGE_SIDE // SAMPLING else 1


def _log_static(stream: rr.RecordingStream, plan: Plan) -> None:
    for scene, task in {task.scene.name: task for task in plan.tasks}.items():
        if (up := task.scene.up) is not None:  # the axis of the world that is nearest to it
            axis = int(np.abs(up).argmax())
            name = f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}"
            stream.log(path(scene), getattr(rr.ViewCoordinates, name), static=True)
        legend.log_legend(stream, path(scene, "legend"), task.mapping.target)
    for task in plan.tasks:
        entity = path(task.scene.name, "camera", task.backbone)
        stream.log(f"{entity}/labels", label_context(task.mapping.target), static=True)
        stream.log(f"{entity}/drift", drift_context(), static=True)
    series.log_styles(stream, plan)


def _final(summary: UnitSummary) -> str:
    unit, table = summary.unit, summary.table
    return (
        f"{unit.backbone}, {unit.backend}: {table.voxels:,} voxels, mean OP {table.mean_op:.2f}, VSS {table.vss:.3f},"
        f" SBD {table.sbd:.4f} bits, H {table.entropy:.4f} (K = {table.K})"
    )
