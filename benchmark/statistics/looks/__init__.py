"""Single looks at sampled voxels: what tells the model from geometry, near looks from far ones, for every run."""

from semstab.statistics.looks.reach import reach_of
from semstab.statistics.looks.sampler import Sample, Sampler, View

__all__ = ["Sample", "Sampler", "View", "reach_of"]
