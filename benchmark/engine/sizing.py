"""Which units fit into memory as they are, which are fused in tiles, and which not at all: before any is fused."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from semstab.backends import frame_bytes, restrictable, takes_blocks
from semstab.config import Config
from semstab.engine.folder import Folder
from semstab.engine.observer import Observers
from semstab.engine.tiling.collected import Seen
from semstab.engine.tiling.partition import ROOM, Tiling, tile_size, tiled
from semstab.engine.tiling.sights import CELL, SIGHTS, Looking, Sights, look_at, origin_of, sights_of
from semstab.engine.tiling.stretches import stretches_of
from semstab.engine.units import Planned, PlannedUnit
from semstab.engine.work.executors import Executor
from semstab.engine.work.jobs import Job, Request
from semstab.engine.work.memory import GB, Kind, Load, filled_of, most_voxels, room, takes, too_large, voxels_of
from semstab.errors import ConfigError, DataError
from semstab.model.frames import Frame
from semstab.task import Task, read

# What the frames of a unit see: looked at by threads of this process, or by an executor's workers elsewhere.


@dataclass(frozen=True)
class Survey:
    """Who looks: workers of `executor`, where they may be on other machines, and else threads of this one.

    start  of the run in the folder
    """

    executor: Executor
    folder: Folder
    start: str

    def sights(self, planned: PlannedUnit, settings: Config, cell: int, key: str) -> Sights:
        """By cells of that edge, kept under that key. Raises DataError as `look_at` does."""
        file = self.folder.path / SIGHTS / f"{key}.npz"
        if (kept := Sights.load(file)) is not None:
            return kept
        if self.executor.remote:
            found = self._from_workers(planned, settings, cell, f"{SIGHTS}/{key}")
        else:
            found = look_at(planned.task, settings.voxel_size, settings.pixel_stride, cell, settings.threads)
        found.save(file)
        shutil.rmtree(file.with_suffix(""), ignore_errors=True)
        return found

    def _from_workers(self, planned: PlannedUnit, settings: Config, cell: int, folder: str) -> Sights:
        """Stretch by stretch, each kept in that folder until all are there."""
        frames, origin = planned.task.indices, origin_of(planned.task, settings.voxel_size, settings.pixel_stride)
        stretches = stretches_of(frames, origin, lead=0, width=self.executor.width)
        tasks = {f"{folder}/{each.name}.npz": each.frames for each in stretches}
        there = {name: seen for name in tasks if (seen := Seen.load(self.folder.path / name)) is not None}
        unit, whole = planned.unit, Request.of(planned)
        jobs = [
            Job(
                unit.scene,
                unit.backbone,
                (whole.looking_at(frames, Looking(name, origin, cell)),),
                self.start,
                self.folder.path,
                settings.threads,
            )
            for name, frames in tasks.items()
            if name not in there
        ]
        with contextlib.closing(self.executor.run(jobs, Observers([]))) as finished:
            for job, (outcome,) in finished:
                if outcome.error is not None:
                    raise DataError(outcome.error)
                self.folder.save_files(outcome)
                looking = job.requests[0].looking
                assert looking is not None
                seen = Seen.load(self.folder.path / looking.file)
                if seen is None:
                    raise DataError(f"{self.folder.path / looking.file}: is not in the folder; start it again")
                there[looking.file] = seen
        return sights_of((there[name] for name in tasks), origin, cell)


SHARE = 0.45
"""Of the memory that maps may take, a part of one in tiles takes so much: a hash or a grid that doubles needs room."""


SMALLER = 8
"""Tiles of a map that outgrew the memory are so much smaller than others: a part can be cut down to a single one."""


@dataclass
class Sizing:
    """What is done with units that would not fit, by identity.

    tilings  into which parts their maps are cut
    refused  why they cannot be fused
    remarks  a line for each sequence that is fused in tiles
    """

    tilings: dict[str, Tiling] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def sized(config: Config, missing: Sequence[Planned], survey: Survey) -> Sizing:
    """Look at units that are to be fused; what cannot be read is left to them to report."""
    found = Sizing()
    for group in _groups(missing):
        with contextlib.suppress(DataError):
            _size(config, group, survey, found)
    return found


def begun_again(config: Config, planned: PlannedUnit, survey: Survey) -> Sizing:
    """What is done with a unit that was fused at once and took more memory than there is: it is fused in tiles.

    Nothing where that cannot be, or is forbidden.
    """
    found = Sizing()
    with contextlib.suppress(DataError):
        if _cannot_be_tiled(config, [planned]) is None:
            _size(config, [planned], survey, found, outgrown=True)
    return found


def _groups(missing: Sequence[Planned]) -> Iterator[list[PlannedUnit]]:
    """Units that are in memory at once: those of a sequence that are watched; others can be put off."""
    together: dict[tuple[str, str], list[PlannedUnit]] = {}
    for each in missing:
        if isinstance(each, PlannedUnit):
            if each.kept:
                together.setdefault((each.unit.scene, each.unit.backbone), []).append(each)
            else:
                yield [each]
    yield from together.values()


def _size(
    config: Config, group: Sequence[PlannedUnit], survey: Survey, found: Sizing, *, outgrown: bool = False
) -> None:
    """Where a unit has outgrown the memory, or had when it was begun, more than the estimate takes all there is."""
    task, settings, width = group[0].task, group[0].config, survey.executor.width
    begun = config.tile_size is None and any(survey.folder.begun_in_tiles(each) for each in group)
    outgrown = outgrown or begun
    forced = isinstance(config.tile_size, int) or outgrown
    first = _first(task, settings)
    if not forced and _surely_fits(config, width, group, first):
        return
    soft = _is_soft(task)
    size = config.tile_size if isinstance(config.tile_size, int) else None
    sights = _sights(survey, group[0], settings, min(CELL, size or CELL))
    voxels, observations = float(sights.voxels.sum()), float(sights.observations.sum())
    kinds, load = _kinds(group, first, soft=soft), _load(group, first, soft=soft)
    needed = sum(kind.bytes(voxels, observations) for kind in kinds)
    own = room(config, width, load.beside(needed))
    if not forced and needed <= own:
        return
    if (why := _cannot_be_tiled(config, group)) is not None:
        if isinstance(config.tile_size, int):
            raise ConfigError(f"tile_size = {config.tile_size}: {why}")
        names = [each.unit.backend for each in group]
        line = too_large(task, names, settings, voxels, needed, own, f" ({why})")
        found.refused |= {each.identity: line for each in group}
        return
    outgrown = outgrown and needed <= own
    more = own / needed if outgrown and needed else 1.0
    budget = SHARE * room(config, width, load.beside(needed, in_tiles=True)) / more
    if outgrown and size is None:  # small ones, as nobody knows how much more it will be
        size = tile_size(sights, kinds[0].bytes, budget / ROOM / SMALLER)
    for each, kind in zip(group, kinds, strict=True):
        found.tilings[each.identity] = tiled(sights, kind.bytes, budget, size, 2 * width if width > 1 else 1)
    tiling = found.tilings[group[0].identity]
    decoded = tiling.decodes / max(len(task.indices), 1)
    each_has = " for each process" if width > 1 else ""
    how = ", which it outgrew: begun again" if outgrown else ": fused"
    found.remarks.append(
        f"{takes(task, settings, voxels, needed)}, {own / GB:.2g} GB are there{each_has}{how} in {len(tiling.parts)}"
        f" parts, of tiles of {tiling.size * settings.voxel_size:g} m; a frame is decoded {decoded:.2f} times for them"
    )


def _surely_fits(config: Config, width: int, group: Sequence[PlannedUnit], first: Frame) -> bool:
    """Without a look at labels, which may be a network's, where that will do."""
    task, settings = group[0].task, group[0].config
    voxels = most_voxels(task, settings, first)

    def fits(*, soft: bool) -> bool:
        needed = sum(kind.bytes(voxels, voxels) for kind in _kinds(group, first, soft=soft))
        return needed <= room(config, width, _load(group, first, soft=soft).beside(needed))

    return fits(soft=True) or (fits(soft=False) and not _is_soft(task))


