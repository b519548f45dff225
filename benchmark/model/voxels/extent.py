"""A part of space that a map is restricted to: whole columns of voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Extent:
    """The voxels with low <= (ix, iy) < high, whatever their iz.

    origin  voxel of the first camera of the whole map, where that is known: soft scores are rounded as they are there
    """

    low: tuple[int, int]
    high: tuple[int, int]
    origin: tuple[int, int, int] | None = None

    def holds(self, index: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """Whether each of the voxels of these indices (3, n) is one of them: (n,)."""
        ix, iy = index[0], index[1]
        inside: npt.NDArray[np.bool_] = (ix >= self.low[0]) & (ix < self.high[0])
        inside &= (iy >= self.low[1]) & (iy < self.high[1])
        return inside
