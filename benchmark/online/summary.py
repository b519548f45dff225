"""Define the numbers of a map that people track."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from semstab.data.measures import ENTROPY, SBD, VSS
from semstab.data.results import TableSummary
from semstab.data.statistics import UNKNOWN, MapStatistics


@dataclass(frozen=True)
class Summary:
    """The numbers of one map; NaN if undefined.

    Attributes:
        frames: Frames that were fused.
        voxels: Voxels of the map.
        alpha: Agreement of two views at the same spot beyond chance, at most 1: the number that the verdict rests on.
        alpha_low, alpha_high: Ends of its confidence interval.
        confidence: Confidence of that interval, 0 to 1.
        vss_op3, sbd_op3, entropy_op3: The paper's VSS, SBD in bits, and entropy, of the voxels with OP >= 3.
        psa_op2: Probability that two frames agree, of the voxels with OP >= 2.
        flicker: Percent of the co-visible pixels whose label changes from frame to frame, motion compensated.
        recurrent_share: Share of the voxels with OP >= 3, 0 to 1.
        verdict: The level.
        probability: Probability that the level is right.
        feature_alpha: Alpha of features, if frames have some; with its ends feature_alpha_low, feature_alpha_high.
    """

    NAMES: ClassVar = ("alpha", "vss_op3", "sbd_op3", "psa_op2", "flicker", "recurrent_share")

    frames: int
    voxels: int
    alpha: float
    alpha_low: float
    alpha_high: float
    confidence: float
    vss_op3: float
    sbd_op3: float
    entropy_op3: float
    psa_op2: float
    flicker: float
    recurrent_share: float
    verdict: str
    probability: float
    feature_alpha: float = math.nan
    feature_alpha_low: float = math.nan
    feature_alpha_high: float = math.nan

    @classmethod
    def from_statistics(cls, frames: int, table: TableSummary, statistics: MapStatistics, flicker: float) -> Summary:
        """Return the summary of a map's statistics."""
        verdict, alpha = statistics.verdict, statistics.headline.alpha
        of_features = UNKNOWN if statistics.features is None else statistics.features.alpha
        return cls(
            frames=frames,
            voxels=table.voxels,
            alpha=alpha.value,
            alpha_low=alpha.low,
            alpha_high=alpha.high,
            confidence=alpha.level,
            vss_op3=float(table.recurrent[VSS]),
            sbd_op3=float(table.recurrent[SBD]),
            entropy_op3=float(table.recurrent[ENTROPY]),
            psa_op2=statistics.agreement.psa_op2.value,
            flicker=flicker,
            recurrent_share=table.recurrent.share,
            verdict=verdict.decisive,
            probability=verdict.decisive_probability,
            feature_alpha=of_features.value,
            feature_alpha_low=of_features.low,
            feature_alpha_high=of_features.high,
        )

    def scalars(self) -> dict[str, float]:
        """Return the numbers that are logged every epoch, by name."""
        numbers = self.alpha, self.vss_op3, self.sbd_op3, self.psa_op2, self.flicker, self.recurrent_share
        return dict(zip(self.NAMES, numbers, strict=True))
