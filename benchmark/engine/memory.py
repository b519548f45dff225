"""The memory of maps: estimated before anything is fused, tiles where a map will not fit, watched while it grows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from semstab.backends import expected_bytes, is_builtin, is_pointwise
from semstab.backends.numpy_reference import MOST_OF_ALL, ONE_IN
from semstab.config import Config
from semstab.core.arrays import evenly
from semstab.core.prefetch import default_threads, prefetch
from semstab.core.process import available_bytes, resident_bytes, trim_malloc
from semstab.core.types import Int32, Int64
from semstab.data.evidence import STRETCH_ENTRIES
from semstab.data.frames import Frame
from semstab.engine.units import Unit
from semstab.errors import ConfigError, DataError, OutgrownError
from semstab.pixels.preparation import perturb
from semstab.statistics.cluster_sums import count_distinct
from semstab.statistics.sample import MOST_VOXELS
from semstab.task import Task, read, truth_task

if TYPE_CHECKING:
    from semstab.engine.live_maps import LiveMap

GB = 1e9

LOADED = 210e6
"""Bytes of code that a run loads once it is planned, and of the sample of observations and its statistics."""

FRAMES_AT_WORK = 3
"""Frames that are in memory in addition to those which are read ahead."""


@dataclass(frozen=True)
class MapMemory:
    """Approximate memory of maps of one kind: bytes by their voxels and observations.

    Attributes:
        backend: The backend of the maps.
        K: Number of classes.
        soft: Whether the maps fuse scores, which are also fused as labels.
        logged: Whether every observation is kept.
        compared: Whether the ground truth is fused, too.
        sampled: Whether the reference fuses a sample of the voxels, or, to check a backend from outside, all of them.
    """

    backend: str
    K: int
    soft: bool = False
    logged: bool = False
    sampled: bool = False
    compared: bool = False

    def growing(self, voxels: float, observations: float) -> float:
        """Return the bytes of a map, of that of the ground truth or of reduced scores, and of the reference."""
        n, num_observations = int(voxels), int(observations)
        total = expected_bytes(self.backend, n, num_observations, self.K, soft=self.soft)
        total += (self.compared + self.soft) * expected_bytes(self.backend, n, num_observations, self.K)
        if is_builtin(self.backend):
            return total + self.sampled * expected_bytes("numpy", n // ONE_IN, 0, self.K)
        reference_voxels = min(n, MOST_OF_ALL)
        return total + self.sampled * expected_bytes(
            "numpy", reference_voxels, num_observations * reference_voxels // max(n, 1), self.K, soft=self.soft
        )

    def tables(self, voxels: float, observations: float) -> float:
        """Return the bytes of its tables and of its log."""
        n, num_observations = int(voxels), int(observations)
        tables = (1 + self.compared) * table_bytes(n, self.K, soft=self.soft)
        return tables + self.logged * log_bytes(num_observations, self.K, soft=self.soft)

    def statistics(self, voxels: float) -> float:
        """Return the bytes that statistics take beyond the tables: columns of voxels, and a stretch of scores."""
        sampled_voxels = min(int(voxels), MOST_VOXELS)
        return 160 * sampled_voxels + self.soft * 40 * min(self.K * sampled_voxels, STRETCH_ENTRIES)

    def whole(self, voxels: float, observations: float) -> float:
        """Return the bytes of a map and its tables, while they are made of it or measured."""
        return self.tables(voxels, observations) + max(self.growing(voxels, observations), self.statistics(voxels))

    def tile(self, voxels: float, observations: float) -> float:
        """Return the bytes of a tile and its tables."""
        return self.tables(voxels, observations) + self.growing(voxels, observations)

    def tiles(self, voxels: float, observations: float, tile_voxels: float) -> float:
        """Return the bytes of a map in tiles of at most `tile_voxels`.

        That is a tile beside the voxels that are drawn from those before it, these twice while they are joined, or the
        statistics of the voxels that are drawn from all of them.
        """
        per_voxel, sampled_voxels = observations / max(voxels, 1.0), min(voxels, MOST_VOXELS)
        held = min(voxels, 2 * sampled_voxels)
        parts = self.tables(held, per_voxel * held)
        tile = self.tile(tile_voxels, per_voxel * tile_voxels)
        return max(
            parts + tile,
            2 * parts,
            self.tables(sampled_voxels, per_voxel * sampled_voxels) + self.statistics(sampled_voxels),
        )


def log_bytes(observations: int, num_classes: int, *, soft: bool) -> int:
    """Return the bytes of a log, held frame by frame and sorted by voxel."""
    return observations * (100 + (20 * num_classes if soft else 0))


def table_bytes(voxels: int, num_classes: int, *, soft: bool) -> int:
    """Return the bytes of a voxel table while it is measured and written."""
    return voxels * (80 + (10 * num_classes if soft else 0))


def process_bytes(first: Frame, K: int, threads: int | None, *, soft: bool) -> float:
    """Return the bytes that a process takes without its maps: code, and frames like the first one."""
    threads = default_threads() if threads is None else threads
    return LOADED + (threads + FRAMES_AT_WORK) * first.shape[0] * first.shape[1] * (6 + (4 * K if soft else 0))


def voxels_in(frame: Frame, voxel_size: float) -> Int64:
    """Return the indices (n, 3) of the voxels that a frame of one class touches."""
    from semstab.backends.shared.aggregator import Aggregator

    pixels = Aggregator(voxel_size, num_classes=1)
    return pixels.index_of(pixels.observe(frame).key)


# --- Whole, or in tiles? ----------------------------------------------------------------------------------------------

DOUBT = 10
"""A sequence whose frames might see that many times the voxels of the first one, all new, is surely small enough."""

SAMPLED, PAIRS = 192, 8
"""Frames, evenly spaced, from which the size of a map is estimated; those that are read with their successors."""

DRAWN = 1 << 13
"""Voxels of a frame, about, that are looked at."""

SHARE = 0.6
"""The part of the memory for maps that a tile takes: a hash or a grid that doubles needs room."""

CROWDED = 1.3
"""A tile may have that many times the mean number of voxels of its size."""

SMALLEST, LARGEST = 8, 1 << 16
"""Edges of a tile that is chosen, in voxels."""


@dataclass
class Sizing:
    """Units that would not fit, by identity: the edge of their tiles, or why they cannot be fused; `lines` say so."""

    tile_sizes: dict[str, int] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


def planned_sizes(config: Config, missing: Iterable[Unit], width: int) -> Sizing:
    """Estimate the units that are to be fused; where one cannot be read, its computation reports the error."""
    sizing, together = Sizing(), dict[object, list[Unit]]()
    for unit in missing:
        if unit.fuses:  # watched units of a sequence are in memory together; others can be put off
            key = (unit.name.scene, unit.name.model) if unit.stored else unit.identity
            together.setdefault(key, []).append(unit)
    for group in together.values():
        try:
            _plan_sizes(config, group, width, sizing)
        except DataError:
            continue
    return sizing


def _plan_sizes(config: Config, group: Sequence[Unit], width: int, sizing: Sizing) -> None:
    task, settings, K = group[0].task, group[0].config, len(group[0].task.mapping.target)
    why = None
    if config.tile_size == "off":
        why = "tile_size: off forbids to fuse it in tiles"
    elif other := [unit.name.backend for unit in group if not is_pointwise(unit.name.backend)]:
        why = f"backend '{other[0]}' cannot be restricted to tiles"
    if isinstance(config.tile_size, int):
        if why is not None:
            raise ConfigError(f"tile_size = {config.tile_size}: {why}")
        sizing.tile_sizes |= {unit.identity: config.tile_size for unit in group}
        return
    first = _geometry(task, settings, task.indices[0])
    most = DOUBT * len(task.indices) * len(voxels_in(first.every(2), settings.voxel_size))
    for soft in (True, False):  # if scores would fit, no label is decoded to know, which a network may have to predict
        free = available_for_maps(config, width, process_bytes(first, K, settings.threads, soft=soft))
        kinds = [_kind(unit, soft=soft) for unit in group]
        if sum(kind.whole(most, most) for kind in kinds) <= free:
            return
        if soft and read(task, task.indices[0], settings.pixel_stride).scores is not None:
            break
    size = map_size(task, settings)
    needed = sum(kind.whole(size.voxels, size.observations) for kind in kinds)
    if needed <= free:
        return
    takes = (
        f"{task.scene.name}, {task.model}: about {size.voxels / 1e6:.2g} million voxels of {settings.voxel_size:g} m"
        f" would take {needed / GB:.2g} GB"
    )
    if why is not None:
        free_text = f"{free / GB:.2g} GB " + ("are free for it" if config.memory_gb is None else "is memory_gb")
        line = (
            f"{takes}, and {free_text}; use larger voxels (voxel_size), fewer frames (frames), a larger pixel_stride"
            f"{_without(group, settings)}; or set memory_gb to try anyway ({why})"
        )
        sizing.refused |= {unit.identity: line for unit in group}
        return
    edges = [_tile_edge(kind, size, SHARE * free, width) for kind in kinds]
    sizing.tile_sizes |= {unit.identity: edge for unit, edge in zip(group, edges, strict=True)}
    tiles = max(
        kind.tiles(size.voxels, size.observations, size.of_tile(edge)) for kind, edge in zip(kinds, edges, strict=True)
    )
    sizing.lines.append(
        f"{takes}, {free / GB:.2g} GB are free{' for each process' if width > 1 else ''}: it is fused in tiles of"
        f" {edges[0] * settings.voxel_size:g} m, which take {tiles / GB:.2g} GB"
    )


def available_for_maps(config: Config, width: int, taken: float) -> float:
    """Return the bytes for the maps of a process: its share of `memory_gb`, else of what is free beyond `taken`.

    If hardly anything is free, maps still get a quarter of it.
    """
    free = available_bytes() / width
    return max(free - taken, free / 4) if config.memory_gb is None else config.memory_gb * GB / width


def _kind(unit: Unit, *, soft: bool) -> MapMemory:
    config, K = unit.config, len(unit.task.mapping.target)
    compared = unit.compares_truth and truth_task(unit.task) is not None
    return MapMemory(unit.name.backend, K, soft, config.statistics or config.events, unit.sampled, compared)


def _without(group: Sequence[Unit], settings: Config) -> str:
    backends = [unit.name.backend for unit in group]
    keep_all = [name for name in backends if expected_bytes(name, 1, 2, 2) > expected_bytes(name, 1, 1, 2)]
    without = f", no backend that keeps every observation ({', '.join(keep_all)})" if keep_all else ""
    return without + (", no statistics" if settings.statistics else "")


class MapSize(NamedTuple):
    """The estimated size of a map: its voxels, observations, and voxels in a column of them."""

    voxels: float
    observations: float
    by_column: float

    def of_tile(self, edge: int) -> float:
        """Return the voxels of a tile, where they are crowded."""
        return min(CROWDED * self.by_column * edge**2, self.voxels)


def _tile_edge(kind: MapMemory, size: MapSize, budget: float, width: int) -> int:
    """Return the largest edge of a tile, a power of 2, within the budget.

    It is smaller where several processes share the tiles.
    """
    edge = LARGEST
    while edge > SMALLEST:
        voxels = size.of_tile(edge)
        alone = width > 1 and 2 * width * size.by_column * edge**2 > size.voxels
        if kind.tile(voxels, voxels * size.observations / max(size.voxels, 1.0)) <= budget and not alone:
            break
        edge //= 2
    return edge


def map_size(task: Task, settings: Config) -> MapSize:
    """Estimate the size of a map from evenly spaced frames.

    There are no more voxels than if each frame added as many as the second one of two successive frames adds to the
    first.
    """
    frames, voxels_of_frame, one_in = len(task.indices), dict[int, Int32](), 0
    sampled = evenly(frames, SAMPLED)
    following = [k + 1 for k in sampled[:: -(-len(sampled) // PAIRS)] if k + 1 < frames]
    positions = sorted({*sampled, *following})
    ahead = prefetch(lambda k: _geometry(task, settings, task.indices[k]), positions, threads=settings.threads)
    for k, fetched in zip(positions, ahead, strict=True):
        frame_voxels = voxels_in(fetched.item, settings.voxel_size)
        one_in = one_in or max(1, len(frame_voxels) // DRAWN)
        voxels_of_frame[k] = _drawn(frame_voxels, one_in)
    sampled_voxels = [voxels_of_frame[k] for k in sampled]
    together = np.concatenate(sampled_voxels)
    distinct, columns = count_distinct(together), count_distinct(together[:, :2])
    mean_voxels = float(np.mean([len(voxels) for voxels in sampled_voxels]))
    new = [_count((voxels_of_frame[k - 1], voxels_of_frame[k])) - len(voxels_of_frame[k - 1]) for k in following]
    most = mean_voxels + (frames - 1) * (float(np.mean(new)) if new else 0.0)
    voxels = max(float(distinct), min(_of_all_frames(sampled_voxels, distinct, frames), most))
    return MapSize(one_in * voxels, one_in * frames * mean_voxels, distinct / max(columns, 1))


def _of_all_frames(frame_voxels: Sequence[Int32], distinct: int, frames: int) -> float:
    """Return the number of voxels that `frames` frames see.

    `frame_voxels` has the voxels that each frame of a sample sees, `distinct` together. The more frames, the fewer
    voxels are new: a quarter, a half and all of the sample give the factor from the voxels of one doubling of the
    frames to the voxels of the next.
    """
    quarter, half, voxels = _count(frame_voxels[::4]), _count(frame_voxels[::2]), float(distinct)
    factor, added, reached = (
        min((distinct - half) / max(half - quarter, 1), 2.0),
        float(distinct - half),
        len(frame_voxels),
    )
    while reached < frames:
        added *= factor
        voxels += added * min(1.0, math.log2(frames / reached))
        reached *= 2
    return voxels


def _drawn(voxels: Int64, one_in: int) -> Int32:
    """Return the voxels of a fixed random sample of columns, one in `one_in`; each column is taken whole."""
    places = voxels[:, 0] * 0x9E3779B1 + voxels[:, 1] * 0x85EBCA77  # that are drawn lie evenly, without a grid
    sample: Int32 = voxels[(places >> 16) % one_in == 0].astype(np.int32)
    return sample


def _count(frame_voxels: Sequence[Int32]) -> int:
    return count_distinct(np.concatenate(frame_voxels)) if frame_voxels else 0


def _geometry(task: Task, settings: Config, index: int) -> Frame:
    """Return the frame as it is fused, but for its labels, which may leave pixels out."""
    frame = task.scene.geometry(index)
    if task.perturbation is not None:
        frame = perturb(frame, task.perturbation, task.scene.name)
    return frame.every(settings.pixel_stride)


# --- While maps grow --------------------------------------------------------------------------------------------------

STEP = 32e6
"""Bytes by which the process may grow before its maps are measured again."""

AMPLE = 4
"""The free memory, in bytes of the maps, from which on freed memory is retained: the next images need not clear it."""


class MemoryBudget:
    """The memory budget of a pass: `memory_gb` or what is free, shared by `width` processes."""

    def __init__(self, memory_gb: float | None, width: int) -> None:
        self._limit = None if memory_gb is None else memory_gb * GB / width
        self._width = width
        self._before: int | None = None  # memory of this process without maps; code that the first frame loads stays
        self._seen = self._largest_step = 0
        self._left = 0.0

    def lacking(self, maps: Sequence[LiveMap]) -> LiveMap | None:
        """Return the largest map if the memory left does not suffice for the end of each map, else None.

        A hash map that is full doubles: the next step may be twice the largest one so far.
        """
        expected, end = sum(map(_bytes, maps)), max(map(end_bytes, maps))
        if self._before is None:
            self._before = resident_bytes() - expected
        taken = max(resident_bytes() - self._before, expected)  # maps may take memory that was freed before
        if taken - self._seen < min(STEP, (self._limit or STEP) / 8):
            return None
        if self._beyond(taken) < AMPLE * (taken + end):
            trim_malloc()  # else freed memory would count
            taken = max(resident_bytes() - self._before, expected)
            self._largest_step = max(self._largest_step, taken - self._seen)
        self._seen, self._left = taken, self._beyond(taken)
        return None if self._left >= end + 2 * self._largest_step else max(maps, key=_bytes)

    def _beyond(self, taken: int) -> float:
        free = available_bytes() / self._width
        return free if self._limit is None else min(free, self._limit - taken)

    def outgrown(self, live: LiveMap) -> OutgrownError:
        """Return the error of a map that is given up."""
        name, config, tile = live.name, live.config, live.work.tile
        voxels = live.rows[-1].report.map_voxels
        which = "are free" if self._limit is None else "is left of memory_gb"
        size = f"a smaller --tile-size than {tile.size}" if tile is not None else "tiles (--tile-size 256)"
        return OutgrownError(
            f"{name.scene}, {name.model}, {name.backend}: after {len(live.rows)} of {len(live.frames)} frames"
            f" the map has {voxels / 1e6:.2g} million voxels of {config.voxel_size:g} m; its table"
            f" {'and statistics' if config.statistics else 'alone'} would take {end_bytes(live) / GB:.2g} GB, and"
            f" {max(0, self._left) / GB:.2g} GB {which}; use {size}, larger voxels (voxel_size), fewer frames (frames),"
            " or a larger pixel_stride"
        )


def end_bytes(live: LiveMap) -> int:
    """Return the bytes that measuring and writing a map takes beyond what it takes already."""
    config, K = live.config, len(live.task.mapping.target)
    voxels = live.rows[-1].report.map_voxels
    tables = (1 + (live.truth is not None)) * table_bytes(voxels, K, soft=live.soft)
    return tables + (log_bytes(live.observations, K, soft=live.soft) if config.statistics or config.events else 0)


def _bytes(live: LiveMap) -> int:
    K, voxels = len(live.task.mapping.target), live.rows[-1].report.map_voxels
    return expected_bytes(live.name.backend, voxels, live.observations, K, soft=live.soft)
