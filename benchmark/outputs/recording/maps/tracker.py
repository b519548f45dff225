"""What each frame of a backbone on a scene did to the voxels: followed for the recorder, whichever backends fuse it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.backends import GrowingMap
from semstab.backends.numba_hash import NumbaHash
from semstab.model.frames import Frame
from semstab.model.voxels.extent import Extent
from semstab.outputs.recording.kernels import find_voxels


class Tracker:
    """Follows a map voxel by voxel: one of the run, which fuses each frame anyway, or else one of its own."""

    def __init__(
        self, voxel_size: float, num_classes: int, of_the_run: GrowingMap | None = None, within: Extent | None = None
    ) -> None:
        self.map: GrowingMap = (
            of_the_run if of_the_run is not None else NumbaHash(voxel_size, num_classes, within=within)
        )
        """The map that is followed."""
        self._is_own = of_the_run is None

    def follow(self, frame: Frame) -> None:
        """All units have fused the frame: from here on it is in the map that is followed, too."""
        if self._is_own:
            self.map.integrate(frame)

    def drift_of(self, frame: Frame) -> FrameDrift:
        """What that frame, which went into the map last, did to the voxels that it saw."""
        changes = self.map.changes
        return FrameDrift(frame, changes.key.copy(), changes.drift, self.map.voxel_size, self.map.origin)


@dataclass(frozen=True, eq=False)
class FrameDrift:
    """The drift that a frame caused at each voxel that it saw, whatever becomes of the map.

    key    (n,) int64 packed voxel index, relative to the origin
    drift  (n,) float32 bits, NaN where the voxel was not seen before
    """

    frame: Frame
    key: npt.NDArray[np.int64]
    drift: npt.NDArray[np.float32]
    voxel_size: float
    origin: npt.NDArray[np.int64]

    def at(self, stride: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
        """Drift behind every stride-th pixel (H', W'), and where there is a voxel: where there is none, drift is 0."""
        found = self.voxels_at(stride)
        seen = found >= 0
        drift = np.zeros(found.shape, dtype=np.float32)
        drift[seen] = self.drift[found[seen]]
        return drift, seen

    def voxels_at(self, stride: int) -> npt.NDArray[np.int32]:
        """Which of the n voxels is behind every stride-th pixel (H', W'); -1 where a pixel does not count."""
        H, W = self.frame.shape
        camera, pick = self.frame.intrinsics, np.s_[::stride, ::stride]
        rays = (np.arange(W)[::stride] - camera.cx) / camera.fx, (np.arange(H)[::stride] - camera.cy) / camera.fy
        depth = np.where(self.frame.valid[pick], self.frame.depth[pick], np.float32(0))
        found = np.full(depth.shape, -1, dtype=np.int32)
        find_voxels(depth, *rays, np.array(self.frame.T_wc), self.voxel_size, self.origin, self.key, found)
        return found
