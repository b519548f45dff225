"""The topmost voxel of each column along the up axis: the map seen from above."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64

EMPTY = -1
"""The row of a cell without a voxel."""

LARGEST = 2000
"""The most cells along a map's longer side; the cells of a larger map are several voxels wide."""

OUTLIERS = 0.01
"""The share of the voxels that may lie outside of the map at each of its four sides, so that lone voxels far away do
not shrink it."""


def level_axes(up: npt.ArrayLike) -> tuple[Float64, Float64, Float64]:
    """Return right-handed unit vectors (right, ahead, up).

    Right is the world's x axis, or y where up is x, laid level.
    """
    up_axis = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    along = np.eye(3)[0 if abs(up_axis[0]) < 0.9 else 1]
    right = along - (along @ up_axis) * up_axis
    right /= np.linalg.norm(right)
    return right, np.cross(up_axis, right), up_axis


class TopDown(NamedTuple):
    """A map seen along an axis.

    Attributes:
        rows: (H, W) row of the voxel that each cell shows, or EMPTY; the first row of cells is the farthest ahead.
        cell: Edge of a cell, metres.
        corner: Metres to the right and ahead of the origin at which the lower left corner of the picture lies.
    """

    rows: Int64
    cell: float
    corner: tuple[float, float]


def top_down(
    centers: Float64, voxel_size: float, up: npt.ArrayLike, rank: Float64 | None = None, largest: int = LARGEST
) -> TopDown:
    """Return the topmost voxel in each cell.

    Args:
        centers: (n, 3) of voxels, metres.
        voxel_size: Edge of a voxel, metres.
        up: (3,) direction out of the picture.
        rank: (n,) the voxel of a cell with the highest rank is shown, instead of the topmost one.
        largest: Most cells of the longer side.

    Where up is an axis of the world a cell is a column of voxels; else
    each voxel covers the cells that a level square of its size touches.
    """
    from semstab.data.kernels import put_topmost

    right, ahead, up_axis = level_axes(up)
    plane = np.stack([centers @ ahead, centers @ right], axis=1)
    low, high = np.quantile(plane, [OUTLIERS, 1 - OUTLIERS], axis=0)
    factor = max(1, int(np.ceil((high - low).max() / voxel_size / largest)))
    cell = factor * voxel_size
    cells, rows = covered(plane, up_axis, voxel_size, cell)
    first, last = (np.floor(edge / cell).astype(np.int64) for edge in (low, high))
    inside = ((cells >= first) & (cells <= last)).all(axis=1)
    cells, rows = cells[inside] - first, rows[inside]
    height = centers @ up_axis if rank is None else rank
    image = np.full(last - first + 1, EMPTY, dtype=np.int64)
    put_topmost(cells, rows, height, image)
    ahead_of, right_of = (first * cell).tolist()
    return TopDown(image[::-1], cell, (right_of, ahead_of))


def covered(plane: Float64, up: Float64, voxel_size: float, cell: float) -> tuple[Int64, Int64]:
    """Return the cells (m, 2) of an edge, and the voxel (m,) that covers each, by centres (n, 2) in the plane.

    Where up is an axis of the world a cell is a column of voxels; else each voxel covers the cells that a level square
    of its size touches, where a cell is one voxel.
    """
    aligned = np.isclose(np.abs(up).max(), 1.0)
    reach = 0.0 if aligned or cell > voxel_size else 0.499 * voxel_size
    corners = [(0.0, 0.0)] if reach == 0.0 else [(a, b) for a in (-reach, reach) for b in (-reach, reach)]
    cells = np.concatenate([np.floor((plane + corner) / cell).astype(np.int64) for corner in corners])
    return cells, np.tile(np.arange(len(plane)), len(corners))
