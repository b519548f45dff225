"""The run: every selected backbone through every selected backend, measured, compared, and kept.

What happens is told to observers; the terminal, the rerun recording and others watch the run through them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import time
from collections import defaultdict
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from semstab.backends import FusionBackend, create, takes_option
from semstab.check import Verdict, require_sound
from semstab.config import BackendConfig, Config
from semstab.errors import DataError
from semstab.evaluation import Evaluation, logged_by
from semstab.frames import Frame
from semstab.manifest import manifest
from semstab.memory import require_memory
from semstab.metrics import compare, flicker_percent, macro_mean, summarise
from semstab.plan import Plan, Task, make_plan, read, resolve
from semstab.prefetch import Fetched, prefetch
from semstab.results import STAGES, GroupResult, RunResult, Unit, UnitSummary
from semstab.run_folder import FrameRow, RunFolder, group_key
from semstab.statistics import BackboneComparison, MapStatistics
from semstab.voxels import VoxelTable


class Observer:
    """Watches a run; override what is of interest. Frames have their colour where an observer `wants_color`."""

    wants_color = False

    def run_started(self, plan: Plan) -> None:
        """The plan is made, nothing is fused yet."""

    def geometry_checked(self, task: Task, verdict: Verdict) -> None:
        """Depth and poses of the task's scene were compared, and do not contradict each other."""

    def frame_fused(self, unit: Unit, frame: Frame, row: FrameRow) -> None:
        """A frame went into a unit's map; `frame` holds labels in the run's label space."""

    def unit_fused(self, unit: Unit, table: VoxelTable) -> None:
        """All frames went into a unit's map, which is measured and written next."""

    def unit_finished(self, unit: Unit, table: VoxelTable, summary: UnitSummary) -> None:
        """A unit's map is measured and written."""

    def group_kept(self, task: Task, result: GroupResult) -> None:
        """A backbone on a scene was found finished in the run folder."""

    def run_finished(self, result: RunResult) -> None:
        """Everything has been written."""


def run(
    config: Config,
    *,
    out: str | Path | None = None,
    observers: Sequence[Observer] = (),
    command: Sequence[str] = (),
) -> RunResult:
    """Fuse, measure and compare what the configuration selects.

    out is the run folder; where it holds a part of this very run, that part is kept. `command` goes into the manifest.
    Raises ConfigError or DataError; what was finished before stays in the run folder.
    """
    config = resolve(config)
    plan = make_plan(config)
    folder = None if out is None else RunFolder(out, config)
    watch = Stopwatch()
    for observer in observers:
        observer.run_started(plan)
    groups: list[GroupResult] = []
    comparisons: list[BackboneComparison] = []
    geometry: dict[str, Verdict] = {}
    evaluation = Evaluation(config)
    for task in plan.tasks:
        groups.append(_run_task(task, config, folder, observers, watch, geometry, evaluation))
        if task is plan.last_of(task.scene):
            with watch("statistics"):
                comparisons += evaluation.comparisons()
        result = RunResult(tuple(groups), tuple(comparisons))
        if folder is not None:
            folder.save_summary(result)
            inputs = {f"{t.scene.name}/{t.backbone}": t.digest for t in plan.tasks[: len(groups)]}
            checked = {"geometry": {scene: verdict.summary() for scene, verdict in geometry.items()}}
            folder.save_manifest(manifest(config, inputs, watch.seconds, command) | checked)
    for observer in observers:
        observer.run_finished(result)
    return result


