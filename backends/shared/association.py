"""Voxels from the pixels or points of a frame: back-projection, voxel index, and one evidence vector a voxel.

Paper, Semantic Evidence and World-Space Association, and Persistent Voxel Evidence.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from semstab.core.types import Float32, Float64, Int64, Mask
from semstab.data.events import Events
from semstab.data.frames import Frame
from semstab.data.results import Changes, FrameReport
from semstab.data.voxels import Extent, VoxelTable
from semstab.errors import ConfigError, DataError

if TYPE_CHECKING:
    from semstab.backends import FusionBackend


INDEX_LIMIT = 2**31
"""Voxel indices are int32."""

CHECKED = 2**12
"""Pixels of a depth map, about, that the check of its unit reads; of one as large some must be finite."""

FAR, DISTINCT = 100.0, 8
"""Depth is in millimetres if all values are whole numbers, at least DISTINCT differ, and most exceed FAR metres."""

FEW = 1 << 15
"""The most pixels that are back-projected together: the results stay in a core's cache."""


@dataclass(frozen=True, eq=False)
class Observations:
    """The observations of n voxels by one frame, sorted by index.

    Attributes:
        index: (n, 3) int64 voxel index.
        s_bar: (n, K) float64 mean evidence of the frame's pixels in the voxel.
        pixels: (n,) int64 how many they are.
    """

    index: Int64
    s_bar: Float64
    pixels: Int64


def check_settings(voxel_size: float, num_classes: int) -> None:
    """Raise ConfigError where a map cannot be made with these settings."""
    if not (math.isfinite(voxel_size) and voxel_size > 0):
        raise ConfigError(f"voxel_size = {voxel_size:g}: it must be positive, in metres")
    if num_classes < 2:
        raise ConfigError(f"num_classes = {num_classes}: stability needs at least 2 (entropy divides by log K)")


def check_frame(frame: Frame, num_classes: int) -> None:
    """Raise DataError where the frame's labels or scores do not fit K classes."""
    if frame.scores is not None:
        if frame.scores.shape[2] != num_classes:
            raise DataError(
                f"{frame.where('scores')}: scores hold {frame.scores.shape[2]} classes, the map {num_classes}"
            )
    else:
        assert frame.labels is not None
        highest = int(frame.labels.max(initial=0))
        if highest >= num_classes:  # 255 for 'ignore', in most frames
            highest = int(np.where(frame.valid, frame.labels, 0).max(initial=0))
        if highest >= num_classes:
            raise DataError(
                f"{frame.where('labels')}: label id {highest} is outside 0 to {num_classes - 1}; map it or ignore it"
            )


