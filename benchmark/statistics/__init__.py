"""Stability at any number of observations, its null models, its uncertainty, and the accuracy of consistent voxels.

Pure functions of a VoxelTable and its Events. `describe` returns all statistics of one map;
docs/metrics.md derives each measure.

Examples:
    >>> table = semstab.load("run").table(model="sim-flicker")
    >>> 0.6 < float(semstab.statistics.psa(table)[table.op >= 2].mean()) < 1.0
    True
"""

from semstab.data.statistics import Estimate, Reliability
from semstab.statistics.agreement import (
    alpha,
    class_agreement,
    decompose,
    disagreement,
    fleiss_kappa,
    krippendorff_alpha,
    psa,
)
from semstab.statistics.correctness import consistent_wrong, correctness, join_truth, reliability
from semstab.statistics.correlogram import correlogram
from semstab.statistics.drift import expected_sbd, flips
from semstab.statistics.geometry import ceiling, losses, rendered
from semstab.statistics.map_statistics import Analysis, analyse, describe
from semstab.statistics.observations import SpotObservations, Views
from semstab.statistics.sample import MapSample
from semstab.statistics.sampler import Sampler
from semstab.statistics.verdict import verdict

__all__ = [
    "Analysis",
    "Estimate",
    "MapSample",
    "Reliability",
    "Sampler",
    "SpotObservations",
    "Views",
    "alpha",
    "analyse",
    "ceiling",
    "class_agreement",
    "consistent_wrong",
    "correctness",
    "correlogram",
    "decompose",
    "describe",
    "disagreement",
    "expected_sbd",
    "fleiss_kappa",
    "flips",
    "join_truth",
    "krippendorff_alpha",
    "losses",
    "psa",
    "reliability",
    "rendered",
    "verdict",
]
