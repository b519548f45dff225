"""What the frames of a unit see: looked at by threads of this process, or by an executor's workers elsewhere."""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import dataclass

from semstab.config import Config
from semstab.engine.folder import Folder
from semstab.engine.observer import Observers
from semstab.engine.tiling.collected import Seen
from semstab.engine.tiling.sights import SIGHTS, Looking, Sights, look_at, origin_of, sights_of
from semstab.engine.tiling.stretches import stretches_of
from semstab.engine.units import PlannedUnit
from semstab.engine.work.executors import Executor
from semstab.engine.work.jobs import Job, Request
from semstab.errors import DataError


@dataclass(frozen=True)
class Survey:
    """Who looks: workers of `executor`, where they may be on other machines, and else threads of this one.

    start  of the run in the folder
    """

    executor: Executor
    folder: Folder
    start: str

    def sights(self, planned: PlannedUnit, settings: Config, cell: int, key: str) -> Sights:
        """By cells of that edge, kept under that key. Raises DataError as `look_at` does."""
        file = self.folder.path / SIGHTS / f"{key}.npz"
        if (kept := Sights.load(file)) is not None:
            return kept
        if self.executor.remote:
            found = self._from_workers(planned, settings, cell, f"{SIGHTS}/{key}")
        else:
            found = look_at(planned.task, settings.voxel_size, settings.pixel_stride, cell, settings.threads)
        found.save(file)
        shutil.rmtree(file.with_suffix(""), ignore_errors=True)
        return found

    def _from_workers(self, planned: PlannedUnit, settings: Config, cell: int, folder: str) -> Sights:
        """Stretch by stretch, each kept in that folder until all are there."""
        frames, origin = planned.task.indices, origin_of(planned.task, settings.voxel_size, settings.pixel_stride)
        stretches = stretches_of(frames, origin, lead=0, width=self.executor.width)
        tasks = {f"{folder}/{each.name}.npz": each.frames for each in stretches}
        there = {name: seen for name in tasks if (seen := Seen.load(self.folder.path / name)) is not None}
        unit, whole = planned.unit, Request.of(planned)
        jobs = [
            Job(
                unit.scene,
                unit.backbone,
                (whole.looking_at(frames, Looking(name, origin, cell)),),
                self.start,
                self.folder.path,
                settings.threads,
            )
            for name, frames in tasks.items()
            if name not in there
        ]
        with contextlib.closing(self.executor.run(jobs, Observers([]))) as finished:
            for job, (outcome,) in finished:
                if outcome.error is not None:
                    raise DataError(outcome.error)
                self.folder.save_files(outcome)
                looking = job.requests[0].looking
                assert looking is not None
                seen = Seen.load(self.folder.path / looking.file)
                if seen is None:
                    raise DataError(f"{self.folder.path / looking.file}: is not in the folder; start it again")
                there[looking.file] = seen
        return sights_of((there[name] for name in tasks), origin, cell)
