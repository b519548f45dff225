"""The paper's measures as pure functions of a voxel table, and measures in the image.

Examples:
    >>> table = semstab.load("run").table(model="sim-flicker")
    >>> summary = semstab.metrics.summarise(table)
    >>> summary.voxels == len(table)
    True
"""

from semstab.data.measures import dominant, entropy, op, sbd, vss
from semstab.metrics.agreement import compare
from semstab.metrics.flicker import (
    CompensatedFlicker,
    RegionChange,
    SelfConsistency,
    VideoConsistency,
    changed_pixels,
    compensated_flicker,
    flicker_percent,
    matched_region_flicker,
)
from semstab.metrics.frame_quality import FrameQualityMeter
from semstab.metrics.summary import (
    CATEGORIES,
    CATEGORY_COLORS,
    NOT_ASSESSED,
    CategoryThresholds,
    categories,
    category_shares,
    macro_mean,
    pool,
    split_last,
    strata,
    summarise,
)
from semstab.metrics.temporal_consistency import TemporalConsistency, flow_by_depth, image_flow, occluded, warp_labels
from semstab.metrics.video_measures import VideoMeter

__all__ = [
    "CATEGORIES",
    "CATEGORY_COLORS",
    "NOT_ASSESSED",
    "CategoryThresholds",
    "CompensatedFlicker",
    "FrameQualityMeter",
    "RegionChange",
    "SelfConsistency",
    "TemporalConsistency",
    "VideoConsistency",
    "VideoMeter",
    "categories",
    "category_shares",
    "changed_pixels",
    "compare",
    "compensated_flicker",
    "dominant",
    "entropy",
    "flicker_percent",
    "flow_by_depth",
    "image_flow",
    "macro_mean",
    "matched_region_flicker",
    "occluded",
    "op",
    "pool",
    "sbd",
    "split_last",
    "strata",
    "summarise",
    "vss",
    "warp_labels",
]
