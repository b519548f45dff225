"""Record videos without depth and poses: images, label maps, and flicker by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property

import rerun as rr
import rerun.blueprint as rrb

from semstab.core.palette import model_color
from semstab.data.frames import Frame
from semstab.data.videos import VideoResult
from semstab.engine.videos import VideoObserver
from semstab.recording.camera import JPEG_QUALITY, label_context, over_camera, stride_of
from semstab.recording.target import Target, flush
from semstab.recording.timeline import Clock, FrameJobs, path
from semstab.task import Task

SERIES = {
    "flicker_percent": "Pixel flicker (%)",
    "compensated_flicker_percent": "Flicker (%)",
    "lone_percent": "Alone (%)",
}
"""Columns that are drawn, and the titles of their plots."""


class VideoRecording(VideoObserver):
    """A recording of a run over videos, which gets each frame as it is measured.

    Args:
        target: Its file, and the viewer that follows it.
    """

    of_earlier_starts = True

    def __init__(self, target: Target) -> None:
        self._target, self._clock = target, Clock()
        self._background: FrameJobs | None = None
        self._models: dict[str, list[str]] = {}
        self._shown: set[tuple[str, int]] = set()

    @cached_property
    def _stream(self) -> rr.RecordingStream:
        """Opened with the first frame: a run that cannot begin leaves no file."""
        return self._target.open()

    def frame_measured(self, task: Task, frame: Frame, numbers: Mapping[str, float]) -> None:
        """Log a frame of a model, and its numbers."""
        self._background = self._background or FrameJobs(self._stream, self._clock)
        scene = task.scene.name
        models = self._models.setdefault(scene, [])
        if task.model not in models:
            models.append(task.model)
            self._stream.log(path(scene, "camera", task.model), label_context(task.mapping.target), static=True)
            for name in SERIES:
                style = rr.SeriesLines(colors=[model_color(len(models) - 1)], names=[task.model])
                self._stream.log(path(scene, "series", name, task.model), style, static=True)
        first = (scene, frame.index) not in self._shown
        self._shown.add((scene, frame.index))
        self._background.submit(frame.index, frame.timestamp, lambda: self._log(task, frame, numbers, first))

    def _log(self, task: Task, frame: Frame, numbers: Mapping[str, float], first: bool) -> None:
        scene, stream = task.scene.name, self._stream
        if first and frame.color is not None:
            step = stride_of(frame.color.shape[:2])
            image = rr.Image(frame.color[::step, ::step]).compress(jpeg_quality=JPEG_QUALITY)
            stream.log(path(scene, "camera"), over_camera(step))
            stream.log(path(scene, "camera", "color"), image)
        step = stride_of(frame.shape)
        stream.log(path(scene, "camera", task.model, "labels"), rr.SegmentationImage(frame.predicted[::step, ::step]))
        self._log_numbers(scene, task.model, numbers)

    def _log_numbers(self, scene: str, model: str, numbers: Mapping[str, float]) -> None:
        for name in SERIES:
            if math.isfinite(value := numbers.get(name, math.nan)):
                self._stream.log(path(scene, "series", name, model), rr.Scalars(value))

    def run_finished(self, result: VideoResult) -> None:
        """Log what follows from all frames, and the layout."""
        assert self._background is not None
        self._background.drain()
        for record in result.records:
            for row in record.rows:
                time = None if math.isnan(row.timestamp) else row.timestamp
                self._clock.set(self._stream, row.frame, time)
                self._log_numbers(record.scene, record.model, {"lone_percent": row.lone_percent})
        tabs = [_layout(scene, self._models[scene]) for scene in result.scenes]
        self._stream.send_blueprint(
            rrb.Blueprint(rrb.Tabs(*tabs), rrb.TimePanel(timeline="frame"), collapse_panels=True)
        )

    def close(self) -> None:
        """Write what is left."""
        if self._background is not None:
            self._background.close()
            flush(self._stream, self._target.file)


def _layout(scene: str, models: Sequence[str]) -> rrb.Vertical:
    """Return a video as the viewer shows it: image and label maps above, series below."""
    camera = path(scene, "camera")
    views = [rrb.Spatial2DView(origin=camera, contents=[f"{camera}/color"], name="Image")]
    for model in models:
        origin = path(scene, "camera", model)
        views.append(rrb.Spatial2DView(origin=origin, contents=[f"{origin}/**"], name=model))
    plots = [
        rrb.TimeSeriesView(
            origin=path(scene, "series", name), name=title, plot_legend=rrb.PlotLegend(visible=len(models) > 1)
        )
        for name, title in SERIES.items()
    ]
    return rrb.Vertical(rrb.Grid(*views), rrb.Horizontal(*plots), name=scene, row_shares=[3, 2])
