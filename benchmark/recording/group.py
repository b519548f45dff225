"""What is recorded of one backbone on a scene: its pictures, its maps, what flipped."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import rerun as rr

from semstab.backends import GrowingMap
from semstab.core.types import Int64
from semstab.metrics import compensated_flicker
from semstab.model.frames import Frame
from semstab.model.measures import measures
from semstab.model.results import Unit, UnitSummary
from semstab.model.voxels import VoxelTable
from semstab.recording import camera, series
from semstab.recording.background import Background
from semstab.recording.camera import Overlay, coarse_stride, sampling, stride_of
from semstab.recording.changes import log_difference
from semstab.recording.entities import Clock, path
from semstab.recording.flips import FlipLog, FrameDrift, Suspect, Tracker
from semstab.recording.layout import drawn, is_pointwise
from semstab.recording.voxel_maps import MapLog, looks_report
from semstab.task import Task


class GroupLog:
    """What is recorded of one backbone on a scene."""

    def __init__(
        self,
        task: Task,
        voxel_size: float,
        origin: Int64,
        growing: GrowingMap | None = None,
        taken: Collection[int] = (),
        previous: Frame | None = None,
    ) -> None:
        self.task = task
        self.origin = origin
        self._classes, self._taken = task.mapping.target, taken
        self._translation = origin * voxel_size
        self._tracker = Tracker(voxel_size, len(self._classes), growing)
        self._flips = FlipLog()
        self._maps: dict[str, MapLog] = {}
        self.tables: dict[str, VoxelTable] = {}
        """By backend, as they are finished."""
        self._previous = previous
        self._entity = path(task.scene.name, "camera", task.backbone)
        self._overlay = Overlay()
        self.last: tuple[int, float | None] = (task.indices[-1], None)
        """Number and timestamp of the last frame."""
        self.spans: dict[str, tuple[float, float]] = {}
        """The lowest and highest value of each series in all backends."""
        self.voxels = 0
        """Of its largest final map."""
        self.remarks: dict[str, str] = {}
        """What there is to say of the final map of a backend."""

    def span(self, values: Mapping[str, float]) -> None:
        """A unit's series had these values in a frame."""
        for name, value in values.items():
            low, high = self.spans.get(name, (value, value))
            self.spans[name] = min(low, value), max(high, value)

    def log(self, stream: rr.RecordingStream, frame: Frame, background: Background, *, maps: bool) -> None:
        """All units of the group fused the frame: log what it shows and what it changed, and where wanted the map."""
        self._tracker.follow(frame)
        self.last = frame.index, frame.timestamp
        self._flips.update(self._tracker, frame)
        drawn_map = self._map(drawn(self.task)) if maps and is_pointwise(drawn(self.task)) else None
        grown = drawn_map.update(stream, self._tracker.map) if drawn_map is not None else []
        drift, previous = self._tracker.drift_of(frame), self._previous
        self._previous = frame

        def job() -> None:
            self._log_pictures(stream, drift)
            if previous is not None:
                self._log_flicker(stream, previous, frame)
            for log_chunk in grown:
                log_chunk()

        background.submit(frame.index, frame.timestamp, job)

    def see(self, stream: rr.RecordingStream, frame: Frame, background: Background) -> None:
        """Log what a frame shows that goes into no map here, and is not in the recording already."""
        previous, self._previous = self._previous, frame
        if frame.index in self._taken:
            return

        def job() -> None:
            self._log_labels(stream, frame)
            if previous is not None:
                self._log_flicker(stream, previous, frame)

        background.submit(frame.index, frame.timestamp, job)

    @property
    def grown(self) -> int:
        """Voxels of the map that is drawn while it grows."""
        return len(self._tracker.map) if is_pointwise(drawn(self.task)) else 0

    def log_map(
        self, stream: rr.RecordingStream, unit: Unit, table: VoxelTable, tolerance: float, factor: int = 1
    ) -> None:
        """Log a unit's final voxels, and where they differ from those of the drawn unit.

        factor  of a table that is thinned already: it is not compared
        """
        if factor > 1:
            self.voxels = max(self.voxels, len(table))
            self.remarks[unit.backend] = self._map(unit.backend).finish(stream, table, factor)
            return
        first = drawn(self.task)
        self.tables[unit.backend] = table
        self.voxels = max(self.voxels, len(table))
        if first in self.tables:
            for backend in self.tables if unit.backend == first else [unit.backend]:
                self._compare(stream, first, backend, tolerance)
        self.remarks[unit.backend] = self._map(unit.backend).finish(stream, table)

    def log_numbers(self, stream: rr.RecordingStream, summary: UnitSummary) -> None:
        """Log the final numbers of a unit, and what its frames agree on."""
        text = final(summary) + self.remarks.get(summary.unit.backend, "")
        stream.log(path(summary.unit.scene, "log"), rr.TextLog(text))
        if summary.statistics is not None:
            document = rr.TextDocument(looks_report(summary.statistics), media_type=rr.MediaType.MARKDOWN)
            stream.log(path(summary.unit.scene, "agreement", summary.unit.backbone), document, static=True)

    def log_flips(self, stream: rr.RecordingStream, clock: Clock, suspects: list[Suspect] | None = None) -> None:
        """Log which frames changed the voxels that drifted most: those that are said to, of a map in tiles."""
        suspects = list(self._flips.suspects(self._tracker)) if suspects is None else suspects
        self._flips.log(
            stream, self.task.scene.name, self.task.backbone, suspects, self._classes, self._translation, clock
        )

    def _compare(self, stream: rr.RecordingStream, first: str, second: str, tolerance: float) -> None:
        if first == second:
            return
        scene, backbone = self.task.scene.name, self.task.backbone
        entity = path(scene, "difference", backbone, f"{first} and {second}")
        tables = {name: self.tables[name] for name in (first, second)}
        found = log_difference(stream, entity, tables, self.origin, tolerance)
        stream.log(path(scene, "log"), rr.TextLog(f"{backbone}: {found}"))
        report = rr.TextDocument(f"{found}.", media_type=rr.MediaType.MARKDOWN)
        stream.log(path(scene, "difference_report", backbone, f"{first} and {second}"), report, static=True)

    def _log_pictures(self, stream: rr.RecordingStream, caused: FrameDrift) -> None:
        self._log_labels(stream, caused.frame)
        coarse = coarse_stride(caused.frame.shape)
        self._log_picture(stream, caused.frame.shape, "drift", camera.levels_of(*caused.at(coarse)), coarse)

    def _log_labels(self, stream: rr.RecordingStream, frame: Frame) -> None:
        stride = stride_of(frame.shape)
        labels = np.ascontiguousarray(frame.predicted[::stride, ::stride])
        self._log_picture(stream, frame.shape, "labels", labels, stride)

    def _log_picture(
        self, stream: rr.RecordingStream, shape: tuple[int, int], name: str, picture: Any, stride: int
    ) -> None:
        entity = f"{self._entity}/{name}"
        self._overlay.log(stream, entity, shape, picture.shape, stride)
        stream.log(entity, rr.SegmentationImage(picture, draw_order=-10))

    def _log_flicker(self, stream: rr.RecordingStream, previous: Frame, frame: Frame) -> None:
        """Motion-compensated flicker: of a sample of the frame's pixels, looked up in the whole frame before."""
        stride = stride_of(frame.shape)
        sample = frame.every(stride)
        flicker = compensated_flicker(previous, sample.every(sampling(sample.shape))).flicker_percent
        if math.isfinite(flicker):
            stream.log(series.entity("compensated_flicker", self.task.units[0]), rr.Scalars(flicker))

    def _map(self, backend: str) -> MapLog:
        if backend not in self._maps:
            entity = path(self.task.scene.name, "map", self.task.backbone, backend)
            self._maps[backend] = MapLog(entity, self._classes, self.origin, len(self.task.indices))
        return self._maps[backend]


def final(summary: UnitSummary) -> str:
    """Its numbers, in a line."""
    unit, table = summary.unit, summary.table
    means = (f"{m.symbol} {table[m]:.{m.digits[0]}f} {m.unit}".rstrip() for m in measures())
    return (
        f"{unit.backbone}, {unit.backend}: {table.voxels:,} voxels, mean OP {table.mean_op:.2f}, {', '.join(means)}"
        f" (K = {table.K})"
    )
