"""What a unit comes to at half, once and twice its voxel size, from some of its frames."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace

from semstab.backends import create
from semstab.check.views import evenly
from semstab.config import Config
from semstab.errors import DataError
from semstab.model.frames import Frame
from semstab.model.results import SizeAlpha
from semstab.model.voxels import VoxelTable
from semstab.statistics import krippendorff_alpha
from semstab.task import Task

FACTORS = (0.5, 1.0, 2.0)

FRAMES, PIXELS = 16, 2**16
"""At most so many frames, evenly spaced, are fused once more a voxel size, and about so many pixels of each."""


class SizeMaps:
    """Maps of a task's frames, of some of them and some of their pixels, by voxel size: one after the other."""

    def __init__(self, task: Task, config: Config) -> None:
        self._frames = frozenset(task.indices[k] for k in evenly(len(task.indices), FRAMES))
        self._K = len(task.mapping.target)
        self._sizes = [config.voxel_size * factor for factor in FACTORS]
        self._kept: list[Frame] = []

    def add(self, index: int, frame: Frame) -> None:
        """Keep some pixels of the frame of that index, if it is one of them."""
        if index not in self._frames:
            return
        H, W = frame.shape
        some = frame.every(max(1, round(math.sqrt(H * W / PIXELS))))
        self._kept.append(
            replace(
                some,
                depth=some.depth.copy(),
                labels=None if some.labels is None else some.labels.copy(),
                scores=None if some.scores is None else some.scores.copy(),
                color=None,
                mask=None,
                left_out=None,
            )
        )

    def alphas(self) -> tuple[SizeAlpha, ...]:
        """One a voxel size; none of a size at which the scene is larger than a map."""
        found = []
        for size in self._sizes:
            with contextlib.suppress(DataError):
                found.append(SizeAlpha(size, len(self._frames), krippendorff_alpha(self._fused(size))))
        return tuple(found)

    def _fused(self, voxel_size: float) -> VoxelTable:
        fused = create("numba", voxel_size=voxel_size, num_classes=self._K)  # of few pixels: blocks would cost too much
        for frame in self._kept:
            fused.integrate(frame)
        return fused.table()
