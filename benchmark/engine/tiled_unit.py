"""A unit in tiles while its portions are worked off: what is there, what is missing, and the unit once all is there."""

from __future__ import annotations

import itertools

from semstab.engine.folder import Folder, unit_key
from semstab.engine.tiling.partition import Tiling
from semstab.engine.tiling.portion import Finished
from semstab.engine.units import PlannedUnit
from semstab.engine.work.assembly import assembled
from semstab.engine.work.jobs import Outcome, Request, failed
from semstab.errors import SemstabError


class TiledUnit:
    """What an earlier start finished of it is kept, if the unit is still cut in the same way."""

    def __init__(self, planned: PlannedUnit, tiling: Tiling, folder: Folder, width: int = 1) -> None:
        self.planned, self._folder = planned, folder
        self._key = unit_key(planned.identity, planned.digest)
        self._requests = {
            request.portion.name: request
            for request in Request.portions(planned, self._key, tiling, width)
            if request.portion is not None
        }
        self._there: dict[str, Finished] = {}
        for name in self._requests:
            if (found := folder.portion(self._key, name)) is not None:
                self._there[name] = found
        folder.clear(planned, {name for each in self._there.values() for name in each.about.files})
        shares = itertools.pairwise(k * planned.frames // len(self._requests) for k in range(len(self._requests) + 1))
        self._steps = iter([last - first for first, last in shares])
        self.kept = sum(next(self._steps) for _ in self._there)

    @property
    def name(self) -> str:
        """What the progress calls it."""
        return f"{self.planned.unit.scene} · {self.planned.unit.backbone}"

    def step(self) -> int:
        """The frames that the portion which is finished now stands for."""
        return next(self._steps, 0)

    def missing(self) -> list[Request]:
        """What is still to be computed."""
        return [request for name, request in self._requests.items() if name not in self._there]

    def take(self, outcome: Outcome | None) -> Outcome | None:
        """One more portion, None for nothing new; the unit's own outcome where it failed, or all are there."""
        if outcome is not None and outcome.error is not None:
            return outcome
        if outcome is not None and outcome.portion is not None:
            self._folder.save_files(outcome)
            found = self._folder.portion(self._key, outcome.portion)
            if found is None:
                return failed(
                    [self._requests[outcome.portion]],
                    f"{self.planned.unit.slug}: part {outcome.portion} is not in the folder; start it again",
                )[0]
            self._there[outcome.portion] = found
        if len(self._there) < len(self._requests):
            return None
        return self._assembled()

    def _assembled(self) -> Outcome:
        identity = self.planned.identity
        finished = {name: self._there[name] for name in self._requests}  # sums do not hang on who was first
        try:
            return Outcome(identity, assembled(self.planned, finished, self._folder.path))
        except SemstabError as error:
            return failed([*self._requests.values()][:1], error)[0]
