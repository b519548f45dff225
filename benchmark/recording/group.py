"""The parts of a recording: a scene with its axes, legend and camera; a backbone with its pictures, maps and flips."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import rerun as rr

from semstab.backends import GrowingMap
from semstab.core.types import Float64, Int64
from semstab.engine.units import Plan
from semstab.metrics import compensated_flicker, dominant
from semstab.model.frames import Frame
from semstab.model.measures import measures
from semstab.model.results import UnitSummary
from semstab.model.voxels import VoxelTable
from semstab.recording import drift, timeline
from semstab.recording.camera import CameraLog, Overlay, coarse_stride, label_context, sampling, stride_of
from semstab.recording.drift import ContributionLog, FrameDrift, Tracker
from semstab.recording.layout import Legend, SceneBounds, Shown, drawn, is_pointwise
from semstab.recording.timeline import Background, Clock, path
from semstab.recording.voxel_maps import CHUNKS, VoxelLogger, agreement_report, chunks_of, log_difference
from semstab.task import Task

FIRST_CHUNKS = 8
"""Chunks of each map that the first layout knows; it is sent again where a map outgrows them."""

SAMPLE = 20_000
"""Voxels of a scene from which its camera pose follows."""

ORIGIN_STEP = 1000.0
"""Metres; map origins are multiples of it: a scene near its world's origin keeps its coordinates."""


class SceneLog:
    """A scene of a plan: where its maps begin, its camera, its legend.

    live  whether a viewer follows the run, which keeps the layout that it got first
    """

    def __init__(self, tasks: list[Task], *, live: bool) -> None:
        self._tasks, self._name = tasks, tasks[0].scene.name
        legend = Legend([task.mapping.target for task in tasks])
        self.shown = Shown(legend, chunks=CHUNKS if live else FIRST_CHUNKS)
        self.camera: CameraLog
        self._origin: Int64 | None = None

    @classmethod
    def of_plan(cls, plan: Plan, *, live: bool) -> dict[str, SceneLog]:
        """Return the scenes of a plan by name."""
        tasks: dict[str, list[Task]] = {}
        for task in plan.tasks:
            tasks.setdefault(task.scene.name, []).append(task)
        return {scene: cls(there, live=live) for scene, there in tasks.items()}

    @property
    def is_open(self) -> bool:
        """Whether something was recorded of it."""
        return self._origin is not None

    @property
    def chunks(self) -> int:
        """Of how many chunks of each map the layout knows."""
        return self.shown.chunks

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Log what holds in all frames: axes, legends, names and colours."""
        name, first = self._name, self._tasks[0]
        if (up := first.scene.up) is not None:  # the axis of the world that is nearest to it
            axis = int(np.abs(up).argmax())
            axes = f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}"
            stream.log(path(name), getattr(rr.ViewCoordinates, axes), static=True)
        self.shown.legend.log(stream, path(name, "legend"), path(name, "all_classes"))
        drift.log_legend(stream, path(name, "drift_legend"), first.mapping.target)
        for task in self._tasks:
            entity = path(name, "camera", task.backbone)
            stream.log(f"{entity}/labels", label_context(task.mapping.target), static=True)
            stream.log(f"{entity}/drift", drift.context(task.mapping.target), static=True)

    def origin(self, stream: rr.RecordingStream, task: Task, position: Float64 | None, voxel_size: float) -> Int64:
        """Return the origin of the scene's maps, in voxels: near the first camera position that is known."""
        if self._origin is None:
            if position is None:  # frames are not read: the scene's first pose, or the world's origin without dataset
                position = task.scene.T_wc(task.indices[0])[:3, 3] if hasattr(task.scene, "T_wc") else np.zeros(3)
            steps = np.round(position / ORIGIN_STEP).astype(np.int64)
            self._origin = steps * round(ORIGIN_STEP / voxel_size)
            at = self._origin * voxel_size
            self.camera = CameraLog(task.scene, at, len(task.indices))
            if steps.any():
                where = ", ".join(f"{name} = {value:.3f} m" for name, value in zip("xyz", at, strict=True))
                text = f"map coordinates are relative to {where} of the scene's world"
                stream.log(path(self._name, "log"), rr.TextLog(text))
        return self._origin

    def outgrown(self, voxels: int) -> bool:
        """Return whether a map of that size has more chunks than the layout knew; from now on it knows them all."""
        if chunks_of(voxels) <= self.shown.chunks:
            return False
        self.shown.chunks = CHUNKS
        return True

    def see(self, stream: rr.RecordingStream, group: GroupLog, table: VoxelTable) -> bool:
        """Take from a finished map what the layout depends on; return whether that changed it."""
        task, legend, shown = group.task, self.shown.legend, self.shown
        used = legend.used
        legend.see(task.mapping.target, dominant(table))
        legend.log(stream, path(self._name, "legend"), path(self._name, "all_classes"))
        compared = len(task.backends) > 1
        if compared:
            shown.spans[task.backbone] = group.spans
        first = shown.bounds is None and len(table) > 0
        if first:
            some = table.index[:: math.ceil(len(table) / SAMPLE)]
            points = ((some - group.origin + 0.5) * table.voxel_size).astype(np.float64)
            shown.bounds = SceneBounds(points, self.camera.poses, task.scene.up)
        return first or compared or used != legend.used


