"""The records of a plan's units, and the result that they make together."""

from __future__ import annotations

import importlib.metadata
import itertools
import platform
import resource
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from semstab.check import Verdict
from semstab.config import BACKENDS, BASE, Config
from semstab.core.process import Stopwatch
from semstab.data.events import Events
from semstab.data.labels import sharing_classes
from semstab.data.records import REGIONS, Failure, Record, RegionFlicker, Result, Tables
from semstab.data.results import Agreement, VoxelAdvice
from semstab.data.tiles import Tiles, side_by_side
from semstab.data.voxels import VoxelTable
from semstab.datasets import GROUND_TRUTH
from semstab.engine.folder import Folder
from semstab.engine.units import Plan, must_agree
from semstab.engine.work import Work
from semstab.metrics import compare
from semstab.metrics.agreement import together
from semstab.statistics import ModelComparison, SpotObservations, claimed_together
from semstab.statistics.model_comparison import Region, Regions, compare_regions


@dataclass
class UnitResults:
    """Records of the units by identity, or their errors; geometry, advice by scene, notes by model, causes."""

    records: dict[str, Record | RegionFlicker] = field(default_factory=dict)
    finished_before: int = 0
    geometry: dict[str, Verdict] = field(default_factory=dict)
    advice: dict[str, VoxelAdvice] = field(default_factory=dict)
    notes: dict[tuple[str, str], tuple[str, ...]] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)
    causes: dict[str, BaseException] = field(default_factory=dict)
    watch: Stopwatch = field(default_factory=Stopwatch)

    def finished(self) -> list[Record]:
        """Return the records of the units that were fused."""
        return [record for record in self.records.values() if isinstance(record, Record)]

    def add_seconds(self, work: Work) -> None:
        """Add the time that a pass took, by stage."""
        for stage, seconds in work.seconds.items():
            self.watch.seconds[stage] += seconds


def result_of(plan: Plan, folder: Folder, units: UnitResults) -> Result:
    """Return the result of all units that there are: how they agree, and how models compare."""
    config = plan.config
    finished = [(unit, kept) for unit in plan.units if isinstance(kept := units.records.get(unit.identity), Record)]
    records = tuple(folder.record(unit, record) for unit, record in finished)
    tables = Tables(most=len({record.unit.backend for record in records}))
    with units.watch("agreement"):
        checks = (record.checked for unit, record in finished if unit.sampled)
        agreement = (*filter(None, checks), *_agreements(config, records, tables, must=True))
        compared = tuple(_agreements(config, records, tables, must=False))
    with units.watch("comparisons"):
        comparisons = claimed_together(tuple(_comparisons(config, records, tables)) if config.statistics else ())
    up: dict[str, tuple[float, float, float]] = {}  # of the first model whose base unit has it
    base = [record for unit, record in finished if unit.variation.sweep == BASE]
    for record in base:
        if record.up is not None:
            up.setdefault(record.unit.scene, record.up)
    failed = [unit for unit in plan.every() if unit.identity in units.errors]
    return Result(
        name=config.name,
        backend=config.backends[0].name,
        records=records,
        failures=tuple(Failure(unit.name, unit.variation, units.errors[unit.identity]) for unit in failed),
        agreement=agreement,
        comparisons=comparisons,
        up=up,
        georeference={name: known for name, scene in plan.scenes.items() if (known := scene.georeference) is not None},
        regions=tuple(
            kept for unit in plan.regions if isinstance(kept := units.records.get(unit.identity), RegionFlicker)
        ),
        compared=compared,
        advice=units.advice,
        notes=_notes_of(base),
        benchmark="" if config.benchmark is None else str(config.benchmark),
    )


def advice_of(plan: Plan, records: Mapping[str, Record | RegionFlicker]) -> dict[str, VoxelAdvice]:
    """Return the voxel size's advice of each scene, from when its base units were computed."""
    base = (records.get(unit.identity) for unit in plan.units if unit.variation.sweep == BASE)
    return {each.unit.scene: each.advice for each in base if isinstance(each, Record) and each.advice is not None}


def _notes_of(base: Sequence[Record]) -> dict[str, tuple[str, ...]]:
    """Return the remarks of the check on each scene, from when its base units were computed."""
    notes: dict[str, list[str]] = {}
    for record in base:
        if record.notes:
            notes.setdefault(record.unit.scene, []).extend(record.notes)
    return {scene: tuple(dict.fromkeys(of_scene)) for scene, of_scene in notes.items()}


