"""The paper's measures as pure functions of a voxel table, and what follows from them."""

from semstab.metrics.agreement import compare
from semstab.metrics.flicker import flicker_percent
from semstab.metrics.summary import summarise
from semstab.metrics.voxelwise import dominant, entropy, op, sbd, vss

__all__ = ["compare", "dominant", "entropy", "flicker_percent", "op", "sbd", "summarise", "vss"]
