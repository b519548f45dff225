"""The numbers of one map that people track."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from semstab.model.measures import ENTROPY, SBD, VSS
from semstab.model.results import TableSummary
from semstab.model.statistics import MapStatistics


@dataclass(frozen=True)
class Summary:
    """The numbers of one map; NaN where undefined.

    vss3, sbd, entropy    the paper's: VSS of the voxels with OP >= 3, SBD in bits of those with OP >= 2, entropy of all
    psa, alpha            pairwise agreement of frames and Krippendorff's alpha, of the voxels with OP >= 2
    ceiling_share         what part of the alpha that geometry allows between frames is reached, 0 to 1
    flicker               percent of the co-visible pixels whose label changes from frame to frame, motion compensated
    op3_share             part of the voxels with OP >= 3, 0 to 1
    verdict, probability  the level, and how probable it is that it is right
    """

    NAMES: ClassVar = ("vss@3", "sbd", "psa", "alpha", "ceiling_share", "flicker", "op3_share")

    frames: int
    voxels: int
    vss3: float
    sbd: float
    entropy: float
    psa: float
    alpha: float
    ceiling_share: float
    flicker: float
    op3_share: float
    verdict: str
    probability: float

    @classmethod
    def of(cls, frames: int, table: TableSummary, statistics: MapStatistics, flicker: float) -> Summary:
        """From what a run says of a map."""
        share, agreement, verdict = statistics.ceiling_share, statistics.agreement, statistics.verdict
        return cls(
            frames=frames,
            voxels=table.voxels,
            vss3=float(table.recurrent[VSS]),
            sbd=float(table[SBD]),
            entropy=float(table[ENTROPY]),
            psa=agreement.psa.value,
            alpha=agreement.alpha.value,
            ceiling_share=math.nan if share is None else share.share.value,
            flicker=flicker,
            op3_share=table.recurrent.share,
            verdict=verdict.level,
            probability=verdict.probability,
        )

    def scalars(self) -> dict[str, float]:
        """Those that are logged every epoch, by name."""
        numbers = self.vss3, self.sbd, self.psa, self.alpha, self.ceiling_share, self.flicker, self.op3_share
        return dict(zip(self.NAMES, numbers, strict=True))