def _load(group: Sequence[PlannedUnit], first: Frame, *, soft: bool) -> Load:
    """Of the process that these units are fused in."""
    task, settings = group[0].task, group[0].config
    return Load(first, len(task.indices), len(task.mapping.target), soft, settings.threads)


def _first(task: Task, settings: Config) -> Frame:
    """The geometry of the first frame as it is fused."""
    return task.scene.geometry(task.indices[0]).every(settings.pixel_stride)


def _kinds(group: Sequence[PlannedUnit], first: Frame, *, soft: bool) -> list[Kind]:
    about = (first, group[0].config.voxel_size, len(group[0].task.mapping.target))
    touched = voxels_of(*about) if any(frame_bytes(each.unit.backend, 1, 2) for each in group) else 0
    filled = filled_of(*about) if any(takes_blocks(each.unit.backend) for each in group) else 0.0
    return [
        Kind(
            each.unit.backend,
            len(each.task.mapping.target),
            soft=soft,
            logged=each.config.statistics or each.config.events,
            sampled=each.sampled,
            touched=touched,
            filled=filled,
        )
        for each in group
    ]


def _is_soft(task: Task) -> bool:
    return read(task, task.indices[0]).scores is not None


def _cannot_be_tiled(config: Config, group: Sequence[PlannedUnit]) -> str | None:
    """Why not; None where they can."""
    if config.tile_size == "off":
        return "tile_size: off forbids to fuse it in tiles"
    other = [each.unit.backend for each in group if not restrictable(each.unit.backend)]
    return f"backend '{other[0]}' cannot be restricted to tiles" if other else None


def _sights(survey: Survey, planned: PlannedUnit, settings: Config, cell: int) -> Sights:
    """What the frames see, kept from before or looked at now."""
    task = planned.task
    noise = None if task.perturbation is None else task.perturbation.model_dump()
    content = [task.scene.name, task.digest, settings.voxel_size, settings.pixel_stride, noise, [*task.indices], cell]
    key = hashlib.blake2b(json.dumps(content).encode(), digest_size=12).hexdigest()
    return survey.sights(planned, settings, cell, key)