def _agreements(config: Config, records: Sequence[Record], tables: Tables, *, must: bool) -> Iterator[Agreement]:
    """Yield how far backends agree on each scene and model that both fused.

    Args:
        config: The settings of the run.
        records: Its records, those of the first backend first.
        tables: Their voxel tables.
        must: Whether to take each pair of those that must agree; else for the first backend and each other one, where
            one of the two need not agree.
    """
    checked = {backend.name for backend in config.fused_by() if must_agree(backend)}
    groups: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        if record.variation.sweep in (BASE, BACKENDS):  # those of the first backend come first
            groups.setdefault((record.unit.scene, record.unit.model), []).append(record)
    for group in groups.values():
        for a, b in itertools.combinations(group, 2) if must else zip(group[:1] * len(group), group[1:], strict=False):
            if must == ({a.unit.backend, b.unit.backend} <= checked):
                yield _alike(config, a, b, tables)


def _alike(config: Config, a: Record, b: Record, tables: Tables) -> Agreement:
    units = a.unit, b.unit
    maps = [Tiles.open(file, VoxelTable) for record in (a, b) if (file := record.voxels_file) is not None]
    if not (a.in_tiles or b.in_tiles):
        return compare(tables.of(a), tables.of(b), units, tolerance=config.tolerance)
    return together([compare(one, other, units, tolerance=config.tolerance) for one, other in side_by_side(maps)])


def _comparisons(config: Config, records: Sequence[Record], tables: Tables) -> Iterator[ModelComparison]:
    """Yield the comparison of each scene's base units; with accuracy where there is ground truth."""
    base = [record for record in records if record.variation.sweep == BASE and record.unit.model != GROUND_TRUTH]
    for scene in dict.fromkeys(record.unit.scene for record in base):
        there = [record for record in base if record.unit.scene == scene]
        if len(there) > 1:
            files = {record.unit.model: record.observations_file for record in there}
            loaded = {name: SpotObservations.load(file) for name, file in files.items() if file and file.exists()}
            regions, observations = _regions_of(there, config, tables), loaded if len(loaded) == len(there) else None
            of_labels = {record.unit.model: record.summary.reduced is None for record in there}
            if (compared := _compared_maps(scene, regions, observations, of_labels)) is not None:
                yield compared


def _compared_maps(
    scene: str, regions: Regions, observations: Mapping[str, SpotObservations] | None, of_labels: Mapping[str, bool]
) -> ModelComparison | None:
    """Return the comparison of a scene's maps in the label space that most have; None without two such maps.

    The samples of all of them give matched observations.
    """
    first = next(iter(regions()))
    names = sharing_classes({name: table.classes for name, table in first.tables.items()})
    if not names:
        return None
    classes = first.tables[names[0]].classes

    def comparable() -> Iterator[Region]:
        for own in regions():
            tables = {name: own.tables[name] for name in names}
            logs = None if own.events is None else {name: own.events[name] for name in names}
            truth = own.truth if own.truth is not None and own.truth.classes == classes else None
            yield Region(tables, logs, truth, own.share)

    mixed = len({of_labels[name] for name in names}) > 1
    return compare_regions(comparable, observations=observations, mixed=mixed, scene=scene)


def _regions_of(there: Sequence[Record], config: Config, tables: Tables) -> Regions:
    """Yield the maps of a scene's units tile by tile, or whole, with their logs and the ground truth."""
    names = [record.unit.model for record in there]
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
            log = dict(zip(names, own[len(maps) :], strict=False)) if logs else None
            yield Region(dict(zip(names, own, strict=False)), log, own[-1] if truths else None)

    return regions


# The content of manifest.json: the origin of a run's numbers.

SCHEMA = 1
"""Version of manifest.json."""

REPORTED_PACKAGES = ("numpy", "open3d", "opencv-python-headless", "pyarrow", "rerun-sdk", "trimesh")


def origin(config: Config, command: Sequence[str]) -> dict[str, Any]:
    """Return versions, the command line, and the peak of memory so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # in kB on Linux, bytes on macOS
    return {
        "schema": SCHEMA,
        "semstab": _version("semstab"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: _version(name) for name in REPORTED_PACKAGES},
        "command": list(command),
        "seed": config.dataset.options.get("seed"),
        "peak_memory_bytes": peak if sys.platform == "darwin" else 1024 * peak,
    }


def manifest(plan: Plan, units: UnitResults, executor: str, command: Sequence[str]) -> dict[str, Any]:
    """Return the content of manifest.json: versions, digests of the inputs, seconds by stage, peak memory, counts."""
    records, before, failed = units.records, units.finished_before, len(units.errors)
    counts = {"units": len(records) + failed, "kept": before, "computed": len(records) - before, "failed": failed}
    return {
        **origin(plan.config, command),
        "inputs": {
            f"{unit.name.scene}/{unit.name.model}": records[unit.identity].input
            for unit in plan.every()
            if unit.identity in records and unit.variation.sweep in (BASE, REGIONS)
        },
        "seconds": dict(units.watch.seconds),
        "units": counts | {"executor": executor},
        "geometry": {scene: verdict.summary() for scene, verdict in units.geometry.items()},
        "depth_from": {name: scene.depth_from for name, scene in plan.scenes.items() if scene.depth_from},
        "placed": {name: scene.placed for name, scene in plan.scenes.items() if scene.placed},
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
