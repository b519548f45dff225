"""The observations of a frame as compiled backends take them, and the change that they make to a map."""

from __future__ import annotations

import contextlib
import math
import mmap
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Float64, Int64, Mask, UInt16
from semstab.data.information import entropy_bits, js_divergence, normalise
from semstab.data.measures import RECURRENT
from semstab.data.results import FrameReport


@dataclass(frozen=True, eq=False)
class Observed:
    """The observations of a frame as sparse rows, grouped by partition; valid until the next frame is observed.

    Attributes:
        key: (n,) int64 packed voxel index, relative to the origin.
        pixels: (n,) int64 pixels in the voxel.
        start: (n + 1,) int64 first entry of each voxel.
        label: (m,) uint16 classes seen in the voxel, ascending.
        weight: (m,) float64 pixels of that class, or the sum of their normalised scores; s_bar = weight / pixels.
        bounds: (PARTITIONS + 1,) int64 first voxel of each partition.
    """

    key: Int64
    pixels: Int64
    start: Int64
    label: UInt16
    weight: Float64
    bounds: Int64


@dataclass(frozen=True, eq=False)
class ObservedScores:
    """The observations of a frame as dense rows, grouped by partition; valid until the next frame is observed.

    Attributes:
        key: (n,) int64 packed voxel index, relative to the origin.
        pixels: (n,) int64 pixels in the voxel.
        row: (n,) int64 index of each voxel's first sum in `sums`.
        sums: float64, the sums of the voxels' normalised scores, K in a row; s_bar = sums / pixels.
        bounds: (PARTITIONS + 1,) int64 first voxel of each partition.
        K: Number of classes.
    """

    key: Int64
    pixels: Int64
    row: Int64
    sums: Float64
    bounds: Int64
    K: int

    def rows(self, some: slice = np.s_[:]) -> Float64:
        """Return the sums (n, K) of some voxels."""
        sums: Float64 = self.sums[self.row[some, None] + np.arange(self.K)]
        return sums

    def only(self, some: Mask) -> ObservedScores:
        """Return the scores of some of the voxels (n,)."""
        bounds = np.concatenate([[0], np.cumsum(some)])[self.bounds]
        return ObservedScores(self.key[some], self.pixels[some], self.row[some], self.sums, bounds, self.K)

    def sparse(self) -> Observed:
        """Return the same as entries; classes without evidence have no entry."""
        sums = self.rows()
        voxel, label = np.nonzero(sums)
        start = np.searchsorted(voxel, np.arange(len(self.key) + 1))
        return Observed(self.key, self.pixels, start, label.astype(np.uint16), sums[voxel, label], self.bounds)


LINE = 64
"""Bytes of a line of the cache: a vector that lies across two of them takes twice the time."""


class WorkSpace:
    """Arrays that one frame after the other uses, by name."""

    def __init__(self) -> None:
        self._arrays: dict[str, npt.NDArray[Any]] = {}
        self._last: dict[str, npt.NDArray[Any]] = {}
        """The part of each that was asked for last."""

    def room(self, name: str, *shape: int, dtype: Any = np.int64, gaps: bool = False) -> npt.NDArray[Any]:
        """Return an array of that shape with whatever is in it; with `gaps`, most of it will not be written to."""
        if (last := self._last.get(name)) is not None and last.shape == shape:
            return last
        size = math.prod(shape)
        if name not in self._arrays or len(self._arrays[name]) < size:
            length = max(size, 1) * np.dtype(dtype).itemsize
            room = _in_small_pages(length + LINE) if gaps else np.empty(length + LINE, dtype=np.uint8)
            start = -room.ctypes.data % LINE
            self._arrays[name] = room[start : start + length].view(dtype)
        self._last[name] = room = self._arrays[name][:size].reshape(shape)
        return room


def _in_small_pages(length: int) -> npt.NDArray[np.uint8]:
    """Return bytes that take memory only for the pages written to; numpy would ask for pages of 2 MB if available."""
    page_flags = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_ANONYMOUS") else {}
    pages = mmap.mmap(-1, length, **page_flags)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        with contextlib.suppress(OSError):  # a kernel without large pages
            pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype=np.uint8)


# Totals of a map as it grows, whatever holds its voxels, and the report of each frame made of them.


