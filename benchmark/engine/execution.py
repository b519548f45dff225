"""A run or a study computes every unit of its plan that an earlier start did not finish; all of them make a result."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

from semstab.check import (
    Ordered,
    Verdict,
    advise,
    faces_in_surface,
    quick_sample,
    refuse_unsound,
    with_invalid_depth,
    with_voxel_size,
)
from semstab.check.scene_notes import scene_notes, stored_labels
from semstab.config import Config
from semstab.configure import resolve
from semstab.core.process import trim_malloc
from semstab.data.records import Record, Result
from semstab.engine.executors import Executor, InProcess
from semstab.engine.folder import Folder, require_file_names
from semstab.engine.frame_loop import share_open_scenes
from semstab.engine.observer import Observer, Observers
from semstab.engine.run_result import UnitResults, advice_of, manifest, result_of
from semstab.engine.sizing import planned_sizes
from semstab.engine.tiled_units import TiledUnit
from semstab.engine.units import Plan, Unit, fitting, make_plan
from semstab.engine.work import Job, Start, Work, jobs_of
from semstab.errors import ConfigError, DataError
from semstab.task import open_scenes

logger = logging.getLogger("semstab")


def execute(
    config: Config,
    out: Path,
    executor: Executor | None = None,
    observers: Sequence[Observer] = (),
    command: Sequence[str] = (),
    *,
    overwrite: bool = False,
) -> tuple[Result, Mapping[str, BaseException]]:
    """Compute the units that the folder `out` does not hold yet, and return the result of all.

    Each unit is stored when it is finished, under a key of its settings and its input: a killed run is resumed by the
    same command, and a changed setting computes again only the units that it touches. `command` goes into the manifest;
    results of another run, of which nothing would be kept, are replaced only with `overwrite`.
    A unit that fails is among the result's failures, and the others finish.

    Returns:
        The result, and the exceptions of failing units in this process, by message.

    Raises:
        ConfigError, DataError: If the plan does not fit together, or a scene's depth and poses contradict each other,
            before anything is computed.
    """
    started, telling, executor = time.perf_counter(), Observers(observers), executor or InProcess()
    config = resolve(config)
    scenes = open_scenes(config, out.absolute(), posed=False)
    config = fitting(config, scenes)
    config, gaps = with_invalid_depth(config, scenes) if config.check_geometry else (config, {})
    if gaps:
        scenes = open_scenes(config, out.absolute())
    config, advice = with_voxel_size(config, scenes)
    plan = make_plan(config, scenes)
    require_file_names(out, (unit.name for unit in plan.units))
    folder = Folder(out, plan, overwrite=overwrite)
    try:
        execution = _Execution(plan, folder, executor, telling, gaps)
        with folder.started(config) as start, share_open_scenes(start.name, plan.scenes):
            execution.begin(start)
            with contextlib.closing(executor.run(execution.next_job, telling)) as works:
                for work in itertools.chain(execution.ended, works):
                    execution.take(work)
        units = execution.units
        units.advice = advice or advice_of(plan, units.records)
        result = result_of(plan, folder, units)
        units.watch.seconds["all"] = time.perf_counter() - started
        result = dataclasses.replace(result, manifest=manifest(plan, units, executor.name, command))
        folder.save_result(result, units.finished())
        telling.tell(lambda observer: observer.run_finished(result))
    finally:
        folder.close()
        executor.close()
    telling.raise_first()
    return result, units.causes


class _Execution:
    """The units that an earlier start finished, and all others, stored as they finish.

    Attributes:
        units: What is known of each unit so far.
        ended: Tiled units that an earlier start computed and did not store.
    """

    def __init__(
        self, plan: Plan, folder: Folder, executor: Executor, observers: Observers, gaps: Mapping[str, str]
    ) -> None:
        self._plan, self._folder, self._executor, self._observers = plan, folder, executor, observers
        self._gaps = gaps
        self.units = units = UnitResults()
        with units.watch("digest"):
            stored = ((key, folder.finished(unit)) for key, unit in plan.distinct().items())
            units.records = {key: record for key, record in stored if record is not None}
        units.finished_before, finished = len(units.records), dict(units.records)
        self._missing = {key: unit for key, unit in plan.distinct().items() if key not in finished}
        if self._missing:
            folder.remove_outputs()
        observers.tell(lambda observer: observer.run_started(plan, finished))
        self._queue, self._tiled, self.ended = deque[Job](), dict[str, TiledUnit](), list[Work]()
        if plan.config.check_geometry:
            with units.watch("check"):
                self._check_geometry(plan.config, [*self._missing.values()])

    def begin(self, start: Start) -> None:
        """Queue the units that are fused whole, and the units in tiles; those that cannot be fused fail."""
        with self.units.watch("sizing"):
            sizing = planned_sizes(self._plan.config, self._missing.values(), self._executor.width)
            trim_malloc()
        for line in sizing.lines:
            logger.warning("%s", line)
        untiled = list[Work]()
        for key, unit in self._missing.items():
            if (error := sizing.refused.get(key)) is not None:
                self._keep(Work.from_unit(unit, start).failed(ConfigError(error)))
            elif (size := sizing.tile_sizes.get(key)) is not None:
                self._tiled[key] = TiledUnit(unit, size, self._folder, start)
            else:
                untiled.append(Work.from_unit(unit, start))
        self._queue = deque(jobs_of(untiled, self._executor.width))
        self.ended = [work for tiled in self._tiled.values() if (work := tiled.ended()) is not None]

    def next_job(self) -> Job | None:
        """Return the next job, or None without a job until a work that comes back calls for more."""
        if self._queue:
            return self._queue.popleft()
        return next(filter(None, (unit.next_job() for unit in self._tiled.values())), None)

    def take(self, work: Work) -> None:
        """Store a unit or a tile that a worker gave back."""
        tiled = self._tiled.get(work.unit.identity)
        if tiled is None or work.tile is None:
            self._keep(work)
            return
        self.units.add_seconds(work)
        with self.units.watch("assemble"):
            finished = tiled.take(work)
        step, name = tiled.step(), tiled.name
        self._observers.tell(lambda observer: observer.advanced(step, name))
        if finished is not None:
            self._keep(finished)

    def _keep(self, work: Work) -> None:
        """Store a whole unit, or why there is none, and tell the observers."""
        units, folder, record = self.units, self._folder, work.record
        unit = self._missing[work.unit.identity]  # a worker gives it back without its task
        if record is None:
            error = units.errors[unit.identity] = work.error or ""
            folder.save_trace(work)
            if work.cause is not None:
                units.causes.setdefault(error, work.cause)
        else:
            if isinstance(record, Record):
                scene, model = unit.name.scene, unit.name.model
                advice, notes = units.advice.get(scene), units.notes.get((scene, model), ())
                record = dataclasses.replace(record, advice=advice, notes=notes)
            with units.watch("keep"):
                folder.save(dataclasses.replace(work, record=record))
                if isinstance(record, Record):
                    folder.clear(unit, record.files)
            units.records[unit.identity] = record
        if unit.identity not in self._tiled:
            units.add_seconds(work)
            if self._executor.elsewhere or unit.regions:
                frames, name = len(unit.task.indices), f"{unit.name.scene} · {unit.name.model}"
                self._observers.tell(lambda observer: observer.advanced(frames, name))
        if isinstance(record, Record):
            record = dataclasses.replace(record, voxels_file=folder.record(unit, record).voxels_file)
        self._observers.tell(lambda observer: observer.unit_finished(unit, record, work.table, work.error))

    def _check_geometry(self, config: Config, missing: Sequence[Unit]) -> None:
        """Check the geometry and the voxel size of each scene of missing units; those report errors of reading."""
        fused = {(unit.name.scene, unit.name.model): unit.task for unit in reversed(missing) if not unit.regions}
        tasks = {scene: task for (scene, _), task in fused.items()}
        verdicts, faces, ordered = dict[str, Verdict](), dict[str, list[str]](), dict[str, Ordered]()
        for task in reversed(tasks.values()):
            with contextlib.suppress(DataError):
                name, options = task.scene.name, config.dataset.options
                stored = stored_labels(task.scene, task.model, config)
                verdicts[name], sample, ordered[name] = quick_sample(task.scene, task.indices, options, stored)
                faces[name] = faces_in_surface(sample, config)
                if (advice := advise(sample, config)) is not None:
                    self.units.advice[name] = advice
        for scene, verdict in verdicts.items():
            refuse_unsound(tasks[scene].scene, verdict)
            self._observers.tell(
                lambda observer, scene=scene, verdict=verdict: observer.geometry_checked(tasks[scene], verdict)  # type: ignore[misc]
            )
        self.units.geometry = verdicts
        for (scene, model), task in fused.items():
            if scene in verdicts:
                with contextlib.suppress(DataError):
                    notes = scene_notes(task.scene, task.indices, model, config, ordered.get(scene))
                    notes = (*notes, *faces.get(scene, []))
                    left_out = [self._gaps[scene]] if scene in self._gaps else []
                    self.units.notes[scene, model] = (*left_out, *verdicts[scene].remarks, *notes)
