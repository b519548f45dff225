"""A run or a study: every unit of its plan that is not kept from before, computed, and what they add up to."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from semstab.check import Verdict, advise, quick_look, refuse_unsound, with_voxel_size
from semstab.config import Config
from semstab.engine.folder import Folder, require_file_names
from semstab.engine.found import Found, advice_of, result_of
from semstab.engine.manifest import manifest
from semstab.engine.observer import Factory, Observer, Observers
from semstab.engine.sizing import Sizing, sized
from semstab.engine.survey import Survey
from semstab.engine.tiled_unit import TiledUnit
from semstab.engine.tiling.partition import Tiling
from semstab.engine.units import Plan, Planned, PlannedUnit, make_plan
from semstab.engine.work.executors import Executor, InProcess
from semstab.engine.work.jobs import Job, Outcome, Request, split
from semstab.engine.work.passes import lend
from semstab.errors import ConfigError, DataError
from semstab.model.records import Result, UnitContent
from semstab.model.results import VoxelAdvice
from semstab.runtime.process import give_back
from semstab.runtime.stopwatch import Stopwatch
from semstab.settings import resolve

GB = 1e9


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
    told.tell(lambda observer: observer.run_started(plan, [units[identity] for identity in contents]))
    _tell_kept(plan, contents, told)
    missing = [each for identity, each in units.items() if identity not in contents]
    if plan.config.check_geometry:
        with watch("check"):
            found.geometry, found.advice = _checked(plan.config, missing, told)
    with folder.started() as start, lend(start, plan.scenes):
        with watch("sizing"):
            sizing = sized(plan.config, missing, Survey(executor, folder, start))
            give_back()
        for line in sizing.remarks:
            told.tell(lambda observer, line=line: observer.remarked(line))  # type: ignore[misc]
        _refuse(sizing, missing, found, executor, told)
        fitting = [each for each in missing if each.identity not in sizing.refused]
        _work_off(plan, folder, start, executor, told, found, fitting, sizing.tilings)
    return found


def _refuse(sizing: Sizing, missing: Sequence[Planned], found: Found, executor: Executor, told: Observers) -> None:
    """Those that do not fit fail, and the others go on."""
    for each in missing:
        if (error := sizing.refused.get(each.identity)) is not None:
            found.errors[each.identity] = error
            found.causes.setdefault(error, ConfigError(error))
            _tell_done(each, error, executor, told)


def _work_off(
    plan: Plan,
    folder: Folder,
    start: str,
    executor: Executor,
    told: Observers,
    found: Found,
    missing: Sequence[Planned],
    tilings: Mapping[str, Tiling],
) -> None:
    """What is missing, kept as it finishes."""
    units = {each.identity: each for each in missing}
    whole = [each for each in missing if each.identity not in tilings]
    in_tiles = {
        each.identity: TiledUnit(each, tilings[each.identity], folder, executor.width)
        for each in missing
        if isinstance(each, PlannedUnit) and each.identity in tilings
    }
    factories = told.elsewhere(folder.path) if executor.elsewhere and missing else ()
    jobs = split(_jobs(plan.config, folder.path, start, whole, factories), executor.width)

    def portions() -> Iterator[Job]:
        return _portion_jobs(plan.config, folder.path, start, in_tiles.values(), factories)

    kept = (tiled.take(None) for tiled in in_tiles.values())
    done = _outcomes(executor, itertools.chain(jobs, portions()), portions, told)
    with contextlib.closing(done):
        for outcome in itertools.chain((outcome for outcome in kept if outcome is not None), done):
            each, tiled = units[outcome.identity], in_tiles.get(outcome.identity)
            ended: Outcome | None = outcome
            for stage, seconds in outcome.seconds.items():
                found.watch.seconds[stage] += seconds
            if tiled is not None and outcome.portion is not None:
                if outcome.error is None:
                    told.tell(lambda observer, tiled=tiled: observer.advanced(tiled.step(), tiled.name))  # type: ignore[misc]
                with found.watch("assemble"):
                    ended = tiled.take(outcome)
            if ended is not None and ended.identity not in found.errors:
                _keep(folder, found, each, ended)
                if tiled is not None and ended.content is not None:
                    _tell_assembled(tiled, ended.content, told)
                _tell_done(each, ended.error, executor, told, counted=tiled is not None)


def _outcomes(
    executor: Executor, jobs: Iterable[Job], further: Callable[[], Iterator[Job]], told: Observers
) -> Generator[Outcome, None, None]:
    """Those of the jobs, then of further ones that have come up meanwhile, until there are none."""
    while (first := next(waiting := iter(jobs), None)) is not None:
        with contextlib.closing(executor.run(itertools.chain([first], waiting), told)) as finished:
            for _, outcomes in finished:
                yield from outcomes
        jobs = further()


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


def _tell_kept(plan: Plan, contents: Mapping[str, UnitContent], told: Observers) -> None:
    watched = [each for each in plan.units if each.kept and each.identity in contents]
    for task in plan.tasks:
        group = [each for each in watched if (each.unit.scene, each.unit.backbone) == (task.scene.name, task.backbone)]
        summaries = [summary for each in group if (summary := contents[each.identity].summary) is not None]
        if summaries:
            told.tell(lambda observer, task=task, summaries=summaries: observer.group_kept(task, summaries))  # type: ignore[misc]


def _tell_assembled(tiled: TiledUnit, content: UnitContent, told: Observers) -> None:
    summary, planned = content.summary, tiled.planned
    if planned.kept and summary is not None:
        told.tell(lambda observer: observer.unit_assembled(planned.task, summary))


def _tell_done(each: Planned, error: str | None, executor: Executor, told: Observers, *, counted: bool = False) -> None:
    if not counted and (executor.elsewhere or not isinstance(each, PlannedUnit)):
        what = f"{each.unit.scene} · {each.unit.backbone}"
        told.tell(lambda observer: observer.advanced(each.frames, what))
    told.tell(lambda observer: observer.unit_done(each, error))


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


def _jobs(
    config: Config, folder: Path, start: str, missing: Sequence[Planned], observers: Sequence[Factory]
) -> list[Job]:
    """The units by the sequence that they read; scene by scene, for what a scene's backbones share stays at hand."""
    sequences: dict[tuple[str, str], list[Request]] = {}
    for each in missing:
        sequences.setdefault((each.unit.scene, each.unit.backbone), []).append(Request.of(each))
    memory = None if config.memory_gb is None else config.memory_gb * GB
    return [
        Job(scene, backbone, tuple(requests), start, folder, config.threads, memory, tuple(observers))
        for (scene, backbone), requests in sequences.items()
    ]


def _portion_jobs(
    config: Config, folder: Path, start: str, tiled: Iterable[TiledUnit], observers: Sequence[Factory]
) -> Iterator[Job]:
    """A job each, so that no two maps are in memory at once; a frame by itself is shown to observers of one of them."""
    memory = None if config.memory_gb is None else config.memory_gb * GB
    shown = set()
    for each in tiled:
        unit = each.planned.unit
        for request in each.waiting():
            frames = (unit.scene, unit.backbone, request.stretch and request.stretch.name)
            seen = request.part is not None or (request.shown and frames not in shown)
            own = tuple(observers) if seen else ()
            shown.add(frames)
            yield Job(unit.scene, unit.backbone, (request,), start, folder, config.threads, memory, own)
