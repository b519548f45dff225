"""What a run reports: the report of one fused frame, the summary of one unit, the agreement of two backends."""

from __future__ import annotations

import math
from dataclasses import dataclass

RECURRENT = 3
"""A voxel is recurrent where OP >= 3 (paper, Sensitivity to World-Space Association)."""


@dataclass(frozen=True)
class FrameReport:
    """What fusing one frame did. The map's means are those after the frame; NaN where a backend does not keep them.

    points           valid pixels ('sampled points')
    voxels           voxels the frame touched ('observations')
    new_voxels       of them, voxels seen for the first time
    drift_sum        sum over the other ones of D_JS(p^(t), p^(t-1)), bits
    seconds          wall-clock time of integrate
    map_voxels       voxels in the map
    map_vss          mean VSS over them
    map_entropy      mean normalised entropy over them
    map_recurrent    share of them with OP >= 3
    """

    frame: int
    points: int
    voxels: int
    new_voxels: int
    drift_sum: float
    seconds: float
    map_voxels: int
    map_vss: float = math.nan
    map_entropy: float = math.nan
    map_recurrent: float = math.nan

    @property
    def drift(self) -> float:
        """Mean drift of the frame's updates, bits a re-observed voxel; NaN where it met none."""
        updated = self.voxels - self.new_voxels
        return self.drift_sum / updated if updated else math.nan
