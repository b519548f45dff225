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
from semstab.statistics.blocks import BlockBootstrap, Blocks, spatial_blocks
from semstab.statistics.correctness import Truth, correctness, join_truth, quadrants, reliability, stable_wrong
from semstab.statistics.description import Analysis, analyse, describe
from semstab.statistics.looks import CellObservations, ObservationSample, Sampler, Views, correlogram, reach_of
from semstab.statistics.order.drift import Flips, VoxelDrift, expected_sbd, flips, voxel_drift
from semstab.statistics.order.fusion_rules import RULES, Fused, fuse
from semstab.statistics.order.p_values import benjamini_hochberg
from semstab.statistics.sample import MOST_VOXELS, MapSample
from semstab.statistics.scene_drift import SceneDrift, scene_drift
from semstab.statistics.verdict import ceiling, losses, rendered, verdict
from semstab.statistics.versus.backbones import compare_backbones
from semstab.statistics.versus.comparison import coverage, paired
from semstab.statistics.versus.differences import claimed_together
from semstab.statistics.versus.standard import standardised

__all__ = [
    "MOST_VOXELS",
    "RULES",
    "Analysis",
    "BackboneComparison",
    "BlockBootstrap",
    "Blocks",
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
    "reach_of",
    "reliability",
    "rendered",
    "scene_drift",
    "spatial_blocks",
    "stable_wrong",
    "standardised",
    "verdict",
    "voxel_drift",
]
