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

from semstab.check import Verdict, advise, quick_sample, refuse_unsound, with_invalid_depth, with_voxel_size
from semstab.check.scene_notes import scene_notes
from semstab.config import Config
from semstab.core.process import trim_malloc
from semstab.data.records import Result
from semstab.engine.executors import Executor, InProcess
from semstab.engine.folder import Folder, require_file_names
from semstab.engine.frame_loop import share_open_scenes
from semstab.engine.memory import planned_sizes
from semstab.engine.messages import Job, Outcome, Start, Work, jobs_of
from semstab.engine.observer import Observer, Observers
from semstab.engine.run_result import UnitResults, advice_of, manifest, result_of
from semstab.engine.tiled_units import TiledUnit
from semstab.engine.units import Plan, PlannedUnit, make_plan
from semstab.errors import ConfigError, DataError
from semstab.settings import resolve
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
    scenes = open_scenes(config, out.absolute())
    config, gaps = with_invalid_depth(config, scenes) if config.check_geometry else (config, {})
    if gaps:
        scenes = open_scenes(config, out.absolute())
    config, advice = with_voxel_size(config, scenes)
    plan = make_plan(config, scenes)
    require_file_names(out, (each.unit for each in plan.units))
    folder = Folder(out, plan, overwrite=overwrite)
    try:
        execution = _Execution(plan, folder, executor, telling, gaps)
        with folder.started(config) as start, share_open_scenes(start.name, plan.scenes):
            execution.begin(start)
            with contextlib.closing(executor.run(execution.next_job, telling)) as outcomes:
                for outcome in itertools.chain(execution.ended, outcomes):
                    execution.take(outcome)
        units = execution.units
        units.advice = advice or advice_of(plan, units.contents)
        result = result_of(plan, folder, units)
        units.watch.seconds["all"] = time.perf_counter() - started
        result = dataclasses.replace(result, manifest=manifest(plan, units, executor.name, command))
        folder.save_result(result, units.contents.values())
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
        ended: Outcomes of tiled units that an earlier start computed and did not store.
    """

    def __init__(
        self, plan: Plan, folder: Folder, executor: Executor, observers: Observers, gaps: Mapping[str, str]
    ) -> None:
        self._plan, self._folder, self._executor, self._observers = plan, folder, executor, observers
        self._gaps = gaps
        self.units = units = UnitResults()
        with units.watch("digest"):
            there = ((key, folder.finished(each)) for key, each in plan.distinct().items())
            units.contents = {key: content for key, content in there if content is not None}
        units.finished_before, finished = len(units.contents), dict(units.contents)
        self._missing = {each.identity: each for each in plan.distinct().values() if each.identity not in finished}
        if self._missing:
            folder.remove_outputs()
        observers.tell(lambda observer: observer.run_started(plan, finished))
        self._queue, self._tiled, self.ended = deque[Job](), dict[str, TiledUnit](), list[Outcome]()
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
        whole = list[Work]()
        for each in self._missing.values():
            if (error := sizing.refused.get(each.identity)) is not None:
                self._keep(each, Outcome(each.identity, error=error, cause=ConfigError(error)))
            elif (size := sizing.tile_sizes.get(each.identity)) is not None:
                self._tiled[each.identity] = TiledUnit(each, size, self._folder, start)
            else:
                whole.append(Work.of(each, start))
        self._queue = deque(jobs_of(whole, self._executor.width))
        self.ended = [outcome for unit in self._tiled.values() if (outcome := unit.ended()) is not None]

    def next_job(self) -> Job | None:
        """Return the next job; None where there is none until outcomes that are taken call for more."""
        if self._queue:
            return self._queue.popleft()
        return next(filter(None, (unit.next_job() for unit in self._tiled.values())), None)

    def take(self, outcome: Outcome) -> None:
        """Store the outcome of a unit, or of a tile."""
        own: Outcome | None = outcome
        unit = self._tiled.get(outcome.identity)
        if unit is not None and outcome.tile is not None:
            self.units.add_seconds(outcome)
            with self.units.watch("assemble"):
                own = unit.take(outcome)
            step, name = unit.step(), unit.name
            self._observers.tell(lambda observer: observer.advanced(step, name))
        if own is not None:
            self._keep(self._missing[own.identity], own, in_tiles=unit is not None)

    def _keep(self, each: PlannedUnit, outcome: Outcome, *, in_tiles: bool = False) -> None:
        units, folder, content = self.units, self._folder, outcome.content
        if content is not None:
            unit = each.unit
            advice, notes = units.advice.get(unit.scene), units.notes.get((unit.scene, unit.model), ())
            content = dataclasses.replace(content, advice=advice, notes=notes)
            with units.watch("keep"):
                folder.save(dataclasses.replace(outcome, content=content))
                folder.clear(each, content.files)
            units.contents[outcome.identity] = content
        else:
            error = units.errors[outcome.identity] = outcome.error or ""
            folder.save_trace(outcome)
            if outcome.cause is not None:
                units.causes.setdefault(error, outcome.cause)
        if not in_tiles:
            units.add_seconds(outcome)
            if self._executor.elsewhere or each.regions:
                name = f"{each.unit.scene} · {each.unit.model}"
                self._observers.tell(lambda observer: observer.advanced(each.frames, name))
        self._observers.tell(lambda observer: observer.unit_finished(each, content, outcome.table, outcome.error))

    def _check_geometry(self, config: Config, missing: Sequence[PlannedUnit]) -> None:
        """Check the geometry and the voxel size of each scene of missing units; those report errors of reading."""
        fused = {(each.unit.scene, each.unit.model): each.task for each in reversed(missing) if not each.regions}
        tasks = {scene: task for (scene, _), task in fused.items()}
        verdicts: dict[str, Verdict] = {}
        for task in reversed(tasks.values()):
            with contextlib.suppress(DataError):
                verdicts[task.scene.name], sample = quick_sample(task.scene, task.indices, config.dataset.options)
                if (advice := advise(sample, config)) is not None:
                    self.units.advice[task.scene.name] = advice
        for scene, verdict in verdicts.items():
            refuse_unsound(tasks[scene].scene, verdict)
            self._observers.tell(
                lambda observer, scene=scene, verdict=verdict: observer.geometry_checked(tasks[scene], verdict)  # type: ignore[misc]
            )
        self.units.geometry = verdicts
        for (scene, model), task in fused.items():
            if scene in verdicts:
                with contextlib.suppress(DataError):
                    found = scene_notes(task.scene, task.indices, model, config)
                    left_out = [self._gaps[scene]] if scene in self._gaps else []
                    self.units.notes[scene, model] = (*left_out, *verdicts[scene].remarks, *found)
