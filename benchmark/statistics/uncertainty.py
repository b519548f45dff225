"""Where the entropy of a voxel's belief comes from: from within each frame, or from disagreement between frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.model.measures import entropy
from semstab.model.voxels import VoxelTable

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Normalised entropy of each voxel (n,) as a sum of two parts, all in units of log K, in [0, 1].

    within   mean entropy of the frames' own evidence: class borders, voxels larger than things, unsure scores
    between  generalised Jensen-Shannon divergence of the frames' evidence: their disagreement in time
    total    within + between, the entropy of the belief
    """

    within: Float64
    between: Float64
    total: Float64


def decompose(table: VoxelTable) -> Uncertainty:
    """Split the entropy: H(mean_t s_t) = mean_t H(s_t) + JSD(s_1, ..., s_T) (Lin 1991, IEEE TIT 37, equal weights).

    Between-frame entropy is 0 at OP = 1 and grows with OP for the very same predictions: compare it within a stratum.
    """
    total = entropy(table)
    within = table.frame_entropy_sum / table.op / math.log2(table.K)
    return Uncertainty(np.minimum(within, total), np.maximum(total - within, 0.0), total)
