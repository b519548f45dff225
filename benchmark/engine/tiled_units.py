"""The units of a start that are fused in tiles: some from its beginning, others since they outgrew the memory."""

from __future__ import annotations

import concurrent.futures as cf
import itertools
import logging
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

from semstab.config import Config
from semstab.engine.folder import Folder, unit_key
from semstab.engine.observer import Observers
from semstab.engine.sizing import Survey, begun_again
from semstab.engine.tiling.again import SeenAgain
from semstab.engine.tiling.partition import Part, Tiling
from semstab.engine.tiling.portion import PART, STRETCH, Finished
from semstab.engine.units import Planned, PlannedUnit
from semstab.engine.work.assembly import Joined, Sampled, assembled, joined, second_looks
from semstab.engine.work.jobs import Job, Outcome, Request, failed, split
from semstab.engine.work.memory import GB
from semstab.engine.work.passes import look_again
from semstab.errors import DataError, OutgrownError, SemstabError
from semstab.statistics.sums import Whole

# What this process puts together while others do the work.

T = TypeVar("T")


class Beside:
    """One call after the other, in a thread beside where others do the work; at once where this process does it."""

    def __init__(self, *, threaded: bool = False) -> None:
        self._pool = cf.ThreadPoolExecutor(1) if threaded else None

    def submit(self, call: Callable[[], T]) -> cf.Future[T]:
        """What it will return, or raise."""
        if self._pool is not None:
            return self._pool.submit(call)
        future = cf.Future[T]()
        try:
            future.set_result(call())
        except SemstabError as error:
            future.set_exception(error)
        return future


# A unit in tiles while its portions are worked off: what is there, what is missing, and the unit once all is there.

MORE = 1.5
"""A part that is expected to take so many times its share is cut before it is begun; a share leaves that much room."""


