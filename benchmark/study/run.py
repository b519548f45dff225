"""The study: every unit of its grid that is not kept from before, computed by an executor, and what they add up to."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semstab.check import Verdict, quick_check, refuse_unsound
from semstab.datasets import GROUND_TRUTH
from semstab.errors import DataError
from semstab.evaluation import comparable
from semstab.json_form import from_json
from semstab.manifest import manifest
from semstab.metrics import compare
from semstab.results import Agreement
from semstab.statistics import BackboneComparison, compare_backbones
from semstab.study.config import StudyConfig
from semstab.study.executors import Executor, InProcess
from semstab.study.folder import StudyFolder
from semstab.study.grid import Cell, Grid, RegionCell, make_grid
from semstab.study.jobs import Job, Outcome, Request
from semstab.study.results import BACKENDS, BASE, REGIONS, Failure, Record, RegionFlicker, StudyResult

GB = 1e9


class StudyObserver:
    """Watches a study; override what is of interest."""

    def study_started(self, units: int, kept: int) -> None:
        """So many units are wanted; so many of them were found finished."""

    def unit_finished(self, cell: Cell | RegionCell, error: str | None) -> None:
        """A unit was computed and is kept, or failed."""

    def study_finished(self, result: StudyResult) -> None:
        """The summary has been written."""


def run_study(
    config: StudyConfig,
    out: str | Path,
    *,
    executor: Executor | None = None,
    observers: Sequence[StudyObserver] = (),
    command: Sequence[str] = (),
) -> StudyResult:
    """Compute what the study folder `out` does not hold yet, and say what was found.

    Each unit is kept when it is finished, under a key of its settings and its input: a killed study goes on where it
    was, a changed setting computes again only what it touches. `command` goes into the manifest.

    Raises ConfigError or DataError where the study does not fit together, or a scene's depth and poses contradict each
    other, before anything is computed. A unit that fails later is among the result's failures, and the others finish.
    """
    started = time.perf_counter()
    config, executor = config.resolved(), executor or InProcess()
    grid = make_grid(config)
    folder = StudyFolder(out, config)
    found = _compute(config, folder, executor, grid.units(), observers)
    result = _result(config, folder, grid, found)
    seconds = {"study": time.perf_counter() - started}
    content = manifest(config.base(), found.inputs(grid), seconds, command)
    content |= {"study": found.counts() | {"executor": executor.name}}
    content |= {"geometry": {scene: verdict.summary() for scene, verdict in found.geometry.items()}}
    result = dataclasses.replace(result, manifest=content)
    folder.save_result(result)
    for observer in observers:
        observer.study_finished(result)
    return result


@dataclass
class _Found:
    """What is known of the units, by their identity: the content of their files, or why they failed.

    geometry  of the scenes of which something was computed
    """

    contents: dict[str, Mapping[str, Any]]
    kept: int
    geometry: dict[str, Verdict] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)

    def inputs(self, grid: Grid) -> dict[str, str]:
        """The digest of the input of each base unit, and of each source of regions."""
        return {
            f"{cell.unit.scene}/{cell.unit.backbone}": self.contents[cell.identity]["input"]
            for cell in grid.every()
            if cell.variation.sweep in (BASE, REGIONS) and cell.identity in self.contents
        }

    def counts(self) -> dict[str, Any]:
        """How many units there are, were kept from before, computed and failed."""
        failed = len(self.errors)
        computed = len(self.contents) - self.kept
        return {"units": len(self.contents) + failed, "kept": self.kept, "computed": computed, "failed": failed}


def _compute(
    config: StudyConfig,
    folder: StudyFolder,
    executor: Executor,
    units: Mapping[str, Cell | RegionCell],
    observers: Sequence[StudyObserver],
) -> _Found:
    """Take what is kept, compute the rest."""
    contents = {identity: kept for identity, cell in units.items() if (kept := folder.kept(cell)) is not None}
    found = _Found(contents, kept=len(contents))
    for observer in observers:
        observer.study_started(len(units), found.kept)
    missing = [cell for identity, cell in units.items() if identity not in contents]
    if config.check_geometry:
        found.geometry = _checked(config, missing)
    with contextlib.closing(_outcomes(config, folder, executor, missing)) as outcomes:
        for outcome in outcomes:
            if outcome.content is not None:
                folder.save(outcome)
                contents[outcome.identity] = outcome.content
            else:
                found.errors[outcome.identity] = outcome.error or ""
            for observer in observers:
                observer.unit_finished(units[outcome.identity], outcome.error)
    return found


def _checked(config: StudyConfig, missing: Sequence[Cell | RegionCell]) -> dict[str, Verdict]:
    """The geometry of each scene with units to compute; what cannot be read is left to these to report.

    Raises DataError where depth and poses contradict each other.
    """
    found: dict[str, Verdict] = {}
    for task in {cell.task.scene.name: cell.task for cell in missing if isinstance(cell, Cell)}.values():
        with contextlib.suppress(DataError):
            found[task.scene.name] = quick_check(task.scene, task.indices, task.backbone, config.dataset.options)
    for scene, verdict in found.items():
        refuse_unsound(scene, verdict)
    return found


def _outcomes(
    config: StudyConfig, folder: StudyFolder, executor: Executor, missing: Sequence[Cell | RegionCell]
) -> Generator[Outcome, None, None]:
    """What becomes of each unit, as it finishes."""
    with folder.started() as start:
        jobs = split(_jobs(config, folder.path, start, missing), executor.width)
        with contextlib.closing(executor.run(jobs)) as finished:
            for _, outcomes in finished:
                yield from outcomes


def _result(config: StudyConfig, folder: StudyFolder, grid: Grid, found: _Found) -> StudyResult:
    contents, errors = found.contents, found.errors
    records = tuple(folder.record(cell, contents[cell.identity]) for cell in grid.cells if cell.identity in contents)
    return StudyResult(
        name=config.name,
        backend=config.backend.name,
        records=records,
        failures=tuple(
            Failure(cell.unit, cell.variation, errors[cell.identity])
            for cell in grid.every()
            if cell.identity in errors
        ),
        agreement=tuple(_agreement(config, records)),
        comparisons=tuple(_comparisons(records)) if config.statistics else (),
        up=_up_axes(grid.cells, contents),
        regions=tuple(
            from_json(RegionFlicker, contents[cell.identity]["regions"], folder.path)
            for cell in grid.regions
            if cell.identity in contents
        ),
    )


def _jobs(config: StudyConfig, folder: Path, start: str, cells: Sequence[Cell | RegionCell]) -> list[Job]:
    """The units by the sequence that they read; scene by scene, for what a scene's backbones share stays at hand."""
    sequences: dict[tuple[str, str], list[Request]] = {}
    for cell in cells:
        sequences.setdefault((cell.unit.scene, cell.unit.backbone), []).append(cell.request())
    memory = None if config.memory_gb is None else config.memory_gb * GB
    return [
        Job(scene, backbone, tuple(requests), start, folder, config.threads, memory)
        for (scene, backbone), requests in sequences.items()
    ]


