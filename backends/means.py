"""Means over a growing map, kept from the voxels that each frame touched: no work that grows with the map."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from semstab.frames import Frame
from semstab.information import entropy_bits, js_divergence, normalise
from semstab.results import RECURRENT, FrameReport

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


class MapMeans:
    """Sums of VSS and entropy over the voxels of a map, and the counts of its voxels and of its recurrent ones."""

    def __init__(self) -> None:
        self.voxels = 0
        self.recurrent = 0
        self.vss_sum = 0.0
        self.entropy_sum = 0.0

    def update(self, before: Float64, after: Float64, op: Int64) -> Float64:
        """Account for a frame; return the drift D_JS(p^(t), p^(t-1)) of each touched voxel, bits, 0 for new ones.

        before, after  (n, K) evidence of the touched voxels before and after the frame; all 0 before the first
        op             (n,) observations including this one
        """
        seen = op > 1
        before, after = np.asfortranarray(before), np.asfortranarray(after)  # sums over few classes run along n
        p_after = normalise(after)
        p_before = normalise(before.T[:, seen].T)
        drift = np.zeros(len(op))
        drift[seen] = js_divergence(p_after.T[:, seen].T, p_before)
        log_k = math.log2(after.shape[1])
        self.voxels += int(np.count_nonzero(~seen))
        self.recurrent += int(np.count_nonzero(op == RECURRENT))
        self.vss_sum += float(p_after.max(axis=1).sum() - p_before.max(axis=1).sum())
        self.entropy_sum += float(entropy_bits(p_after).sum() - entropy_bits(p_before).sum()) / log_k
        return drift

    def report(self, frame: Frame, pixels: Int64, op: Int64, drift: Float64, seconds: float) -> FrameReport:
        """The frame's report, after `update`: its touched voxels' pixels, OP and drift (n,)."""
        n = max(self.voxels, 1)
        return FrameReport(
            frame=frame.index,
            points=int(pixels.sum()),
            voxels=len(pixels),
            new_voxels=int(np.count_nonzero(op == 1)),
            drift_sum=float(drift.sum()),
            seconds=seconds,
            map_voxels=self.voxels,
            map_vss=self.vss_sum / n if self.voxels else math.nan,
            map_entropy=self.entropy_sum / n if self.voxels else math.nan,
            map_recurrent=self.recurrent / n if self.voxels else math.nan,
        )
