"""The observations of a frame as compiled backends take them, and what they change in a map."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, Mask, UInt16
from semstab.model.information import entropy_bits, js_divergence, normalise
from semstab.model.results import RECURRENT, FrameReport


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
    label: UInt16
    weight: Float64
    bounds: Int64

    def only(self, some: Mask) -> Observed:
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
    sums: Float64
    bounds: Int64
    K: int

    def rows(self, some: slice = np.s_[:]) -> Float64:
        """The sums (n, K) of some voxels."""
        sums: Float64 = self.sums[self.row[some, None] + np.arange(self.K)]
        return sums

    def only(self, some: Mask) -> ObservedScores:
        """Those of some of the voxels (n,)."""
        own = self.key[some], self.pixels[some], self.row[some]
        return ObservedScores(*own, self.sums, _bounds_of(self.bounds, some), self.K)

    def sparse(self) -> Observed:
        """The same by entries, of which there are none for classes without evidence."""
        sums = self.rows()
        voxel, label = np.nonzero(sums)
        start = np.searchsorted(voxel, np.arange(len(self.key) + 1))
        return Observed(self.key, self.pixels, start, label.astype(np.uint16), sums[voxel, label], self.bounds)


def _bounds_of(bounds: Int64, some: Mask) -> Int64:
    """First voxel of each partition among some of the voxels."""
    before: Int64 = np.concatenate([[0], np.cumsum(some)])[bounds]
    return before


LINE = 64
"""Bytes of a line of the cache: a vector that lies across two of them takes twice the time."""


class WorkSpace:
    """Arrays that one frame after the other uses, by name."""

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


# Totals of a map as it grows, whatever holds its voxels, and the report of each frame made of them.

PIECE = 1 << 20
"""Numbers of evidence that are worked on together, about: each takes some hundred bytes meanwhile."""


@dataclass(frozen=True)
class Change:
    """The change of a map by one frame, summed over the voxels that it touched.

    points     pixels that it counted
    voxels     voxels that it touched
    new        of them, those seen for the first time
    drift      D_JS(p^(t), p^(t-1)) of the others, bits
    vss        VSS after the frame, less VSS before it; a new voxel had none
    entropy    likewise entropy, bits
    recurrent  voxels that it made recurrent
    """

    points: int
    voxels: int
    new: int
    drift: float
    vss: float
    entropy: float
    recurrent: int

    @classmethod
    def of(cls, sums: Iterable[float]) -> Change:
        """From numbers in the order of the fields."""
        points, voxels, new, drift, vss, entropy, recurrent = sums
        return cls(int(points), int(voxels), int(new), float(drift), float(vss), float(entropy), int(recurrent))

    @classmethod
    def between(cls, before: Float64, after: Float64, op: Int64, pixels: Int64) -> Change:
        """Of the n touched voxels, from their evidence.

        before, after  (n, K) evidence before and after the frame; all 0 before the first
        op             (n,) observations including this one
        pixels         (n,) of the frame
        """
        known = op > 1
        pieces = [_voxel_by_voxel(before[some], after[some], known[some]) for some in _pieces(*after.shape)]
        drift, vss, vss_before, entropy, entropy_before = map(np.concatenate, zip(*pieces, strict=True))
        return cls(
            points=int(pixels.sum()),
            voxels=len(op),
            new=int(np.count_nonzero(~known)),
            drift=float(drift.sum()),
            vss=float(vss.sum() - vss_before.sum()),
            entropy=float(entropy.sum() - entropy_before.sum()),
            recurrent=int(np.count_nonzero(op == RECURRENT)),
        )


def _pieces(rows: int, columns: int) -> Iterator[slice]:
    """Of about as many rows each, so that arrays of that many columns take little memory; one where there is none."""
    count = max(1, -(-rows * columns // PIECE))
    return (slice(k * rows // count, (k + 1) * rows // count) for k in range(count))


def _voxel_by_voxel(before: Float64, after: Float64, known: Mask) -> tuple[Float64, ...]:
    """Drift and VSS of touched voxels, VSS before of the known ones, entropy likewise."""
    before, after = np.asfortranarray(before), np.asfortranarray(after)  # sums over few classes run along n
    p_after = normalise(after)
    p_before = normalise(before.T[:, known].T)
    drift = np.zeros(len(known))
    drift[known] = js_divergence(p_after.T[:, known].T, p_before)
    return drift, p_after.max(axis=1), p_before.max(axis=1), entropy_bits(p_after), entropy_bits(p_before)


class MapTotal:
    """Running totals over the voxels of a map of K classes: no work that grows with the map."""

    def __init__(self, num_classes: int) -> None:
        self.num_classes = num_classes
        self.voxels = 0
        self.recurrent = 0
        self.vss = 0.0
        self.entropy = 0.0
        """In bits."""

    def add(self, frame: int, change: Change, started: float, associated: float = math.nan) -> FrameReport:
        """Account for a frame that went into the map just now, and report it.

        started, associated  `time.perf_counter()` when its fusion began, and when its pixels had become observations
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
            map_vss=self.vss / n,
            map_entropy=self.entropy / n / math.log2(self.num_classes),
            map_recurrent=self.recurrent / n,
            association_seconds=associated - started,
            update_seconds=finished - associated,
        )