def _run_task(
    task: Task,
    config: Config,
    folder: RunFolder | None,
    observers: Sequence[Observer],
    watch: Stopwatch,
    geometry: dict[str, Verdict],
    evaluation: Evaluation,
) -> GroupResult:
    kept = None if folder is None else _kept(task, config, folder, watch)
    if folder is not None and kept is not None:
        if config.statistics:
            evaluation.add(task, VoxelTable.load(folder.voxels_path(kept.runs[0].unit)))
        for observer in observers:
            observer.group_kept(task, kept)
        return kept
    if config.check_geometry and task.scene.name not in geometry:
        with watch("check"):
            verdict = require_sound(task.scene, task.indices, task.backbone, config.dataset.options)
        geometry[task.scene.name] = verdict
        for observer in observers:
            observer.geometry_checked(task, verdict)
    result = _fuse(task, config, folder, observers, watch, evaluation)
    if folder is not None:
        folder.save_group(task.scene.name, task.backbone, _key(task, config, watch), result)
    return result


def _kept(task: Task, config: Config, folder: RunFolder, watch: Stopwatch) -> GroupResult | None:
    """What an earlier start found. Only then is the input read to compare it; else its digest comes with decoding."""
    scene, backbone = task.scene.name, task.backbone
    return folder.kept(scene, backbone, _key(task, config, watch)) if folder.has(scene, backbone) else None


def _key(task: Task, config: Config, watch: Stopwatch) -> str:
    with watch("digest"):
        return group_key(config, task.scene.name, task.backbone, task.digest)


def _fuse(
    task: Task,
    config: Config,
    folder: RunFolder | None,
    observers: Sequence[Observer],
    watch: Stopwatch,
    evaluation: Evaluation,
) -> GroupResult:
    """One backbone on one scene through every backend: the same frames in the same order, decoded once."""
    maps = _maps(task, config)
    rows = _fuse_frames(task, config, maps, observers, watch)
    with watch("measure"):
        classes = task.mapping.target.classes
        tables = {unit: dataclasses.replace(backend.table(), classes=classes) for unit, backend in maps.items()}
        require_voxels(task, config, tables)
    with watch("observe"):
        for unit in maps:
            for observer in observers:
                observer.unit_fused(unit, tables[unit])
    with watch("statistics"):
        analyses = evaluation.analyses(task, maps, tables)
    with watch("measure"):
        said = {unit: analyses[unit].summary if unit in analyses else None for unit in maps}
        summaries = {unit: unit_summary(task, config, tables[unit], unit, rows[unit], said[unit]) for unit in maps}
        alike = [unit for unit, backend in maps.items() if getattr(backend, "pointwise", True)]
        agreement = tuple(
            compare(tables[a], tables[b], (a, b), tolerance=config.tolerance)
            for a, b in itertools.combinations(alike, 2)
        )
    with watch("write"):
        for unit, backend in maps.items():
            if folder is not None:
                events = backend.events() if config.events else None
                named = None if events is None else dataclasses.replace(events, classes=classes)
                found = analyses[unit].maps if config.statistics and unit in analyses else {}
                folder.save_unit(unit, tables[unit], named, rows[unit], found)
    with watch("observe"):
        for unit in maps:
            for observer in observers:
                observer.unit_finished(unit, tables[unit], summaries[unit])
    return GroupResult(tuple(summaries.values()), agreement)


def _fuse_frames(
    task: Task, config: Config, maps: Mapping[Unit, FusionBackend], observers: Sequence[Observer], watch: Stopwatch
) -> dict[Unit, list[FrameRow]]:
    """Every frame into every map, while worker threads decode the next ones."""
    rows: dict[Unit, list[FrameRow]] = {unit: [] for unit in maps}
    previous: Frame | None = None
    with contextlib.closing(_decoded(task, config, observers)) as frames:
        for fetched in frames:
            frame = fetched.item
            if previous is None:
                require_memory(task, config, frame)
            watch.seconds["read"] += fetched.waited
            with watch("flicker") as flicker_time:
                flicker = flicker_between(previous, frame)
            for unit, backend in maps.items():
                with watch(f"fuse {unit.backend}"):
                    report = backend.integrate(frame)
                row = FrameRow(
                    report, frame.timestamp, flicker, fetched.seconds, fetched.waited, flicker_time.seconds,
                    left_out=frame.left_out_pixels,
                )  # fmt: skip
                with watch("observe") as logging_time:
                    for observer in observers:
                        observer.frame_fused(unit, frame, row)
                rows[unit].append(dataclasses.replace(row, logging_seconds=logging_time.seconds))
            previous = frame
    return rows


