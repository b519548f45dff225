"""What each frame of a backbone on a scene did to the voxels: followed for the recorder, whichever backends fuse it."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.backends.numba_hash import NumbaHash, NumbaReport
from semstab.frames import Frame
from semstab.results import FrameReport


class Tracker:
    """Follows a map voxel by voxel: the run's own, where backend `numba` is in it, else one of its own."""

    def __init__(self, voxel_size: float, num_classes: int) -> None:
        self._new_map = functools.partial(NumbaHash, voxel_size, num_classes)
        self._map: NumbaHash | None = None
        self._drift = np.zeros(0, dtype=np.float32)  # of the frame that saw the voxel last
        self._total = np.zeros(0, dtype=np.float32)

    @property
    def map(self) -> NumbaHash:
        """The map that is followed."""
        if self._map is None:
            self._map = self._new_map()
        return self._map

    @property
    def total_drift(self) -> npt.NDArray[np.float32]:
        """Sum of each voxel's drift so far, bits."""
        return self._total[: len(self.map)]

    def follow(self, report: FrameReport) -> bool:
        """Follow the map that the report's frame went into, where that is possible; from the first frame or never."""
        if self._map is None and isinstance(report, NumbaReport):
            self._map = report.fused_into
        return isinstance(report, NumbaReport) and report.fused_into is self._map

    def integrate(self, frame: Frame) -> None:
        """Fuse the frame into the map of its own."""
        self.map.integrate(frame)

    def note(self) -> None:
        """Take down what the last frame did."""
        changes = self.map.changes
        self._drift, self._total = (_grown(array, len(self.map)) for array in (self._drift, self._total))
        self._drift[changes.row] = changes.drift
        self._total[changes.row] += np.nan_to_num(changes.drift)

    def drift_at(self, frame: Frame, stride: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
        """Drift in bits (H', W') that the last frame caused behind every stride-th pixel, and where there is a voxel.

        NaN where the voxel was not seen before.
        """
        rows = self.map.rows_at(frame, stride)
        drift: npt.NDArray[np.float32] = self._drift[rows] if len(self._drift) else np.zeros(rows.shape, np.float32)
        return drift, rows >= 0


def _grown(array: npt.NDArray[Any], size: int) -> npt.NDArray[Any]:
    """The array, with zeros behind it where it is too short; by quarters."""
    if size <= len(array):
        return array
    return np.concatenate([array, np.zeros(max(size, len(array) * 5 // 4) - len(array), dtype=array.dtype)])