class BeliefChange(NamedTuple):
    """Drift (n,) of the voxels that a frame saw, and their dominant class before and after, as `Changes` has them."""

    drift: Float32
    before: UInt16
    after: UInt16

    @classmethod
    def room(cls, n: int) -> BeliefChange:
        """Return changes of n voxels to be filled."""
        return cls(np.empty(n, np.float32), np.empty(n, np.uint16), np.empty(n, np.uint16))


@dataclass(frozen=True)
class Change:
    """The change of a map by one frame, summed over the voxels that it touched.

    Attributes:
        points: Pixels that it counted.
        voxels: Voxels that it touched.
        new: Voxels that were seen for the first time.
        drift: D_JS(p^(t), p^(t-1)) of the other voxels, bits.
        vss: VSS after the frame minus VSS before it; a new voxel had no VSS.
        entropy: Likewise entropy, bits.
        recurrent: Voxels that it made recurrent.
    """

    points: int
    voxels: int
    new: int
    drift: float
    vss: float
    entropy: float
    recurrent: int

    @classmethod
    def from_sums(cls, sums: Iterable[float]) -> Change:
        """Make it of numbers in the order of the fields."""
        points, voxels, new, drift, vss, entropy, recurrent = sums
        return cls(int(points), int(voxels), int(new), float(drift), float(vss), float(entropy), int(recurrent))

    @classmethod
    def between(cls, before: Float64, after: Float64, op: Int64, pixels: Int64) -> tuple[Change, BeliefChange]:
        """Return the change of the map, and that of the belief of each of the n touched voxels.

        Args:
            before: (n, K) evidence before the frame; all 0 before the first.
            after: (n, K) evidence after the frame.
            op: (n,) observations including this one.
            pixels: (n,) of the frame.
        """
        is_repeated = op > 1
        before, after = np.asfortranarray(before), np.asfortranarray(after)  # sums over few classes run along n
        p_after, p_before, drift = normalise(after), normalise(before.T[:, is_repeated].T), np.zeros(len(op))
        drift[is_repeated] = js_divergence(p_after.T[:, is_repeated].T, p_before)
        dominant_after = after.argmax(axis=1).astype(np.uint16)
        dominant_before = np.where(is_repeated, before.argmax(axis=1).astype(np.uint16), dominant_after)
        change = cls(
            points=int(pixels.sum()),
            voxels=len(op),
            new=int(np.count_nonzero(~is_repeated)),
            drift=float(drift.sum()),
            vss=float(p_after.max(axis=1).sum() - p_before.max(axis=1).sum()),
            entropy=float(entropy_bits(p_after).sum() - entropy_bits(p_before).sum()),
            recurrent=int(np.count_nonzero(op == RECURRENT)),
        )
        return change, BeliefChange(
            np.where(is_repeated, drift, np.nan).astype(np.float32), dominant_before, dominant_after
        )


class MapTotal:
    """Running totals over the voxels of a map of K classes: no work that grows with the map."""

    def __init__(self, num_classes: int) -> None:
        self.num_classes = num_classes
        self.voxels = 0
        self.recurrent = 0
        self.vss = 0.0
        self.entropy = 0.0
        """The summed entropy, in bits."""

    def add(self, frame: int, change: Change, started: float, associated: float = math.nan) -> FrameReport:
        """Account for a frame that went into the map just now, and report it.

        Args:
            frame: Its index.
            change: Its effect on the map.
            started: `time.perf_counter()` when its fusion began.
            associated: `time.perf_counter()` when its pixels had become observations; NaN if not measured separately.
        """
        finished = time.perf_counter()
        self.voxels += change.new
        self.recurrent += change.recurrent
        self.vss += change.vss
        self.entropy += change.entropy
        n = self.voxels or math.nan
        return FrameReport(
            frame=frame,
            points=change.points,
            voxels=change.voxels,
            new_voxels=change.new,
            drift_sum=change.drift,
            seconds=finished - started,
            map_voxels=self.voxels,
            map_vss_all=self.vss / n,
            map_entropy_all=self.entropy / n / math.log2(self.num_classes),
            map_recurrent=self.recurrent / n,
            association_seconds=associated - started,
            update_seconds=finished - associated,
        )
