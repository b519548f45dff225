"""Record a run by an observer, or a finished run from its folder."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.backends import FusionBackend, changes_of, create, expected_bytes
from semstab.config import BACKENDS, BASE, Config
from semstab.configure import require_named_code, settings_of_folder
from semstab.core.prefetch import prefetch
from semstab.core.process import available_bytes
from semstab.core.types import Float64, Int64, UInt8
from semstab.data.features import FeatureColours
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace
from semstab.data.measures import measures
from semstab.data.records import Record, RegionFlicker, Result
from semstab.data.results import TableSummary, UnitName
from semstab.data.voxels import VoxelTable
from semstab.datasets import Scene
from semstab.engine.folder import load_result
from semstab.engine.observer import Observer
from semstab.engine.series import FrameRow
from semstab.engine.units import Plan, Unit, make_plan, must_agree
from semstab.errors import ConfigError, SemstabError, summarize_error
from semstab.recording import timeline
from semstab.recording.camera import COARSE_SIDE, SceneLog, over_camera, stride_of
from semstab.recording.drift import DriftLog, FrameChanges, log_points
from semstab.recording.layout import VERDICT, blueprint, drawn
from semstab.recording.target import DEFAULT_URL, Target, flush, is_whole
from semstab.recording.timeline import Clock, FrameJobs, SeriesLog, path
from semstab.recording.voxel_maps import (
    PENDING,
    VoxelLogger,
    agreement_report,
    load_map,
    log_difference,
    verdict_report,
)
from semstab.report.narrative import not_assessed
from semstab.statistics.moving import has_movers, states_of
from semstab.task import Task, read

logger = logging.getLogger("semstab")

REPLAY = "numba"
"""The backend by which a finished run is fused again, where its recording lacks pictures."""


class GroupLog:
    """The recording of one model on a scene.

    Attributes:
        fused: The map whose growth and drift are drawn; None if no map is fused.
    """

    def __init__(self, task: Task, voxel_size: float, origin: Int64, fused: FusionBackend | None) -> None:
        self.task, self.origin = task, origin
        self._scene, self._classes = task.scene.name, task.mapping.target
        self._size, self._fused = voxel_size, fused
        self._drift = DriftLog(voxel_size)
        self._maps: dict[str, VoxelLogger] = {}
        self._colours: FeatureColours | None = None
        self._strides = dict[str, int]()  # of the last picture of each name
        self._tables: dict[str, VoxelTable] = {}  # by backend, as they are finished
        self.last: tuple[int, float | None] = (task.indices[-1], None)
        """The number and timestamp of the last frame."""

    def log(
        self, stream: rr.RecordingStream, frame: Frame, rows: Mapping[UnitName, FrameRow], voxels: int,
        series: SeriesLog, background: FrameJobs,
    ) -> None:  # fmt: skip
        """Log the rows of a fused frame, its labels, the changes that it made to the map, and the map of its voxels."""
        self.last = frame.index, frame.timestamp
        changes, jobs = None, list[Callable[[], None]]()
        if self._fused is not None:
            jobs = self._map(drawn(self.task)).update(stream, voxels, self._fused.table)
            changes = changes_of(self._fused)

        def job() -> None:
            drift = None if changes is None else self._drift.follow(frame, changes)
            for unit, row in rows.items():
                series.add(unit, self.task, frame.index, frame.timestamp, row.cells())
            if frame.is_scan:
                log_points(stream, path(self._scene, "camera", self.task.model), frame, drift)
            else:
                self._log_pictures(stream, frame, drift)
            for log_chunk in jobs:
                log_chunk()

        background.submit(frame.index, frame.timestamp, job)

    def _log_pictures(self, stream: rr.RecordingStream, frame: Frame, drift: FrameChanges | None) -> None:
        """Log labels, contradictions and drift over the image."""
        stride, coarse = stride_of(frame.shape), stride_of(frame.shape, COARSE_SIDE)
        pictures: dict[str, tuple[npt.NDArray[Any], int]] = {
            "labels": (np.ascontiguousarray(frame.predicted[::stride, ::stride]), stride)
        }
        if drift is not None:
            pictures |= {name: (picture, coarse) for name, picture in drift.pictures(coarse).items()}
        for name, (picture, picture_stride) in pictures.items():
            image = rr.SegmentationImage(picture, draw_order=-10)
            stream.log(self._picture(name), image, *self._placed(name, picture_stride))
        if frame.features is not None:  # in the colours of the first frame
            self._colours = self._colours or FeatureColours.from_features(frame.features)
        if frame.features is not None and self._colours is not None and self._colours.fit(frame.features):
            colours = frame.features.image(self._colours(frame.features), frame.shape, 0)[::stride, ::stride]
            image_of_features = rr.Image(np.ascontiguousarray(colours), draw_order=-5).compress(jpeg_quality=90)
            stream.log(self._picture("features"), image_of_features, *self._placed("features", stride))

    def _picture(self, name: str) -> str:
        return path(self._scene, "camera", self.task.model, name)

    def _placed(self, name: str, stride: int) -> list[rr.Transform3D]:
        """Return the transform that lays a picture over the camera's image, where the last one of its name differs."""
        before, self._strides[name] = self._strides.get(name), stride
        return [] if before == stride else [over_camera(stride)]

    def log_unit(
        self, stream: rr.RecordingStream, record: Record, table: VoxelTable, tolerance: float, factor: int = 1,
        moved: UInt8 | None = None,
    ) -> None:  # fmt: skip
        """Log a unit's final voxels, their differences from the drawn unit, its numbers, the agreement of its frames.

        - `factor`: the factor of a table that is thinned already: it is not compared
        - `moved`: (n,) the states of the table's voxels, if movers were found
        """
        unit, first = record.unit, drawn(self.task)
        if factor == 1:
            self._tables[unit.backend] = table
        if first in self._tables and factor == 1:
            for other in self._tables if unit.backend == first else [unit.backend]:
                if other != first:
                    self._log_difference(stream, first, other, tolerance)
        silent = not_assessed(record)
        note = self._map(unit.backend).finish(stream, table, factor, assessed=not silent, moved=moved)
        note += f"; {silent}" if silent else ""
        of_map = record.map_summary
        recurrent = of_map.recurrent
        means = (f"{m.full_title} {recurrent[m]:.{m.digits[0]}f} {m.unit}".rstrip() for m in measures())
        text = (
            f"{unit.model}, {unit.backend}: {of_map.voxels:,} voxels, mean OP {of_map.mean_op:.2f},"
            f" {', '.join(means)} (K = {of_map.K}){note}"
        )
        stream.log(path(unit.scene, "log"), rr.TextLog(text))
        if record.statistics is not None:
            document = rr.TextDocument(agreement_report(record.statistics), media_type=rr.MediaType.MARKDOWN)
            stream.log(path(unit.scene, "agreement", unit.model), document, static=True)

    def log_flips(self, stream: rr.RecordingStream, clock: Clock) -> None:
        """Log the voxels that drifted most, and the frames that contributed most."""
        table = self._tables.get(drawn(self.task))
        if table is None and self._fused is not None:
            table = self._fused.table()
        if table is not None:
            model, translation = self.task.model, self.origin * self._size
            self._drift.log(stream, self._scene, model, self._classes, table, translation, clock)

    def _log_difference(self, stream: rr.RecordingStream, first: str, second: str, tolerance: float) -> None:
        model, pair = self.task.model, f"{first} and {second}"
        tables = {name: self._tables[name] for name in (first, second)}
        text = log_difference(stream, path(self._scene, "difference", model, pair), tables, self.origin, tolerance)
        stream.log(path(self._scene, "log"), rr.TextLog(f"{model}: {text}"))
        report = rr.TextDocument(f"{text}.", media_type=rr.MediaType.MARKDOWN)
        stream.log(path(self._scene, "difference_report", model, pair), report, static=True)

    def _map(self, backend: str) -> VoxelLogger:
        if backend not in self._maps:
            entity = path(self._scene, "map", self.task.model, backend)
            self._maps[backend] = VoxelLogger(entity, self._classes, self.origin, len(self.task.indices))
        return self._maps[backend]


