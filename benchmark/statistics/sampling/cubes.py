"""Cubes of space: how large they are, which of them hold voxels, and which one each voxel is in."""

from __future__ import annotations

import math

import numpy as np

from semstab.core.types import Int32, Mask
from semstab.metrics.agreement import voxel_keys
from semstab.statistics.sampling.influence import MOST_CELLS

FEW_RUNS = 1 << 12
"""Voxels that follow each other in a map are mostly in one cube: there is room for so many runs at first."""


def cubes(
    index: tuple[Int32, Int32, Int32], voxel_size: float, edge: float | None = None, some: Mask | None = None
) -> tuple[Int32, Int32, float]:
    """The cubes (G, 3) that hold voxels of index columns (n,), which of them each is in (n,), and their edge.

    A cube is floor(voxel centre / edge). Only `some` (n,) of the voxels count, the others are in -1. The edge, unless
    it is given, is the smallest power of 2 metres, no smaller than a voxel, that leaves at most MOST_CELLS cubes.
    """
    from semstab.statistics.loops import cubes as loops

    some = np.ones(len(index[0]), np.bool_) if some is None else some
    if edge is None:
        smallest = 2.0 ** math.ceil(math.log2(voxel_size) - 1e-9)
        edge = float(smallest * 2.0 ** loops.occupied(*index, some, voxel_size / smallest, MOST_CELLS))
    cells, of, scale = np.empty((FEW_RUNS, 3), np.int64), np.empty(len(some), np.int32), voxel_size / edge
    if (count := loops.runs(*index, some, scale, cells, of)) > len(cells):
        cells = np.empty((count, 3), np.int64)
        loops.runs(*index, some, scale, cells, of)
    (key,) = voxel_keys(cells[:count])
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    loops.renumber(of, number)
    return cells[first].astype(np.int32), of, edge
