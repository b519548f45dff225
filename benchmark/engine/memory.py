"""The memory of maps: estimated before anything is fused, tiles where a map will not fit, watched while it grows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from semstab.backends import expected_bytes, frame_bytes, restrictable, takes_blocks
from semstab.backends.numpy_reference import ONE_IN
from semstab.check.reprojection import evenly
from semstab.config import Config
from semstab.core.prefetch import default_threads
from semstab.core.process import available_bytes, resident_bytes, trim_malloc
from semstab.core.types import Int64
from semstab.engine.units import Planned, PlannedUnit
from semstab.errors import ConfigError, DataError, OutgrownError
from semstab.model.evidence import STRETCH
from semstab.model.frames import Frame
from semstab.pixels.preparation import perturb
from semstab.statistics.cluster_sums import distinct_rows
from semstab.task import Task, read

if TYPE_CHECKING:
    from semstab.engine.streams import LiveMap

GB = 1e9

LOADED, LOADED_FOR_SCORES, LOADED_FOR_TILES = 170e6, 30e6, 50e6
"""Bytes of code that a run loads once it is planned, of the sample of observations, and left between tiles."""

FRAMES_AT_WORK = 3
"""Frames that are in memory beside those which are read ahead."""

BLOCK = 4
"""Voxels along an edge of a block of space, of which some maps keep all or none."""


@dataclass(frozen=True)
class MemoryModel:
    """The bytes that the map of a unit takes, roughly.

    K        number of classes
    soft     whether frames have scores, which are fused as labels as well
    logged   whether every observation is kept, and the ground truth fused too
    sampled  whether the reference follows a sample of its voxels
    touched  voxels that a frame touches
    filled   share of the voxels of blocks of space that it touches, 0 where that does not matter
    """

    backend: str
    K: int
    soft: bool = False
    logged: bool = False
    sampled: bool = False
    touched: int = 0
    filled: float = 0.0

    @classmethod
    def of(cls, planned: PlannedUnit, first: Frame, *, soft: bool) -> MemoryModel:
        """The model of a unit, whose first frame is that one."""
        config, backend, K = planned.config, planned.unit.backend, len(planned.task.mapping.target)
        seen = voxels_in(first, config.voxel_size, K)
        touched, filled = len(seen) if frame_bytes(backend, 1, 2) else 0, filled_share(seen)
        logged = config.statistics or config.events
        return cls(backend, K, soft, logged, planned.sampled, touched, filled if takes_blocks(backend) else 0.0)

    def map_bytes(self, voxels: float, observations: float) -> float:
        """Bytes of a map of so many voxels and observations, and of its tables."""
        n, seen = int(voxels), int(observations)
        fused = expected_bytes(self.backend, n, seen, self.K, soft=self.soft, filled=self.filled)
        of_labels = expected_bytes(self.backend, n, seen, self.K, filled=self.filled)
        fused += of_labels * (self.logged + self.soft)  # the ground truth, and the map of reduced scores
        if self.logged:
            fused += log_bytes(seen, self.K, soft=self.soft)
        if self.sampled:
            fused += expected_bytes("numpy", n // ONE_IN, 0, self.K) + 8 * self.K * min(n // ONE_IN, STRETCH)
        fused += frame_bytes(self.backend, min(n, self.touched), self.K)
        return fused + (1 + self.logged) * table_bytes(n, self.K, soft=self.soft)


def process_bytes(first: Frame, K: int, threads: int | None, *, soft: bool, in_tiles: bool = False) -> float:
    """Bytes that a process takes beside its maps: code, and frames like the first one."""
    threads = default_threads() if threads is None else threads
    frames = (threads + FRAMES_AT_WORK) * first.shape[0] * first.shape[1] * (6 + (4 * K if soft else 0))
    return LOADED + soft * LOADED_FOR_SCORES + in_tiles * LOADED_FOR_TILES + frames


def log_bytes(observations: int, num_classes: int, *, soft: bool) -> int:
    """A log of observations: kept frame by frame, and sorted by voxel; of soft scores with most of the classes."""
    return observations * (100 + (20 * num_classes if soft else 0))


def table_bytes(voxels: int, num_classes: int, *, soft: bool) -> int:
    """A voxel table, while it is measured and written."""
    return voxels * (80 + (10 * num_classes if soft else 0))


def voxels_in(frame: Frame, voxel_size: float, num_classes: int) -> Int64:
    """(n, 3) indices of the voxels that a frame touches."""
    from semstab.backends.shared.aggregator import Aggregator

    pixels = Aggregator(voxel_size, num_classes)
    return pixels.index_of(pixels.observe(frame).key)


def filled_share(index: Int64) -> float:
    """Share of the voxels of those blocks, of 4 x 4 x 4, of which any is among these (n, 3)."""
    return len(index) / (BLOCK**3 * max(len(distinct_rows(index // BLOCK)[0]), 1))


def available_for_maps(config: Config, width: int, taken: float) -> float:
    """Bytes that maps of a process may take: its share of `memory_gb`, else of what is free beside what it takes.

    Where hardly anything is free, a quarter of it is for maps all the same.
    """
    if config.memory_gb is not None:
        return config.memory_gb * GB / width
    free = available_bytes() / width
    return max(free - taken, free / 4)


# --- Whole, or in tiles? ----------------------------------------------------------------------------------------------

DOUBT = 10
"""A sequence whose frames might see that many times the voxels of the first one, all new, is surely small enough."""

FEW = 8
"""Pairs of successive frames, evenly spaced, from which the size of a map is estimated."""

SHARE = 0.5
"""Of the memory for maps, a tile takes so much: a hash or a grid that doubles needs room."""

CROWDED = 1.5
"""A tile may have that many times the mean number of voxels of its size."""

SMALLEST, LARGEST = 8, 1 << 16
"""Edges of a tile that is chosen, in voxels."""


@dataclass
class Sizing:
    """Units that would not fit into memory, by identity: the edge of their tiles, or why they cannot be fused.

    lines  say so, one for each sequence in tiles
    """

    tile_sizes: dict[str, int] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


def planned_sizes(config: Config, missing: Iterable[Planned], width: int) -> Sizing:
    """Estimate the units that are to be fused; where one cannot be read, computing it will say so."""
    sizing, together = Sizing(), dict[object, list[PlannedUnit]]()
    for each in missing:
        if isinstance(each, PlannedUnit):  # watched units of a sequence are in memory together; others can be put off
            key = (each.unit.scene, each.unit.backbone) if each.kept else each.identity
            together.setdefault(key, []).append(each)
    for group in together.values():
        try:
            _plan_sizes(config, group, width, sizing)
        except DataError:
            continue
    return sizing


def _plan_sizes(config: Config, group: Sequence[PlannedUnit], width: int, sizing: Sizing) -> None:
    task, settings = group[0].task, group[0].config
    why = None
    if config.tile_size == "off":
        why = "tile_size: off forbids to fuse it in tiles"
    elif other := [each.unit.backend for each in group if not restrictable(each.unit.backend)]:
        why = f"backend '{other[0]}' cannot be restricted to tiles"
    if isinstance(config.tile_size, int):
        if why is not None:
            raise ConfigError(f"tile_size = {config.tile_size}: {why}")
        sizing.tile_sizes |= {each.identity: config.tile_size for each in group}
        return
    first, K = _geometry(task, settings, task.indices[0]), len(task.mapping.target)
    most = DOUBT * len(task.indices) * len(voxels_in(first.every(2), settings.voxel_size, K))
    for soft in (True, False):  # if scores would fit, no label is decoded to know, which a network may have to predict
        models = [MemoryModel.of(each, first, soft=soft) for each in group]
        free = available_for_maps(config, width, process_bytes(first, K, settings.threads, soft=soft))
        if sum(model.map_bytes(most, most) for model in models) <= free:
            return
        if soft and read(task, task.indices[0], settings.pixel_stride).scores is not None:
            break
    size = map_size(task, settings, K)
    needed = sum(model.map_bytes(size.voxels, size.observations) for model in models)
    if needed <= free:
        return
    takes = (
        f"{task.scene.name}, {task.backbone}: about {size.voxels / 1e6:.2g} million voxels of {settings.voxel_size:g} m"
        f" would take {needed / GB:.2g} GB"
    )
    if why is not None:
        there = f"{free / GB:.2g} GB " + ("are free for it" if config.memory_gb is None else "is memory_gb")
        line = (
            f"{takes}, and {there}; use larger voxels (voxel_size), fewer frames (frames), a larger pixel_stride"
            f"{_without(group, settings)}; or set memory_gb to try all the same ({why})"
        )
        sizing.refused |= {each.identity: line for each in group}
        return
    in_tiles = available_for_maps(config, width, process_bytes(first, K, settings.threads, soft=soft, in_tiles=True))
    edges = [size.tile_edge(model, SHARE * in_tiles, width) for model in models]
    sizing.tile_sizes |= {each.identity: edge for each, edge in zip(group, edges, strict=True)}
    sizing.lines.append(
        f"{takes}, {free / GB:.2g} GB are there{' for each process' if width > 1 else ''}: fused in tiles of"
        f" {edges[0] * settings.voxel_size:g} m"
    )


def _without(group: Sequence[PlannedUnit], settings: Config) -> str:
    keep_all = [
        name for each in group if expected_bytes(name := each.unit.backend, 1, 2, 2) > expected_bytes(name, 1, 1, 2)
    ]
    without = f", no backend that keeps every observation ({', '.join(keep_all)})" if keep_all else ""
    return without + (", no statistics" if settings.statistics else "")


@dataclass(frozen=True)
class MapSize:
    """The estimated size of a map: its voxels, observations, and voxels in a column of them."""

    voxels: float
    observations: float
    by_column: float

    def tile_edge(self, model: MemoryModel, budget: float, width: int) -> int:
        """The largest edge of a tile, a power of 2, within the budget; smaller where several processes share them."""
        edge = LARGEST
        seen = self.observations / max(self.voxels, 1.0)
        while edge > SMALLEST:
            voxels = min(CROWDED * self.by_column * edge**2, self.voxels)
            alone = width > 1 and 2 * width * self.by_column * edge**2 > self.voxels
            if model.map_bytes(voxels, voxels * seen) <= budget and not alone:
                break
            edge //= 2
        return edge


def map_size(task: Task, settings: Config, num_classes: int) -> MapSize:
    """Estimate a map from a few pairs of successive frames, evenly spaced.

    If no place is seen again later, each frame adds as many voxels as the second one of a pair adds to the first.
    Where frames far apart see the same voxels, it adds fewer: as many as if frames drew their voxels at random from a
    fixed number of them, which follows from how many of the sampled ones are distinct.
    """
    first = [task.indices[k] for k in evenly(len(task.indices), FEW)]
    after = dict(zip(task.indices, task.indices[1:], strict=False))
    seen, new = list[Int64](), list[float]()
    for index in first:
        seen.append(voxels_in(_geometry(task, settings, index), settings.voxel_size, num_classes))
        if index in after:
            later = voxels_in(_geometry(task, settings, after[index]), settings.voxel_size, num_classes)
            new.append(len(distinct_rows(np.concatenate([seen[-1], later]))[0]) - len(seen[-1]))
    frames, each = len(task.indices), float(np.mean([len(own) for own in seen]))
    distinct = distinct_rows(np.concatenate(seen))[0]
    ahead = each + (frames - 1) * float(np.mean(new)) if new else each
    places = _drawn_from(len(distinct), each, len(seen))
    again = frames * each if math.isinf(places) else places * -math.expm1(frames * math.log1p(-each / places))
    voxels = max(float(len(distinct)), min(ahead, again))
    columns = len(distinct_rows(distinct[:, :2])[0])
    return MapSize(voxels, frames * each, len(distinct) / max(columns, 1))


def _drawn_from(distinct: int, each: float, frames: int) -> float:
    """The number of voxels of which so many frames see `each` at random, if so many are distinct; maybe infinite."""
    if distinct >= 0.999 * frames * each:
        return math.inf
    low, high = max(float(distinct), each * (1 + 1e-9)), 1e4 * frames * each
    for _ in range(100):
        middle = math.sqrt(low * high)
        if middle * -math.expm1(frames * math.log1p(-each / middle)) < distinct:
            low = middle
        else:
            high = middle
    return high


def _geometry(task: Task, settings: Config, index: int) -> Frame:
    """The frame as it is fused, but for its labels, which may leave pixels out."""
    frame = task.scene.geometry(index)
    if task.perturbation is not None:
        frame = perturb(frame, task.perturbation, task.scene.name)
    return frame.every(settings.pixel_stride)


# --- While maps grow --------------------------------------------------------------------------------------------------

STEP = 32e6
"""Bytes by which the process may grow before its maps are looked at closer."""

AMPLE = 4
"""Where that many times the bytes of the maps are left, freed memory is kept: the next images need not clear it."""


class MemoryBudget:
    """Watches the memory of a pass, frame by frame, in a time that does not grow with the maps.

    memory_gb  that all maps and their tables may take; None: what is free
    width      processes that share it
    """

    def __init__(self, memory_gb: float | None, width: int) -> None:
        self._limit = None if memory_gb is None else memory_gb * GB / width
        self._width = width
        self._before: int | None = None  # memory of this process without maps; code that the first frame loads stays
        self._seen = self._largest_step = 0
        self._left = 0.0

    def lacking(self, maps: Sequence[LiveMap]) -> LiveMap | None:
        """The largest of the maps where the memory left would not do for the end of each; None where it does.

        A hash map that is full doubles: the next step may be twice the largest one so far.
        """
        expected = sum(map(_bytes, maps))
        if self._before is None:
            self._before = resident_bytes() - expected
        taken = self._taken(expected)
        if taken - self._seen < min(STEP, (self._limit or STEP) / 8):
            return None
        end = max(map(end_bytes, maps))
        if self._beyond(taken) >= AMPLE * (taken + end):
            self._seen = taken
            return None
        trim_malloc()  # else freed memory would count
        taken = self._taken(expected)
        self._seen, self._largest_step = taken, max(self._largest_step, taken - self._seen)
        self._left = self._beyond(taken)
        return None if self._left >= end + 2 * self._largest_step else max(maps, key=_bytes)

    def _beyond(self, taken: int) -> float:
        """Bytes left for maps that take so many."""
        free = available_bytes() / self._width
        return free if self._limit is None else min(free, self._limit - taken)

    def _taken(self, expected: int) -> int:
        """Bytes that maps take; one may take memory that was freed before."""
        return max(resident_bytes() - (self._before or 0), expected)

    def outgrown(self, live: LiveMap) -> OutgrownError:
        """The error of a map that is given up."""
        unit, config, tile = live.unit, live.work.config, live.work.tile
        voxels = live.rows[-1].report.map_voxels
        which = "are free" if self._limit is None else "is left of memory_gb"
        size = f"a smaller --tile-size than {tile.size}" if tile is not None else "tiles (--tile-size 256)"
        return OutgrownError(
            f"{unit.scene}, {unit.backbone}, {unit.backend}: after {len(live.rows)} of {len(live.frames)} frames"
            f" the map has {voxels / 1e6:.2g} million voxels of {config.voxel_size:g} m, of which its table"
            f" {'and statistics' if config.statistics else 'alone'} would take {end_bytes(live) / GB:.2g} GB, and"
            f" {max(0, self._left) / GB:.2g} GB {which}; use {size}, larger voxels (voxel_size), fewer frames (frames),"
            " or a larger pixel_stride"
        )


def end_bytes(live: LiveMap) -> int:
    """Bytes that measuring and writing a map takes beside what it takes already."""
    config, K = live.work.config, len(live.task.mapping.target)
    voxels = live.rows[-1].report.map_voxels
    tables = (1 + (live.truth is not None)) * table_bytes(voxels, K, soft=live.soft)
    return tables + (log_bytes(live.observations, K, soft=live.soft) if config.statistics or config.events else 0)


def _bytes(live: LiveMap) -> int:
    K, voxels = len(live.task.mapping.target), live.rows[-1].report.map_voxels
    return expected_bytes(live.unit.backend, voxels, live.observations, K, soft=live.soft)
