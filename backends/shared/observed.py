"""What compiled backends take from a frame: its observations as sparse rows, and the space to work them out in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Observed:
    """The observations of a frame as sparse rows, grouped by partition; valid until the next frame is observed.

    key     (n,) int64 packed voxel index, relative to the origin
    pixels  (n,) int64 pixels in the voxel
    start   (n + 1,) int64 first entry of each voxel
    label   (m,) uint16 classes seen in the voxel, ascending
    weight  (m,) float64 pixels of that class, or the sum of their normalised scores; s_bar = weight / pixels
    bounds  (PARTITIONS + 1,) int64 first voxel of each partition
    """

    key: Int64
    pixels: Int64
    start: Int64
    label: npt.NDArray[np.uint16]
    weight: npt.NDArray[np.float64]
    bounds: Int64

    def only(self, some: npt.NDArray[np.bool_]) -> Observed:
        """Those of some of the voxels (n,)."""
        size = np.diff(self.start)
        entries = np.repeat(some, size)
        start = np.concatenate([[0], np.cumsum(size[some])])
        return Observed(
            self.key[some], self.pixels[some], start, self.label[entries], self.weight[entries],
            _bounds_of(self.bounds, some),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class ObservedScores:
    """The observations of a frame as dense rows, grouped by partition; valid until the next frame is observed.

    key     (n,) int64 packed voxel index, relative to the origin
    pixels  (n,) int64 pixels in the voxel
    row     (n,) int64 place of each voxel's first sum in `sums`
    sums    float64, the sums of the voxels' normalised scores, K in a row; s_bar = sums / pixels
    bounds  (PARTITIONS + 1,) int64 first voxel of each partition
    K       number of classes
    """

    key: Int64
    pixels: Int64
    row: Int64
    sums: npt.NDArray[np.float64]
    bounds: Int64
    K: int

    def rows(self, some: slice = np.s_[:]) -> npt.NDArray[np.float64]:
        """The sums (n, K) of some voxels."""
        sums: npt.NDArray[np.float64] = self.sums[self.row[some, None] + np.arange(self.K)]
        return sums

    def only(self, some: npt.NDArray[np.bool_]) -> ObservedScores:
        """Those of some of the voxels (n,)."""
        own = self.key[some], self.pixels[some], self.row[some]
        return ObservedScores(*own, self.sums, _bounds_of(self.bounds, some), self.K)

    def sparse(self) -> Observed:
        """The same by entries, of which there are none for classes without evidence."""
        sums = self.rows()
        voxel, label = np.nonzero(sums)
        start = np.searchsorted(voxel, np.arange(len(self.key) + 1))
        return Observed(self.key, self.pixels, start, label.astype(np.uint16), sums[voxel, label], self.bounds)


def _bounds_of(bounds: Int64, some: npt.NDArray[np.bool_]) -> Int64:
    """First voxel of each partition among some of the voxels."""
    before: Int64 = np.concatenate([[0], np.cumsum(some)])[bounds]
    return before


LINE = 64
"""Bytes of a line of the cache: a vector that lies across two of them takes twice the time."""


class WorkSpace:
    """Arrays that are kept from frame to frame, by name."""

    def __init__(self) -> None:
        self._arrays: dict[str, npt.NDArray[Any]] = {}

    def room(self, name: str, *shape: int, dtype: Any = np.int64) -> npt.NDArray[Any]:
        """An array of that shape with whatever is in it."""
        size = int(np.prod(shape))
        if name not in self._arrays or len(self._arrays[name]) < size:
            self._arrays[name] = _aligned(max(size, 1), np.dtype(dtype))
        return self._arrays[name][:size].reshape(shape)


def _aligned(size: int, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """An array that begins with a line of the cache."""
    room = np.empty(size * dtype.itemsize + LINE, dtype=np.uint8)
    start = -room.ctypes.data % LINE
    return room[start : start + size * dtype.itemsize].view(dtype)