def check_depth(frame: Frame) -> None:
    """Raise DataError where the frame's depth is finite nowhere, or cannot be metres; of a scan its points cannot."""
    depth, measured = frame.depth, frame.depth if frame.points is None else frame.points
    step = max(1, depth.size // CHECKED if len(depth) == 1 else int(math.sqrt(depth.size / CHECKED)))
    sample = measured[::step, ::step]
    has_fractions = _has_fractions(sample[len(sample) // 2, : 8 * DISTINCT].ravel().tolist())
    if has_fractions and frame.points is None:
        return  # metres: a few of the middle tell of nearly all that are
    if depth.size >= CHECKED and not np.isfinite(depth[::step, ::step]).any() and not np.isfinite(depth).any():
        raise DataError(f"{frame.where('depth')}: depth is finite nowhere (NaN or inf); leave this frame out")
    if not has_fractions and _whole_millimetres(sample):
        largest = np.max(np.abs(sample), initial=0, where=np.isfinite(sample))
        raise DataError(
            f"{frame.where('depth')}: depth looks like millimetres, whole numbers up to {largest:.0f}; divide it by"
            " 1000, or set depth_scale"
            if frame.points is None
            else f"{frame.where('points')}: points look like millimetres, whole numbers up to {largest:.0f}; divide"
            " them by 1000"
        )


def _whole_millimetres(measured: Float32) -> bool:
    """Return whether what is measured is whole numbers, as nothing in metres is, and too large to be near."""
    values = np.abs(measured[np.isfinite(measured) & (measured != 0)])
    if values.size < DISTINCT or not np.array_equal(values, np.floor(values)):
        return False
    return bool(np.median(values) >= FAR) and len(np.unique(values)) >= DISTINCT


def _has_fractions(few: list[float]) -> bool:
    """Return whether enough of a few is measured, and not all of it whole numbers: numpy would take longer."""
    values = [value for value in few if value != 0 and math.isfinite(value)]
    return len(values) >= DISTINCT and any(value != math.floor(value) for value in values)


def observe(frame: Frame, voxel_size: float, num_classes: int, pixels: Mask | None = None) -> Observations:
    """Return the frame's observations: s_bar(q) = 1/|A_t(q)| sum of s_i over the pixels A_t(q) that fall into voxel q.

    They are of some of its valid `pixels` (H, W) only, where these are given.
    """
    chosen = frame.valid if pixels is None else pixels
    points = back_project(frame, chosen)
    if not points.shape[1]:
        nothing = np.zeros((0, 3), dtype=np.int64), np.zeros((0, num_classes)), np.zeros(0, dtype=np.int64)
        return Observations(*nothing)
    key, low, size = pack(voxel_index(points, voxel_size, frame), frame)
    voxels, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    s_sum = _sums_of_evidence(frame, num_classes, chosen, inverse.ravel(), len(voxels))
    return Observations(unpack(voxels, low, size), s_sum / count[:, None], count)


def back_project(frame: Frame, pixels: Mask | None = None) -> Float64:
    """Return world coordinates (3, n), metres, of the frame's valid pixels, or of some of them (H, W), in row order.

    x_w = T_wc d ((u - cx) / fx, (v - cy) / fy, 1), of a scan T_wc p.

    The order of operations is the protocol's, so that every backend assigns a point on a voxel's face to the same
    voxel.
    """
    return np.concatenate([*_points(frame, frame.valid if pixels is None else pixels)], axis=1)


def pixels_held(frame: Frame, pixels: Mask, voxel_size: float, holds: Callable[[Int64], Mask]) -> Mask:
    """Return the pixels (H, W) that fall into voxels of a set, by their index (3, n)."""
    held = [holds(voxel_index(points, voxel_size, frame)) for points in _points(frame, pixels)]
    chosen = np.zeros_like(pixels)
    chosen[pixels] = np.concatenate(held)
    return chosen


def _points(frame: Frame, pixels: Mask) -> Iterator[Float64]:
    """Yield world coordinates (3, n) of some pixels, of FEW at a time: a large frame would take much memory."""
    if frame.points is not None:
        yield in_world(frame.points[pixels].T.astype(np.float64), frame.T_wc)
        return
    across, down = frame.rays
    at = np.flatnonzero(pixels)
    for first in range(0, max(len(at), 1), FEW):
        row, column = np.divmod(at[first : first + FEW], frame.shape[1])
        z = frame.depth[row, column].astype(np.float64)
        yield in_world((across[column] * z, down[row] * z, z), frame.T_wc)


def in_world(points: Sequence[Float64] | Float64, T_wc: Float64) -> Float64:
    """Return world coordinates (3, n) of points in the sensor's (3, n): ((R0 x + R1 y) + R2 z) + t, in this order."""
    (x, y, z), R, t = points, T_wc[:3, :3], T_wc[:3, 3]
    return np.stack([((R[i, 0] * x + R[i, 1] * y) + R[i, 2] * z) + t[i] for i in range(3)])


def voxel_index(points: Float64, voxel_size: float, frame: Frame) -> Int64:
    """Return voxel index (3, n) of world points (3, n): q = floor(x_w / r).

    Raises:
        DataError: If an index does not fit 32 bits, with the frame and its extent.
    """
    q = np.floor(points / voxel_size)
    if q.size and not (q.min() >= -INDEX_LIMIT and q.max() < INDEX_LIMIT):
        low, high = points.min(axis=1), points.max(axis=1)
        raise DataError(
            f"{frame.where('pose')}: frame {frame.index} spans {low.round(1).tolist()} to {high.round(1).tolist()} m,"
            f" beyond 2^31 voxels of {voxel_size:g} m; check depth and pose units, or use larger voxels"
        )
    return q.astype(np.int64)


def pack(index: Int64, frame: Frame) -> tuple[Int64, Int64, tuple[int, ...]]:
    """Return one int64 key for each voxel of a frame, ascending with (ix, iy, iz); its lowest corner and size undo it.

    Raises:
        DataError: If the frame's extent holds too many voxels for a key.
    """
    low = index.min(axis=1, keepdims=True)
    size = tuple(int(n) for n in index.max(axis=1) - low[:, 0] + 1)
    if math.prod(size) >= 2**45:
        raise DataError(
            f"{frame.where('depth')}: frame {frame.index} spans {' x '.join(map(str, size))} voxels;"
            " leave out far depth (sky?), or use larger voxels"
        )
    return np.ravel_multi_index(tuple(index - low), size).astype(np.int64, copy=False), low[:, 0], size


def unpack(key: Int64, low: Int64, size: tuple[int, ...]) -> Int64:
    """Return the voxel indices (n, 3) behind keys made by `pack`."""
    return np.stack(np.unravel_index(key, size), axis=1) + low


def _sums_of_evidence(frame: Frame, num_classes: int, chosen: Mask, voxel: Int64, voxels: int) -> Float64:
    """Return the sums (m, K) of s over the pixels of each voxel (n,): of one-hot labels, or of scores that sum to 1."""
    if frame.labels is not None and frame.scores is None:  # never a vector a pixel: of many classes it takes too much
        entries = voxel * num_classes + frame.labels[chosen]
        return np.bincount(entries, minlength=voxels * num_classes).reshape(voxels, num_classes).astype(np.float64)
    assert frame.scores is not None
    s_sum, begin = np.zeros((voxels, num_classes)), 0
    for row, pixels in zip(frame.scores, chosen, strict=True):  # a whole image of them takes four times that of halves
        s = row[pixels].astype(np.float64)
        s /= s.sum(axis=1, keepdims=True)
        np.add.at(s_sum, voxel[begin : begin + len(s)], s)
        begin += len(s)
    return s_sum


# Any backend restricted to columns of voxels: it gets the pixels of each frame that fall into them.


class Restricted:
    """A backend that has no restriction of its own, and associates pixel by pixel."""

    def __init__(self, backend: FusionBackend, voxel_size: float, within: Extent) -> None:
        self._backend = backend
        self._voxel_size = voxel_size
        self._within = within

    def integrate(self, frame: Frame) -> FrameReport:
        """Fuse the pixels of the frame in the columns."""
        depth = np.where(falling_into(self._within, frame, self._voxel_size), frame.depth, np.float32(0))
        return self._backend.integrate(dataclasses.replace(frame, depth=depth))

    def table(self) -> VoxelTable:
        """Return the voxels of the columns; a map in single precision may have put a pixel one voxel beyond."""
        table = self._backend.table()
        inside = self._within.holds(table.index.T)
        return table if inside.all() else table.rows(inside)

    def events(self) -> Events | None:
        """Return the log, where the backend has one."""
        return self._backend.events()

    def changes(self) -> Changes | None:
        """Return the changes by the last frame, where the backend says them."""
        return self._backend.changes() if hasattr(self._backend, "changes") else None


def falling_into(within: Extent, frame: Frame, voxel_size: float) -> Mask:
    """Return the pixels (H, W) with depth whose voxels are in the extent."""
    has_depth: Mask = np.isfinite(frame.depth) & (frame.depth > 0)
    return pixels_held(frame, has_depth, voxel_size, within.holds)
