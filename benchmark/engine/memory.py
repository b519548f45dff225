"""The memory of maps and of a process, estimated by their voxels, observations and frames."""

from __future__ import annotations

from dataclasses import dataclass

from semstab.backends import by_own_rule, expected_bytes, is_builtin, is_pointwise
from semstab.backends.numpy_reference import MOST_OF_ALL, ONE_IN
from semstab.config import Config
from semstab.core.prefetch import default_threads
from semstab.core.process import available_bytes
from semstab.data.evidence import STRETCH_ENTRIES
from semstab.data.frames import Frame
from semstab.statistics.sample import MOST_VOXELS

GB = 1e9

LOADED, OF_CLASS, MANY_CLASSES = 240e6, 0.6e6, 256
"""Bytes of code that a run loads once it is planned, and of the sample of observations and its statistics: in all, and
for each class, up to MANY_CLASSES."""

FRAMES_AT_WORK = 3
"""Frames that are in memory in addition to those which are read ahead."""


def truth_backend(name: str) -> str:
    """Return the backend that fuses the ground truth for maps of a backend.

    That is the fastest of the built-in ones with the same voxels, which the reference holds to be equal; but maps of
    `numpy` reach farther than those of the others.
    """
    same_voxels = is_builtin(name) and is_pointwise(name) and by_own_rule(name) != "numpy"
    return "numba" if same_voxels else name


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
        total += self.compared * expected_bytes(truth_backend(self.backend), n, num_observations, self.K)
        total += self.soft * expected_bytes(self.backend, n, num_observations, self.K)
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
    pixel_bytes = 6 + (4 * K if soft else 0)
    frames = (threads + FRAMES_AT_WORK) * first.shape[0] * first.shape[1] * pixel_bytes
    return LOADED + OF_CLASS * min(K, MANY_CLASSES) + frames


def available_for_maps(config: Config, width: int, taken: float) -> float:
    """Return the bytes for the maps of a process: its share of `memory_gb`, else of what is free beyond `taken`.

    If hardly anything is free, maps still get a quarter of it.
    """
    free = available_bytes() / width
    return max(free - taken, free / 4) if config.memory_gb is None else config.memory_gb * GB / width
