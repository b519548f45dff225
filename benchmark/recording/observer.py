"""The observer that records a run."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import logging
import threading
from collections.abc import Collection, Sequence
from pathlib import Path

import rerun as rr

from semstab.backends import FusionBackend, GrowingMap
from semstab.config import Config
from semstab.core.files import atomic_path
from semstab.engine.observer import Factory, Observer
from semstab.engine.series import FrameRow
from semstab.engine.tiling.partition import Part
from semstab.engine.units import Plan, Planned, PlannedUnit
from semstab.errors import ConfigError, one_line
from semstab.model.frames import Frame
from semstab.model.records import RECORDING_PARTS, Result, Variation
from semstab.model.results import Unit, UnitSummary
from semstab.model.voxels import VoxelTable
from semstab.recording import earlier, series
from semstab.recording.background import Background
from semstab.recording.drift_parts import DriftParts
from semstab.recording.entities import Clock, path
from semstab.recording.finished import log_finished
from semstab.recording.group import GroupLog, final
from semstab.recording.parts import Parts
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

    pictures_only = False
    """Whether series, maps and layout are logged by another recording, of which this is a part."""

    def __init__(self, target: str | Path | Target, run: Path | None = None) -> None:
        self.target = target if isinstance(target, Target) else Target(Path(target))
        self._run = run
        self._plan: Plan
        self._scenes: Scenes
        self._tasks: dict[tuple[str, str], Task] = {}
        self._stream: rr.RecordingStream | None = None
        self._server: rr.RecordingStream | None = None  # an earlier one, that serves what this one sends
        self._clock = Clock()
        self._kept: list[tuple[Task, Sequence[UnitSummary]]] = []  # not logged yet
        self._growing: dict[tuple[str, str], GrowingMap] = {}  # of the units that started
        self._group: GroupLog | None = None  # the backbone on a scene that is being fused
        self._ahead: Frame | None = None  # of those that are seen next
        self._background: Background | None = None
        self._parts: Parts | None = None
        self._drift = DriftParts(None if run is None else run / RECORDING_PARTS)
        self._tiled: dict[tuple[str, str], bool] = {}  # in tiles; whether an earlier start left something
        self._taken: dict[tuple[str, str], set[int]] = {}  # frames of which an earlier recording had the pictures
        self._whole: set[tuple[str, str]] = set()  # of which all pictures are there
        self._cut = False  # whether there is no earlier recording that is whole

    def run_started(self, plan: Plan, kept: Sequence[Planned]) -> None:
        """Keep the plan: layout, names and colours follow from it."""
        self._plan, self._scenes = plan, Scenes(plan, live=self.target.live)
        self._tasks = {(task.scene.name, task.backbone): task for task in plan.tasks}
        unmerged = self._run is not None and any((self._run / RECORDING_PARTS).glob("*.rrd"))
        self._cut = unmerged or not is_whole(self.target.file)

    def unit_started(self, unit: Unit, backend: FusionBackend) -> None:
        """Keep the map, where it can be followed: the first one of a backbone on a scene will be."""
        if isinstance(backend, GrowingMap):
            self._growing.setdefault((unit.scene, unit.backbone), backend)

    def frame_fused(self, unit: Unit, frame: Frame, row: FrameRow) -> None:
        """Log the unit's row of the time series."""
        stream, _ = self._opened()
        task = self._tasks[unit.scene, unit.backbone]
        self._clock.set(stream, frame.index, frame.timestamp)
        origin = self._scenes.origin(stream, task, frame.T_wc[:3, 3])
        if self._group is None or self._group.task is not task:
            growing = self._growing.pop((unit.scene, unit.backbone), None)
            self._group = GroupLog(task, self._plan.config.voxel_size, origin, growing)
        if not self.pictures_only:
            values = series.values(row.cells())
            series.log_row(stream, unit, task, values)
            self._group.span(values)

    def frame_finished(self, task: Task, frame: Frame) -> None:
        """Log what the camera and the map show."""
        (stream, background), group, scene = self._opened(), self._fused, task.scene.name
        self._scenes.cameras[scene].log(stream, frame, background)
        group.log(stream, frame, background, maps=not self.pictures_only)
        if not self.pictures_only and chunks_of(group.grown) > self._scenes.known.chunks[scene]:
            show = functools.partial(self._scenes.show_chunks, stream, scene, group.grown)
            background.submit(frame.index, frame.timestamp, show)

    def frame_ahead(self, task: Task, frame: Frame) -> None:
        """Keep what the next frame is compared with."""
        self._ahead = frame

    def frame_seen(self, task: Task, frame: Frame) -> None:
        """Log what the camera shows; the map follows when its tiles are there, and the track where others look too."""
        (stream, background), scene = self._opened(), task.scene.name
        previous, self._ahead = self._ahead, None
        self._clock.set(stream, frame.index, frame.timestamp)
        origin = self._scenes.origin(stream, self._tasks[scene, task.backbone], frame.T_wc[:3, 3])
        self._scenes.cameras[scene].log(stream, frame, background, track=not self.pictures_only)
        if (scene, task.backbone) in self._whole:
            return
        if self._group is None or self._group.task is not task:
            taken = self._taken.get((scene, task.backbone), ())
            self._group = GroupLog(task, self._plan.config.voxel_size, origin, taken=taken, previous=previous)
        self._group.see(stream, frame, background)

    def unit_begun_again(self, unit: Unit) -> None:
        """Go on in a recording that has nothing of its map, in place of this one: in the file and in a viewer."""
        if self._stream is None or self._background is None or self._parts is not None:
            return
        task, pictures = self._tasks[unit.scene, unit.backbone], (unit.scene, unit.backbone) not in self._whole
        before = self._stream
        self._background.close()
        if self.target.viewer == "serve":
            self._server = self._server or before
        if self.target.live:
            before.send_recording_name("given up, and begun again in tiles")
        self._finish(before)
        with atomic_path(self.target.file) as file:
            target = dataclasses.replace(self.target, file=file, viewer=self.target.viewer_url)
            self._stream = stream = target.open()
            earlier.copy(self.target.file, stream, earlier.entities_of(unit, task, pictures=pictures))
        self._background, self._group = Background(stream, self._clock), None
        self._scenes.send_layout(stream)
        self.target.drop(before.get_recording_id())

    def unit_in_tiles(self, unit: Unit, key: str, portions: Collection[str]) -> None:
        """Keep what an earlier start left of its parts, and the pictures of its frames."""
        place = unit.scene, unit.backbone
        self._tiled[place] = self._drift.keep(unit, key, portions) or self._tiled.get(place, False)
        if self._stream is not None:
            self._drift.belong_to(self._stream.get_recording_id())

    def part_started(self, task: Task, config: Config, part: Part, backend: FusionBackend) -> None:
        """Follow the part's map: pictures of drift wait in the folder until the parts are all there."""
        self._drift.start(task, config.voxel_size, part, backend)

    def part_fused(self, frame: Frame) -> None:
        """Keep the picture of its drift."""
        self._drift.add(frame)

    def part_finished(self) -> None:
        """The part's pictures are all there."""
        self._drift.finish()

    def unit_assembled(self, task: Task, summary: UnitSummary) -> None:
        """Log the unit's series and voxels from the folder."""
        if self._parts is not None:  # all that is in the folder is logged at the end
            return
        stream, background = self._opened()
        background.drain()
        self._kept.append((self._tasks[task.scene.name, task.backbone], [summary]))
        self._log_kept(stream)
        self._log_drift(stream, task, summary)

    def unit_fused(self, unit: Unit, table: VoxelTable) -> None:
        """Log the unit's voxels, while they are measured; the time is that of its last frame."""
        if self.pictures_only:
            return
        (stream, background), group = self._opened(), self._fused
        tolerance = self._plan.config.tolerance
        background.submit(*group.last, functools.partial(group.log_map, stream, unit, table, tolerance))

    def unit_finished(self, unit: Unit, table: VoxelTable, summary: UnitSummary) -> None:
        """Log the unit's final numbers."""
        if self.pictures_only:
            return
        (stream, background), group = self._opened(), self._fused
        background.drain()
        self._clock.set(stream, *group.last)
        group.log_numbers(stream, summary)

    def group_finished(self, task: Task) -> None:
        """Log what flipped, and lay out what there is now."""
        (stream, background), group = self._opened(), self._group
        self._whole.add((task.scene.name, task.backbone))
        if group is None:
            return
        if group.tables:
            (*_, table) = group.tables.values()
            background.submit(*group.last, functools.partial(self._scenes.lay_out, stream, group, table))
        background.submit(*group.last, functools.partial(group.log_flips, stream, self._clock))
        background.drain()

    def group_kept(self, task: Task, summaries: Sequence[UnitSummary]) -> None:
        """Log the units' series and voxels from the folder: their pictures are not in this recording."""
        self._kept.append((self._tasks[task.scene.name, task.backbone], summaries))
        if self._stream is not None:
            self._log_kept(self._stream)

    def elsewhere(self, folder: Path) -> Factory:
        """Each job records what only its frames show; series, maps and layout follow from the folder when all is done.

        Raises ConfigError where a viewer is to follow the run.
        """
        if self.target.live:
            raise ConfigError("--rerun: a viewer follows a run in one process; leave out --jobs and --scheduler")
        self._parts, self._scenes.waits = Parts.of(folder), True
        self.target = self._parts.of_the_whole(self.target)
        return functools.partial(PictureRecording, self._parts)

    def run_finished(self, result: Result) -> None:
        """Finish the file; where the recording is served, `serve` or `close` does that."""
        if self._parts is not None:
            self._finish_parts(self._parts, result)
            return
        if self._cut:
            self._opened()
        if self.target.viewer != "serve":
            self.close()

    def _finish_parts(self, parts: Parts, result: Result) -> None:
        """Add to the pictures what the folder tells, and make one file of all."""
        logged = {(task.scene.name, task.backbone) for task, _ in self._kept}
        for place, task in self._tasks.items():
            summaries = [run for run in result.runs if (run.unit.scene, run.unit.backbone) == place]
            if place not in logged and summaries:
                self._kept.append((task, summaries))
        stream, _ = self._opened()
        for run in result.runs:
            if (run.unit.scene, run.unit.backbone) in self._tasks:
                self._log_drift(stream, self._tasks[run.unit.scene, run.unit.backbone], run)
        self._scenes.waits = False
        self._scenes.send_layout(stream)
        self.close()
        self.target = parts.merged(self.target)

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
        self._drift.end()
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
            if self._server is not None:
                self._server.disconnect()

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
            if stream is not self._server:
                stream.disconnect()

    @property
    def _fused(self) -> GroupLog:
        """The group that is being fused."""
        assert self._group is not None
        return self._group

    def _opened(self) -> tuple[rr.RecordingStream, Background]:
        if self._stream is None or self._background is None:
            self._stream = stream = self._begun()
            self._background = Background(stream, self._clock)
            if self.pictures_only:
                return stream, self._background
            self._scenes.log_static(stream)
            self._scenes.send_layout(stream)
            self._log_kept(stream)
        return self._stream, self._background

    def _begun(self) -> rr.RecordingStream:
        """A new recording; with pictures of frames in an earlier one where maps in tiles are gone on with."""
        again = [self._tasks[place] for place, same in self._tiled.items() if same and self._parts is None]
        if not again or not self._drift.recording or self._drift.recording != earlier.identity_of(self.target.file):
            stream = self.target.open()
        else:
            with atomic_path(self.target.file) as file:
                stream = dataclasses.replace(self.target, file=file).open()
                shown = [earlier.pictures_of(task) for task in again]
                frames = earlier.take(self.target.file, stream, {*itertools.chain.from_iterable(shown)})
            for task, (depth, *_, labels) in zip(again, shown, strict=True):
                self._scenes.origin(stream, task, task.scene.T_wc(task.indices[0])[:3, 3])
                self._scenes.cameras[task.scene.name].take(frames.pop(depth, ()))
                self._taken[task.scene.name, task.backbone] = frames[labels]
        if self._tiled and self._parts is None:
            self._drift.belong_to(stream.get_recording_id())
        return stream

    def _log_kept(self, stream: rr.RecordingStream) -> None:
        kept, self._kept = self._kept, []
        for task, summaries in kept:
            self._clock.set(stream, task.indices[-1])
            if self._run is not None:
                together = self._parts is not None
                log_finished(stream, task, summaries, self._run, self._scenes, self._clock, track=together)
                continue
            for summary in summaries:
                text = f"{final(summary)}; finished by an earlier start, series and voxels are not in this recording"
                stream.log(path(task.scene.name, "log"), rr.TextLog(text))

    def _log_drift(self, stream: rr.RecordingStream, task: Task, summary: UnitSummary) -> None:
        """Log what parts of a map in tiles have left: pictures of drift, and the voxels that drifted most."""
        group, place = None, (task.scene.name, task.backbone)
        for picture in self._drift.pictures(summary.unit) if place not in self._whole else ():
            group = group or GroupLog(task, self._plan.config.voxel_size, self._scenes.origins[task.scene.name])
            self._clock.set(stream, picture.frame, picture.timestamp)
            group.log_drift(stream, picture)
        suspects = self._drift.suspects(summary.unit, summary.table.voxels)
        if group is not None and suspects is not None:
            group.log_flips(stream, self._clock, suspects)
        if group is not None:
            self._whole.add(place)
        self._drift.remove(summary.unit)


class PictureRecording(Recording):
    """What only the frames of one job show, in a file of its own: camera, labels, drift and flips."""

    pictures_only = True

    def __init__(self, parts: Parts) -> None:
        super().__init__(parts.folder / "unknown.rrd")
        self._parts_of, self._drift = parts, DriftParts(parts.folder)

    def group_started(self, task: Task, config: Config) -> None:
        """The job's backbone on a scene: it is all of this recording's plan."""
        self.target = self._parts_of.of_group(task)
        units = (
            PlannedUnit(Variation(), config, dataclasses.replace(task, backends=(backend,)), "", False, True)
            for backend in task.backends
        )
        self.run_started(Plan(config, {}, tuple(units), ()), [])