class TiledUnit:
    """What an earlier start finished of it is kept, if the unit is still cut in the same way.

    A part that turned out larger than there is memory for it is cut in two, and so are those that would, judged by how
    many voxels the parts before had, of how many were expected. Where several tasks share the parts, the largest are
    first, and the last one of each is cut in two as well: none is left with a large one when the others are done.
    What needs no part, or no second look at one, is put together `beside` those who are at them.

    key  under which its portions are kept
    """

    def __init__(
        self, planned: PlannedUnit, tiling: Tiling, folder: Folder, width: int = 1, beside: Beside | None = None
    ) -> None:
        self.planned, self._folder, self._tiling = planned, folder, tiling
        self._beside = beside or Beside()
        self.key = unit_key(planned.identity, planned.digest)
        self._there: dict[str, Finished] = {}
        there = folder.portions(self.key)
        whole = self._evened(Request.portions(planned, self.key, tiling, width), width, there)
        requests = [each for request in whole for each in self._as_cut(request, there - {_name(one) for one in whole})]
        self._requests = {_name(request): request for request in requests}
        self._whole: Whole | None = None
        self._second: dict[str, Request] | None = None  # looks at the parts, once all of them are there
        self._again: dict[str, SeenAgain] = {}
        for name in self._requests.keys() & there:
            if (found := folder.portion(self.key, name)) is not None:
                self._there[name] = found.without_rows()
        self._failed = False
        self._sampled: cf.Future[Sampled] | None = None  # what all frames tell, once they are looked at
        self._joined: cf.Future[Joined] | None = None  # what all portions come to
        self._waiting = [request for name, request in self._requests.items() if name not in self._there]
        if width > 1:
            self._waiting.sort(key=self._turn)
        folder.clear(planned, {name for each in self._there.values() for name in each.about.files})
        shares = itertools.pairwise(k * planned.frames // len(self._requests) for k in range(len(self._requests) + 1))
        self._steps = iter([last - first for first, last in shares])
        self.kept = sum(next(self._steps) for _ in self._there)

    @property
    def name(self) -> str:
        """What the progress calls it."""
        return f"{self.planned.unit.scene} · {self.planned.unit.backbone}"

    @property
    def finished(self) -> list[str]:
        """Names of its portions that are."""
        return [*self._there]

    def step(self) -> int:
        """The frames that the portion which is finished now stands for."""
        return next(self._steps, 0)

    def next_request(self) -> Request | None:
        """What is to be begun next; None where there is nothing, until what is finished calls for more."""
        while self._waiting and not self._failed:
            request = self._waiting.pop(0)
            if self._expected(request) <= MORE * self._tiling.budget or not self._cut(request):
                return request
        return None

    def take(self, outcome: Outcome | None) -> Outcome | None:
        """One more portion, None for nothing new; the unit's own outcome where it failed, or all are there."""
        name = None if outcome is None else outcome.portion
        if outcome is not None and name is not None and outcome.error is None:
            if self._second is not None:
                self._again[name] = outcome.again or self._look_again(self._second[name])
            elif (error := self._keep(outcome, name)) is not None:
                return error
        elif outcome is not None and name is not None and outcome.outgrown and name in self._requests:
            if not self._cut(self._requests[name]):
                more = f", or set a smaller --tile-size: part {name} is a single tile"
                return self._error(name, OutgrownError(f"{outcome.error}{more}"))
        elif outcome is not None:
            self._failed = True
            return outcome
        if len(self._there) < len(self._requests):
            self._look_ahead()
            return None
        return self._ended()

    def _keep(self, outcome: Outcome, name: str) -> Outcome | None:
        """A finished portion; why the unit failed, where it cannot be kept."""
        self._folder.save_files(outcome)
        found = self._folder.portion(self.key, name)
        if found is None:
            return self._error(name, f"part {name} is not in the folder; start it again")
        self._there[name] = found.without_rows()
        return None

    def _ended(self) -> Outcome | None:
        """The unit's own outcome, once all parts have been looked at again, which is asked for first."""
        finished = {name: self._there[name] for name in self._requests}  # sums do not hang on who was first
        try:
            self._look_ahead()
            assert self._sampled is not None
            sampled = self._sampled.result()
            if self._second is None:
                parts = {name: each for name, each in finished.items() if each.about.kind == PART}
                self._whole, looks = second_looks(self.planned, parts, sampled)
                self._waiting = Request.of(self.planned).looking_again(looks)
                self._second = {each.name: request for each, request in zip(looks, self._waiting, strict=True)}
                together = partial(joined, self.planned, finished, self._loaded, self._folder.path, sampled)
                self._joined = self._beside.submit(together)
            if len(self._again) < len(self._second):
                return None
            assert self._joined is not None
            again = [self._again[name] for name in self._second]
            own = self._joined.result()
            content = assembled(self.planned, finished, own, self._folder.path, sampled, self._whole, again)
            return Outcome(self.planned.identity, content)
        except SemstabError as error:
            return failed([*self._requests.values()][:1], error)[0]

    def _loaded(self, name: str) -> Finished:
        """A portion with what it has of each frame. Raises DataError where it is gone meanwhile."""
        if (found := self._folder.portion(self.key, name)) is None:
            raise DataError(f"{self.name}: part {name} is no longer in the folder as it was; start it again")
        return found

    def _look_again(self, request: Request) -> SeenAgain:
        """Here, where the worker does not see the folder."""
        assert request.again is not None
        return look_again(request.again, self._folder.path)

    def _look_ahead(self) -> None:
        """Prepare what all frames tell, once they are looked at, while others fuse the parts."""
        frames = [name for name, request in self._requests.items() if _kind(request) == STRETCH]
        if self._sampled is None and self._there.keys() >= set(frames):
            stretches = [self._there[name] for name in frames]
            self._sampled = self._beside.submit(partial(Sampled.of, stretches, self._folder.path))

    def _evened(self, requests: list[Request], width: int, there: Collection[str]) -> list[Request]:
        """With the smallest parts cut in two, one for each of several tasks: the same ones whenever it is started."""
        parts = sorted((each for each in requests if _kind(each) == PART), key=self._expected)
        last = {_name(each) for each in parts[:width]} - {*there} if 1 < width < len(parts) else set[str]()
        return [half for each in requests for half in (self._halves(each) if _name(each) in last else ()) or (each,)]

    def _turn(self, request: Request) -> tuple[bool, bool, float]:
        """Stretches first, as what they tell is put together meanwhile; then parts, the largest first."""
        return _kind(request) != STRETCH, _kind(request) != PART, -self._expected(request)

    def _as_cut(self, request: Request, names: Collection[str]) -> list[Request]:
        """A part as an earlier start cut it, where something of that is there."""
        part = _part(request)
        if not names or part is None:
            return [request]
        halves = [each for half in self._tiling.halves(part) for each in self._as_cut(request.of_part(half), names)]
        return halves if any(_name(half) in names for half in halves) else [request]

    def _cut(self, request: Request) -> bool:
        """Put a part's halves in its place, to be begun next; not where it is a single tile."""
        halves = self._halves(request)
        if halves:
            parts = ((each,) if each is not request else halves for each in self._requests.values())
            self._requests = {_name(each): each for some in parts for each in some}
            self._waiting[:0] = halves
        return bool(halves)

    def _halves(self, request: Request) -> list[Request]:
        """Of a part; none of a single tile, or of what is no part."""
        part = _part(request)
        return [] if part is None else [request.of_part(half) for half in self._tiling.halves(part)]

    def _expected(self, request: Request) -> float:
        """Bytes that it takes, by what is known by now; 0 of what is no part."""
        if (part := _part(request)) is None:
            return 0.0
        done = [(_part(self._requests[name]), found.about.voxels) for name, found in self._there.items()]
        known = [(each.voxels, came) for each, came in done if each is not None]
        planned, came = sum(one for one, _ in known), sum(one for _, one in known)
        return self._tiling.bytes(part) * max(1.0, came / max(planned, 1))

    def _error(self, portion: str, error: str | OutgrownError) -> Outcome:
        self._failed = True
        return failed([self._requests[portion]], error)[0]


def _name(request: Request) -> str:
    assert request.portion is not None
    return request.portion.name


def _kind(request: Request) -> str:
    assert request.portion is not None
    return request.portion.kind


def _part(request: Request) -> Part | None:
    return None if request.portion is None else request.portion.part


# The jobs of a start as they come up: whole units, and portions of those in tiles.


class Waiting(Iterator[Job]):
    """What is still to be begun; where there is nothing, there may be again once what is at work has finished."""

    def __init__(self, config: Config, folder: Path, start: str) -> None:
        self._config, self._folder, self._start = config, folder, start
        self._whole = deque[Job]()
        self._tiled: list[TiledUnit] = []

    def add_whole(self, units: Sequence[Planned], width: int) -> None:
        """Units that are fused at once, for so many tasks.

        By the sequence that they read; scene by scene, for what a scene's backbones share stays at hand.
        """
        sequences: dict[tuple[str, str], list[Request]] = {}
        for each in units:
            sequences.setdefault((each.unit.scene, each.unit.backbone), []).append(Request.of(each))
        jobs = [self._job(*sequence, tuple(requests)) for sequence, requests in sequences.items()]
        self._whole.extend(split(jobs, width))

    def add_tiled(self, tiled: TiledUnit) -> None:
        """A unit in tiles."""
        self._tiled.append(tiled)

    def __next__(self) -> Job:
        if self._whole:
            return self._whole.popleft()
        for each in self._tiled:
            if (request := each.next_request()) is not None:
                unit = each.planned.unit
                return self._job(unit.scene, unit.backbone, (request,))
        raise StopIteration

    def _job(self, scene: str, backbone: str, requests: tuple[Request, ...]) -> Job:
        memory = None if self._config.memory_gb is None else self._config.memory_gb * GB
        return Job(scene, backbone, requests, self._start, self._folder, self._config.threads, memory)


class InTiles:
    """Puts them together, and begins them again where they turn out too large."""

    def __init__(self, config: Config, survey: Survey, waiting: Waiting, told: Observers) -> None:
        self._config, self._survey, self._waiting, self._told = config, survey, waiting, told
        self._units: dict[str, TiledUnit] = {}
        self._beside = Beside(threaded=survey.executor.elsewhere)

    def __contains__(self, identity: str) -> bool:
        return identity in self._units

    def begin(self, planned: PlannedUnit, tiling: Tiling) -> Outcome | None:
        """A unit; its own outcome where it has failed already."""
        tiled = TiledUnit(planned, tiling, self._survey.folder, self._survey.executor.width, self._beside)
        self._units[planned.identity] = tiled
        self._waiting.add_tiled(tiled)
        return tiled.take(None)

    def take(self, planned: Planned, outcome: Outcome) -> Outcome | None:
        """What became of a unit, or of a portion of one; the unit's own outcome, where it has come to its end."""
        tiled = self._units.get(planned.identity)
        if tiled is None:
            again = isinstance(planned, PlannedUnit) and outcome.outgrown
            return self._begin_again(planned, outcome) if again else outcome  # type: ignore[arg-type]
        if outcome.portion is None:
            return outcome
        if outcome.error is None:
            self._told.tell(lambda observer: observer.advanced(tiled.step(), tiled.name))
        return tiled.take(outcome)

    def _begin_again(self, planned: PlannedUnit, outcome: Outcome) -> Outcome | None:
        sizing = begun_again(self._config, planned, self._survey)
        for line in sizing.remarks:
            logging.getLogger("semstab").warning("%s", line)
        tiling = sizing.tilings.get(planned.identity)
        if tiling is None:
            return outcome
        return self.begin(planned, tiling)
