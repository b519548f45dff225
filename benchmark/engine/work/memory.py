"""What a map takes: from a bound that costs one frame, or from what all frames see."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from semstab.backends import expected_bytes, frame_bytes
from semstab.backends.numpy_reference import ONE_IN
from semstab.config import Config
from semstab.core.prefetch import default_threads
from semstab.core.process import available_bytes, give_back, resident_bytes
from semstab.core.types import Int64
from semstab.engine.work.sizes import sizes_bytes
from semstab.engine.work.stream import UnitMap
from semstab.errors import OutgrownError
from semstab.model.evidence import STRETCH
from semstab.model.frames import Frame
from semstab.statistics.ranks import distinct_rows
from semstab.task import Task

GB = 1e9
DOUBT = 10
"""A sequence whose frames might see that many times the voxels of the first, all new, is not looked at closer."""

LOADED, LOADED_FOR_SCORES, LOADED_FOR_TILES = 170e6, 30e6, 50e6
"""Bytes of what a run loads once it is planned (compiled loops, formats of files), of the sample of looks, and of what
is left between parts."""
BLOCK = 4
"""Voxels along an edge of a block of space."""

FRAMES_AT_WORK = 3
"""Frames that are in memory beside those which are read ahead."""


@dataclass(frozen=True)
class Kind:
    """What the bytes of a map depend on beside its size.

    backend  that fuses it
    K        number of classes
    soft     whether frames have scores, which are fused as labels as well
    logged   whether every observation is kept, and the ground truth fused too
    sampled  whether the reference follows a sample of its voxels
    touched  voxels that a frame touches
    filled   share of the voxels of blocks of space that it touches, 0 where that is not known
    """

    backend: str
    K: int
    soft: bool = False
    logged: bool = False
    sampled: bool = False
    touched: int = 0
    filled: float = 0.0

    def bytes(self, voxels: float, observations: float) -> float:
        """Of a map of so many voxels and observations, with what comes of it."""
        n, looks = int(voxels), int(observations)
        fused = expected_bytes(self.backend, n, looks, self.K, soft=self.soft, filled=self.filled)
        of_labels = expected_bytes(self.backend, n, looks, self.K, filled=self.filled)
        truth = of_labels if self.logged else 0
        logs = log_bytes(looks, self.K, soft=self.soft) if self.logged else 0
        followed = expected_bytes("numpy", n // ONE_IN, 0, self.K) if self.sampled else 0  # looks: when the map is gone
        compared = 8 * self.K * min(n // ONE_IN, STRETCH) if self.sampled else 0
        reduced = of_labels if self.soft else 0
        now = frame_bytes(self.backend, min(n, self.touched), self.K)
        return (
            fused
            + truth
            + logs
            + followed
            + compared
            + reduced
            + now
            + (1 + self.logged) * result_bytes(n, self.K, soft=self.soft)
        )


@dataclass(frozen=True)
class Load:
    """What the bytes depend on that a process takes beside its maps.

    first    frame, as it is fused
    frames   how many there are
    K        number of classes
    soft     whether frames have scores
    threads  that read ahead; None: as many as there are for it
    """

    first: Frame
    frames: int
    K: int
    soft: bool
    threads: int | None

    def beside(self, maps: float, *, in_tiles: bool = False) -> float:
        """Beside maps of so many bytes: what is loaded, and frames.

        And some frames fused once more, before half of what is loaded comes, as far as they are more than what is gone
        by then, or not yet there.
        """
        pixels = self.first.shape[0] * self.first.shape[1]
        threads = default_threads() if self.threads is None else self.threads
        frames = (threads + FRAMES_AT_WORK) * pixels * (6 + (4 * self.K if self.soft else 0))
        sizes = sizes_bytes(self.first, self.frames, self.K, soft=self.soft)
        loaded = LOADED + self.soft * LOADED_FOR_SCORES + in_tiles * LOADED_FOR_TILES
        return loaded + frames + max(0.0, sizes - LOADED / 2 - maps)


def room(config: Config, width: int, taken: float) -> float:
    """Bytes that maps of a process may take: its share of `memory_gb`, else of what is free, less what it takes beside.

    Where hardly anything is free, a quarter of it is for maps all the same.
    """
    if config.memory_gb is not None:
        return config.memory_gb * GB / width
    free = available_bytes() / width
    return max(free - taken, free / 4)


def most_voxels(task: Task, config: Config, first: Frame) -> int:
    """More voxels than a sequence shows, and observations, judged by its first frame."""
    return DOUBT * len(task.indices) * voxels_of(first.every(2), config.voxel_size, len(task.mapping.target))


def voxels_of(frame: Frame, voxel_size: float, num_classes: int) -> int:
    """How many a frame touches."""
    return len(_touched(frame, voxel_size, num_classes))


def filled_of(frame: Frame, voxel_size: float, num_classes: int) -> float:
    """Which share of the voxels of those blocks, of 4 x 4 x 4, a frame touches of which it touches any."""
    index = _touched(frame, voxel_size, num_classes)
    return len(index) / (BLOCK**3 * max(len(distinct_rows(index // BLOCK)[0]), 1))


def _touched(frame: Frame, voxel_size: float, num_classes: int) -> Int64:
    """Indices (n, 3) of the voxels."""
    from semstab.backends.shared.aggregator import Aggregator

    pixels = Aggregator(voxel_size, num_classes)
    return pixels.index_of(pixels.observe(frame).key)


def too_large(
    task: Task, backends: Iterable[str], config: Config, voxels: float, needed: float, own: float, why: str = ""
) -> str:
    """That a map does not fit, by how much, and which settings change it."""
    there = f"{own / GB:.2g} GB " + ("are free for it" if config.memory_gb is None else "is memory_gb")
    return (
        f"{takes(task, config, voxels, needed)}, and {there}; use larger voxels (voxel_size), fewer frames (frames), a"
        f" larger pixel_stride{_without(backends, config)}; or set memory_gb to try all the same{why}"
    )


def takes(task: Task, config: Config, voxels: float, needed: float) -> str:
    """What a map would take."""
    return (
        f"{task.scene.name}, {task.backbone}: about {voxels / 1e6:.2g} million voxels of {config.voxel_size:g} m would"
        f" take {needed / GB:.2g} GB"
    )


def _without(backends: Iterable[str], config: Config) -> str:
    keep_all = [name for name in backends if _keeps_observations(name)]
    without = f", no backend that keeps every observation ({', '.join(keep_all)})" if keep_all else ""
    return without + (", no statistics" if config.statistics else "")


def log_bytes(observations: int, num_classes: int, *, soft: bool) -> int:
    """A log of observations: kept frame by frame, and sorted by voxel; of soft scores with most of the classes."""
    return observations * (100 + (20 * num_classes if soft else 0))


def result_bytes(voxels: int, num_classes: int, *, soft: bool) -> int:
    """A voxel table, and what comes from it when it is measured and written."""
    return voxels * (80 + (10 * num_classes if soft else 0))


def _keeps_observations(backend: str) -> bool:
    return expected_bytes(backend, 1, 2, 2) > expected_bytes(backend, 1, 1, 2)


# While maps grow: is the memory that is left enough for what their end will take?

STEP = 32e6
"""Bytes by which the process may grow before it is looked at closer."""

AMPLE = 4
"""Where that many times what maps take is left, freed memory is kept: the next images need not clear theirs again."""


class Room:
    """Watches the memory of a pass, frame by frame, in a time that does not grow with the maps.

    memory_gb  that all maps and what comes of them may take; None: what is free
    width      processes that share it
    """

    def __init__(self, memory_gb: float | None, width: int) -> None:
        self._limit = None if memory_gb is None else memory_gb * GB / width
        self._width = width
        self._before: int | None = None  # memory of this process without maps; what is loaded at the first frame stays
        self._seen = self._largest_step = 0
        self._left = 0.0

    def lacking(self, maps: Sequence[UnitMap]) -> UnitMap | None:
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
        give_back()  # else what was freed would count
        taken = self._taken(expected)
        self._seen, self._largest_step = taken, max(self._largest_step, taken - self._seen)
        self._left = self._beyond(taken)
        return None if self._left >= end + 2 * self._largest_step else max(maps, key=_bytes)

    def _beyond(self, taken: int) -> float:
        """What is left for maps that take so much."""
        free = available_bytes() / self._width
        return free if self._limit is None else min(free, self._limit - taken)

    def _taken(self, expected: int) -> int:
        """By the maps; one may take what was freed before."""
        return max(resident_bytes() - (self._before or 0), expected)

    def outgrown(self, one: UnitMap) -> OutgrownError:
        """Why a map is given up."""
        unit, config = one.task.units[0], one.request.config
        voxels = one.rows[-1].report.map_voxels
        which = "are free" if self._limit is None else "is left of memory_gb"
        return OutgrownError(
            f"{unit.scene}, {unit.backbone}, {unit.backend}: after {len(one.rows)} of {len(one.task.indices)} frames"
            f" the map has {voxels / 1e6:.2g} million voxels of {config.voxel_size:g} m, of which its table"
            f" {'and statistics' if config.statistics else 'alone'} would take {end_bytes(one) / GB:.2g} GB, and"
            f" {max(0, self._left) / GB:.2g} GB {which}; use larger voxels (voxel_size), fewer frames (frames),"
            " or a larger pixel_stride"
        )


def end_bytes(one: UnitMap) -> int:
    """What measuring and writing a map takes beside what it takes already."""
    config, K = one.request.config, len(one.task.mapping.target)
    voxels = one.rows[-1].report.map_voxels
    tables = (1 + (one.truth is not None)) * result_bytes(voxels, K, soft=one.soft)
    return tables + (log_bytes(one.observations, K, soft=one.soft) if config.statistics or config.events else 0)


def _bytes(one: UnitMap) -> int:
    (backend,) = one.task.backends
    K, voxels = len(one.task.mapping.target), one.rows[-1].report.map_voxels
    return expected_bytes(backend, voxels, one.observations, K, soft=one.soft)
