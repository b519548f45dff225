"""VSS, SBD, OP and entropy: one value a voxel (paper, Voxel-Level Stability Metrics)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from semstab.information import entropy_bits, normalise
from semstab.voxels import VoxelTable

Float64 = npt.NDArray[np.float64]


def vss(table: VoxelTable) -> Float64:
    """Voxel Semantic Stability (n,): max_k e_k / sum_k e_k, in [1/K, 1]; read it with OP."""
    concentration: Float64 = table.evidence.max(axis=1) / table.evidence.sum(axis=1)
    return concentration


def sbd(table: VoxelTable) -> Float64:
    """Semantic Belief Drift (n,): mean over t = 2..T of D_JS(p^(t), p^(t-1)), bits, in [0, 1]; NaN where OP < 2."""
    return mean_drift(table.drift_sum, table.op)


def mean_drift(drift_sum: Float64, op: npt.NDArray[np.int32]) -> Float64:
    """SBD (n,) from the summed drift in bits (n,) and OP (n,); see `sbd`."""
    drift = np.full(len(op), np.nan)
    again = op >= 2
    drift[again] = drift_sum[again] / (op[again] - 1)
    return drift


def op(table: VoxelTable) -> npt.NDArray[np.int32]:
    """Observation Persistence (n,): the number of frames that observed the voxel."""
    return table.op


def entropy(table: VoxelTable) -> Float64:
    """Normalised entropy (n,): -sum_k p_k log p_k / log K, in [0, 1]; report it together with K."""
    normalised: Float64 = entropy_bits(normalise(table.evidence)) / math.log2(table.K)
    return normalised


def dominant(table: VoxelTable) -> npt.NDArray[np.int64]:
    """Dominant class (n,): argmax_k e_k, the lowest on ties."""
    label: npt.NDArray[np.int64] = table.evidence.argmax(axis=1)
    return label