def split(jobs: Sequence[Job], width: int) -> list[Job]:
    """As many jobs as can run at once, if there are that many units: the largest ones are halved."""
    jobs = list(jobs)
    while 0 < len(jobs) < width:
        k = max(range(len(jobs)), key=lambda k: len(jobs[k].requests))
        requests = jobs[k].requests
        if len(requests) < 2:
            break
        half = len(requests) // 2
        jobs[k : k + 1] = [dataclasses.replace(jobs[k], requests=part) for part in (requests[:half], requests[half:])]
    return jobs


def _agreement(config: StudyConfig, records: Sequence[Record]) -> Iterator[Agreement]:
    """Of each backend that must agree with the base one, on each scene and backbone that both fused."""
    checked = [backend.name for backend in config.backends.values if backend.checked]
    others = [r for r in records if r.variation.sweep == BACKENDS and r.unit.backend in checked]
    for base in (record for record in records if record.variation.sweep == BASE):
        table = None
        for other in others:
            if (other.unit.scene, other.unit.backbone) == (base.unit.scene, base.unit.backbone):
                table = base.table() if table is None else table
                yield compare(table, other.table(), (base.unit, other.unit), tolerance=config.tolerance)


def _comparisons(records: Sequence[Record]) -> Iterator[BackboneComparison]:
    """The base units of each scene beside each other; accuracy where the ground truth is one of them."""
    base = [record for record in records if record.variation.sweep == BASE]
    for scene in dict.fromkeys(record.unit.scene for record in base):
        maps = {record.unit.backbone: record.table() for record in base if record.unit.scene == scene}
        truth = maps.pop(GROUND_TRUTH, None)
        if comparable(maps):
            known = truth is not None and comparable(maps | {GROUND_TRUTH: truth})
            yield compare_backbones(maps, truth=truth if known else None, scene=scene)


def _up_axes(cells: Sequence[Cell], contents: Mapping[str, Mapping[str, Any]]) -> dict[str, tuple[float, float, float]]:
    """Each scene's up axis, as the base unit of its first backbone has it that knows one."""
    axes: dict[str, tuple[float, float, float]] = {}
    for cell in cells:
        up = contents.get(cell.identity, {}).get("up")
        if cell.variation.sweep == BASE and up is not None:
            axes.setdefault(cell.unit.scene, (up[0], up[1], up[2]))
    return axes
