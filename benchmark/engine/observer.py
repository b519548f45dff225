"""Who watches a run or a study, and what they are told: the progress bar, the recording, the report are observers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from semstab.backends import FusionBackend
    from semstab.check import Verdict
    from semstab.config import Config
    from semstab.engine.series import FrameRow
    from semstab.engine.tiling.partition import Part
    from semstab.engine.units import Plan, PlannedRegions, PlannedUnit
    from semstab.model.frames import Frame
    from semstab.model.records import Result
    from semstab.model.results import Unit, UnitSummary
    from semstab.model.voxels import VoxelTable
    from semstab.task import Task


class Observer:
    """Watches; override what is of interest.

    Of single frames and maps only the units at the base settings are told, by whatever backend, and only where they
    are fused: for work in other processes see `elsewhere`. Frames have their colour where an observer `wants_color`.
    """

    wants_color = False

    def run_started(self, plan: Plan, kept: Sequence[PlannedUnit | PlannedRegions]) -> None:
        """The plan is made, nothing is fused yet; `kept` was found finished in the folder."""

    def geometry_checked(self, task: Task, verdict: Verdict) -> None:
        """Depth and poses of the task's scene were compared, and do not contradict each other."""

    def group_kept(self, task: Task, summaries: Sequence[UnitSummary]) -> None:
        """These base units of a backbone on a scene were found finished."""

    def remarked(self, line: str) -> None:
        """Something is done otherwise than usual: a map that would not fit is fused in tiles."""

    def group_started(self, task: Task, config: Config) -> None:
        """The task's frames are fused from now on, by those of its backends that are not kept; `config` is a unit's."""

    def unit_started(self, unit: Unit, backend: FusionBackend) -> None:
        """The unit's frames go into this map from now on."""

    def frame_fused(self, unit: Unit, frame: Frame, row: FrameRow) -> None:
        """A frame went into a unit's map; `frame` holds labels in the run's label space."""

    def frame_finished(self, task: Task, frame: Frame) -> None:
        """A frame went into the maps of all units of the task."""

    def frame_ahead(self, task: Task, frame: Frame) -> None:
        """A frame before those of a map in tiles that are looked at next; it is looked at elsewhere."""

    def frame_seen(self, task: Task, frame: Frame) -> None:
        """A frame of a map in tiles was looked at; the tiles are fused by themselves."""

    def unit_in_tiles(self, unit: Unit, key: str, portions: Collection[str]) -> None:
        """It is fused in tiles from now on; parts and stretches of these names were finished by an earlier start.

        key  of its settings and its input
        """

    def part_started(self, task: Task, config: Config, part: Part, backend: FusionBackend) -> None:
        """The frames that see this part of the map in tiles of the task's unit go into it from now on."""

    def part_fused(self, frame: Frame) -> None:
        """A frame went into that part of a map."""

    def part_finished(self) -> None:
        """All frames that see it went into it; its map is measured and written next."""

    def unit_begun_again(self, unit: Unit) -> None:
        """It outgrew the memory: what went into its map is given up, and it is fused in tiles, from its first frame."""

    def unit_assembled(self, task: Task, summary: UnitSummary) -> None:
        """All tiles of a unit's map are in the folder, and measured."""

    def unit_fused(self, unit: Unit, table: VoxelTable) -> None:
        """All frames went into a unit's map, which is measured and written next."""

    def unit_finished(self, unit: Unit, table: VoxelTable, summary: UnitSummary) -> None:
        """A unit's map is measured and written."""

    def group_finished(self, task: Task) -> None:
        """All units of the task are measured."""

    def advanced(self, frames: int, what: str) -> None:
        """So many frames went into a map, whichever and wherever; `what` says into which."""

    def unit_done(self, unit: PlannedUnit | PlannedRegions, error: str | None) -> None:
        """A unit, of whatever settings, was computed and is kept, or failed."""

    def run_finished(self, result: Result) -> None:
        """The summary has been written."""

    def close(self) -> None:
        """The end, also after an interruption."""

    def elsewhere(self, folder: Path) -> Factory | None:
        """What makes an observer of the jobs that are done in other processes, and can be pickled; None for none."""


Factory = Callable[[], Observer]


class Observers:
    """Tells several of them; one that fails is told nothing more, and everything else goes on."""

    def __init__(self, observers: Sequence[Observer]) -> None:
        self._listening = list(observers)
        self.errors: list[Exception] = []

    @property
    def want_color(self) -> bool:
        """Whether frames should have their colour."""
        return any(observer.wants_color for observer in self._listening)

    def tell(self, what: Callable[[Observer], None]) -> None:
        """Call it for each."""
        for observer in list(self._listening):
            try:
                what(observer)
            except Exception as error:  # noqa: BLE001 - raised once all else is done
                self._listening.remove(observer)
                self.errors.append(error)

    def elsewhere(self, folder: Path) -> tuple[Factory, ...]:
        """What makes those observers that want to see what is done in other processes."""
        made = (observer.elsewhere(folder) for observer in self._listening)
        return tuple(factory for factory in made if factory is not None)

    def raise_first(self) -> None:
        """Raise what the first one that failed raised."""
        if self.errors:
            raise self.errors[0]
