"""The time series of a unit: one row a frame."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Sequence
from typing import Any

from semstab.model.results import STAGES, FrameReport

FRAME_COLUMNS = (
    "frame", "timestamp", "points", "voxels", "new_voxels", "drift", "flicker_percent", "map_voxels", "map_vss",
    "map_entropy", "map_recurrent", "fuse_ms",
    "decode_ms", "wait_ms", "association_ms", "update_ms", "left_out",
)  # fmt: skip
"""The columns of OUT/frames/*.csv; drift in bits; an undefined number is an empty field."""


@dataclasses.dataclass(frozen=True)
class FrameRow:
    """One row of a unit's time series: the backend's report, what the frame itself tells, and seconds by stage.

    left_out counts the pixels that were left out of fusion because what they show moves; scores_left_out and
    most_scores_left_out are the mean and the largest share of a pixel's scores that `top_k` left out. logging_seconds
    is known once the observers have seen the row.
    """

    report: FrameReport
    timestamp: float | None
    flicker_percent: float
    decode_seconds: float = math.nan
    wait_seconds: float = math.nan
    flicker_seconds: float = math.nan
    logging_seconds: float = math.nan
    left_out: int = 0
    scores_left_out: float = math.nan
    most_scores_left_out: float = math.nan

    def stage_ms(self) -> dict[str, float]:
        """Milliseconds of each of `STAGES`; NaN where it is not known."""
        seconds = dataclasses.asdict(self.report) | dataclasses.asdict(self)
        return {stage: 1e3 * seconds[f"{stage}_seconds"] for stage in STAGES}

    def cells(self) -> dict[str, Any]:
        """The row by column name, an undefined number as None."""
        row = dataclasses.asdict(self.report) | {
            "timestamp": self.timestamp,
            "flicker_percent": self.flicker_percent,
            "left_out": self.left_out,
            "drift": self.report.drift,
            "fuse_ms": self.report.seconds * 1e3,
            **{f"{stage}_ms": value for stage, value in self.stage_ms().items()},
        }
        return {name: None if row[name] is None or row[name] != row[name] else row[name] for name in FRAME_COLUMNS}


def to_csv(rows: Sequence[FrameRow]) -> str:
    """The rows as text, with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, FRAME_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(row.cells() for row in rows)
    return text.getvalue()
