"""Clusters of observations: cubes of space, and groups of frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import distinct_keys
from semstab.core.types import Float64, Int32, Int64, Mask

MOST_CELLS, MOST_GROUPS = 256, 64
"""Largest number of cubes of space, and of groups of frames."""

MOST_SUMS = 2**24
"""Most numbers in the sums: with thousands of classes there are fewer groups of frames."""


def most_groups(K: int) -> int:
    """Return the largest number of groups of frames with K classes."""
    return max(1, min(MOST_GROUPS, MOST_SUMS // (MOST_CELLS * K)))


@dataclass(frozen=True, eq=False)
class ClusterIndex:
    """The cube of space and the group of frames of rows (m,), some of which belong to no frame.

    Attributes:
        cubes: (G, 3) sorted, of an edge in metres; row (m,) the cube of each row.
        frames: (F,) the groups of frames, sorted; per_group is their mean number of frames, 0 if frames are unknown.
        known: (r,) the rows that belong to a group, column (r,) that group.
    """

    cubes: Int64
    row: Int64
    frames: Int64
    known: Int64
    column: Int64
    edge: float
    per_group: float

    @classmethod
    def from_cells(
        cls, cell: npt.NDArray[np.integer], frame: npt.NDArray[np.integer] | None, edge: float, per_group: float = 0
    ) -> ClusterIndex:
        """Index rows by cube (m, 3) and group of frames (m,), -1 where unknown; without frames all are of one."""
        cubes, row = distinct_rows(cell)
        if frame is None:
            return cls(cubes, row, np.array([-1]), np.arange(len(row)), np.zeros(len(row), np.int64), edge, 0)
        rows_with_frame = np.flatnonzero((frame >= 0) | (per_group == 0))
        frames, column = np.unique(frame[rows_with_frame].astype(np.int64), return_inverse=True)
        return cls(cubes, row, frames, rows_with_frame, column, edge, per_group)

    def by_cube(self, values: Float64) -> Float64:
        """Return the sums (G,) of values (m,)."""
        return np.bincount(self.row, weights=values, minlength=len(self.cubes)).astype(np.float64, copy=False)

    def by_both(self, values: Float64) -> Float64:
        """Return the sums (G, F) of values (m,)."""
        shape = len(self.cubes), len(self.frames)
        cell = self.row[self.known] * shape[1] + self.column
        sums: Float64 = np.bincount(cell, weights=values[self.known], minlength=shape[0] * shape[1]).astype(np.float64)
        return sums.reshape(shape)


def distinct_rows(rows: npt.NDArray[np.integer]) -> tuple[Int64, Int64]:
    """Return each row of whole numbers (n, C) once, ascending, and which of them each is: np.unique by one number."""
    key = _keys(rows)
    if key is None:
        distinct, of = np.unique(rows, axis=0, return_inverse=True)
        return distinct.astype(np.int64), of.ravel()
    keys, of = distinct_keys(key)
    first = np.empty(len(keys), np.int64)
    first[of] = np.arange(len(rows))
    return rows[first].astype(np.int64), of


def count_distinct(rows: npt.NDArray[np.integer]) -> int:
    """Return how many of the rows of whole numbers (n, C) differ."""
    key = _keys(rows)
    if key is None:
        return len(np.unique(rows, axis=0))
    key.sort()  # np.unique alone would take a hundred times as long
    return int(np.count_nonzero(np.diff(key))) + (len(key) > 0)


def _keys(rows: npt.NDArray[np.integer]) -> Int64 | None:
    """Return a number for each row, in their order; None if 64 bits are too few."""
    low = [int(column.min(initial=0)) for column in rows.T]
    size = [int(column.max(initial=0)) - least + 1 for column, least in zip(rows.T, low, strict=True)]
    if math.prod(size) >= 2**63:
        return None
    key = np.zeros(len(rows), np.int64)
    for column, least, many in zip(rows.T, low, size, strict=True):
        key = key * many + (column - least)
    return key


class FrameGroups(NamedTuple):
    """Groups of as many successive frames each, in which observations are.

    Attributes:
        groups: (F,) their numbers, ascending: the index of a frame divided by `step`, rounded down.
        of: (m,) the row in `groups` of each observation.
        step: Frames of a group, a power of 2.
        frames: The number of frames.
    """

    groups: Int64
    of: Int64
    step: int
    frames: int

    @classmethod
    def at_most(cls, most: int, frame: npt.NDArray[np.integer]) -> FrameGroups:
        """Return the smallest groups, at most that many, of observations by the index (m,) of their frame."""
        frames, at = distinct_keys(frame.astype(np.int64))
        step = 1
        while len(groups := np.unique(frames // step)) > most:
            step *= 2
        return cls(groups, np.searchsorted(groups, frames // step)[at], step, len(frames))


def cubes_of(
    index: tuple[Int32, Int32, Int32],
    voxel_size: float,
    edge: float | None = None,
    counted: Mask | None = None,
    most: int = MOST_CELLS,
) -> tuple[Int32, Int32, float]:
    """Return the cubes (G, 3) that hold voxels of index columns (n,), the cube (n,) of each voxel, and their edge.

    A cube is floor(voxel centre / edge). Only the voxels `counted` (n,) count, the others are in -1. The edge, unless
    it is given, is the smallest power of 2 metres, no smaller than a voxel, that leaves at most `most` cubes.
    """
    rows = np.arange(len(index[0])) if counted is None else np.flatnonzero(counted)
    smallest = 2.0 ** math.ceil(math.log2(voxel_size) - 1e-9)
    scale = voxel_size / (smallest if edge is None else edge)
    cell = np.stack([np.floor((axis[rows] + 0.5) * scale) for axis in index], axis=1).astype(np.int64)
    if edge is None:
        cubes, number, doublings = _few_cubes(cell, most)
        edge = smallest * 2**doublings
    else:
        cubes, number = distinct_rows(cell)
    of = np.full(len(index[0]), -1, np.int32)
    of[rows] = number
    return cubes.astype(np.int32), of, edge


def _few_cubes(cell: Int64, most: int) -> tuple[Int64, Int64, int]:
    """Return the distinct cubes of cells (n, 3) and which each cell is in, and how often their edge was doubled.

    The smallest cubes are sought that are at most `most`, beginning with large ones: few are quickly counted.
    """
    doublings = 0
    if len(cell) > most:
        low, high = cell.min(axis=0), cell.max(axis=0)
        while math.prod(((high >> doublings) - (low >> doublings) + 1).tolist()) > most:
            doublings += 1
    cubes, of = distinct_rows(cell >> doublings)
    while doublings > 0:
        smaller, of_smaller = distinct_rows(cell >> (doublings - 1))
        if len(smaller) > most:
            break
        cubes, of, doublings = smaller, of_smaller, doublings - 1
    return cubes, of, doublings
