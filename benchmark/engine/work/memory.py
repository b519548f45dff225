"""What a map takes: from a bound that costs one frame, or from what all frames see."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from semstab.backends import expected_bytes
from semstab.backends.numpy_reference import ONE_IN
from semstab.config import Config
from semstab.model.frames import Frame
from semstab.runtime.memory import available_bytes
from semstab.task import Task

GB = 1e9
DOUBT = 10
"""A sequence whose frames might see that many times the voxels of the first, all new, is not looked at closer."""


@dataclass(frozen=True)
class Kind:
    """What the bytes of a map depend on beside its size.

    backend  that fuses it
    K        number of classes
    soft     whether frames have scores, which are fused as labels as well
    logged   whether every observation is kept, and the ground truth fused too
    sampled  whether the reference follows a sample of its voxels
    """

    backend: str
    K: int
    soft: bool = False
    logged: bool = False
    sampled: bool = False

    def bytes(self, voxels: float, observations: float) -> float:
        """Of a map of so many voxels and observations, with what comes of it."""
        n, looks = int(voxels), int(observations)
        fused = expected_bytes(self.backend, n, looks, self.K, soft=self.soft)
        truth = expected_bytes(self.backend, n, looks, self.K) if self.logged else 0
        logs = log_bytes(looks, self.K, soft=self.soft) if self.logged else 0
        followed = expected_bytes("numpy", n // ONE_IN, 0, self.K) if self.sampled else 0  # looks: when the map is gone
        reduced = expected_bytes(self.backend, n, looks, self.K) if self.soft else 0
        return fused + truth + logs + followed + reduced + (1 + self.logged) * result_bytes(n, self.K, soft=self.soft)


def limit(config: Config) -> int:
    """Bytes that maps may take: `memory_gb` where it is set, else what is free."""
    return available_bytes() if config.memory_gb is None else int(config.memory_gb * GB)


def most_voxels(task: Task, config: Config, first: Frame) -> int:
    """More voxels than a sequence shows, and observations, judged by its first frame."""
    from semstab.backends.shared.aggregator import Aggregator

    seen = Aggregator(config.voxel_size, len(task.mapping.target)).observe(first.every(2))
    return DOUBT * len(task.indices) * len(seen.key)


def too_large(task: Task, backends: Iterable[str], config: Config, voxels: float, needed: float, why: str = "") -> str:
    """That a map does not fit, by how much, and which settings change it."""
    free = limit(config)
    room = f"{free / GB:.2g} GB " + ("are free" if config.memory_gb is None else "is memory_gb")
    return (
        f"{takes(task, config, voxels, needed)}, and {room}; use larger voxels (voxel_size), fewer frames (frames), a"
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
