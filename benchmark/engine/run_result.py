"""The records of a plan's units, and the result that they make together."""

from __future__ import annotations

import itertools
import platform
import resource
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from semstab.backends import rule_of
from semstab.check import Verdict
from semstab.config import BACKENDS, BASE, Config
from semstab.core.process import Stopwatch
from semstab.core.versions import version_of
from semstab.data.records import REGIONS, Failure, Record, RegionFlicker, Result, Tables
from semstab.data.results import Agreement, VoxelAdvice
from semstab.data.tiles import Tiles, side_by_side
from semstab.data.voxels import VoxelTable
from semstab.engine.folder import Folder
from semstab.engine.units import Plan, must_agree
from semstab.engine.work import Work
from semstab.metrics import compare
from semstab.metrics.agreement import together


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
    """Return the result of all units that there are: how backends agree."""
    config = plan.config
    finished = [(unit, stored) for unit in plan.units if isinstance(stored := units.records.get(unit.identity), Record)]
    records = tuple(folder.record(unit, record) for unit, record in finished)
    tables = Tables(most=len({record.unit.backend for record in records}))
    with units.watch("agreement"):
        checks = (record.checked for unit, record in finished if unit.sampled)
        agreement = (*filter(None, checks), *_agreements(config, records, tables, must=True))
        compared = tuple(_agreements(config, records, tables, must=False))
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
        up=up,
        georeference={
            name: georeference
            for name, scene in plan.scenes.items()
            if (georeference := scene.georeference) is not None
        },
        regions=tuple(
            flicker for unit in plan.regions if isinstance(flicker := units.records.get(unit.identity), RegionFlicker)
        ),
        compared=compared,
        advice=units.advice,
        notes=_notes_of(base),
        benchmark="" if config.benchmark is None else str(config.benchmark),
    )


def advice_of(plan: Plan, records: Mapping[str, Record | RegionFlicker]) -> dict[str, VoxelAdvice]:
    """Return the voxel size's advice of each scene, from when its base units were computed."""
    base = (records.get(unit.identity) for unit in plan.units if unit.variation.sweep == BASE)
    return {
        record.unit.scene: record.advice for record in base if isinstance(record, Record) and record.advice is not None
    }


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
        if record.variation.sweep in (BASE, BACKENDS):  # the first backend's record comes first
            groups.setdefault((record.unit.scene, record.unit.model), []).append(record)
    for group in groups.values():
        for a, b in itertools.combinations(group, 2) if must else zip(group[:1] * len(group), group[1:], strict=False):
            names = {a.unit.backend, b.unit.backend}
            if must == (names <= checked and len({*map(rule_of, names)}) == 1):
                yield _alike(config, a, b, tables)


def _alike(config: Config, a: Record, b: Record, tables: Tables) -> Agreement:
    units = a.unit, b.unit
    maps = [Tiles.open(file, VoxelTable) for record in (a, b) if (file := record.voxels_file) is not None]
    if not (a.in_tiles or b.in_tiles):
        return compare(tables.table_of(a), tables.table_of(b), units, tolerance=config.tolerance)
    return together([compare(first, second, units, tolerance=config.tolerance) for first, second in side_by_side(maps)])


# The content of manifest.json: the origin of a run's numbers.

SCHEMA = 1
"""Version of manifest.json."""

REPORTED_PACKAGES = ("numpy", "open3d", "opencv-python-headless", "pyarrow", "rerun-sdk", "trimesh")


def origin(config: Config, command: Sequence[str]) -> dict[str, Any]:
    """Return versions, the command line, and the peak of memory so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # in kB on Linux, bytes on macOS
    return {
        "schema": SCHEMA,
        "semstab": version_of("semstab"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: version_of(name) for name in REPORTED_PACKAGES},
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