class GroupLog:
    """What is recorded of one backbone on a scene.

    live      a map that is being fused and can be followed; without it the recording fuses one of its own
    followed  whether a map is followed at all
    """

    def __init__(
        self, task: Task, voxel_size: float, origin: Int64, live: GrowingMap | None = None, *, followed: bool = True
    ) -> None:
        self.task, self.origin = task, origin
        self._classes = task.mapping.target
        self._translation = origin * voxel_size
        self._tracker = Tracker(voxel_size, len(self._classes), live) if followed else None
        self._contributions = ContributionLog()
        self._maps: dict[str, VoxelLogger] = {}
        self._tables: dict[str, VoxelTable] = {}  # by backend, as they are finished
        self._previous: Frame | None = None
        self._overlay = Overlay()
        self._seen = 0
        self.table: VoxelTable | None = None
        """Its last finished map."""
        self.last: tuple[int, float | None] = (task.indices[-1], None)
        """Number and timestamp of the last frame."""
        self.spans: dict[str, tuple[float, float]] = {}
        """The lowest and highest value of each series in all backends."""
        self.voxels = 0
        """Of its largest final map."""

    def span(self, values: Mapping[str, float]) -> None:
        """Widen the ranges of the series by a unit's values."""
        for name, value in values.items():
            low, high = self.spans.get(name, (value, value))
            self.spans[name] = min(low, value), max(high, value)

    def log(self, stream: rr.RecordingStream, frame: Frame, background: Background) -> None:
        """Log the labels of a frame that all units fused, the drift that it caused, and the map that grows."""
        previous, self._previous, self._seen = self._previous, frame, self._seen + 1
        self.last = frame.index, frame.timestamp
        caused, jobs = None, []
        if self._tracker is not None:
            caused = self._tracker.follow(frame)
            self._contributions.update(self._tracker, frame)
            if is_pointwise(drawn(self.task)):
                jobs = self._map(drawn(self.task)).update(stream, self._tracker.map)

        def job() -> None:
            self._log_pictures(stream, frame, caused)
            if previous is not None:
                self._log_flicker(stream, previous, frame)
            for log_chunk in jobs:
                log_chunk()

        background.submit(frame.index, frame.timestamp, job)

    @property
    def grown(self) -> int:
        """Voxels of the map that is drawn while it grows."""
        return len(self._tracker.map) if self._tracker is not None and is_pointwise(drawn(self.task)) else 0

    def log_unit(
        self, stream: rr.RecordingStream, summary: UnitSummary, table: VoxelTable, tolerance: float, factor: int = 1
    ) -> None:
        """Log a unit's final voxels, their differences from the drawn unit, its numbers, the agreement of its frames.

        factor  of a table that is thinned already: it is not compared
        """
        unit, first = summary.unit, drawn(self.task)
        self.table, self.voxels = table, max(self.voxels, len(table))
        if factor == 1:
            self._tables[unit.backend] = table
        if first in self._tables and factor == 1:
            for other in self._tables if unit.backend == first else [unit.backend]:
                if other != first:
                    self._log_difference(stream, first, other, tolerance)
        note = self._map(unit.backend).finish(stream, table, factor)
        stream.log(path(unit.scene, "log"), rr.TextLog(final(summary) + note))
        if summary.statistics is not None:
            document = rr.TextDocument(agreement_report(summary.statistics), media_type=rr.MediaType.MARKDOWN)
            stream.log(path(unit.scene, "agreement", unit.backbone), document, static=True)

    def log_flips(self, stream: rr.RecordingStream, clock: Clock) -> None:
        """Log the voxels that drifted most, and the frames that contributed most."""
        if self._tracker is None or not self._seen:
            return
        scene, backbone = self.task.scene.name, self.task.backbone
        voxels = list(self._contributions.top_voxels(self._tracker))
        self._contributions.log(stream, scene, backbone, voxels, self._classes, self._translation, clock)

    def _log_difference(self, stream: rr.RecordingStream, first: str, second: str, tolerance: float) -> None:
        scene, backbone, pair = self.task.scene.name, self.task.backbone, f"{first} and {second}"
        tables = {name: self._tables[name] for name in (first, second)}
        text = log_difference(stream, path(scene, "difference", backbone, pair), tables, self.origin, tolerance)
        stream.log(path(scene, "log"), rr.TextLog(f"{backbone}: {text}"))
        report = rr.TextDocument(f"{text}.", media_type=rr.MediaType.MARKDOWN)
        stream.log(path(scene, "difference_report", backbone, pair), report, static=True)

    def _log_pictures(self, stream: rr.RecordingStream, frame: Frame, caused: FrameDrift | None) -> None:
        stride, coarse = stride_of(frame.shape), coarse_stride(frame.shape)
        labels: Any = np.ascontiguousarray(frame.predicted[::stride, ::stride])
        pictures = {"labels": (labels, stride)}
        if caused is not None:
            pictures["drift"] = drift.levels_of(*caused.at(coarse)), coarse
        for name, (picture, every) in pictures.items():
            entity = path(self.task.scene.name, "camera", self.task.backbone, name)
            self._overlay.log(stream, entity, frame.shape, picture.shape, every)
            stream.log(entity, rr.SegmentationImage(picture, draw_order=-10))

    def _log_flicker(self, stream: rr.RecordingStream, previous: Frame, frame: Frame) -> None:
        """Motion-compensated flicker: of a sample of the frame's pixels, looked up in the whole frame before."""
        sample = frame.every(stride_of(frame.shape))
        flicker = compensated_flicker(previous, sample.every(sampling(sample.shape))).flicker_percent
        if math.isfinite(flicker):
            stream.log(timeline.entity("compensated_flicker", self.task.units[0]), rr.Scalars(flicker))

    def _map(self, backend: str) -> VoxelLogger:
        if backend not in self._maps:
            entity = path(self.task.scene.name, "map", self.task.backbone, backend)
            self._maps[backend] = VoxelLogger(entity, self._classes, self.origin, len(self.task.indices))
        return self._maps[backend]


def final(summary: UnitSummary) -> str:
    """Return a unit's numbers in a line."""
    unit, table = summary.unit, summary.table
    means = (f"{m.symbol} {table[m]:.{m.digits[0]}f} {m.unit}".rstrip() for m in measures())
    return (
        f"{unit.backbone}, {unit.backend}: {table.voxels:,} voxels, mean OP {table.mean_op:.2f}, {', '.join(means)}"
        f" (K = {table.K})"
    )
