"""Sparse depth of a frame, as of a LiDAR: the points of a scan, or of an image few of whose pixels have depth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, UInt16
from semstab.data.frames import Frame, Pinhole, pinhole
from semstab.data.labels import fixed

FEW = 20_000
"""Pixels, about, of which the median depth is taken; every n-th row is looked at to see whether depth is sparse."""

SPARSE, ALONE, DENSE = 0.3, 0.7, 0.1
"""Depth of an image is sparse, as from a LiDAR, if fewer than this share of its pixels have depth, and fewer than this
share of these have one next to them; and share of the labels at pixels without depth from which on labels are read
where a spot falls, not at the next pixel with depth."""

HOLES = 3.0
"""Distance of the pixels with depth, in pixels, up to which sparse depth of an image is of a camera, and has holes:
whether a view sees through a spot is then told only away from holes."""


@dataclass(frozen=True, eq=False)
class SparseDepth:
    """Sparse depth: points by direction, and an image of their numbers.

    Attributes:
        grid: (rows, columns) int32 the nearest point in each pixel, -1 without any.
        u, v, w: (n,) image coordinates and inverse depth, or inverse range of a scan; w is 0 for invalid points.
        camera: Focal lengths and principal point in pixels; of a scan, pixels in a radian.
        around: Whether columns close a circle.
        reach: Pixels to each side in which points around a place are looked for.
        spacing: Distance of the points in pixels of the grid.
        labels: (n,) uint16 labels of the points; None if the image has labels in all pixels.
    """

    grid: npt.NDArray[np.int32]
    u: Float64
    v: Float64
    w: Float64
    camera: Pinhole
    around: bool
    reach: int
    spacing: float
    labels: UInt16 | None = None

    @classmethod
    def from_frame(cls, frame: Frame, K: int) -> SparseDepth | None:
        """Return the points of a scan, or the pixels with depth of an image with sparse depth; None of another image.

        Args:
            frame: The frame.
            K: The number of classes; the label of a point without one is K, of one that is left out K + 1.
        """
        if frame.points is None:
            return _of_image(frame, K)
        return _of_scan(fixed(frame.points.reshape(-1, 3)), frame.ray_angle, _labels(frame, K))

    def apart(self, looked: int) -> float:
        """Return the distance, in pixels of the grid, of some of the points that are looked at."""
        return self.spacing * math.sqrt(len(self.w) / max(looked, 1))

    @property
    def arrays(self) -> tuple[Any, ...]:
        """The grid and the points, in the order of compiled loops."""
        return self.grid, self.u, self.v, self.w


def of_lidar(sparse: SparseDepth | None) -> TypeGuard[SparseDepth]:
    """Return whether depth is of the points of a LiDAR, and not of a camera whose depth has holes."""
    return sparse is not None and (sparse.around or sparse.spacing > HOLES)


def step_of_few(shape: tuple[int, int]) -> int:
    """Return a step along each axis of an image (H, W) that leaves about FEW pixels."""
    return max(1, round(math.sqrt(shape[0] * shape[1] / FEW)))


def _of_scan(points: npt.NDArray[Any], ray_angle: float, labels: UInt16) -> SparseDepth | None:
    """Return the points (n, 3) of a scan in an image of directions, whose pixels are half their distance wide."""
    from semstab.statistics.loops.sparse import directions, drawn

    if not ray_angle > 0:
        return None
    u, v, w = np.zeros((3, len(points)))
    columns = max(8, round(4 * math.pi / ray_angle))
    unit = 2 * math.pi / columns
    directions(points, unit, u, v, w)
    grid = np.empty((math.ceil(math.pi / unit) + 1, columns), np.int32)
    drawn(u, v, w, grid)
    return SparseDepth(grid, u, v, w, (1 / unit, 1 / unit, 0.0, 0.0), True, 5, 2.0, labels)


def _of_image(frame: Frame, K: int) -> SparseDepth | None:
    """Return the pixels of an image that have depth, if they are few and far between; else None."""
    rows = frame.depth[:: step_of_few(frame.shape)]
    valid = (rows > 0) & (rows < np.inf)
    n, pairs = int(np.count_nonzero(valid)), int(np.count_nonzero(valid[:, 1:] & valid[:, :-1]))
    if not n < SPARSE * valid.size or pairs >= ALONE * n > 0:
        return None
    valid = (frame.depth > 0) & (frame.depth < np.inf)
    if not (n := int(np.count_nonzero(valid))):
        return None
    row, column = np.nonzero(valid)
    spacing = math.sqrt((np.ptp(row) + 1) * (np.ptp(column) + 1) / n)
    u, v, w = column.astype(np.float64), row.astype(np.float64), 1.0 / frame.depth[valid].astype(np.float64)
    grid = np.full(valid.shape, -1, np.int32)
    grid[valid] = np.arange(n, dtype=np.int32)
    labelled = frame.predicted < K
    dense = np.count_nonzero(labelled & ~valid) > DENSE * np.count_nonzero(labelled)
    labels = None if dense else _labels(frame, K, valid)
    reach = min(max(math.ceil(1.1 * spacing), 2), 12)
    return SparseDepth(grid, u, v, w, pinhole(frame.intrinsics), False, reach, spacing, labels)


def _labels(frame: Frame, K: int, chosen: Any = ...) -> UInt16:
    """Return the label (n,) of each chosen pixel or point: K for none, K + 1 for one that is left out."""
    labels = frame.predicted[chosen].astype(np.uint16)
    unlabelled = np.False_ if frame.unlabelled is None else frame.unlabelled[chosen]
    return np.where(labels < K, labels, np.where(unlabelled, K, K + 1)).astype(np.uint16).reshape(-1)
