"""The statistics of a map; JSON has the names of the fields.

Undefined numbers are NaN; a section that could not be computed is None.
"""

from semstab.data.statistics.agreement import (
    ClassAgreement,
    ClassAlpha,
    Correlogram,
    FrameAgreement,
    LabelledPairs,
    LagBin,
    Meaning,
    MovingClasses,
    RangeAgreement,
    RangeStratum,
    SpotAgreement,
    metres,
)
from semstab.data.statistics.correctness import Correctness, CorrectnessStatistics, Losses, Quadrants, Reliability
from semstab.data.statistics.drift import DriftStatistics, Flipping, FlipRates, FrameDisagreement, OutlyingFrames
from semstab.data.statistics.features import FeatureAgreement, FeaturePlace
from semstab.data.statistics.groupings import Grouping, Groupings, Merge
from semstab.data.statistics.intervals import CONFIDENCE, UNDEFINED, UNKNOWN, Estimate, Interval, short, without_zero
from semstab.data.statistics.map_statistics import (
    ORDER_KNOWN,
    EntropyParts,
    HeadlineStatistics,
    Level,
    MapStatistics,
    Repeated,
    StabilityVerdict,
    StratumStatistics,
)
from semstab.data.statistics.moving import MisplacedFrame, MovedClass, MovedSpots, poses_that_do_not_fit
from semstab.data.statistics.visits import Across, TwoVisits, VisitedClass

__all__ = [
    "CONFIDENCE",
    "ORDER_KNOWN",
    "UNDEFINED",
    "UNKNOWN",
    "Across",
    "ClassAgreement",
    "ClassAlpha",
    "Correctness",
    "CorrectnessStatistics",
    "Correlogram",
    "DriftStatistics",
    "EntropyParts",
    "Estimate",
    "FeatureAgreement",
    "FeaturePlace",
    "FlipRates",
    "Flipping",
    "FrameAgreement",
    "FrameDisagreement",
    "Grouping",
    "Groupings",
    "HeadlineStatistics",
    "Interval",
    "LabelledPairs",
    "LagBin",
    "Level",
    "Losses",
    "MapStatistics",
    "Meaning",
    "Merge",
    "MisplacedFrame",
    "MovedClass",
    "MovedSpots",
    "MovingClasses",
    "OutlyingFrames",
    "Quadrants",
    "RangeAgreement",
    "RangeStratum",
    "Reliability",
    "Repeated",
    "SpotAgreement",
    "StabilityVerdict",
    "StratumStatistics",
    "TwoVisits",
    "VisitedClass",
    "metres",
    "poses_that_do_not_fit",
    "short",
    "without_zero",
]
