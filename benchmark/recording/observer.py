"""The observer that records a run, and the recording that a finished run's folder gives."""

from __future__ import annotations

import contextlib
import functools
import logging
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import rerun as rr

from semstab.backends import FusionBackend, GrowingMap
from semstab.config import BACKENDS, BASE, Config
from semstab.core.prefetch import prefetch
from semstab.core.process import available_bytes
from semstab.core.types import Float64
from semstab.datasets import Scene
from semstab.engine.folder import load_result
from semstab.engine.observer import Observer
from semstab.engine.series import FrameRow
from semstab.engine.units import Plan, PlannedUnit, make_plan
from semstab.errors import ConfigError, SemstabError, one_line
from semstab.model.frames import Frame
from semstab.model.labels import LabelSpace
from semstab.model.records import Record, Result, UnitContent, voxels_of
from semstab.model.results import Unit, UnitSummary
from semstab.model.voxels import VoxelTable
from semstab.recording import timeline
from semstab.recording.group import GroupLog, SceneLog, final
from semstab.recording.layout import blueprint
from semstab.recording.target import DEFAULT_URL, Target, is_whole
from semstab.recording.timeline import Background, Clock, path
from semstab.recording.voxel_maps import chunks_of, thinned_map
from semstab.settings import load_config
from semstab.task import Task, read

logger = logging.getLogger("semstab")

BYTES_A_VOXEL = 120
"""Memory that the recording's own map takes for a voxel, besides 8 bytes for each class."""


