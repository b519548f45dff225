"""Stability whatever the number of observations, its null models, its uncertainty, and right beside stable.

Pure functions of a VoxelTable and its Events. `describe` says everything about one map, `compare_backbones` about
several; docs/metrics.md derives each measure.
"""

from semstab.model.contrast import BackboneComparison
from semstab.model.statistics import (
    ClassAgreement,
    Correctness,
    Estimate,
    Losses,
    MapStatistics,
    Quadrants,
    Reliability,
    StabilityVerdict,
)
from semstab.statistics.agreement import (
    Uncertainty,
    alpha_between,
    class_agreement,
    decompose,
    disagreement,
    fleiss_kappa,
    krippendorff_alpha,
    psa,
)
from semstab.statistics.correctness import Truth, correctness, join_truth, quadrants, reliability, stable_wrong
from semstab.statistics.correlogram import correlogram
from semstab.statistics.description import Analysis, analyse, describe
from semstab.statistics.drift import (
    Flips,
    SceneDrift,
    VoxelDrift,
    benjamini_hochberg,
    expected_sbd,
    flips,
    scene_drift,
    voxel_drift,
)
from semstab.statistics.fusion_rules import RULES, Fused, fuse
from semstab.statistics.model_comparison import compare_backbones, coverage, paired
from semstab.statistics.observations import CellObservations, ObservationSample, Views
from semstab.statistics.paired_differences import claimed_together, standardised
from semstab.statistics.sample import MOST_VOXELS, MapSample
from semstab.statistics.sampler import Sampler
from semstab.statistics.verdict import ceiling, ceiling_share, losses, rendered, verdict

__all__ = [
    "MOST_VOXELS",
    "RULES",
    "Analysis",
    "BackboneComparison",
    "CellObservations",
    "ClassAgreement",
    "Correctness",
    "Estimate",
    "Flips",
    "Fused",
    "Losses",
    "MapSample",
    "MapStatistics",
    "ObservationSample",
    "Quadrants",
    "Reliability",
    "Sampler",
    "SceneDrift",
    "StabilityVerdict",
    "Truth",
    "Uncertainty",
    "Views",
    "VoxelDrift",
    "alpha_between",
    "analyse",
    "benjamini_hochberg",
    "ceiling",
    "ceiling_share",
    "claimed_together",
    "class_agreement",
    "compare_backbones",
    "correctness",
    "correlogram",
    "coverage",
    "decompose",
    "describe",
    "disagreement",
    "expected_sbd",
    "fleiss_kappa",
    "flips",
    "fuse",
    "join_truth",
    "krippendorff_alpha",
    "losses",
    "paired",
    "psa",
    "quadrants",
    "reliability",
    "rendered",
    "scene_drift",
    "stable_wrong",
    "standardised",
    "verdict",
    "voxel_drift",
]
