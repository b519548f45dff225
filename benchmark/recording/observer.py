"""The observer that records a run."""

from __future__ import annotations

import contextlib
import functools
import logging
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

import rerun as rr

from semstab.backends import FusionBackend, GrowingMap
from semstab.config import Config
from semstab.engine.observer import Observer
from semstab.engine.series import FrameRow
from semstab.engine.units import Plan, Planned
from semstab.errors import ConfigError, one_line
from semstab.model.frames import Frame
from semstab.model.records import Result, UnitContent
from semstab.model.results import Unit, UnitSummary
from semstab.model.voxels import VoxelTable
from semstab.recording import series
from semstab.recording.background import Background
from semstab.recording.entities import Clock, path
from semstab.recording.finished import log_finished
from semstab.recording.group import GroupLog, final
from semstab.recording.scenes import Scenes
from semstab.recording.target import DEFAULT_URL, Target, is_whole
from semstab.recording.voxel_maps import chunks_of
from semstab.task import Task


class Recording(Observer):
    """Writes one recording while the run goes on; a killed run leaves what it recorded until a moment before.

    target  a file, or a `Target`: a file and a viewer
    run     the run folder, from which the recording of a resumed run takes what an earlier start finished

    The file is opened at the first fused frame: a start that finds every group kept leaves an earlier recording alone,
    unless a kill cut it: then it is made again, of what the run folder tells.
    Call `close` where a run does not come to its end. Raises ConfigError where the file cannot be written.
    """

    def __init__(self, target: str | Path | Target, run: Path | None = None) -> None:
        self.target = target if isinstance(target, Target) else Target(Path(target))
        self._run = run
        self._plan: Plan
        self._scenes: Scenes
        self._tasks: dict[tuple[str, str], Task] = {}
        self._stream: rr.RecordingStream | None = None
        self._clock = Clock()
        self._kept: list[tuple[Task, Sequence[UnitSummary]]] = []  # not logged yet
        self._group: GroupLog | None = None  # the backbone on a scene that is being fused
        self._growing: GrowingMap | None = None
        self._fusing: set[Unit] = set()
        self._background: Background | None = None
        self._cut = False  # whether there is no earlier recording that is whole

    def run_started(self, plan: Plan, finished: Mapping[str, UnitContent]) -> None:
        """Keep the plan: layout, names and colours follow from it."""
        self._plan, self._scenes = plan, Scenes(plan, live=self.target.live)
        self._tasks = {(task.scene.name, task.backbone): task for task in plan.tasks}
        self._cut = not is_whole(self.target.file)
        for planned in plan.units:
            if planned.kept and (content := finished.get(planned.identity)) is not None:
                self._add_finished(planned, content)

    def group_started(self, task: Task, config: Config, backends: Mapping[Unit, FusionBackend]) -> None:
        """Follow the first map that can be followed."""
        self._group, self._fusing = None, set(backends)
        self._growing = next((each for each in backends.values() if isinstance(each, GrowingMap)), None)

    def frame_fused(self, task: Task, frame: Frame, rows: Mapping[Unit, FrameRow]) -> None:
        """Log a row of each time series, and the views of the camera and the map."""
        stream, background = self._opened()
        self._clock.set(stream, frame.index, frame.timestamp)
        scene = task.scene.name
        task = self._tasks[scene, task.backbone]
        origin = self._scenes.origin(stream, task, frame.T_wc[:3, 3])
        group = self._group = self._group or GroupLog(task, self._plan.config.voxel_size, origin, self._growing)
        self._growing = None
        for unit, row in rows.items():
            values = series.values(row.cells())
            series.log_row(stream, unit, task, values)
            group.span(values)
        self._scenes.cameras[scene].log(stream, frame, background)
        group.log(stream, frame, background, maps=True)
        if chunks_of(group.grown) > self._scenes.known.chunks[scene]:
            show = functools.partial(self._scenes.show_chunks, stream, scene, group.grown)
            background.submit(frame.index, frame.timestamp, show)

    def unit_finished(
        self, planned: Planned, content: UnitContent | None, table: VoxelTable | None, error: str | None
    ) -> None:
        """Log the unit's voxels and its final numbers; of one that was not fused here, those of its folder."""
        unit, last = planned.unit, planned.unit in self._fusing and len(self._fusing) == 1
        self._fusing.discard(unit)
        if table is None or content is None or content.summary is None or self._group is None:
            if planned.kept and content is not None:
                self._add_finished(planned, content)
        else:
            (stream, background), group = self._opened(), self._group
            tolerance = self._plan.config.tolerance
            background.submit(*group.last, functools.partial(group.log_map, stream, unit, table, tolerance))
            background.drain()
            self._clock.set(stream, *group.last)
            group.log_numbers(stream, content.summary)
        if last:
            self._end_group()

    def _end_group(self) -> None:
        """Log the flips, and lay out the views of what there is now."""
        group, self._group = self._group, None
        if group is None:
            return
        stream, background = self._opened()
        if group.tables:
            (*_, table) = group.tables.values()
            background.submit(*group.last, functools.partial(self._scenes.lay_out, stream, group, table))
        background.submit(*group.last, functools.partial(group.log_flips, stream, self._clock))
        background.drain()

    def _add_finished(self, planned: Planned, content: UnitContent) -> None:
        """Log the unit's series and voxels from the folder: its pictures are not in this recording."""
        if content.summary is not None:
            self._kept.append((self._tasks[planned.unit.scene, planned.unit.backbone], [content.summary]))
        if self._stream is not None:
            self._log_kept(self._stream)

    def run_finished(self, result: Result) -> None:
        """Finish the file; where the recording is served, `serve` or `close` does that."""
        if self._cut:
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
        if stream is None:
            return
        try:
            if self._background is not None:
                self._background.close()
            for camera in self._scenes.cameras.values():
                if camera.unread is not None:
                    stream.log(path(camera.scene.name, "log"), rr.TextLog(f"without colour: {camera.unread}"))
        finally:
            self._finish(stream)

    def _finish(self, stream: rr.RecordingStream) -> None:
        """Write the file's end. Raises ConfigError where that fails: the disk is full, for example."""
        try:
            stream.flush()
        except RuntimeError as error:
            what = "did the viewer go away?" if self.target.live else "is the disk full?"
            raise ConfigError(
                f"{self.target.file}: the recording is not whole ({one_line(error)}; {what}); all else is kept, and the"
                " same command makes it again"
            ) from error
        finally:
            stream.disconnect()

    def _opened(self) -> tuple[rr.RecordingStream, Background]:
        if self._stream is None or self._background is None:
            self._stream = stream = self.target.open()
            self._background = Background(stream, self._clock)
            self._scenes.log_static(stream)
            self._scenes.send_layout(stream)
            self._log_kept(stream)
        return self._stream, self._background

    def _log_kept(self, stream: rr.RecordingStream) -> None:
        kept, self._kept = self._kept, []
        for task, summaries in kept:
            self._clock.set(stream, task.indices[-1])
            if self._run is not None:
                log_finished(stream, task, summaries, self._run, self._scenes, self._clock, track=True)
                continue
            for summary in summaries:
                text = f"{final(summary)}; finished by an earlier start, series and voxels are not in this recording"
                stream.log(path(task.scene.name, "log"), rr.TextLog(text))
