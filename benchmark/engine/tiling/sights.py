"""Which columns of space each frame sees, and how many voxels there are: from depth alone, before anything is fused."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.backends.shared.association import check_depth
from semstab.backends.shared.pixels.keys import index_of_keys, out_of_reach
from semstab.backends.shared.pixels.pixel_keys import frame_terms
from semstab.engine.tiling.look import LOST, NO_ROOM, look
from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.pixels.perturbation import perturb
from semstab.runtime.array_files import read_arrays, write_arrays
from semstab.runtime.prefetch import prefetch
from semstab.task import Task

SIGHTS = "sights"
"""Folder of what frames see, by input and geometry."""

CELL = 64
"""Voxels along an edge of the cells that are told apart at first."""

MOST_ROWS = 1 << 22
"""Pairs of frame and cell that are kept; where there are more, cells become twice as wide."""

BUDGET, SHARE = 1 << 20, 1 << 29
"""Sampled voxels that are kept: one in eight at first, and half of them go whenever there are too many."""

ALL = 1 << 32

Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]


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
        place, of = np.unique(self.place >> shift, axis=0, return_inverse=True)
        of, cells = of.ravel(), len(place)
        voxels = np.bincount(of, weights=self.voxels, minlength=cells).astype(np.float64)
        observations = np.bincount(of, weights=self.observations, minlength=cells).astype(np.float64)
        return Sights(size, rows[:, 0], rows[:, 1:], place, voxels, observations, self.frames, self.origin)

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


def look_at(
    task: Task, voxel_size: float, pixel_stride: int = 1, cell: int = CELL, threads: int | None = None
) -> Sights:
    """What the frames of a task see, by cells of that edge in voxels, or wider ones.

    Raises DataError where a frame cannot be read, has no finite depth, or reaches too far for a map.
    """
    origin = np.floor(_geometry(task, task.indices[0], pixel_stride).T_wc[:3, 3] / voxel_size).astype(np.int64)

    def seen(index: int) -> _Seen:
        return _look(_geometry(task, index, pixel_stride), voxel_size, origin, cell)

    collected = _Collected(origin, cell)
    for fetched in prefetch(seen, task.indices, threads=threads):
        collected.add(fetched.item)
    return collected.sights()


def _geometry(task: Task, index: int, pixel_stride: int) -> Frame:
    """The frame as it is fused, but for its labels, which may leave pixels out."""
    frame = task.scene.geometry(index)
    if task.perturbation is not None:
        frame = perturb(frame, task.perturbation, task.scene.name)
    return frame.every(pixel_stride)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Of one frame: its cells (t, 2), and the sampled voxels among those that it sees, (n,) keys with their hashes."""

    frame: int
    cell: Int32
    key: Int64
    drawn: Int64


def _look(frame: Frame, voxel_size: float, origin: Int64, size: int) -> _Seen:
    check_depth(frame)
    H, W = frame.shape
    camera = frame.intrinsics
    ray_x, ray_y = (np.arange(W) - camera.cx) / camera.fx, (np.arange(H) - camera.cy) / camera.fy
    rays, margin = frame_terms(ray_x, frame.T_wc, voxel_size)
    everything, row = np.zeros(W, np.uint8), np.empty(W, np.int64)
    room = min(H * W, 1 << 14)
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
    cell = np.column_stack([packed >> 32, packed.astype(np.int32)]).astype(np.int32)
    return _Seen(frame.index, cell, key, drawn[:m][first])


class _Collected:
    """What is seen by frame after frame, in bounded memory."""

    def __init__(self, origin: Int64, cell: int) -> None:
        self._origin, self._cell = origin, cell
        self._size, self._share, self._frames = cell, SHARE, 0
        self._rows: list[npt.NDArray[np.int32]] = []
        self._count = 0
        self._keys = np.zeros(0, np.int64)
        self._drawn = np.zeros(0, np.int64)
        self._looks = np.zeros(0, np.int64)
        self._parts: list[_Seen] = []
        self._waiting = 0

    def add(self, seen: _Seen) -> None:
        """One more frame."""
        self._frames += 1
        shift = (self._size // self._cell).bit_length() - 1
        cell = seen.cell if not shift else np.unique(seen.cell >> shift, axis=0)
        self._rows.append(np.column_stack([np.full(len(cell), seen.frame, np.int32), cell]))
        self._count += len(cell)
        while self._count > MOST_ROWS:
            self._widen()
        self._parts.append(seen)
        self._waiting += len(seen.key)
        if self._waiting > BUDGET:
            self._settle()

    def sights(self) -> Sights:
        """What there is so far."""
        self._settle()
        rows = _joined(self._rows)
        index = index_of_keys(self._keys, self._origin)[:, :2] >> (self._size.bit_length() - 1)
        places = np.concatenate([index.astype(np.int32), rows[:, 1:]])
        place, of = np.unique(places, axis=0, return_inverse=True)
        of, scale = of.ravel()[: len(index)], ALL / self._share
        voxels = (scale * np.bincount(of, minlength=len(place))).astype(np.float64)
        observations = (scale * np.bincount(of, weights=self._looks, minlength=len(place))).astype(np.float64)
        return Sights(self._size, rows[:, 0], rows[:, 1:], place, voxels, observations, self._frames, self._origin)

    def _widen(self) -> None:
        self._size *= 2
        rows = _joined(self._rows) >> np.array([0, 1, 1], np.int32)
        self._rows = [np.unique(rows, axis=0)]
        self._count = len(self._rows[0])

    def _settle(self) -> None:
        """Count what was seen since, and let voxels go where there are too many."""
        keys = np.concatenate([self._keys, *(seen.key for seen in self._parts)])
        drawn = np.concatenate([self._drawn, *(seen.drawn for seen in self._parts)])
        looks = np.concatenate([self._looks, np.ones(self._waiting, np.int64)])
        self._parts, self._waiting = [], 0
        self._keys, first, of = np.unique(keys, return_index=True, return_inverse=True)
        self._looks = np.bincount(of, weights=looks, minlength=len(first)).astype(np.int64)
        self._drawn = drawn[first]
        while len(self._keys) > BUDGET or (self._drawn >= self._share).any():
            self._share //= 2 if len(self._keys) > BUDGET else 1
            kept = self._drawn < self._share
            self._keys, self._drawn, self._looks = self._keys[kept], self._drawn[kept], self._looks[kept]


def _joined(rows: Iterable[npt.NDArray[np.int32]]) -> npt.NDArray[np.int32]:
    return np.concatenate([np.zeros((0, 3), np.int32), *rows])