class Recording(Observer):
    """Writes one recording while the run is fused; a killed run leaves a recording up to a moment before.

    target  a file, or a `Target`: a file and a viewer
    run     the run folder, which has series and voxels of the units that were not fused whole in this process

    The file is opened at the first fused frame: a start that finds every unit finished leaves an earlier recording
    alone, unless a kill cut it. Call `close` where a run does not come to its end. Raises ConfigError where the file
    cannot be written.
    """

    def __init__(self, target: str | Path | Target, run: Path | None = None) -> None:
        self.target = target if isinstance(target, Target) else Target(Path(target))
        self._run = run
        self._plan: Plan
        self._scenes: dict[str, SceneLog] = {}
        self._tasks: dict[tuple[str, str], Task] = {}
        self._stream: rr.RecordingStream | None = None
        self._background: Background | None = None
        self._clock = Clock()
        self._live: GrowingMap | None = None
        self._group: GroupLog | None = None  # the backbone on a scene that is being fused
        self._unfinished: set[Unit] = set()  # of the group
        self._logged: set[Unit] = set()
        self._sent = 0

    def run_started(self, plan: Plan, finished: Mapping[str, UnitContent]) -> None:
        """Keep the plan: layout, names and colours follow from it."""
        self._plan = plan
        self._tasks = {(task.scene.name, task.backbone): task for task in plan.tasks}
        self._scenes = SceneLog.of_plan(plan, live=self.target.live)

    def group_started(self, task: Task, config: Config, backends: Mapping[Unit, FusionBackend]) -> None:
        """Follow the first map that can be followed."""
        self._end_group()
        self._unfinished = {*backends}
        self._live = next((each for each in backends.values() if isinstance(each, GrowingMap)), None)

    def frame_fused(self, task: Task, frame: Frame, rows: Mapping[Unit, FrameRow]) -> None:
        """Log a row of each time series, the camera, and the map."""
        (stream, background), scene = self._opened(), self._scenes[task.scene.name]
        self._clock.set(stream, frame.index, frame.timestamp)
        group = self._begun(task, frame.T_wc[:3, 3])
        for unit, row in rows.items():
            values = timeline.values(row.cells())
            timeline.log_row(stream, unit, group.task, values)
            group.span(values)
        scene.camera.log(stream, frame, background)
        group.log(stream, frame, background)
        if chunks_of(group.grown) > scene.chunks:
            show = functools.partial(self._show_chunks, stream, scene, group.grown)
            background.submit(frame.index, frame.timestamp, show)

    def unit_finished(
        self, planned: PlannedUnit, content: UnitContent | None, table: VoxelTable | None, error: str | None
    ) -> None:
        """Log the unit's voxels and final numbers, at the time of its last frame."""
        if planned.unit not in self._unfinished or self._group is None:
            return
        self._unfinished.remove(planned.unit)
        if content is not None and content.summary is not None and table is not None:
            self._log_unit(self._group, content.summary, table)
        if not self._unfinished:
            self._end_group()

    def run_finished(self, result: Result) -> None:
        """Log the units that were not fused here; the file is whole, or `serve` waits for viewers.

        Where no frame was fused here, an earlier recording that is whole stays.
        """
        self._end_group()
        if self._stream is None and is_whole(self.target.file):
            return
        self._opened()
        for task in self._plan.tasks:
            self._log_finished(task, [each for each in _of(result, task) if each.unit not in self._logged])
        if self.target.viewer != "serve":
            self.close()

    def replay(self, result: Result) -> None:
        """Record all units of a finished run: the frames are read again where the dataset is there."""
        for task in self._plan.tasks:
            records = _of(result, task)
            if not records:
                continue
            self._end_group()
            try:
                if not isinstance(task.scene, _ClosedScene):
                    self._replay_frames(task, records[0].summary)
            except (SemstabError, OSError) as error:
                logger.warning("%s, %s: recorded without pictures (%s)", task.scene.name, task.backbone, error)
            self._log_finished(task, records)
        self.run_finished(result)

    def serve(self) -> None:
        """Wait for viewers until the user interrupts, where the recording is served; else return at once."""
        if self._stream is None:
            return
        logger.warning("serving at %s until interrupted (Ctrl-C)", DEFAULT_URL)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
        self.close()

    def close(self) -> None:
        """Write out what is pending and close the file; a second call does nothing.

        Raises ConfigError where the end cannot be written: the disk is full, for example.
        """
        stream, self._stream = self._stream, None
        if stream is None:
            return
        try:
            if self._background is not None:
                self._background.close()
            for name, scene in self._scenes.items():
                if scene.is_open and scene.camera.unread is not None:
                    stream.log(path(name, "log"), rr.TextLog(f"without colour: {scene.camera.unread}"))
        finally:
            try:
                stream.flush()
            except RuntimeError as error:
                reason = "did the viewer go away?" if self.target.live else "is the disk full?"
                raise ConfigError(
                    f"{self.target.file}: the recording is not whole ({one_line(error)}; {reason}); all else is kept,"
                    " and the same command makes it again"
                ) from error
            finally:
                stream.disconnect()

    def _opened(self) -> tuple[rr.RecordingStream, Background]:
        if self._stream is None or self._background is None:
            self._stream = self.target.open()
            self._background = Background(self._stream, self._clock)
            for scene in self._scenes.values():
                scene.log_static(self._stream)
            timeline.log_styles(self._stream, self._plan)
            self._send_layout(self._stream)
        return self._stream, self._background

    def _begun(self, task: Task, position: Float64 | None = None, *, followed: bool = True) -> GroupLog:
        """The log of the backbone on a scene that is being fused."""
        stream, _ = self._opened()
        if self._group is None:
            own, config = self._tasks[task.scene.name, task.backbone], self._plan.config
            origin = self._scenes[task.scene.name].origin(stream, own, position, config.voxel_size)
            self._group = GroupLog(own, config.voxel_size, origin, self._live, followed=followed)
            self._live = None
        return self._group

    def _replay_frames(self, task: Task, summary: UnitSummary) -> None:
        """Read the frames of a task again; where the map would not fit into memory, their drift is left out."""
        config, scene = self._plan.config, task.scene.name
        fits = summary.table.voxels * (BYTES_A_VOXEL + 8 * summary.table.K) < available_bytes() / 2
        frames = prefetch(
            lambda index: read(task, index, config.pixel_stride),
            task.indices, threads=config.threads, size=lambda frame: frame.nbytes,
        )  # fmt: skip
        with contextlib.closing(frames):
            for each in frames:
                if self._group is None:
                    self._begun(task, each.item.T_wc[:3, 3], followed=fits)
                self.frame_fused(task, each.item, {})
        if not fits:
            text = f"{task.backbone}: drift of frames is left out, the map would not fit into memory a second time"
            self._opened()[0].log(path(scene, "log"), rr.TextLog(text))

    def _log_finished(self, task: Task, records: Sequence[Record]) -> None:
        """Log the series and the voxels of finished units from the run folder."""
        if not records:
            return
        stream, background = self._opened()
        background.drain()
        if self._run is None:
            self._clock.set(stream, task.indices[-1])
            for record in records:
                text = f"{final(record.summary)}; finished by an earlier start, series and voxels are not recorded"
                stream.log(path(task.scene.name, "log"), rr.TextLog(text))
            return
        own = self._tasks[task.scene.name, task.backbone]
        group = self._group or self._begun(own)
        for record in records:
            unit = record.unit
            for values in timeline.send_rows(stream, unit, own, self._run / "frames" / f"{unit.slug}.csv", self._clock):
                group.span(values)
            factor, table = thinned_map(voxels_of(self._run, unit), group.origin)
            self._log_unit(group, record.summary, table, factor)
        self._end_group()

    def _log_unit(self, group: GroupLog, summary: UnitSummary, table: VoxelTable, factor: int = 1) -> None:
        stream, background = self._opened()
        self._logged.add(summary.unit)
        tolerance = self._plan.config.tolerance
        background.submit(*group.last, functools.partial(group.log_unit, stream, summary, table, tolerance, factor))

    def _end_group(self) -> None:
        """Log the flips of the group that is fused, and the layout with its maps."""
        group, self._group, self._live, self._unfinished = self._group, None, None, set()
        if group is None:
            return
        stream, background = self._opened()
        background.submit(*group.last, functools.partial(self._lay_out, stream, group))
        background.submit(*group.last, functools.partial(group.log_flips, stream, self._clock))
        background.drain()

    def _lay_out(self, stream: rr.RecordingStream, group: GroupLog) -> None:
        """Send the layout again where there is more to it now."""
        scene = self._scenes[group.task.scene.name]
        if group.table is not None and scene.see(stream, group, group.table):
            scene.outgrown(group.voxels)
            self._send_layout(stream)
        else:
            self._show_chunks(stream, scene, group.voxels)

    def _show_chunks(self, stream: rr.RecordingStream, scene: SceneLog, voxels: int) -> None:
        if scene.outgrown(voxels):
            self._send_layout(stream)

    def _send_layout(self, stream: rr.RecordingStream) -> None:
        """Send the layout; a viewer that follows the run stays at the one that it got first."""
        layout = blueprint(self._plan, {name: scene.shown for name, scene in self._scenes.items()})
        stream.send_blueprint(layout, make_default=True, make_active=self._sent == 0 or not self.target.live)
        self._sent += 1


