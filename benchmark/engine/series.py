"""The time series of a unit: one row a frame."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Sequence
from typing import Any, overload

import numpy as np
import numpy.typing as npt

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
        seconds = vars(self.report) | vars(self)
        return {stage: 1e3 * seconds[f"{stage}_seconds"] for stage in STAGES}

    def cells(self) -> dict[str, Any]:
        """The row by column name, an undefined number as None."""
        row = vars(self.report) | {
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


REPORT = ("frame", "points", "voxels", "new_voxels", "drift_sum", "seconds", "map_voxels", "map_vss", "map_entropy",
          "map_recurrent", "association_seconds", "update_seconds")  # fmt: skip
ROW = ("timestamp", "flicker_percent", "decode_seconds", "wait_seconds", "flicker_seconds", "logging_seconds",
       "left_out", "scores_left_out", "most_scores_left_out")  # fmt: skip
NUMBERS = (*REPORT, *ROW)
"""What a row of numbers holds: fields of the report, then of the row; an undefined one is NaN."""

INTEGERS = ("frame", "points", "voxels", "new_voxels", "map_voxels")


class Series(Sequence[FrameRow]):
    """The rows of a time series, kept as numbers: as objects they would take ten times the memory.

    numbers  (F, C) of the first rows
    """

    def __init__(self, numbers: npt.NDArray[np.float64] | None = None) -> None:
        self._numbers = np.zeros((0, len(NUMBERS))) if numbers is None else numbers
        self._rows = len(self._numbers)

    @property
    def numbers(self) -> npt.NDArray[np.float64]:
        """(F, C) the NUMBERS of each row."""
        return self._numbers[: self._rows]

    def append(self, row: FrameRow) -> None:
        """One more frame."""
        if self._rows == len(self._numbers):
            room = np.zeros((max(64, 2 * self._rows), len(NUMBERS)))
            room[: self._rows] = self._numbers
            self._numbers = room
        report = (getattr(row.report, name) for name in REPORT)
        self._numbers[self._rows] = [*report, *(getattr(row, name) for name in ROW)]
        self._rows += 1

    def __len__(self) -> int:
        """The number of frames."""
        return self._rows

    @overload
    def __getitem__(self, at: int) -> FrameRow: ...
    @overload
    def __getitem__(self, at: slice) -> Sequence[FrameRow]: ...
    def __getitem__(self, at: int | slice) -> FrameRow | Sequence[FrameRow]:
        """A row, or some."""
        return Series(self.numbers[at]) if isinstance(at, slice) else _row(self.numbers[at].tolist())


def _row(numbers: Sequence[float]) -> FrameRow:
    values: dict[str, Any] = dict(zip(NUMBERS, numbers, strict=True))
    report = {name: int(values[name]) if name in INTEGERS else values[name] for name in REPORT}
    row = {name: values[name] for name in ROW} | {"left_out": int(values["left_out"])}
    row["timestamp"] = None if math.isnan(values["timestamp"]) else values["timestamp"]
    return FrameRow(FrameReport(**report), **row)