def _decoded(task: Task, config: Config, observers: Sequence[Observer]) -> Generator[Fetched[Frame], None, None]:
    """The task's frames in order, each with what makes them ready to fuse done in a worker thread."""
    color = any(observer.wants_color for observer in observers)

    def decode(index: int) -> Frame:
        frame = read(task, index, config.pixel_stride, color=color)
        _ = frame.valid  # computed once and kept: here, where it costs the caller no time
        return frame

    return prefetch(decode, task.indices, threads=config.threads, size=lambda frame: frame.nbytes)


def flicker_between(previous: Frame | None, frame: Frame) -> float:
    """Flicker against the frame before; undefined for the first one, and where the image size changes."""
    if previous is None or previous.shape != frame.shape:
        return math.nan
    return flicker_percent(previous, frame)


def _maps(task: Task, config: Config) -> dict[Unit, FusionBackend]:
    created = (new_map(backend, task, config) for backend in config.fused_by())
    return dict(zip(task.units, created, strict=True))


def new_map(backend: BackendConfig, task: Task, config: Config) -> FusionBackend:
    """An empty map; it keeps the history where the run is to write it, or to compute statistics from it."""
    wanted = config.events or backend.name == logged_by(config)
    history = {"history": True} if wanted and takes_option(backend.name, "history") else {}
    options = history | backend.options
    return create(backend.name, voxel_size=config.voxel_size, num_classes=len(task.mapping.target), **options)


def require_voxels(task: Task, config: Config, tables: Mapping[Unit, VoxelTable]) -> None:
    """Raise DataError, which says what is missing in the first frame, where every map is empty."""
    if any(len(table) for table in tables.values()):
        return
    frame = read(task, task.indices[0], config.pixel_stride)
    depth = np.mean(np.isfinite(frame.depth) & (frame.depth > 0))
    labelled = np.mean(frame.predicted != frame.ignore_id)
    raise DataError(
        f"{task.scene.name}, {task.backbone}: no pixel of {len(task.indices)} frames is valid (first frame: depth in"
        f" {depth:.0%} of the pixels, a label in {labelled:.0%}); check depth_scale, the ignore id and the taxonomy"
    )


def unit_summary(
    task: Task,
    config: Config,
    table: VoxelTable,
    unit: Unit,
    rows: list[FrameRow],
    statistics: MapStatistics | None,
) -> UnitSummary:
    """What is reported of a unit, from its map, its time series and what `semstab.statistics` says of the map."""
    return UnitSummary(
        unit=unit,
        taxonomy=task.mapping.target.name,
        frames=len(task.indices),
        table=summarise(table, config.strata),
        flicker_percent=macro_mean([row.flicker_percent for row in rows]),
        fuse_ms_per_frame=macro_mean([row.report.seconds * 1e3 for row in rows]),
        stages_ms=_stages_ms(rows),
        left_out=sum(row.left_out for row in rows),
        statistics=statistics,
    )


def _stages_ms(rows: list[FrameRow]) -> dict[str, float]:
    """Mean milliseconds a frame by stage; NaN where no frame has it."""
    stages = [row.stage_ms() for row in rows]
    return {stage: macro_mean([row[stage] for row in stages]) for stage in STAGES}


class Stopwatch:
    """Adds up wall-clock seconds by stage."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[Lap]:
        """Time the block; the yielded lap has its own seconds once it is over."""
        lap = Lap()
        started = time.perf_counter()
        try:
            yield lap
        finally:
            lap.seconds = time.perf_counter() - started
            self.seconds[stage] += lap.seconds


@dataclasses.dataclass
class Lap:
    """What one timed block took."""

    seconds: float = math.nan
