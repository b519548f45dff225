"""Which columns of space each frame sees, and how many voxels there are: from depth alone, before anything is fused."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semstab.backends.shared.association import check_depth
from semstab.backends.shared.keys import index_of_keys, out_of_reach
from semstab.backends.shared.pixel_keys import frame_terms
from semstab.core.files import read_arrays, write_arrays
from semstab.core.prefetch import prefetch
from semstab.core.types import Float64, Int32, Int64
from semstab.engine.tiling.collected import SHARE, Collected, Seen
from semstab.engine.tiling.look import LOST, NO_ROOM, look
from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.pixels.preparation import perturb
from semstab.statistics.ranks import distinct_rows
from semstab.task import Task

SIGHTS = "sights"
"""Folder of what frames see, by input and geometry."""

CELL = 64
"""Voxels along an edge of the cells that are told apart at first."""

ALL = 1 << 32


@dataclass(frozen=True, eq=False)
class Sights:
    """What frames see, as far as their depth tells: never too little, for labels only leave pixels out.

    size    edge of a cell of columns, voxels, a power of 2
    frame   (m,) int32 index of a frame, cell (m, 2) int32 a cell that it sees: ix // size, iy // size; sorted
    place   (c, 2) int32 all cells, voxels and observations (c,) in each, estimated from a sample of the voxels
    frames  how many were looked at
    origin  (3,) voxel of the first camera
    """

    size: int
    frame: Int32
    cell: Int32
    place: Int32
    voxels: Float64
    observations: Float64
    frames: int
    origin: Int64 = field(default_factory=lambda: np.zeros(3, np.int64))

    def in_tiles(self, size: int) -> Sights:
        """The same for cells of that size, a multiple of this one."""
        shift = (size // self.size).bit_length() - 1
        rows = np.unique(np.column_stack([self.frame, self.cell >> shift]), axis=0)
        place, of = distinct_rows(self.place >> shift)
        cells = len(place)
        voxels = np.bincount(of, weights=self.voxels, minlength=cells).astype(np.float64)
        observations = np.bincount(of, weights=self.observations, minlength=cells).astype(np.float64)
        parts = rows[:, 0], rows[:, 1:], place.astype(np.int32)
        return Sights(size, *parts, voxels, observations, self.frames, self.origin)

    def save(self, path: Path) -> None:
        """Write it, atomically."""
        write_arrays(path, vars(self))

    @classmethod
    def load(cls, path: Path) -> Sights | None:
        """What `save` wrote; None where there is no such file, or it is damaged."""
        values = read_arrays(path)
        if values is None or values.keys() != {field.name for field in dataclasses.fields(cls)}:
            return None
        own: dict[str, Any] = {**values, **{name: int(values[name]) for name in ("size", "frames")}}
        return cls(**own)


@dataclass(frozen=True)
class Looking:
    """A look at some frames of a map whose first camera is in the voxel `origin`, by cells of that edge.

    file  of what is seen, in the folder
    """

    file: str
    origin: tuple[int, int, int]
    cell: int


def look_at(
    task: Task, voxel_size: float, pixel_stride: int = 1, cell: int = CELL, threads: int | None = None
) -> Sights:
    """What the frames of a task see, by cells of that edge in voxels, or wider ones.

    Raises DataError where a frame cannot be read, has no finite depth, or reaches too far for a map.
    """
    origin = origin_of(task, voxel_size, pixel_stride)
    return sights_of([seen_by(task, voxel_size, pixel_stride, origin, cell, threads)], origin, cell)


def origin_of(task: Task, voxel_size: float, pixel_stride: int = 1) -> tuple[int, int, int]:
    """The voxel of the first camera. Raises DataError where the first frame cannot be read."""
    x, y, z = np.floor(_geometry(task, task.indices[0], pixel_stride).T_wc[:3, 3] / voxel_size).astype(int).tolist()
    return x, y, z


def seen_by(
    task: Task,
    voxel_size: float,
    pixel_stride: int,
    origin: tuple[int, int, int],
    cell: int = CELL,
    threads: int | None = None,
) -> Seen:
    """What the frames of a task see of a map whose first camera is in that voxel; raises what `look_at` raises."""
    first = np.array(origin, dtype=np.int64)

    def seen(index: int) -> Seen:
        return seen_in(_geometry(task, index, pixel_stride), voxel_size, first, cell)

    collected = Collected(cell)
    for fetched in prefetch(seen, task.indices, threads=threads):
        collected.add(fetched.item)
    return collected.seen()


def sights_of(stretches: Iterable[Seen], origin: tuple[int, int, int], cell: int = CELL) -> Sights:
    """What all frames see, from what stretches of them do, in order: the same, however they are cut."""
    collected = Collected(cell)
    for each in stretches:
        collected.add(each)
    seen, first = collected.seen(), np.array(origin, dtype=np.int64)
    index = index_of_keys(seen.key, first)[:, :2] >> (seen.size.bit_length() - 1)
    places = np.concatenate([index.astype(np.int32), seen.rows[:, 1:]])
    place, of = distinct_rows(places)
    of, scale = of[: len(index)], ALL / seen.share
    voxels = (scale * np.bincount(of, minlength=len(place))).astype(np.float64)
    observations = (scale * np.bincount(of, weights=seen.looks, minlength=len(place))).astype(np.float64)
    cells = seen.rows[:, 0], seen.rows[:, 1:], place.astype(np.int32)
    return Sights(seen.size, *cells, voxels, observations, seen.frames, first)


def _geometry(task: Task, index: int, pixel_stride: int) -> Frame:
    """The frame as it is fused, but for its labels, which may leave pixels out."""
    frame = task.scene.geometry(index)
    if task.perturbation is not None:
        frame = perturb(frame, task.perturbation, task.scene.name)
    return frame.every(pixel_stride)


def seen_in(frame: Frame, voxel_size: float, origin: Int64, size: int = CELL) -> Seen:
    """What one frame sees, by cells of that edge in voxels; raises what `look_at` raises."""
    check_depth(frame)
    H, W = frame.shape
    camera = frame.intrinsics
    ray_x, ray_y = (np.arange(W) - camera.cx) / camera.fx, (np.arange(H) - camera.cy) / camera.fy
    rays, margin = frame_terms(ray_x, frame.T_wc, voxel_size)
    everything, row = np.zeros(W, np.uint8), np.empty(W, np.int64)
    room = min(H * W, max(1 << 14, 2 * H * W * SHARE // ALL))
    while True:
        cells, keys, drawn = (np.empty(room, np.int64) for _ in range(3))
        n, m = look(
            fixed(frame.depth), everything, ray_x, ray_y, fixed(frame.T_wc), voxel_size, origin, rays, margin,
            size.bit_length() - 1, SHARE, row, cells, keys, drawn,
        )  # fmt: skip
        if n == LOST:
            raise out_of_reach(frame, origin, voxel_size)
        if n != NO_ROOM:
            break
        room = min(H * W, 8 * room)
    packed = np.unique(cells[:n])
    key, first = np.unique(keys[:m], return_index=True)
    rows = np.column_stack([np.full(len(packed), frame.index), packed >> 32, packed.astype(np.int32)])
    return Seen(size, SHARE, 1, rows.astype(np.int32), key, drawn[:m][first], np.ones(len(key), np.int64))
