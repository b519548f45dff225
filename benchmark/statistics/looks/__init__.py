"""Single looks at sampled voxels: what tells the model from geometry, near looks from far ones, for every run."""

from semstab.statistics.looks.common import Common, common
from semstab.statistics.looks.correlogram import correlogram
from semstab.statistics.looks.entries import CellObservations, ObservationSample
from semstab.statistics.looks.reach import reach_by, reach_from, reach_of
from semstab.statistics.looks.sampler import Sampler
from semstab.statistics.looks.views import Views

__all__ = [
    "CellObservations",
    "Common",
    "ObservationSample",
    "Sampler",
    "Views",
    "common",
    "correlogram",
    "reach_by",
    "reach_from",
    "reach_of",
]
