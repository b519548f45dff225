"""The size of a map, estimated before anything is fused, from evenly spaced frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from semstab.config import Config
from semstab.core.arrays import evenly
from semstab.core.prefetch import prefetch
from semstab.core.types import Int32, Int64
from semstab.data.frames import Frame
from semstab.pixels.preparation import perturb
from semstab.statistics.cluster_sums import count_distinct
from semstab.task import Task

SAMPLED, PAIRS = 192, 8
"""Frames, evenly spaced, from which the size of a map is estimated; those that are read with their successors."""

DRAWN = 1 << 13
"""Voxels of a frame, about, that are looked at."""

CROWDED = 1.3
"""A tile may have that many times the mean number of voxels of its size."""


class MapSize(NamedTuple):
    """The estimated size of a map: its voxels, observations, and voxels in a column of them."""

    voxels: float
    observations: float
    by_column: float

    def of_tile(self, edge: int) -> float:
        """Return the voxels of a tile, where they are crowded."""
        return min(CROWDED * self.by_column * edge**2, self.voxels)


def map_size(task: Task, settings: Config) -> MapSize:
    """Estimate the size of a map from evenly spaced frames.

    There are no more voxels than if each frame added as many as the second one of two successive frames adds to the
    first.
    """
    frames, voxels_of_frame, one_in = len(task.indices), dict[int, Int32](), 0
    sampled = evenly(frames, SAMPLED)
    following = [k + 1 for k in sampled[:: -(-len(sampled) // PAIRS)] if k + 1 < frames]
    positions = sorted({*sampled, *following})
    ahead = prefetch(lambda k: geometry(task, settings, task.indices[k]), positions, threads=settings.threads)
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


def geometry(task: Task, settings: Config, index: int) -> Frame:
    """Return the frame as it is fused, but for its labels, which may leave pixels out."""
    frame = task.scene.geometry(index)
    if task.perturbation is not None:
        frame = perturb(frame, task.perturbation, task.scene.name)
    return frame.every(settings.pixel_stride)


def voxels_in(frame: Frame, voxel_size: float) -> Int64:
    """Return the indices (n, 3) of the voxels that a frame of one class touches."""
    from semstab.backends.shared.aggregator import Aggregator

    pixels = Aggregator(voxel_size, num_classes=1)
    return pixels.index_of(pixels.observe(frame).key)
