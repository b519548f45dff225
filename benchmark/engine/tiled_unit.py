"""A unit in tiles while its portions are worked off: what is there, what is missing, and the unit once all is there."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Collection, Iterator

from semstab.engine.folder import Folder, unit_key
from semstab.engine.tiling.partition import Tiling
from semstab.engine.tiling.portion import Finished
from semstab.engine.units import PlannedUnit
from semstab.engine.work.assembly import Sampled, assembled
from semstab.engine.work.jobs import Outcome, Request, failed
from semstab.errors import OutgrownError, SemstabError

MORE = 1.5
"""A part that is expected to take so many times its share is cut before it is begun; a share leaves that much room."""


class TiledUnit:
    """What an earlier start finished of it is kept, if the unit is still cut in the same way.

    A part that turned out larger than there is memory for it is cut in two, and so are those that would, judged by how
    many voxels the parts before had, of how many were expected.
    """

    def __init__(self, planned: PlannedUnit, tiling: Tiling, folder: Folder, width: int = 1) -> None:
        self.planned, self._folder, self._tiling = planned, folder, tiling
        self._key = unit_key(planned.identity, planned.digest)
        whole = Request.portions(planned, self._key, tiling, width)
        there = folder.portions(self._key)
        requests = [each for request in whole for each in self._as_cut(request, there - {_name(one) for one in whole})]
        self._requests = {_name(request): request for request in requests}
        self._there: dict[str, Finished] = {}
        for name in self._requests.keys() & there:
            if (found := folder.portion(self._key, name)) is not None:
                self._there[name] = found
        self._failed = False
        self._sampled: Sampled | None = None
        self._waiting = [request for name, request in self._requests.items() if name not in self._there]
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

    def waiting(self) -> Iterator[Request]:
        """What is still to be begun, until there is nothing; more of it may come up meanwhile."""
        while self._waiting and not self._failed:
            request = self._waiting.pop(0)
            if self._expected(request) <= MORE * self._tiling.budget or not self._cut(request):
                yield request

    def take(self, outcome: Outcome | None) -> Outcome | None:
        """One more portion, None for nothing new; the unit's own outcome where it failed, or all are there."""
        if outcome is not None and outcome.portion is not None and outcome.error is None:
            self._folder.save_files(outcome)
            found = self._folder.portion(self._key, outcome.portion)
            if found is None:
                return self._error(outcome.portion, f"part {outcome.portion} is not in the folder; start it again")
            self._there[outcome.portion] = found
        elif outcome is not None and outcome.portion is not None and outcome.outgrown:
            if not self._cut(self._requests[outcome.portion]):
                more = f", or set a smaller --tile-size: part {outcome.portion} is a single tile"
                return self._error(outcome.portion, OutgrownError(f"{outcome.error}{more}"))
        elif outcome is not None:
            self._failed = True
            return outcome
        if len(self._there) == len(self._requests):
            return self._assembled()
        self._look_ahead()
        return None

    def _look_ahead(self) -> None:
        """Prepare what all frames tell, once they are looked at, while others fuse the parts."""
        portions = {name: request.portion for name, request in self._requests.items()}
        frames = {name for name, portion in portions.items() if portion is not None and portion.stretch is not None}
        if self._sampled is None and frames <= self._there.keys():
            with contextlib.suppress(SemstabError):  # raised again where the unit is put together
                self._sampled = Sampled.of(
                    [self._there[name] for name in portions if name in frames], self._folder.path
                )

    def _as_cut(self, request: Request, names: Collection[str]) -> list[Request]:
        """A part as an earlier start cut it, where something of that is there."""
        part = None if request.portion is None else request.portion.part
        if not names or part is None:
            return [request]
        halves = [each for half in self._tiling.halves(part) for each in self._as_cut(request.of_part(half), names)]
        return halves if any(_name(half) in names for half in halves) else [request]

    def _cut(self, request: Request) -> bool:
        """Put a part's halves in its place, to be begun next; not where it is a single tile."""
        part = None if request.portion is None else request.portion.part
        halves = [] if part is None else [request.of_part(half) for half in self._tiling.halves(part)]
        if halves:
            parts = ((each,) if each is not request else halves for each in self._requests.values())
            self._requests = {_name(each): each for some in parts for each in some}
            self._waiting[:0] = halves
        return bool(halves)

    def _expected(self, request: Request) -> float:
        """Bytes that it takes, by what is known by now; 0 of what is no part."""
        if request.portion is None or request.portion.part is None:
            return 0.0
        done = [(self._requests[name].portion, found.about.voxels) for name, found in self._there.items()]
        known = [(each.part.voxels, came) for each, came in done if each is not None and each.part is not None]
        planned, came = sum(one for one, _ in known), sum(one for _, one in known)
        return self._tiling.bytes(request.portion.part) * max(1.0, came / max(planned, 1))

    def _error(self, portion: str, error: str | OutgrownError) -> Outcome:
        self._failed = True
        return failed([self._requests[portion]], error)[0]

    def _assembled(self) -> Outcome:
        identity = self.planned.identity
        finished = {name: self._there[name] for name in self._requests}  # sums do not hang on who was first
        try:
            return Outcome(identity, assembled(self.planned, finished, self._folder.path, self._sampled))
        except SemstabError as error:
            return failed([*self._requests.values()][:1], error)[0]


def _name(request: Request) -> str:
    assert request.portion is not None
    return request.portion.name
