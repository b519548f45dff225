"""Observers of a run or a study, such as the progress bar, the recording and the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from semstab.backends import FusionBackend
    from semstab.check import Verdict
    from semstab.config import Config
    from semstab.data.frames import Frame
    from semstab.data.records import Record, RegionFlicker, Result
    from semstab.data.results import UnitName
    from semstab.data.voxels import VoxelTable
    from semstab.engine.series import FrameRow
    from semstab.engine.units import Plan, Unit
    from semstab.task import Task


class Observer:
    """An observer of a run; override what is of interest.

    An observer sees frames and live maps of the units at the base settings, by whatever backend, that are fused whole
    in this process: not of those in tiles, and not of those that other processes or machines fuse.
    Frames have their colour where an observer `wants_color`.
    """

    wants_color = False

    def run_started(self, plan: Plan, finished: Mapping[str, Record | RegionFlicker]) -> None:
        """Take note that the plan is made and nothing fused yet; an earlier start finished these units, by identity."""

    def geometry_checked(self, task: Task, verdict: Verdict) -> None:
        """Take note that depth and poses of the task's scene were compared, and do not contradict each other."""

    def group_started(self, task: Task, config: Config, backends: Mapping[UnitName, FusionBackend]) -> None:
        """Take note of the maps that the task's frames go into; `config` is that of the first of these units."""

    def frame_fused(self, task: Task, frame: Frame, rows: Mapping[UnitName, FrameRow]) -> None:
        """Take note that a frame went into all maps of the group; `frame` holds labels in the run's label space."""

    def advanced(self, frames: int, what: str) -> None:
        """Take note that `frames` frames went into a map, in any process; `what` names the unit."""

    def unit_finished(
        self, unit: Unit, record: Record | RegionFlicker | None, table: VoxelTable | None, error: str | None
    ) -> None:
        """Take note that a unit is computed and stored, or failed for the reason in `error`.

        The table holds its voxels if the unit is watched and was fused whole in this process.
        """

    def run_finished(self, result: Result) -> None:
        """Take note that the summary has been written."""

    def close(self) -> None:
        """Take note of the end, also after an interruption."""


class Observers:
    """Several observers as one; one that fails hears nothing more, and the run goes on without it."""

    def __init__(self, observers: Sequence[Observer] = ()) -> None:
        self._listening = list(observers)
        self.errors: list[Exception] = []

    @property
    def want_color(self) -> bool:
        """Return whether frames should have their colour."""
        return any(observer.wants_color for observer in self._listening)

    def tell(self, call: Callable[[Observer], None]) -> None:
        """Call it for each."""
        for observer in list(self._listening):
            try:
                call(observer)
            except Exception as error:  # noqa: BLE001 - raised once all else is done
                self._listening.remove(observer)
                self.errors.append(error)

    def raise_first(self) -> None:
        """Raise the error of the first one that failed."""
        if self.errors:
            raise self.errors[0]