def _of(result: Result, task: Task) -> list[Record]:
    """The records of a task's units."""
    base = (*result.select(BASE), *result.select(BACKENDS))
    return [each for each in base if (each.unit.scene, each.unit.backbone) == (task.scene.name, task.backbone)]


# The recording of a finished run, from its folder.


def lacks_pictures(run: Path, file: Path) -> bool:
    """Return whether a finished run has units that its recording has no pictures of, or that no recording is there.

    Units that were fused in tiles, in other processes, or by an earlier start have none.
    """
    if not is_whole(file):
        return True
    columns = rr.chunk.RrdReader(file).store().schema().column_names()
    units = [record.unit for record in load_result(run).select()]
    labels = [path(unit.scene, "camera", unit.backbone, "labels") for unit in units]
    return any(f"{entity}:SegmentationImage:buffer" not in columns for entity in labels)


def record_finished(run: Path, file: Path) -> None:
    """Make the recording of a finished run from its folder; pictures need the dataset that config.yaml names."""
    result, config = load_result(run), load_config(run / "config.yaml")
    recording = Recording(file, run)
    recording.run_started(_plan_of(run, config, result), {})
    with contextlib.closing(recording):
        recording.replay(result)


@dataclass(frozen=True)
class _ClosedScene:
    """A scene of which only the run folder is there."""

    name: str
    backbones: tuple[str, ...]
    up: Float64 | None


def _plan_of(run: Path, config: Config, result: Result) -> Plan:
    """The plan of the run; without its dataset that of its finished units."""
    try:
        return make_plan(config)
    except SemstabError as error:
        logger.warning("%s: recorded without pictures (%s)", run, error)
    units = []
    for record in (*result.select(), *result.select(BACKENDS)):
        unit, up = record.unit, result.up.get(record.unit.scene)
        scene = _ClosedScene(unit.scene, result.backbones, None if up is None else np.array(up))
        classes = next(VoxelTable.iter_tiles(voxels_of(run, unit))).classes
        space = LabelSpace(record.summary.taxonomy, classes)
        if config.taxonomy is not None:
            with contextlib.suppress(SemstabError):
                space = LabelSpace.load(config.taxonomy)
        frames = timeline.frames_of(run / "frames" / f"{unit.slug}.csv")
        task = Task(cast(Scene, scene), unit.backbone, frames, space.mapping_to(space), (unit.backend,))
        units.append(PlannedUnit(record.variation, config, task, record.key, image_space=False, kept=True))
    return Plan(config, {}, tuple(units), ())
