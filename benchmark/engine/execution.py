"""A run or a study: every unit of its plan that is not kept from before, computed, and what they add up to."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semstab.check import Verdict, advise, quick_look, refuse_unsound, with_voxel_size
from semstab.config import BACKENDS, BASE, Config
from semstab.datasets import GROUND_TRUTH
from semstab.engine.evaluation import comparison
from semstab.engine.folder import Folder, require_file_names
from semstab.engine.manifest import manifest
from semstab.engine.observer import Factory, Observer, Observers
from semstab.engine.sizing import Sizing, sized
from semstab.engine.survey import Survey
from semstab.engine.tiled_unit import TiledUnit
from semstab.engine.tiling.partition import Tiling
from semstab.engine.units import Plan, Planned, PlannedUnit, make_plan, must_agree
from semstab.engine.work.executors import Executor, InProcess
from semstab.engine.work.jobs import Job, Outcome, Request, split
from semstab.engine.work.passes import lend
from semstab.errors import ConfigError, DataError
from semstab.metrics import compare
from semstab.metrics.agreement import together
from semstab.model.records import REGIONS, Failure, Record, RegionFlicker, Result, Tables, UnitContent
from semstab.model.results import Agreement, VoxelAdvice
from semstab.model.voxels import Events, VoxelTable
from semstab.model.voxels.tiles import Tiles, side_by_side
from semstab.runtime.stopwatch import Stopwatch
from semstab.settings import resolve
from semstab.statistics import BackboneComparison, Looks, claimed_together
from semstab.statistics.versus.backbones import Region, Regions

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
        found.advice = advice or _advice(plan, found.contents)
        result = _result(plan, folder, found)
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


@dataclass
class _Found:
    """What is known of the units, by their identity: the content of their files, or why they failed.

    geometry  of the scenes of which something was computed
    advice    where the voxel size lies in them
    causes    what was raised in this process, by its message
    """

    contents: dict[str, UnitContent]
    kept: int
    geometry: dict[str, Verdict] = field(default_factory=dict)
    advice: dict[str, VoxelAdvice] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)
    causes: dict[str, BaseException] = field(default_factory=dict)
    watch: Stopwatch = field(default_factory=Stopwatch)

    def inputs(self, plan: Plan) -> dict[str, str]:
        """The digest of the input of each base unit, and of each source of regions."""
        return {
            f"{each.unit.scene}/{each.unit.backbone}": self.contents[each.identity].input
            for each in plan.every()
            if each.variation.sweep in (BASE, REGIONS) and each.identity in self.contents
        }

    def counts(self) -> dict[str, Any]:
        """How many units there are, were kept from before, computed and failed."""
        failed = len(self.errors)
        computed = len(self.contents) - self.kept
        return {"units": len(self.contents) + failed, "kept": self.kept, "computed": computed, "failed": failed}


def _compute(plan: Plan, folder: Folder, executor: Executor, told: Observers) -> _Found:
    """Take what is kept, compute the rest."""
    units, watch = plan.distinct(), Stopwatch()
    with watch("digest"):
        contents = {identity: kept for identity, each in units.items() if (kept := folder.kept(each)) is not None}
    found = _Found(contents, kept=len(contents), watch=watch)
    told.tell(lambda observer: observer.run_started(plan, [units[identity] for identity in contents]))
    _tell_kept(plan, contents, told)
    missing = [each for identity, each in units.items() if identity not in contents]
    if plan.config.check_geometry:
        with watch("check"):
            found.geometry, found.advice = _checked(plan.config, missing, told)
    with folder.started() as start, lend(start, plan.scenes):
        with watch("sizing"):
            sizing = sized(plan.config, missing, Survey(executor, folder, start))
        for line in sizing.remarks:
            told.tell(lambda observer, line=line: observer.remarked(line))  # type: ignore[misc]
        _refuse(sizing, missing, found, executor, told)
        fitting = [each for each in missing if each.identity not in sizing.refused]
        _work_off(plan, folder, start, executor, told, found, fitting, sizing.tilings)
    return found


def _refuse(sizing: Sizing, missing: Sequence[Planned], found: _Found, executor: Executor, told: Observers) -> None:
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
    found: _Found,
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
    requests = [request for tiled in in_tiles.values() for request in tiled.missing()]
    jobs = split(_jobs(plan.config, folder.path, start, whole, factories), executor.width)
    jobs += _portion_jobs(plan.config, folder.path, start, requests, units, factories)
    kept = (tiled.take(None) for tiled in in_tiles.values())
    with contextlib.closing(executor.run(jobs, told)) as finished:
        done = (outcome for _, outcomes in finished for outcome in outcomes)
        for outcome in itertools.chain((outcome for outcome in kept if outcome is not None), done):
            each, tiled = units[outcome.identity], in_tiles.get(outcome.identity)
            ended: Outcome | None = outcome
            for stage, seconds in outcome.seconds.items():
                found.watch.seconds[stage] += seconds
            if tiled is not None and outcome.portion is not None:
                told.tell(lambda observer, tiled=tiled: observer.advanced(tiled.step(), tiled.name))  # type: ignore[misc]
                with found.watch("assemble"):
                    ended = tiled.take(outcome)
            if ended is not None and ended.identity not in found.errors:
                _keep(folder, found, each, ended)
                if tiled is not None and ended.content is not None:
                    _tell_assembled(tiled, ended.content, told)
                _tell_done(each, ended.error, executor, told, counted=tiled is not None)


def _keep(folder: Folder, found: _Found, each: Planned, outcome: Outcome) -> None:
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
    config: Config,
    folder: Path,
    start: str,
    requests: Sequence[Request],
    units: Mapping[str, Planned],
    observers: Sequence[Factory],
) -> list[Job]:
    """A job each, so that no two maps are in memory at once; a frame is shown to observers of one of them."""
    memory = None if config.memory_gb is None else config.memory_gb * GB
    jobs, shown = [], set()
    for request in requests:
        unit = units[request.identity].unit
        frames = (unit.scene, unit.backbone, request.stretch and request.stretch.name)
        own = tuple(observers) if request.shown and frames not in shown else ()
        shown.add(frames)
        jobs.append(Job(unit.scene, unit.backbone, (request,), start, folder, config.threads, memory, own))
    return jobs


def _result(plan: Plan, folder: Folder, found: _Found) -> Result:
    contents, errors = found.contents, found.errors
    records = tuple(folder.record(each, contents[each.identity]) for each in plan.units if each.identity in contents)
    tables = Tables(most=len({record.unit.backend for record in records}))
    with found.watch("agreement"):
        agreement = (*_samples(plan, contents), *_agreement(plan.config, records, tables))
        compared = tuple(_compared(plan.config, records, tables))
    with found.watch("comparisons"):
        scenes = tuple(_comparisons(plan.config, records, tables)) if plan.config.statistics else ()
        comparisons = claimed_together(scenes)
    return Result(
        name=plan.config.name,
        backend=plan.config.backends[0].name,
        records=records,
        failures=tuple(
            Failure(each.unit, each.variation, errors[each.identity])
            for each in plan.every()
            if each.identity in errors
        ),
        agreement=agreement,
        comparisons=comparisons,
        up=_up_axes(plan.units, contents),
        georeference={name: known for name, scene in plan.scenes.items() if (known := scene.georeference) is not None},
        regions=tuple(_regions(plan, contents)),
        compared=compared,
        advice=found.advice,
    )


def _advice(plan: Plan, contents: Mapping[str, UnitContent]) -> dict[str, VoxelAdvice]:
    """Where the voxel size lies in each scene, as it was looked at when its base units were computed."""
    return {
        each.unit.scene: content.advice
        for each in plan.units
        if each.variation.sweep == BASE and (content := contents.get(each.identity)) and content.advice is not None
    }


def _samples(plan: Plan, contents: Mapping[str, UnitContent]) -> Iterator[Agreement]:
    """Of units with the reference, on a sample of their voxels."""
    for each in plan.units:
        content = contents.get(each.identity)
        if each.sampled and content is not None and content.checked is not None:
            yield content.checked


def _agreement(config: Config, records: Sequence[Record], tables: Tables) -> Iterator[Agreement]:
    """Of each pair of backends that must agree, on each scene and backbone that both fused."""
    checked = {backend.name for backend in config.fused_by() if must_agree(backend)}
    for group in _by_backend(records).values():
        there = [record for record in group if record.unit.backend in checked]
        for a, b in itertools.combinations(there, 2):
            yield _alike(config, a, b, tables)


def _compared(config: Config, records: Sequence[Record], tables: Tables) -> Iterator[Agreement]:
    """Of the first backend and each other one, where one of the two need not agree."""
    free = {backend.name for backend in config.fused_by() if not must_agree(backend)}
    for first, *others in _by_backend(records).values():
        for other in others:
            if free & {first.unit.backend, other.unit.backend}:
                yield _alike(config, first, other, tables)


def _alike(config: Config, a: Record, b: Record, tables: Tables) -> Agreement:
    """How far two units agree, voxel by voxel; tile by tile where one is in tiles."""
    units = a.unit, b.unit
    maps = [Tiles.open(file, VoxelTable) for record in (a, b) if (file := record.voxels_file) is not None]
    if not (a.in_tiles or b.in_tiles):
        return compare(tables.of(a), tables.of(b), units, tolerance=config.tolerance)
    return together([compare(one, other, units, tolerance=config.tolerance) for one, other in side_by_side(maps)])


def _by_backend(records: Sequence[Record]) -> dict[tuple[str, str], list[Record]]:
    """The records at the base settings of each scene and backbone, those of the first backend first."""
    groups: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        if record.variation.sweep in (BASE, BACKENDS):
            groups.setdefault((record.unit.scene, record.unit.backbone), []).append(record)
    return groups


def _comparisons(config: Config, records: Sequence[Record], tables: Tables) -> Iterator[BackboneComparison]:
    """The base units of each scene beside each other; accuracy where there is ground truth."""
    base = [record for record in records if record.variation.sweep == BASE]
    for scene in dict.fromkeys(record.unit.scene for record in base):
        there = [record for record in base if record.unit.scene == scene and record.unit.backbone != GROUND_TRUTH]
        if len(there) > 1:
            regions = _regions_of(there, config, tables)
            kept = {record.unit.backbone: record.looks_file for record in there}
            looks = {name: Looks.load(file) for name, file in kept.items() if file is not None and file.exists()}
            found = comparison(scene, regions, looks if len(looks) == len(there) else None)
            if found is not None:
                yield found


def _regions_of(there: Sequence[Record], config: Config, tables: Tables) -> Regions:
    """The maps of a scene's units tile by tile, or whole, with their logs and the ground truth."""
    names = [record.unit.backbone for record in there]
    in_tiles = any(record.in_tiles for record in there)
    files = [record.events_file for record in there if config.events]
    logs: list[Tiles[Any]] = [Tiles.open(file, Events) for file in files if file is not None and file.exists()]
    logs = logs if len(logs) == len(there) else []
    truths = [Tiles.open(file, VoxelTable) for record in there if (file := record.truth_file) is not None][:1]
    maps = [
        Tiles.open(file, VoxelTable) if in_tiles else Tiles.of(tables.of(record))
        for record in there
        if (file := record.voxels_file) is not None
    ]

    def regions() -> Iterator[Region]:
        for own in side_by_side([*maps, *logs, *truths]):
            found, events, truth = (
                own[: len(maps)],
                own[len(maps) : len(maps) + len(logs)],
                own[len(maps) + len(logs) :],
            )
            log = dict(zip(names, events, strict=True)) if logs else None
            yield Region(dict(zip(names, found, strict=True)), log, truth[0] if truth else None)

    return regions


def _regions(plan: Plan, contents: Mapping[str, UnitContent]) -> Iterator[RegionFlicker]:
    for each in plan.regions:
        content = contents.get(each.identity)
        if content is not None and content.regions is not None:
            yield content.regions


def _up_axes(
    units: Sequence[PlannedUnit], contents: Mapping[str, UnitContent]
) -> dict[str, tuple[float, float, float]]:
    """Each scene's up axis, as the base unit of its first backbone has it that knows one."""
    axes: dict[str, tuple[float, float, float]] = {}
    for each in units:
        content = contents.get(each.identity)
        if each.variation.sweep == BASE and content is not None and content.up is not None:
            axes.setdefault(each.unit.scene, content.up)
    return axes
