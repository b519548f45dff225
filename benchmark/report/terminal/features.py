"""The answer on a model that gives features and no labels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from semstab.core.console import wrapped
from semstab.data.records import Record
from semstab.data.statistics import FeatureAgreement, LagBin, metres, short
from semstab.report.terminal.layout import percent

MOST_PLACES = 3
"""Most places that are told."""

WITHOUT = "no VSS, SBD, entropy, flicker, classes and verdict: they need labels"


def features_alone(features: FeatureAgreement, record: Record) -> Iterator[str]:
    """Yield alpha of features, by range, time and angle, the frames that stand out, and the worst places."""
    alpha = features.alpha
    ends = "" if math.isnan(alpha.low) else f" ({alpha.interval_name} {short(alpha.low)} to {short(alpha.high)})"
    yield f"  FEATURES    alpha {short(alpha.value)}{ends}    {features.components} components"
    fraction = f", 1 in {features.one_in} kept" if features.one_in > 1 else ""
    yield from wrapped(
        f"mean cosine {short(features.cosine)} of two views at one of {features.spots:,} spots{fraction},"
        f" {short(features.chance)} of any two"
    )
    yield from wrapped(WITHOUT)
    yield ""
    yield from feature_lines(features)
    recurrent = record.map_summary.recurrent
    yield f"  map  {record.map_summary.voxels:,} voxels, {percent(recurrent.share)} seen 3 times or more"
    yield ""


def feature_lines(features: FeatureAgreement) -> Iterator[str]:
    """Yield alpha by range, time and angle, the frames that stand out, and the worst places."""
    if assessed := [row for row in features.ranges if row.is_assessed]:
        by_range = ", ".join(f"{metres(row.low)} to {metres(row.high)} m {short(row.alpha.value)}" for row in assessed)
        yield from wrapped(f"alpha by range: {by_range}")
    views, degrees = features.correlogram.time, features.correlogram.angle
    if len(views) > 1:
        yield from wrapped(f"alpha by views apart: {_ends(views, 0)}")
    if len(degrees) > 1:
        yield from wrapped(f"alpha by angle between two views: {_ends(degrees, 1, ' degrees')}")
    if features.outlying_frames is not None and features.outlying_frames.frames:
        outliers = features.outlying_frames.frames
        more = f" and {len(outliers) - 3} more" if len(outliers) > 3 else ""
        listed = ", ".join(
            f"{outlier.name} (cosine {short(1 - 2 * outlier.share)}, others {short(1 - 2 * outlier.null)})"
            for outlier in outliers[:3]
        )
        yield from wrapped(f"frames that stand out: {listed}{more}")
    for place in features.places[:MOST_PLACES]:
        x, y, z = place.centre
        frames = ", ".join(map(str, place.frames))
        yield from wrapped(
            f"place at ({x:.1f}, {y:.1f}, {z:.1f}) m: cosine {short(place.cosine)},"
            f" {percent(place.share)} of the disagreement; frames {frames}"
        )


def _ends(bins: Sequence[LagBin], digits: int, unit: str = "") -> str:
    """Return '.93 at 1, .71 at 40': alpha of the nearest pairs and of the farthest."""
    return ", ".join(
        f"{short(lag_bin.alpha.value)} at {lag_bin.mean:.{digits}f}{unit}" for lag_bin in (bins[0], bins[-1])
    )
