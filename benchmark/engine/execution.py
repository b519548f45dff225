"""A run or a study: every unit of its plan that is not kept from before, computed, and what they add up to."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from semstab.check import Verdict, advise, quick_look, refuse_unsound, with_voxel_size
from semstab.config import Config
from semstab.core.process import Stopwatch, give_back
from semstab.engine.folder import Folder, require_file_names
from semstab.engine.observer import Observer, Observers
from semstab.engine.results import Found, advice_of, manifest, result_of
from semstab.engine.sizing import Sizing, Survey, sized
from semstab.engine.tiled_units import InTiles, Waiting
from semstab.engine.tiling.partition import Tiling
from semstab.engine.units import Plan, Planned, PlannedUnit, make_plan
from semstab.engine.work.executors import Executor, InProcess
from semstab.engine.work.jobs import Outcome
from semstab.engine.work.passes import lend
from semstab.errors import ConfigError, DataError
from semstab.model.records import Result
from semstab.model.results import VoxelAdvice
from semstab.settings import resolve

logger = logging.getLogger("semstab")


def run(
    config: Config,
    *,
    out: str | Path | None = None,
    executor: Executor | None = None,
    observers: Sequence[Observer] = (),
    command: Sequence[str] = (),
) -> Result:
    """Fuse, measure and compare what the configuration selects; as `run_study`, but a failing unit is an error.

    Without a folder `out` nothing is left on disk, and the result has summaries, but no voxels. Raises ConfigError or
    DataError, or what a unit raised, once everything else has been written.
    """
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()) if out is None else out)
        result, causes = _execute(config, folder, executor or InProcess(), observers, command)
    if result.failures:
        first = result.failures[0]
        raise causes.get(first.message) or DataError(first.message)
    if out is None:
        records = tuple(dataclasses.replace(record, voxels_file=None, truth_file=None) for record in result.records)
        return dataclasses.replace(result, records=records)
    return result


def run_study(
    config: Config,
    out: str | Path,
    *,
    executor: Executor | None = None,
    observers: Sequence[Observer] = (),
    command: Sequence[str] = (),
) -> Result:
    """Compute what the folder `out` does not hold yet, and say what was found.

    Each unit is kept when it is finished, under a key of its settings and its input: a killed study goes on where it
    was, a changed setting computes again only what it touches. `command` goes into the manifest.

    Raises ConfigError or DataError where the plan does not fit together, or a scene's depth and poses contradict each
    other, before anything is computed. A unit that fails later is among the result's failures, and the others finish.
    """
    return _execute(config, Path(out), executor or InProcess(), observers, command)[0]


def _execute(
    config: Config, out: Path, executor: Executor, observers: Sequence[Observer], command: Sequence[str]
) -> tuple[Result, Mapping[str, BaseException]]:
    """The result, and what failing units raised in this process, by its message."""
    started, told = time.perf_counter(), Observers(observers)
    config = resolve(config)
    config, advice = with_voxel_size(config)
    plan = make_plan(config)
    require_file_names(out, (each.unit for each in plan.units))
    folder = Folder(out, config)
    try:
        found = _compute(plan, folder, executor, told)
        found.advice = advice or advice_of(plan, found.contents)
        result = result_of(plan, folder, found)
        found.watch.seconds["all"] = time.perf_counter() - started
        content = manifest(config, found.inputs(plan), found.watch.seconds, command)
        content |= {"units": found.counts() | {"executor": executor.name}}
        content |= {"geometry": {scene: verdict.summary() for scene, verdict in found.geometry.items()}}
        content |= {"depth_from": {name: scene.depth_from for name, scene in plan.scenes.items() if scene.depth_from}}
        result = dataclasses.replace(result, manifest=content)
        folder.save_result(result)
        told.tell(lambda observer: observer.run_finished(result))
    finally:
        folder.close()
        executor.close()
    told.raise_first()
    return result, found.causes


def _compute(plan: Plan, folder: Folder, executor: Executor, told: Observers) -> Found:
    """Take what is kept, compute the rest."""
    units, watch = plan.distinct(), Stopwatch()
    with watch("digest"):
        contents = {identity: kept for identity, each in units.items() if (kept := folder.kept(each)) is not None}
    found = Found(contents, kept=len(contents), watch=watch)
    finished = dict(contents)
    told.tell(lambda observer: observer.run_started(plan, finished))
    missing = [each for identity, each in units.items() if identity not in contents]
    if plan.config.check_geometry:
        with watch("check"):
            found.geometry, found.advice = _checked(plan.config, missing, told)
    with folder.started() as start, lend(start, plan.scenes):
        survey = Survey(executor, folder, start)
        with watch("sizing"):
            sizing = sized(plan.config, missing, survey)
            give_back()
        for line in sizing.remarks:
            logger.warning("%s", line)
        _refuse(sizing, missing, found, executor, told)
        fitting = [each for each in missing if each.identity not in sizing.refused]
        _work_off(plan.config, survey, told, found, fitting, sizing.tilings)
    return found


def _refuse(sizing: Sizing, missing: Sequence[Planned], found: Found, executor: Executor, told: Observers) -> None:
    """Those that do not fit fail, and the others go on."""
    for each in missing:
        if (error := sizing.refused.get(each.identity)) is not None:
            found.errors[each.identity] = error
            found.causes.setdefault(error, ConfigError(error))
            _tell_done(each, Outcome(each.identity, error=error), executor, told)


def _work_off(
    config: Config,
    survey: Survey,
    told: Observers,
    found: Found,
    missing: Sequence[Planned],
    tilings: Mapping[str, Tiling],
) -> None:
    """What is missing, kept as it finishes."""
    executor, folder = survey.executor, survey.folder
    waiting = Waiting(config, folder.path, survey.start)
    in_tiles = InTiles(config, survey, waiting, told)
    units, ended = {each.identity: each for each in missing}, list[Outcome | None]()
    for each in missing:
        if isinstance(each, PlannedUnit) and each.identity in tilings:
            ended.append(in_tiles.begin(each, tilings[each.identity]))
    waiting.add_whole([each for each in missing if each.identity not in tilings], executor.width)
    with contextlib.closing(executor.run(waiting, told)) as finished:
        done = itertools.chain.from_iterable(outcomes for _, outcomes in finished)
        for outcome in itertools.chain((outcome for outcome in ended if outcome is not None), done):
            each = units[outcome.identity]
            for stage, seconds in outcome.seconds.items():
                found.watch.seconds[stage] += seconds
            with found.watch("assemble"):
                own = in_tiles.take(each, outcome)
            if own is not None and own.identity not in found.errors:
                _keep(folder, found, each, own)
                tiled = own.identity in in_tiles
                _tell_done(each, own, executor, told, counted=tiled)


def _keep(folder: Folder, found: Found, each: Planned, outcome: Outcome) -> None:
    """A finished unit, or why it failed."""
    if outcome.content is not None:
        content = dataclasses.replace(outcome.content, advice=found.advice.get(each.unit.scene))
        with found.watch("keep"):
            folder.save(dataclasses.replace(outcome, content=content))
            if isinstance(each, PlannedUnit):
                folder.clear(each, content.files)
        found.contents[outcome.identity] = content
        return
    found.errors[outcome.identity] = outcome.error or ""
    folder.save_trace(outcome)
    if outcome.cause is not None:
        found.causes.setdefault(outcome.error or "", outcome.cause)


def _tell_done(each: Planned, own: Outcome, executor: Executor, told: Observers, *, counted: bool = False) -> None:
    if not counted and (executor.elsewhere or not isinstance(each, PlannedUnit)):
        what = f"{each.unit.scene} · {each.unit.backbone}"
        told.tell(lambda observer: observer.advanced(each.frames, what))
    told.tell(lambda observer: observer.unit_finished(each, own.content, own.table, own.error))


def _checked(
    config: Config, missing: Sequence[Planned], told: Observers
) -> tuple[dict[str, Verdict], dict[str, VoxelAdvice]]:
    """The geometry of each scene with units to compute, and where the voxel size lies.

    What cannot be read is left to the units to report.

    Raises DataError where depth and poses contradict each other.
    """
    found: dict[str, Verdict] = {}
    advice: dict[str, VoxelAdvice] = {}
    tasks = {each.task.scene.name: each.task for each in reversed(missing) if isinstance(each, PlannedUnit)}
    for task in reversed(tasks.values()):
        with contextlib.suppress(DataError):
            found[task.scene.name], sample = quick_look(task.scene, task.indices, config.dataset.options)
            if (told_of := advise(sample, config)) is not None:
                advice[task.scene.name] = told_of
    for scene, verdict in found.items():
        refuse_unsound(scene, verdict)
        told.tell(lambda observer, scene=scene, verdict=verdict: observer.geometry_checked(tasks[scene], verdict))  # type: ignore[misc]
    return found, advice
