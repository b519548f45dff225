"""What the groups of tests have in common: a backend to test, and how to fuse with it."""

from __future__ import annotations

from typing import Any

import pytest

from semstab.backends import FusionBackend
from semstab.model.frames import Frame
from semstab.model.voxels import VoxelTable


class BackendTests:
    """Tests of the backend that `create` makes; BackendConformance says what the attributes mean."""

    tolerance: float = 1e-9
    voxel_share: float = 0.0
    reach: int = 2**31

    def create(self, voxel_size: float, num_classes: int) -> FusionBackend:
        """A new, empty map."""
        raise NotImplementedError("a subclass of BackendConformance says how its backend is made")

    def fuse(self, *frames: Frame, voxel_size: float = 1.0, K: int = 3) -> VoxelTable:
        """The map of these frames."""
        backend = self.create(voxel_size, K)
        for frame in frames:
            backend.integrate(frame)
        return backend.table()

    def near(self, value: Any) -> Any:
        """`value`, give or take the tolerance."""
        return pytest.approx(value, abs=self.tolerance)
