"""What a unit comes to at half, once and twice its voxel size, from some of its frames."""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
from dataclasses import replace

import numpy as np

from semstab.backends import create
from semstab.backends.shared.association import INDEX_LIMIT, back_project, voxel_index
from semstab.check.views import evenly
from semstab.config import Config
from semstab.errors import DataError
from semstab.model.frames import Frame
from semstab.model.results import SizeAlpha
from semstab.model.voxels import VoxelTable
from semstab.model.voxels.extent import Extent
from semstab.runtime.process import give_back
from semstab.statistics.agreement import alpha_of, alpha_sums
from semstab.task import Task

FACTORS = (0.5, 1.0, 2.0)

FRAMES, PIXELS = 16, 2**16
"""At most so many frames, evenly spaced, are fused once more a voxel size, and about so many pixels of each."""

STRIP_BYTES = 2e8
"""A map of these pixels that would take more is fused strip by strip."""


def map_bytes(pixels: int, K: int, *, soft: bool) -> int:
    """Of a map and its table where each pixel is a voxel."""
    return pixels * (180 + (20 * K if soft else 0))


def sizes_bytes(first: Frame, frames: int, K: int, *, soft: bool) -> float:
    """What fusing some of so many frames once more takes: a strip of the map, and the pixels that are kept for it."""
    pixels = min(frames, FRAMES) * _some(first).depth.size
    return min(STRIP_BYTES, map_bytes(pixels, K, soft=soft)) + pixels * (6 + (4 * K if soft else 0))


def _some(frame: Frame) -> Frame:
    """About PIXELS of its pixels."""
    H, W = frame.shape
    return frame.every(max(1, round(math.sqrt(H * W / PIXELS))))


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
        some = _some(frame)
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
                found.append(SizeAlpha(size, len(self._frames), self._alpha(size)))
            give_back()
        return tuple(found)

    def _alpha(self, voxel_size: float) -> float:
        """Krippendorff's alpha of the map, one strip of space after the other."""
        strips = (alpha_sums(self._fused(voxel_size, within)) for within in self._strips(voxel_size))
        return float(alpha_of(functools.reduce(np.add, strips)))

    def _strips(self, voxel_size: float) -> list[Extent | None]:
        """Along ix, with as many pixels each: of soft scores each voxel has a dense row of evidence."""
        soft = any(frame.scores is not None for frame in self._kept)
        count = math.ceil(map_bytes(sum(frame.depth.size for frame in self._kept), self._K, soft=soft) / STRIP_BYTES)
        if count < 2:
            return [None]
        columns = [voxel_index(back_project(frame.every(4)), voxel_size, frame)[0] for frame in self._kept]
        cuts = np.unique(np.quantile(np.concatenate(columns), np.arange(1, count) / count).astype(np.int64)).tolist()
        x, y, z = voxel_index(self._kept[0].T_wc[:3, 3:], voxel_size, self._kept[0])[:, 0].tolist()
        edges = [-INDEX_LIMIT, *cuts, INDEX_LIMIT]
        return [Extent((low, -INDEX_LIMIT), (high, INDEX_LIMIT), (x, y, z)) for low, high in itertools.pairwise(edges)]

    def _fused(self, voxel_size: float, within: Extent | None) -> VoxelTable:
        fused = create("numba", voxel_size=voxel_size, num_classes=self._K, within=within)  # few pixels: no blocks
        for frame in self._kept:
            fused.integrate(frame)
        return fused.table()
