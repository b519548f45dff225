"""Will a map fit into memory? Estimated from a few frames before the first one is fused, so that no run dies of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from semstab.backends import expected_bytes
from semstab.config import Config
from semstab.errors import ConfigError
from semstab.model.frames import Frame
from semstab.runtime.memory import available_bytes
from semstab.task import Task, read

if TYPE_CHECKING:
    from semstab.backends.shared.aggregator import Aggregator

GB = 1e9
DOUBT = 10
"""A sequence whose frames might see that many times the voxels of the first, all new, is not looked at closer."""
PROBES = 3
"""Places of a sequence at which two consecutive frames are compared."""


@dataclass(frozen=True)
class Expected:
    """What a task's maps will hold at most: voxels, observations, and the bytes of all its backends and results."""

    voxels: int
    observations: int
    bytes: int


def require_memory(task: Task, config: Config, first: Frame) -> None:
    """Refuse a task whose maps would not fit: in `memory_gb` where it is set, else in what is free.

    `first` is the task's first frame. Further frames are read only where `DOUBT` times its voxels in each frame would
    be too much: for a short sequence they would cost more than they tell.
    Raises ConfigError that says how much is missing, and which settings change it.
    """
    free = available_bytes() if config.memory_gb is None else int(config.memory_gb * GB)
    frames = len(task.indices)
    voxels = DOUBT * frames * len(_pixels(task, config).observe(first.every(2)).key)
    if _expected(task, config, voxels, voxels, soft=first.scores is not None).bytes <= free:
        return
    expected = estimate(task, config)
    if expected.bytes <= free:
        return
    raise ConfigError(_too_large(task, config, expected, free))


def estimate(task: Task, config: Config) -> Expected:
    """Voxels and bytes of a task's maps, from pairs of consecutive frames at a few places of the sequence.

    The first frame's voxels, and as many new ones with each further frame as the second frame of a pair has on
    average: too many where the camera comes back to a place.
    """
    pixels = _pixels(task, config)
    seen, new, soft = [], [], False
    for pair in _pairs(task.indices):
        frames_there = [read(task, index, config.pixel_stride) for index in pair]
        keys = [pixels.observe(frame).key.copy() for frame in frames_there]
        soft = soft or any(frame.scores is not None for frame in frames_there)
        seen += [len(key) for key in keys]
        new += [int(np.isin(keys[1], keys[0], invert=True).sum())] if len(keys) > 1 else []
    frames = len(task.indices)
    voxels = np.mean(seen) + (frames - 1) * (np.mean(new) if new else 0)
    return _expected(task, config, int(voxels), int(frames * np.mean(seen)), soft=soft)


def _pixels(task: Task, config: Config) -> Aggregator:
    from semstab.backends.shared.aggregator import Aggregator

    return Aggregator(config.voxel_size, len(task.mapping.target))


def _too_large(task: Task, config: Config, expected: Expected, free: int) -> str:
    room = f"{free / GB:.2g} GB " + ("are free" if config.memory_gb is None else "is memory_gb")
    keep_all = [name for name in task.backends if _keeps_observations(name)]
    without = f", no backend that keeps every observation ({', '.join(keep_all)})" if keep_all else ""
    without += ", no statistics" if config.statistics else ""
    return (
        f"{task.scene.name}, {task.backbone}: about {expected.voxels / 1e6:.2g} million voxels of"
        f" {config.voxel_size:g} m would take {expected.bytes / GB:.2g} GB, and {room}; use larger voxels (voxel_size),"
        f" fewer frames (frames), a larger pixel_stride{without}; or set memory_gb to try all the same"
    )


def _pairs(indices: Sequence[int]) -> list[Sequence[int]]:
    starts = sorted({round(place) for place in np.linspace(0, max(0, len(indices) - 2), PROBES)})
    return [indices[start : start + 2] for start in starts]


def _expected(task: Task, config: Config, voxels: int, observations: int, *, soft: bool) -> Expected:
    K = len(task.mapping.target)
    maps = sum(expected_bytes(name, voxels, observations, K) for name in task.backends)
    logs = log_bytes(observations, K, soft=soft) if config.statistics or config.events else 0
    truth = expected_bytes(task.backends[0], voxels, observations, K) if config.statistics else 0
    tables = (len(task.backends) + config.statistics) * result_bytes(voxels, K, soft=soft)
    return Expected(voxels, observations, maps + logs + truth + tables)


def log_bytes(observations: int, num_classes: int, *, soft: bool) -> int:
    """A log of observations: kept frame by frame, and sorted by voxel; of soft scores with most of the classes."""
    return observations * (100 + (20 * num_classes if soft else 0))


def result_bytes(voxels: int, num_classes: int, *, soft: bool) -> int:
    """A voxel table, and what comes from it when it is measured and written."""
    return voxels * (120 + (10 * num_classes if soft else 0))


def _keeps_observations(backend: str) -> bool:
    return expected_bytes(backend, 1, 2, 2) > expected_bytes(backend, 1, 1, 2)
