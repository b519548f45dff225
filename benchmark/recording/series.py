"""Time series: the columns of RUN/frames/*.csv, and what follows from them."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from semstab.core.rows import Rows
from semstab.engine.units import Plan
from semstab.errors import DataError, one_line
from semstab.model.measures import ENTROPY, VSS
from semstab.model.results import RECURRENT, Unit
from semstab.recording.entities import LAST_DATE, Clock, path
from semstab.task import Task

SERIES = {
    "drift": "Mean drift of updates (bits)",
    "flicker_percent": "Flicker (%)",
    "compensated_flicker": "Flicker, motion-compensated (%)",
    "map_vss": f"Mean {VSS.word} so far (0 to {VSS.largest:g})",
    "map_entropy": f"Mean {ENTROPY.word} so far (0 to {ENTROPY.largest:g})",
    "map_recurrent": f"Share OP >= {RECURRENT} so far (0 to 1)",
    "new_voxels": "New voxels",
    "updated_voxels": "Updated voxels",
    "fuse_ms": "Fusion (ms)",
    "association_ms": "Fusion: association (ms)",
    "update_ms": "Fusion: update (ms)",
    "decode_ms": "Decoding, in a worker (ms)",
    "wait_ms": "Waiting for a frame (ms)",
}
"""Time series by name, and the titles of their plots. All but updated_voxels (voxels - new_voxels) and
compensated_flicker are columns of the CSV."""

PIECE = 1 << 16
"""Of a long series so many values are sent at a time."""

OF_THE_BACKBONE = ("flicker_percent", "compensated_flicker", "decode_ms", "wait_ms")
"""Series that are the same for all backends."""

# Okabe and Ito's colours without black: distinct with any colour vision, and on the viewer's dark ground.
LINE_COLORS = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167), (213, 94, 0), (0, 114, 178),
)  # fmt: skip


def values(cells: Mapping[str, Any]) -> dict[str, float]:
    """The series' values in a row of the CSV, without what is undefined."""
    row = {name: float(cells[name]) for name in SERIES if cells.get(name) not in (None, "")}
    return row | {"updated_voxels": float(cells["voxels"]) - float(cells["new_voxels"])}


def entity(name: str, unit: Unit) -> str:
    """The entity of a series."""
    backend = () if name in OF_THE_BACKBONE else (unit.backend,)
    return path(unit.scene, "series", name, unit.backbone, *backend)


def columns(unit: Unit, task: Task) -> list[str]:
    """The unit's series: what belongs to the backbone goes with its first backend."""
    return [name for name in SERIES if name not in OF_THE_BACKBONE or unit.backend == task.backends[0]]


def log_row(stream: rr.RecordingStream, unit: Unit, task: Task, row: Mapping[str, float]) -> None:
    """Log one frame's values at the stream's time."""
    for name in columns(unit, task):
        if name in row:
            stream.log(entity(name, unit), rr.Scalars(row[name]))


def send_rows(stream: rr.RecordingStream, unit: Unit, task: Task, file: Path, clock: Clock) -> list[dict[str, float]]:
    """Log a whole time series from its CSV; its least values, and its largest. Raises DataError where it is damaged."""
    found = Rows(2 + len(SERIES))
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            for row in csv.DictReader(lines):
                stamp = float(row["timestamp"]) if row["timestamp"] else math.nan
                cells = values(row)
                found.append([int(np.int64(int(row["frame"]))), stamp, *(cells.get(name, math.nan) for name in SERIES)])
    except (OSError, LookupError, TypeError, ArithmeticError, ValueError, csv.Error) as error:
        raise DataError(
            f"{file}: not a time series of a run ({one_line(error)}); delete the run folder's units/"
        ) from error
    frames, stamps = found.column(0).astype(np.int64), found.column(1)
    least, largest, wanted = {}, {}, columns(unit, task)
    for k, name in enumerate(SERIES, start=2):
        column = found.column(k)
        at = ~np.isnan(column)
        if not at.any():
            continue
        least[name], largest[name] = float(column[at].min()), float(column[at].max())
        dated = bool((np.abs(stamps[at]) <= LAST_DATE).all())
        for first in range(0, len(column) if name in wanted else 0, PIECE):
            some = first + np.flatnonzero(at[first : first + PIECE])
            known = [stamp if dated else None for stamp in stamps[some].tolist()]
            times = clock.columns(frames[some].tolist(), known)
            stream.send_columns(entity(name, unit), times, rr.Scalars.columns(scalars=column[some]))
    return [least, largest]


def log_styles(stream: rr.RecordingStream, plan: Plan) -> None:
    """Names, colours and widths of all lines."""
    units = list(dict.fromkeys((unit.backbone, unit.backend) for task in plan.tasks for unit in task.units))
    for task in plan.tasks:
        for unit in task.units:
            color = LINE_COLORS[units.index((unit.backbone, unit.backend)) % len(LINE_COLORS)]
            # Where backends agree their lines coincide; the viewer draws them by name, so each one is thinner.
            width = 2.0 + 2.5 * sum(backend > unit.backend for backend in task.backends)
            for name in columns(unit, task):
                label = unit.backbone if name in OF_THE_BACKBONE else f"{unit.backbone}, {unit.backend}"
                line = rr.SeriesLines(colors=color, names=label, widths=width)
                stream.log(entity(name, unit), line, static=True)