class Recording(Observer):
    """An observer that writes one recording during the run; a killed run leaves one up to a moment before.

    The file is opened at the first fused frame: a start that finds every unit finished leaves an earlier recording
    alone, unless a kill cut it. Series and voxels of units that were not fused whole in this process come from the
    run's folder. Call `close` where a run does not come to its end.

    Attributes:
        target: A file, or a `Target`: a file and a viewer.

    Raises:
        ConfigError: If the file cannot be written.
    """

    def __init__(self, target: str | Path | Target) -> None:
        self.target = target if isinstance(target, Target) else Target(Path(target))
        self._plan: Plan
        self._scenes: dict[str, SceneLog] = {}
        self._stream: rr.RecordingStream | None = None
        self._background: FrameJobs | None = None
        self._clock = Clock()
        self._series: SeriesLog
        self._fused: FusionBackend | None = None  # the map that is drawn
        self._group: GroupLog | None = None  # the model on a scene that is being fused
        self._unfinished: set[UnitName] = set()  # of the group
        self._logged: set[UnitName] = set()
        self._live: set[UnitName] = set()  # units whose rows were logged frame by frame
        self._not_assessed: set[tuple[str, str]] = set()  # scenes and models
        self._with_movers: set[tuple[str, str]] = set()
        self._sent, self._outdated = 0, False  # layouts; whether maps have been finished since the last one
        self._others = "all other files are complete, and the same command makes the recording again"

    def run_started(self, plan: Plan, finished: Mapping[str, Record | RegionFlicker]) -> None:
        """Store the plan, which gives layout, names and colours."""
        self._plan = plan
        for name in dict.fromkeys(task.scene.name for task in plan.tasks):
            self._scenes[name] = SceneLog([task for task in plan.tasks if task.scene.name == name])

    def group_started(self, task: Task, config: Config, backends: Mapping[UnitName, FusionBackend]) -> None:
        """Follow the map that is drawn. The one before is let go of within a few frames: few jobs may wait."""
        self._end_group()
        self._unfinished = {*backends}
        self._fused = next((backend for unit, backend in backends.items() if unit.backend == self._drawn(task)), None)

    def frame_fused(self, task: Task, frame: Frame, rows: Mapping[UnitName, FrameRow]) -> None:
        """Log a row of each time series, the camera, and the map."""
        self._live |= {*rows}
        voxels = next((row.report.map_voxels for unit, row in rows.items() if unit.backend == self._drawn(task)), 0)
        self._log_frame(task, frame, rows, voxels)

    def _log_frame(self, task: Task, frame: Frame, rows: Mapping[UnitName, FrameRow], voxels: int) -> None:
        stream, background = self._opened()
        self._clock.set(stream, frame.index, frame.timestamp)
        group = self._group
        if group is None or group.task.model != task.model:  # the models of a video take turns
            group = self._begin(task, frame.T_wc[:3, 3])
        self._scenes[task.scene.name].log(stream, frame, background)
        group.log(stream, frame, rows, voxels, self._series, background)

    def unit_finished(
        self, unit: Unit, record: Record | RegionFlicker | None, table: VoxelTable | None, error: str | None
    ) -> None:
        """Log the unit's voxels and final numbers, at the time of its last frame."""
        if unit.name not in self._unfinished or self._group is None:
            return
        self._unfinished.remove(unit.name)
        if isinstance(record, Record) and table is not None:
            self._log_unit(self._group, record, table)
        if not self._unfinished:
            self._end_group()

    def run_finished(self, result: Result) -> None:
        """Log the units that were not fused here; the file is whole, or `serve` waits for viewers.

        Where no frame was fused here, an earlier recording that is whole stays.
        """
        self._end_group()
        if result.failures:
            self._others = (
                f"{len(result.failures)} of {len(result.failures) + len(result.records)} units failed, the first with"
                f" {result.failures[0].message}; the same command computes them again"
            )
        if self._stream is None and is_whole(self.target.file):
            return
        self.log_finished(result)
        if self.target.viewer != "serve":
            self.close()

    def log_finished(self, result: Result, *, pictures: bool = False) -> None:
        """Log the units in the run's folder that are not logged yet; with pictures read their frames again."""
        stream, background = self._opened()
        background.drain()  # "the verdict follows" is logged before the verdict
        for task in self._plan.tasks:
            scene, model = task.scene.name, task.model
            records = [
                record
                for sweep in (BASE, BACKENDS)
                for record in result.select(sweep, scene=scene, model=model)
                if record.unit not in self._logged
            ]
            if not records:
                continue
            try:
                if pictures and not isinstance(task.scene, _ClosedScene):
                    self._replay_frames(task, records[0].map_summary)
            except (SemstabError, OSError) as error:
                logger.warning("%s, %s: recorded without pictures (%s)", scene, model, error)
            background.drain()
            self._clock.set(stream, task.indices[-1])
            group = self._group or self._begin(task)
            for record in records:
                if record.series is not None:
                    only = ("lone_percent",) if record.unit in self._live and record.pixels is not None else ()
                    timeline.log_file(stream, record.unit, task, record.series, self._clock, only)
                if record.pixels is None:
                    factor, table = load_map(record, group.origin)
                    self._log_unit(group, record, table, factor)
            self._end_group()
        for scene in self._scenes:
            verdict = rr.TextDocument(verdict_report(result, scene), media_type=rr.MediaType.MARKDOWN)
            stream.log(path(scene, VERDICT), verdict, static=True)

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

        Raises:
            ConfigError: If the end cannot be written: the disk is full, for example.
        """
        stream, self._stream = self._stream, None
        if stream is None:
            return
        try:
            if self._background is not None:
                self._background.close()
                self._series.send()
            if self._outdated:
                self._send_layout(stream)
        finally:
            try:
                flush(stream, self.target.file)
            except RuntimeError as error:
                reason = "was the viewer closed?" if self.target.live else "is the disk full?"
                raise ConfigError(
                    f"{self.target.file}: the recording is not complete ({summarize_error(error)}; {reason});"
                    f" {self._others}"
                ) from error
            else:
                stream.disconnect()

    def _opened(self) -> tuple[rr.RecordingStream, FrameJobs]:
        if self._stream is None or self._background is None:
            self._stream = self.target.open()
            self._background = FrameJobs(self._stream, self._clock)
            self._series = SeriesLog(self._stream, self._clock)
            self._background.begin(functools.partial(self._log_static, self._stream))
        return self._stream, self._background

    def _log_static(self, stream: rr.RecordingStream) -> None:
        for scene in self._scenes.values():
            scene.log_static(stream)
            stream.log(path(scene.name, VERDICT), rr.TextDocument(PENDING), static=True)
        timeline.log_styles(stream, self._plan)
        self._send_layout(stream)

    def _begin(self, task: Task, position: Float64 | None = None) -> GroupLog:
        """Begin the log of a model on a scene, with all backends of the plan."""
        stream, _ = self._opened()
        scene, voxel_size = self._scenes[task.scene.name], self._plan.config.voxel_size
        if position is None:
            position = task.scene.T_wc(task.indices[0])[:3, 3] if task.scene.posed else np.zeros(3)
        origin = scene.begin(stream, position, voxel_size)
        self._group = GroupLog(self._planned(task), voxel_size, origin, self._fused)
        return self._group

    def _planned(self, task: Task) -> Task:
        """Return the model on the scene with all backends of the plan."""
        key = task.scene.name, task.model
        return next(planned for planned in self._plan.tasks if (planned.scene.name, planned.model) == key)

    def _drawn(self, task: Task) -> str:
        """Return the backend that is drawn among those that are fused now."""
        return drawn(dataclasses.replace(self._planned(task), backends=task.backends))

    def _replay_frames(self, task: Task, of_map: TableSummary) -> None:
        """Read and fuse the frames of a task again; where the map would not fit into memory, drift is left out."""
        config, scene, K = self._plan.config, task.scene.name, of_map.K
        posed = task.scene.posed
        fits = expected_bytes(REPLAY, of_map.voxels, 0, K, soft=True) < available_bytes() / 2
        self._fused = create(REPLAY, voxel_size=config.voxel_size, num_classes=K) if fits and posed else None
        frames = prefetch(
            lambda index: read(task, index, config.pixel_stride, color=not posed),
            task.indices, threads=config.threads, size=lambda frame: frame.nbytes,
        )  # fmt: skip
        with contextlib.closing(frames):
            for fetched in frames:
                voxels = 0 if self._fused is None else self._fused.integrate(fetched.item).map_voxels
                self._log_frame(task, fetched.item, {}, voxels)
        if not fits:
            text = f"{task.model}: drift of frames is left out, because its map would not fit into memory"
            self._opened()[0].log(path(scene, "log"), rr.TextLog(text))

    def _log_unit(self, group: GroupLog, record: Record, table: VoxelTable, factor: int = 1) -> None:
        unit = record.unit
        stream, background = self._opened()
        self._logged.add(unit)
        if not_assessed(record):
            self._not_assessed.add((unit.scene, unit.model))
        if has_movers(record):
            self._with_movers.add((unit.scene, unit.model))
        tolerance = self._plan.config.tolerance

        def job() -> None:
            self._series.send()
            group.log_unit(stream, record, table, tolerance, factor, states_of(record, table.centers))
            self._scenes[unit.scene].see(stream, group.task, table)
            self._outdated = True
            if self._sent == 1:  # later layouts wait for the end: each has all scenes
                self._send_layout(stream)

        background.submit(*group.last, job)

    def _end_group(self) -> None:
        """Log the flips of the group that is fused."""
        group, self._group, self._fused, self._unfinished = self._group, None, None, set()
        if group is None:
            return
        stream, background = self._opened()
        background.submit(*group.last, lambda: group.log_flips(stream, self._clock))

    def _send_layout(self, stream: rr.RecordingStream) -> None:
        """Send the layout; a viewer that follows the run keeps the first one."""
        legends = {name: scene.legend for name, scene in self._scenes.items()}
        bounds = {name: scene.bounds for name, scene in self._scenes.items()}
        layout = blueprint(self._plan, legends, bounds, self._not_assessed, self._with_movers)
        stream.send_blueprint(layout, make_default=True, make_active=self._sent == 0 or not self.target.live)
        self._sent, self._outdated = self._sent + 1, False


# A finished run is recorded from its folder.


def lacks_pictures(run: Path, file: Path) -> bool:
    """Return whether a finished run has no recording, or units without pictures in it.

    Units that were fused in tiles, in other processes, or by an earlier start have none.
    """
    if not is_whole(file):
        return True
    columns = rr.chunk.RrdReader(file).store().schema().column_names()
    units = [record.unit for record in load_result(run).select()]
    labels = [path(unit.scene, "camera", unit.model, "labels") for unit in units]
    return any(f"{entity}:SegmentationImage:buffer" not in columns for entity in labels)


def record_finished(run: Path, file: Path, code: Sequence[str] = ()) -> None:
    """Write the recording of a finished run from its folder; pictures need the dataset that config.yaml names.

    Args:
        run: The folder.
        file: The recording.
        code: Code that config.yaml names and that may run, FILE.py:NAME each; with other code there are no pictures.
    """
    result = load_result(run)
    with settings_of_folder(run, code) as config:
        recording = Recording(file)
        recording.run_started(_plan_of(run, config, result), {})
        with contextlib.closing(recording):
            recording.log_finished(result, pictures=True)


@dataclass(frozen=True)
class _ClosedScene:
    """A scene of which only the run folder is available."""

    name: str
    models: tuple[str, ...]
    up: Float64 | None
    of_scans: bool = False
    posed: bool = True

    def T_wc(self, index: int) -> Float64:
        """Return the world's origin: poses are not in the folder."""
        return np.eye(4)


