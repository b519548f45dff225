"""What a unit comes to at half, once and twice its voxel size, from some of its frames."""

from __future__ import annotations

import math

from semstab.backends import FusionBackend, create
from semstab.check.views import evenly
from semstab.config import Config
from semstab.errors import DataError
from semstab.model.frames import Frame
from semstab.model.results import SizeAlpha
from semstab.statistics import krippendorff_alpha
from semstab.task import Task

FACTORS = (0.5, 1.0, 2.0)

FRAMES, PIXELS = 16, 2**16
"""At most so many frames, evenly spaced, are fused once more a voxel size, and about so many pixels of each."""


class SizeMaps:
    """Maps of a task's frames, of some of them and some of their pixels, by voxel size."""

    def __init__(self, task: Task, config: Config) -> None:
        self._frames = frozenset(task.indices[k] for k in evenly(len(task.indices), FRAMES))
        K = len(task.mapping.target)
        self._maps: dict[float, FusionBackend] = {  # of few pixels, for which blocks of voxels would cost too much
            size: create("numba", voxel_size=size, num_classes=K)
            for size in (config.voxel_size * factor for factor in FACTORS)
        }

    def add(self, index: int, frame: Frame) -> None:
        """Fuse the frame of that index, if it is one of them."""
        if index not in self._frames:
            return
        H, W = frame.shape
        some = frame.every(max(1, round(math.sqrt(H * W / PIXELS))))
        for size, fused in list(self._maps.items()):
            try:
                fused.integrate(some)
            except DataError:  # further out than voxels of that size are counted
                del self._maps[size]

    def alphas(self) -> tuple[SizeAlpha, ...]:
        """One a voxel size."""
        frames = len(self._frames)
        return tuple(SizeAlpha(size, frames, krippendorff_alpha(fused.table())) for size, fused in self._maps.items())
