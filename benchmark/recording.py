"""The rerun recording: a run's time series and its final voxels, for the rerun viewer. Only this module imports rerun.

Entities, for each scene:

    SCENE/series/COLUMN/BACKBONE/BACKEND   Scalars: a column of RUN/frames/*.csv (flicker_percent: no BACKEND)
    SCENE/map/BACKBONE/BACKEND/MEASURE     VoxelGridMap: class, vss, sbd, sbd_undefined, entropy, op
    SCENE/legend                           the classes and their colours
    SCENE/log                              TextLog: what a reader of the recording has to know
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
from semstab.frames import Frame
from semstab.labels import LabelSpace
from semstab.metrics import dominant, entropy, sbd, vss
from semstab.pipeline import Observer
from semstab.plan import Plan, Task
from semstab.results import RECURRENT, GroupResult, RunResult, Unit, UnitSummary
from semstab.run_folder import FrameRow
from semstab.voxels import VoxelTable

APPLICATION_ID = "semstab"
MAX_VOXELS = 2_000_000
"""A larger map is thinned, so that a laptop's viewer can draw it."""

SBD_MAX = 1.5 - 0.75 * math.log2(3)
"""The largest SBD there is, 0.311 bits: the second frame sees a class that the first one has not seen at all."""

SERIES = {
    "drift": "Mean drift of this frame's updates (bits)",
    "flicker_percent": "Flicker between consecutive frames (%)",
    "map_vss": "Mean VSS of the map so far",
    "map_entropy": "Mean normalised entropy of the map so far",
    "map_recurrent": f"Share of voxels with OP >= {RECURRENT} so far",
    "voxels": "Voxels touched by this frame",
    "new_voxels": "New voxels in this frame",
    "fuse_ms": "Fusion time (ms)",
}
"""The columns of RUN/frames/*.csv that become time series, and what their plots are called."""


@dataclass(frozen=True)
class Measure:
    """How a number per voxel is drawn: the same colour means the same value in every recording."""

    title: str
    colormap: rr.components.Colormap
    value_range: tuple[float, float]


MEASURES = {
    "vss": Measure("VSS (0 to 1)", rr.components.Colormap.Viridis, (0.0, 1.0)),
    "sbd": Measure(f"SBD (0 to {SBD_MAX:.2f} bits)", rr.components.Colormap.Inferno, (0.0, SBD_MAX)),
    "entropy": Measure("Entropy (0 to 1)", rr.components.Colormap.Inferno, (0.0, 1.0)),
    "op": Measure("OP (1 to 10 and more)", rr.components.Colormap.Viridis, (1.0, 10.0)),
}

# Okabe and Ito's colours without black: distinguishable with any colour vision, and on the viewer's dark ground.
LINE_COLORS = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167), (213, 94, 0), (0, 114, 178),
)  # fmt: skip
UNDEFINED_COLOR = (110, 110, 110)
BLOCK = 1000.0
"""Metres. Map origins are whole multiples of it, so that a scene near its world's origin keeps its coordinates."""


class Recording(Observer):
    """Writes what happens in a run into one .rrd file while it happens.

    The file is opened when the first frame is fused, so that a run of which everything was kept leaves the recording
    of its first start alone. Call `close` where the run does not come to its end.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._plan: Plan | None = None
        self._stream: rr.RecordingStream | None = None
        self._origins: dict[str, npt.NDArray[np.int64]] = {}
        self._notes: list[tuple[Task, str]] = []

    def run_started(self, plan: Plan) -> None:
        """Keep the plan, from which layout, names and colours follow."""
        self._plan = plan

    def frame_fused(self, unit: Unit, frame: Frame, row: FrameRow) -> None:
        """Log the frame's row of the time series."""
        stream = self._opened()
        _set_time(stream, frame.index, frame.timestamp)
        self._log_origin(stream, unit.scene, frame)
        first = _task(self._plan, unit).backends[0]
        cells = row.cells()
        for column in SERIES:
            if cells[column] is not None and (column != "flicker_percent" or unit.backend == first):
                stream.log(_series_path(column, unit), rr.Scalars(cells[column]))

    def unit_finished(self, unit: Unit, table: VoxelTable, summary: UnitSummary) -> None:
        """Log the unit's voxels at the time of its last frame, which is still set."""
        stream = self._opened()
        classes = _task(self._plan, unit).mapping.target
        for name, grid in _grids(table, classes, self._origins[unit.scene]):
            stream.log(_map_path(unit, name), grid)
        if (factor := _factor(table)) > 1:
            text = (
                f"{unit.backbone}, {unit.backend}: the map of {len(table):,} voxels is drawn by one voxel in each block"
                f" of {factor}x{factor}x{factor}; the run's folder holds all of them"
            )
            stream.log([unit.scene, "log"], rr.TextLog(text, level="WARN"))

    def group_kept(self, task: Task, result: GroupResult) -> None:
        """Say that the group is not in this recording."""
        backends = ", ".join(task.backends)
        self._notes.append((task, f"{task.backbone} ({backends}) was finished by an earlier start: not recorded again"))
        if self._stream is not None:
            self._log_notes(self._stream)

    def run_finished(self, result: RunResult) -> None:
        """Finish the file."""
        if not self.path.exists():
            self._opened()
        self.close()

    def close(self) -> None:
        """Write out what is pending and close the file; a second call does nothing."""
        if self._stream is not None:
            self._stream.flush()
            self._stream.disconnect()
            self._stream = None

    def _opened(self) -> rr.RecordingStream:
        if self._stream is None:
            assert self._plan is not None
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = rr.RecordingStream(APPLICATION_ID)
            # In place, not renamed when whole: a viewer can follow the run, and a killed run leaves what it recorded.
            self._stream.save(self.path)
            self._stream.set_log_tick_enabled(False)
            self._stream.set_log_time_enabled(False)
            self._stream.send_recording_name(self.path.stem if self.path.stem != "recording" else self.path.parent.name)
            self._stream.send_blueprint(blueprint(self._plan))
            _log_static(self._stream, self._plan)
            self._log_notes(self._stream)
        return self._stream

    def _log_notes(self, stream: rr.RecordingStream) -> None:
        for task, text in self._notes:
            _set_time(stream, task.indices[-1], None)
            stream.log([task.scene.name, "log"], rr.TextLog(text, level="INFO"))
        self._notes.clear()

    def _log_origin(self, stream: rr.RecordingStream, scene: str, frame: Frame) -> None:
        """Settle the scene's map origin, in voxels, by its first camera position."""
        if scene in self._origins or self._plan is None:
            return
        voxel_size = self._plan.config.voxel_size
        blocks = np.round(frame.T_wc[:3, 3] / BLOCK).astype(np.int64)
        self._origins[scene] = origin = blocks * round(BLOCK / voxel_size)
        if origin.any():
            x, y, z = origin * voxel_size
            text = f"map coordinates are relative to x = {x:.3f}, y = {y:.3f}, z = {z:.3f} m in the scene's world"
            stream.log([scene, "log"], rr.TextLog(text, level="INFO"))
