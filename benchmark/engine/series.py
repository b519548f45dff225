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

from semstab.core.arrays import GrowingRows
from semstab.core.files import atomic_path
from semstab.core.types import Float64
from semstab.data.digests import require_unchanged
from semstab.data.measures import ENTROPY, RECURRENT, VSS
from semstab.data.results import STAGES, FrameReport
from semstab.errors import DataError, summarize_error


@dataclasses.dataclass(frozen=True)
class FrameColumn:
    """A column of OUT/frames/*.csv, and a time series of the recording.

    Attributes:
        key: A field of the report or the row, 'drift', or NAME_ms for NAME_seconds.
        plot: Title of its plot in the recording, with the unit; '' for a column that is not drawn.
        of_model: Whether it is the same for all backends; the others are of a map.
    """

    key: str
    plot: str = ""
    of_model: bool = False


COLUMNS = (
    FrameColumn("frame", of_model=True),
    FrameColumn("timestamp", of_model=True),
    FrameColumn("points", of_model=True),
    FrameColumn("voxels"),
    FrameColumn("new_voxels", "New voxels"),
    FrameColumn("drift", "Mean drift of updates (bits)"),
    FrameColumn("flicker_percent", "Pixel flicker (%)", of_model=True),
    FrameColumn("compensated_flicker_percent", "Flicker (%)", of_model=True),
    FrameColumn("map_voxels"),
    FrameColumn("map_vss_all", f"{VSS.word} so far, any OP (0 to {VSS.largest:g})"),
    FrameColumn("map_entropy_all", f"{ENTROPY.word} so far, any OP (0 to {ENTROPY.largest:g})"),
    FrameColumn("map_recurrent", f"Share OP >= {RECURRENT} so far (0 to 1)"),
    FrameColumn("fuse_ms", "Fusion (ms)"),
    FrameColumn("decode_ms", "Decoding, in a worker (ms)", of_model=True),
    FrameColumn("wait_ms", "Waiting for a frame (ms)", of_model=True),
    FrameColumn("association_ms", "Fusion: association (ms)"),
    FrameColumn("update_ms", "Fusion: update (ms)"),
    FrameColumn("left_out", of_model=True),
)
"""The first columns of the file, in order; drift in bits; an undefined number is an empty field."""

OF_FRAMES = ("lone_percent", "lone_null_percent", "outlying", "moving_percent")
"""The next ones, which follow from all frames (`semstab.statistics.frame_disagreement`); the last one is the name."""


@dataclasses.dataclass(frozen=True)
class FrameRow:
    """One row of a unit's time series: the backend's report, numbers of the frame itself, and seconds by stage.

    compensated_flicker_percent has the camera's motion removed (`ImageSpace`), or is NaN if not measured. left_out
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
        """Return the milliseconds of each of `STAGES`, or NaN if unknown."""
        return {stage: self[f"{stage}_ms"] for stage in STAGES}

    def __getitem__(self, key: str) -> Any:
        """Return the value of a column."""
        if key == "drift":
            return self.report.drift
        if key.endswith("_ms"):
            stage = key.removesuffix("_ms")
            return 1e3 * (self.report.seconds if stage == "fuse" else self[f"{stage}_seconds"])
        return getattr(self if hasattr(self, key) else self.report, key)

    def cells(self) -> dict[str, Any]:
        """Return the row by column, an undefined number as None."""
        row = {column.key: self[column.key] for column in COLUMNS}
        return {key: None if value is None or math.isnan(value) else value for key, value in row.items()}


REPORT, ROW = ([field.name for field in dataclasses.fields(cls)] for cls in (FrameReport, FrameRow))
NUMBERS = (*REPORT, *ROW[1:])
"""Columns of a row of numbers: fields of the report, then of the row; an undefined one is NaN."""

INTEGERS = ("frame", "points", "voxels", "new_voxels", "map_voxels", "left_out")


class Series:
    """The rows of a time series, stored as numbers; `numbers` (F, C) are the NUMBERS of the first ones."""

    def __init__(self, numbers: npt.ArrayLike = ()) -> None:
        self._rows = GrowingRows(len(NUMBERS), numbers)

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
        *,
        maps: bool = True,
    ) -> None:
        """Write COLUMNS, OF_FRAMES by index and the frames' names as text, with a header, atomically.

        Without `maps` the columns of a map are left out.
        """
        keys = [column.key for column in COLUMNS if maps or column.of_model]
        with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(
                file, (*keys, *OF_FRAMES, "name"), extrasaction="raise" if maps else "ignore", lineterminator="\n"
            )
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

    def __getitem__(self, index: int) -> FrameRow:
        """Return a row."""
        values: dict[str, Any] = dict(zip(NUMBERS, self._rows.row(index), strict=True))
        values |= {name: int(values[name]) for name in INTEGERS}
        values["timestamp"] = None if math.isnan(values["timestamp"]) else values["timestamp"]
        report = FrameReport(**{name: values.pop(name) for name in REPORT})
        return FrameRow(report, **values)


def read_cells(file: Path) -> list[dict[str, str]]:
    """Return the cells of each row of a file that `Series.save_csv` wrote, by column.

    Raises:
        DataError: If the file cannot be read, or has changed since the run wrote it.
    """
    require_unchanged(file)
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            return [*csv.DictReader(lines)]
    except (OSError, ValueError, csv.Error) as error:
        raise _damaged(file, error) from error


def read_names(file: Path) -> dict[int, str]:
    """Return the names of frames by their index, as a time series has them.

    Raises:
        DataError: As `read_cells` does.
    """
    cells = read_cells(file)
    try:
        return {int(row["frame"]): row.get("name") or row["frame"] for row in cells}
    except (LookupError, TypeError, ValueError) as error:
        raise _damaged(file, error) from error


def _damaged(file: Path, error: Exception) -> DataError:
    return DataError(f"{file}: cannot be read ({summarize_error(error)}); run it again")