def _without_code(config: Config) -> Config:
    """Return settings from which a plan of finished units follows without the backends that cannot be loaded."""
    lost = set()
    for backend in config.fused_by():
        try:
            must_agree(backend.model_copy(update={"check": None}))
        except SemstabError:
            lost.add(backend.name)
    backends = [
        backend.model_copy(update={"check": True}) if backend.name in lost else backend for backend in config.backends
    ]
    return config.model_copy(update={"backends": backends, "check": None if lost else config.check})


def _plan_of(run: Path, config: Config, result: Result) -> Plan:
    """Return the plan of the run; without its dataset that of its finished units."""
    try:
        require_named_code(run)
        return make_plan(config)
    except SemstabError as error:
        logger.warning("%s: recorded without pictures (%s)", run, error)
    config = _without_code(config)
    units = []
    for record in (*result.select(), *result.select(BACKENDS)):
        unit, up = record.unit, result.up.get(record.unit.scene)
        axis, posed = None if up is None else np.array(up), record.pixels is None
        scene = _ClosedScene(unit.scene, result.models, axis, posed=posed)
        classes = next(record.tiles()).classes if record.pixels is None else record.pixels.classes
        space = LabelSpace(record.taxonomy, classes)
        if config.taxonomy is not None:
            with contextlib.suppress(SemstabError):
                space = LabelSpace.load(config.taxonomy)
        assert record.series is not None
        frames = [frame for frame, *_ in timeline.read_rows(record.series)]
        task = Task(cast(Scene, scene), unit.model, frames, space.mapping_to(space), (unit.backend,))
        units.append(Unit.from_task(record.variation, config, task, record.key, stored=True))
    return Plan(config, {}, tuple(units), ())
