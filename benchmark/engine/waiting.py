"""The jobs of a start as they come up: whole units, and portions of those in tiles."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

from semstab.config import Config
from semstab.engine.observer import Factory
from semstab.engine.tiled_unit import TiledUnit
from semstab.engine.units import Planned
from semstab.engine.work.jobs import Job, Request, split
from semstab.engine.work.memory import GB
from semstab.model.results import Unit


class Waiting(Iterator[Job]):
    """What is still to be begun; where there is nothing, there may be again once what is at work has finished."""

    def __init__(self, config: Config, folder: Path, start: str, observers: Sequence[Factory]) -> None:
        self._config, self._folder, self._start, self._observers = config, folder, start, tuple(observers)
        self._whole = deque[Job]()
        self._tiled: list[TiledUnit] = []
        self._shown = set[tuple[str, str, str | None]]()

    def add_whole(self, units: Sequence[Planned], width: int) -> None:
        """Units that are fused at once, for so many tasks.

        By the sequence that they read; scene by scene, for what a scene's backbones share stays at hand.
        """
        sequences: dict[tuple[str, str], list[Request]] = {}
        for each in units:
            sequences.setdefault((each.unit.scene, each.unit.backbone), []).append(Request.of(each))
        jobs = [self._job(*sequence, tuple(requests), self._observers) for sequence, requests in sequences.items()]
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
                return self._job(unit.scene, unit.backbone, (request,), self._watching(unit, request))
        raise StopIteration

    def _watching(self, unit: Unit, request: Request) -> tuple[Factory, ...]:
        """Who is shown a portion: a job each, so that no two maps are in memory at once; frames are shown in one."""
        frames = (unit.scene, unit.backbone, None if request.stretch is None else request.stretch.name)
        seen = request.part is not None or (request.shown and frames not in self._shown)
        self._shown.add(frames)
        return self._observers if seen else ()

    def _job(self, scene: str, backbone: str, requests: tuple[Request, ...], observers: tuple[Factory, ...]) -> Job:
        memory = None if self._config.memory_gb is None else self._config.memory_gb * GB
        return Job(scene, backbone, requests, self._start, self._folder, self._config.threads, memory, observers)
