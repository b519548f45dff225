"""Any backend restricted to columns of voxels: of each frame it is shown the pixels that fall into them."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from semstab.backends.shared.association import Mask, pixels_held
from semstab.model.frames import Frame
from semstab.model.results import FrameReport
from semstab.model.voxels import Events, VoxelTable
from semstab.model.voxels.extent import Extent

if TYPE_CHECKING:
    from semstab.backends import FusionBackend


class Restricted:
    """A backend that has no restriction of its own, and associates pixel by pixel."""

    def __init__(self, backend: FusionBackend, voxel_size: float, within: Extent) -> None:
        self._backend = backend
        self._voxel_size = voxel_size
        self._within = within

    def integrate(self, frame: Frame) -> FrameReport:
        """Fuse what the frame shows of the columns."""
        depth = np.where(falling_into(self._within, frame, self._voxel_size), frame.depth, np.float32(0))
        return self._backend.integrate(dataclasses.replace(frame, depth=depth))

    def table(self) -> VoxelTable:
        """The voxels of the columns; a map in single precision may have put a pixel one voxel beyond."""
        table = self._backend.table()
        inside = self._within.holds(table.index.T)
        return table if inside.all() else table.rows(inside)

    def events(self) -> Events | None:
        """The log, where the backend keeps one."""
        return self._backend.events()


def falling_into(within: Extent, frame: Frame, voxel_size: float) -> Mask:
    """The pixels (H, W) with depth whose voxels are in the extent."""
    there: Mask = np.isfinite(frame.depth) & (frame.depth > 0)
    return pixels_held(frame, there, voxel_size, within.holds)
