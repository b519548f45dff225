"""What is kept of a map as it grows, whatever holds its voxels: totals, and each frame's report made of them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.model.information import entropy_bits, js_divergence, normalise
from semstab.model.results import RECURRENT, FrameReport

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Change:
    """What one frame did to a map, summed over the voxels that it touched.

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
        seen = op > 1
        before, after = np.asfortranarray(before), np.asfortranarray(after)  # sums over few classes run along n
        p_after = normalise(after)
        p_before = normalise(before.T[:, seen].T)
        drift = np.zeros(len(op))
        drift[seen] = js_divergence(p_after.T[:, seen].T, p_before)
        return cls(
            points=int(pixels.sum()),
            voxels=len(op),
            new=int(np.count_nonzero(~seen)),
            drift=float(drift.sum()),
            vss=float(p_after.max(axis=1).sum() - p_before.max(axis=1).sum()),
            entropy=float(entropy_bits(p_after).sum() - entropy_bits(p_before).sum()),
            recurrent=int(np.count_nonzero(op == RECURRENT)),
        )


class MapTotal:
    """Totals over the voxels of a map of K classes, kept from frame to frame: no work that grows with the map."""

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
