"""The time series of a unit: one row a frame."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import Rows
from semstab.core.files import atomic_path
from semstab.core.types import Float64
from semstab.data.results import STAGES, FrameReport

FRAME_COLUMNS = (
    "frame", "timestamp", "points", "voxels", "new_voxels", "drift", "flicker_percent",
    "compensated_flicker_percent", "map_voxels", "map_vss",
    "map_entropy", "map_recurrent", "fuse_ms",
    "decode_ms", "wait_ms", "association_ms", "update_ms", "left_out",
)  # fmt: skip
"""The first columns of OUT/frames/*.csv; drift in bits; an undefined number is an empty field."""

OF_FRAMES = ("lone_percent", "lone_null_percent", "outlying")
"""The next ones, which follow from all frames (`semstab.statistics.frame_disagreement`); the last one is the name."""


@dataclasses.dataclass(frozen=True)
class FrameRow:
    """One row of a unit's time series: the backend's report, numbers of the frame itself, and seconds by stage.

    compensated_flicker_percent has the camera's motion removed (`ImageSpace`), NaN where that is not measured. left_out
    counts the pixels that were left out of fusion because they move; scores_left_out and most_scores_left_out are the
    mean and the largest share of a pixel's scores that `top_k` left out.
    """

    report: FrameReport
    timestamp: float | None
    flicker_percent: float
    compensated_flicker_percent: float = math.nan
    decode_seconds: float = math.nan
    network_seconds: float = math.nan
    wait_seconds: float = math.nan
    flicker_seconds: float = math.nan
    logging_seconds: float = math.nan
    left_out: int = 0
    scores_left_out: float = math.nan
    most_scores_left_out: float = math.nan

    def stage_ms(self) -> dict[str, float]:
        """Return the milliseconds of each of `STAGES`; NaN where it is not known."""
        seconds = vars(self.report) | vars(self)
        return {stage: 1e3 * seconds[f"{stage}_seconds"] for stage in STAGES}

    def cells(self) -> dict[str, Any]:
        """Return the row by column name, an undefined number as None."""
        row = vars(self.report) | vars(self) | {"drift": self.report.drift, "fuse_ms": self.report.seconds * 1e3}
        row |= {f"{stage}_ms": value for stage, value in self.stage_ms().items()}
        return {name: None if row[name] is None or row[name] != row[name] else row[name] for name in FRAME_COLUMNS}


REPORT, ROW = ([field.name for field in dataclasses.fields(cls)] for cls in (FrameReport, FrameRow))
NUMBERS = (*REPORT, *ROW[1:])
"""Columns of a row of numbers: fields of the report, then of the row; an undefined one is NaN."""

INTEGERS = ("frame", "points", "voxels", "new_voxels", "map_voxels", "left_out")


class Series:
    """The rows of a time series, stored as numbers; `numbers` (F, C) are the NUMBERS of the first ones."""

    def __init__(self, numbers: npt.ArrayLike = ()) -> None:
        self._rows = Rows(len(NUMBERS), numbers)

    @property
    def numbers(self) -> Float64:
        """(F, C) the NUMBERS of each row."""
        return self._rows.table()

    def column(self, name: str) -> Float64:
        """Return one of the NUMBERS of each row (F,)."""
        return self._rows.column(NUMBERS.index(name))

    @property
    def drift(self) -> Float64:
        """(F,) mean drift of each frame's updates; see `FrameReport.drift`."""
        updated = self.column("voxels") - self.column("new_voxels")
        with np.errstate(invalid="ignore"):
            drift: Float64 = np.where(updated, self.column("drift_sum"), np.nan) / updated
        return drift

    def append(self, row: FrameRow) -> None:
        """Add a frame."""
        values = vars(row.report) | vars(row)
        self._rows.append(values[name] for name in NUMBERS)

    def save_csv(
        self,
        path: Path,
        names: Callable[[int], str] = str,
        of_frames: Mapping[int, Mapping[str, float]] = MappingProxyType({}),
    ) -> None:
        """Write FRAME_COLUMNS, OF_FRAMES by index and the frames' names as text, with a header, atomically."""
        with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, (*FRAME_COLUMNS, *OF_FRAMES, "name"), lineterminator="\n")
            writer.writeheader()
            for row in self:
                index = row.report.frame
                writer.writerow(row.cells() | dict(of_frames.get(index, {})) | {"name": names(index)})

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._rows)

    def __iter__(self) -> Iterator[FrameRow]:
        """Yield the rows in turn."""
        return (self[k] for k in range(len(self)))

    def __getitem__(self, at: int) -> FrameRow:
        """Return a row."""
        values: dict[str, Any] = dict(zip(NUMBERS, self._rows.row(at), strict=True))
        values |= {name: int(values[name]) for name in INTEGERS}
        values["timestamp"] = None if math.isnan(values["timestamp"]) else values["timestamp"]
        report = FrameReport(**{name: values.pop(name) for name in REPORT})
        return FrameRow(report, **values)
