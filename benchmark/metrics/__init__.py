"""The paper's measures as pure functions of a voxel table, and what follows from them."""

from semstab.metrics.agreement import compare
from semstab.metrics.flicker import flicker_percent
from semstab.metrics.summary import macro_mean, pool, strata, summarise
from semstab.metrics.voxelwise import dominant, entropy, op, sbd, vss

__all__ = [
    "compare",
    "dominant",
    "entropy",
    "flicker_percent",
    "macro_mean",
    "op",
    "pool",
    "sbd",
    "strata",
    "summarise",
    "vss",
]
