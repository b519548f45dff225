"""Find the topmost voxel of each column along the up axis: the map seen from above."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, Mask
from semstab.data.topdown import EMPTY, LARGEST, OUTLIERS, level_axes, top_down
from semstab.data.voxels import VoxelTable
from semstab.metrics.agreement import rows_of

MOST = LARGEST**2
"""The most voxels that stay in memory of a map that is read tile by tile."""

LID, LIDDED = 0.4, 0.2
"""A map is cut open where more than the second share of its columns are covered by voxels of the upper part, the first
share of its height, that have others below them at half of its height or more: a ceiling, or a shelf's board."""

SLENDER = 2.0
"""A map is shown from a side if it covers SLENDER times the area there that it covers from above: a wall, a facade."""

SPARSE = 16
"""The number of columns per voxel from which on sorting finds the columns that have voxels."""


def topmost(tiles: Iterable[VoxelTable], up: npt.ArrayLike) -> VoxelTable:
    """Return the voxels of a map in tiles that can be seen from above: a table that does not grow with it."""
    factor, parts = 1, list[VoxelTable]()
    for tile in tiles:
        parts.append(_tops(tile, up, factor))
        while sum(map(len, parts)) > MOST:
            factor *= 2
            parts = [_tops(part, up, factor) for part in parts]
    return VoxelTable.joined(parts)


def _tops(table: VoxelTable, up: npt.ArrayLike, factor: int) -> VoxelTable:
    """Return the topmost voxel of each cell, which is `factor` voxels wide."""
    right, ahead, up_axis = level_axes(up)
    cells = np.floor(table.centers @ np.stack([right, ahead], axis=1) / (factor * table.voxel_size)).astype(np.int64)
    order = np.lexsort([-(table.centers @ up_axis), cells[:, 1], cells[:, 0]])
    first = (np.diff(cells[order], axis=0, prepend=cells[order][:1] - 1) != 0).any(axis=1)
    return table.rows(np.sort(order[first]))


def best_view(table: VoxelTable, up: npt.ArrayLike) -> tuple[Mask, Float64, str]:
    """Return a mask (n,) of the voxels to show, the axis (3,) towards the viewer, and the name of that view."""
    return best_view_of(table.centers, table.voxel_size, up)


def best_view_of(centers: Float64, voxel_size: float, up: npt.ArrayLike) -> tuple[Mask, Float64, str]:
    """Return the same of voxels with these centres (n, 3)."""
    right, ahead, up_axis = level_axes(up)
    all_voxels = np.ones(len(centers), dtype=np.bool_)
    column, count = _numbered(_columns(centers, up_axis, voxel_size))
    areas = [count, *(_numbered(_columns(centers, axis, voxel_size))[1] for axis in (right, ahead))]
    if max(areas[1:]) > SLENDER * areas[0]:
        side = right if areas[1] > areas[2] else ahead
        upright = max((-side, side), key=lambda axis: float(level_axes(axis)[1] @ up_axis))
        return all_voxels, upright, "from the side"
    heights = centers @ up_axis
    low, high = np.quantile(heights, [OUTLIERS, 1 - OUTLIERS])
    cut = high - LID * (high - low)
    top, bottom = (np.full(count, end) for end in (-np.inf, np.inf))
    np.maximum.at(top, column, heights)
    np.minimum.at(bottom, column, heights)
    covered_columns = (top > cut) & (bottom < high - 0.5 * (high - low))
    if np.mean(covered_columns) <= LIDDED or high - low < 4 * voxel_size:
        return all_voxels, up_axis, "from above"
    return heights <= cut, up_axis, f"cut open at {cut:.2g} m"


def _columns(centers: Float64, axis: Float64, voxel_size: float) -> Int64:
    """Return a number (n,) for the column of cells along an axis that each voxel lies in."""
    right, ahead, _ = level_axes(axis)
    x, y = (np.floor(centers @ along / voxel_size).astype(np.int64) for along in (right, ahead))
    columns: Int64 = (x - x.min()) * (np.ptp(y) + 1) + (y - y.min())
    return columns


def _numbered(columns: Int64) -> tuple[Int64, int]:
    """Return the numbers of columns (n,) without gaps, and how many columns there are."""
    if columns.max() > SPARSE * len(columns):
        numbers, inverse = np.unique(columns, return_inverse=True)
        return inverse, len(numbers)
    occupied = np.zeros(columns.max() + 1, np.int64)
    occupied[columns] = 1
    number = np.cumsum(occupied)
    return number[columns] - 1, int(number[-1])


@dataclass(frozen=True, eq=False)
class FromAbove:
    """The voxels that are seen from above, or from the side where that shows more of them.

    Attributes:
        table: These voxels alone.
        shown: (n,) mask of these voxels in the map.
        rows: (H, W) the row of each cell's voxel in `table`, EMPTY for a cell without a voxel.
        cell: The edge of a cell in metres.
        view: The name of the view.
        whole: Width and height of all voxels that the view has, metres: the outermost ones are not in the picture.
        axis: Unit vector towards the viewer, in the scene's axes.
        corner: Metres to the right and ahead of the origin at which the lower left corner of the picture lies.
    """

    table: VoxelTable
    shown: Mask
    rows: Int64
    cell: float
    view: str = "from above"
    whole: tuple[float, float] = (0.0, 0.0)
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    corner: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def from_table(cls, table: VoxelTable, up: npt.ArrayLike) -> FromAbove:
        """Return the voxels of a map that are seen; see `best_view` and `top_down`."""
        selected, axis, view = best_view(table, up)
        centers = table.centers[selected]
        rows, cell, corner = top_down(centers, table.voxel_size, axis)
        width, height = (float(np.ptp(centers @ along)) + table.voxel_size for along in level_axes(axis)[:2])
        rows = np.where(rows == EMPTY, EMPTY, np.flatnonzero(selected)[rows])
        visible = np.zeros(len(table), dtype=np.bool_)
        visible[rows[rows != EMPTY]] = True
        renumbered: npt.NDArray[Any] = np.where(rows == EMPTY, EMPTY, (np.cumsum(visible) - 1)[rows])
        x, y, z = axis.tolist()
        return cls(rows_of(table, visible), visible, renumbered, cell, view, (width, height), (x, y, z), corner)
