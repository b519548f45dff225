"""One pass over a sequence: each frame is decoded once, and goes into the maps of all units that want it."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from semstab.backends import FusionBackend
from semstab.config import Config
from semstab.datasets import GROUND_TRUTH, Scene
from semstab.datasets.disk import file_digest
from semstab.errors import DataError
from semstab.evaluation import analyse_map, truth_task
from semstab.files import atomic_path
from semstab.frames import Frame
from semstab.json_form import to_json
from semstab.memory import available_bytes, require_memory
from semstab.pipeline import Stopwatch, flicker_between, new_map, require_voxels, unit_summary
from semstab.plan import Task, prepare, tasks_of
from semstab.prefetch import Fetched, prefetch
from semstab.results import slug
from semstab.run_folder import FrameRow, save_voxels
from semstab.study.image_space import ImageSpaceMeter
from semstab.study.jobs import Job, Outcome, Request, failed, message, shared_marker
from semstab.study.results import OVERVIEW, VOXELS
from semstab.up_axis import estimate_up
from semstab.voxels import VoxelTable

SHOWN_WIDTH = 1280
"""Pixels of the frame that is kept for figures."""


@dataclass(eq=False)
class _Map:
    """A unit that is being fused; `truth` takes the ground truth of the same frames, for statistics."""

    request: Request
    task: Task
    backend: FusionBackend
    truth: FusionBackend | None = None
    rows: list[FrameRow] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Decoded:
    """A frame as its scene has it, with its ground truth where that is wanted; or the error that came instead."""

    index: int
    frame: Frame | None = None
    truth: Frame | None = None
    error: Exception | None = None

    @property
    def nbytes(self) -> int:
        return sum(frame.nbytes for frame in (self.frame, self.truth) if frame is not None)


@dataclass(frozen=True, eq=False)
class _Prepared:
    """A frame ready to fuse, with its ground truth; its flicker in percent, and the seconds which that took."""

    frame: Frame
    truth: Frame | None
    flicker: float
    seconds: float


class _Stream:
    """Units that fuse the very same frames: those of one taxonomy, noise, pixel stride and selection of frames."""

    def __init__(self, maps: Sequence[_Map]) -> None:
        self.maps = list(maps)
        self.task = maps[0].task
        self.pixel_stride = maps[0].request.config.pixel_stride
        self.indices = frozenset(self.task.indices)
        self.previous: Frame | None = None
        self.image_space = ImageSpaceMeter() if any(one.request.image_space for one in maps) else None
        takes_truth = self.image_space is not None or any(one.truth is not None for one in maps)
        self.truth_task = truth_task(self.task) if takes_truth else None
        self.poses: list[Any] = []
        self.shown = self.task.indices[len(self.task.indices) // 2] if self.image_space is not None else None
        self.overview: dict[str, Any] = {}

    def next_frame(self, decoded: _Decoded) -> _Prepared:
        """The frame as the stream's units fuse it."""
        if decoded.error is not None:
            raise decoded.error
        assert decoded.frame is not None
        frame = prepare(self.task, decoded.frame, self.pixel_stride)
        with Stopwatch()("flicker") as lap:
            flicker = flicker_between(self.previous, frame)
        truth = self._truth(decoded)
        if self.image_space is not None:
            self.image_space.add(frame, truth)
        if decoded.index == self.shown:
            self.overview = _overview(self.task, decoded.frame)
        self.poses.append(frame.T_wc)
        self.previous = frame
        return _Prepared(frame, truth, flicker, lap.seconds)

    def _truth(self, decoded: _Decoded) -> Frame | None:
        if self.truth_task is None or decoded.truth is None:
            return None
        return prepare(self.truth_task, decoded.truth, self.pixel_stride)


class Pass:
    """A pass with as many maps as the memory bound allows; the requests of the others are put off to another one."""

    def __init__(self, job: Job, scene: Scene, requests: Sequence[Request]) -> None:
        self.job = job
        self.put_off: list[Request] = []
        self._scene = scene
        self._outcomes: list[Outcome] = []
        self._streams = _streams([one for request in requests for one in self._created(request)])
        self._memory_before = _resident_bytes()
        self._bound = available_bytes() / 2 if job.memory_bytes is None else job.memory_bytes

    def run(self) -> list[Outcome]:
        """Fuse and measure; the outcome of every unit that was not put off."""
        order = sorted(frozenset[int]().union(*(stream.indices for stream in self._streams)))
        decode = prefetch(self._decode, order, threads=self.job.threads, size=lambda decoded: decoded.nbytes)
        with contextlib.closing(decode) as frames:
            for index, fetched in zip(order, frames, strict=True):
                for stream in self._streams:
                    if stream.maps and index in stream.indices:
                        self._feed(stream, fetched)
                self._make_room()
        for stream in self._streams:
            while stream.maps:
                self._finish(stream, stream.maps.pop())
        return self._outcomes

    def _created(self, request: Request) -> list[_Map]:
        """An empty map for a unit; none where it fails."""
        with self._failing([request]):
            (task,) = tasks_of(self._scene, request.config)
            truth = _truth_map(request.config, task) if request.config.statistics else None
            return [_Map(request, task, _new_map(request.config, task), truth)]
        return []

    def _decode(self, index: int) -> _Decoded:
        """Decode a frame in a worker thread; an error fails the units that need the frame, not those that do not."""
        try:
            shown = any(stream.shown == index for stream in self._streams)
            frame = self._scene.frame(index, self.job.backbone, color=shown)
            wanted = any(stream.truth_task is not None and index in stream.indices for stream in self._streams)
            return _Decoded(index, frame, _ground_truth(self._scene, index) if wanted else None)
        except Exception as error:  # noqa: BLE001 - raised again by `_feed`
            return _Decoded(index, error=error)

    def _feed(self, stream: _Stream, fetched: Fetched[_Decoded]) -> None:
        """A frame into every map of a stream."""
        with self._failing([one.request for one in stream.maps]):
            now = stream.next_frame(fetched.item)
            frame = now.frame
            for one in stream.maps:
                with self._failing([one.request]):
                    if not one.rows:
                        require_memory(one.task, one.request.config, frame)
                        _warm_up(one, frame)
                    report = one.backend.integrate(frame)
                    row = FrameRow(
                        report, frame.timestamp, now.flicker, fetched.seconds, fetched.waited, now.seconds,
                        left_out=frame.left_out_pixels,
                    )  # fmt: skip
                    one.rows.append(row)
                    if one.truth is not None and now.truth is not None:
                        one.truth.integrate(now.truth)
        failed = {outcome.identity for outcome in self._outcomes}
        stream.maps = [one for one in stream.maps if one.request.identity not in failed]

    def _finish(self, stream: _Stream, one: _Map) -> None:
        """Measure a finished map."""
        with self._failing([one.request]):
            task, config, unit = one.task, one.request.config, one.task.units[0]
            table = _table(one.backend, task)
            require_voxels(task, config, {unit: table})
            truth = None if one.truth is None else _table(one.truth, task)
            found = analyse_map(task, config, table, one.backend.events() if config.statistics else None, truth)
            summary = unit_summary(task, config, table, unit, one.rows, found.summary)
            content: dict[str, Any] = {"input": task.digest, "summary": to_json(summary)}
            files: dict[str, Callable[[Path], None]] = {}
            if one.request.image_space and stream.image_space is not None:
                content["image_space"] = to_json(stream.image_space.result(summary.flicker_percent))
                content["up"] = _up(self._scene, table, stream.poses)
                files[f"{OVERVIEW}/{slug(unit.scene, unit.backbone)}.npz"] = partial(_save_arrays, stream.overview)
            if one.request.voxels:
                maps = found.maps if config.statistics else {}
                files[f"{VOXELS}/{unit.slug}.parquet"] = partial(save_voxels, table, maps=maps)
            content["files"], returned = self._written(files)
            self._outcomes.append(Outcome(one.request.identity, content, files=returned))

    def _written(self, files: Mapping[str, Callable[[Path], None]]) -> tuple[dict[str, str], dict[str, bytes]]:
        """Write files into the study's folder where it is shared; their digests, and their bytes where it is not."""
        digests, returned = {}, {}
        shared = shared_marker(self.job.folder, self.job.start).exists()
        with tempfile.TemporaryDirectory() as elsewhere:
            for name, save in files.items():
                path = (self.job.folder if shared else Path(elsewhere)) / name
                save(path)
                digests[name] = file_digest(path).hex()
                if not shared:
                    returned[name] = path.read_bytes()
        return digests, returned

    def _make_room(self) -> None:
        """Put half of the maps off to the next pass where they take more than the memory bound."""
        maps = [one for stream in self._streams for one in stream.maps]
        if len(maps) < 2 or _resident_bytes() - self._memory_before <= self._bound:
            return
        off = {one.request.identity for one in maps[len(maps) // 2 :]}
        self.put_off += [one.request for one in maps if one.request.identity in off]
        for stream in self._streams:
            stream.maps = [one for one in stream.maps if one.request.identity not in off]

    @contextlib.contextmanager
    def _failing(self, requests: Sequence[Request]) -> Iterator[None]:
        """What is raised in the block becomes the outcome of these units."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 - a failing unit is reported, and the others go on
            self._outcomes += failed(requests, message(error))


def _streams(maps: Iterable[_Map]) -> list[_Stream]:
    groups: dict[Any, list[_Map]] = {}
    for one in maps:
        config = one.request.config
        same = (config.taxonomy, config.exclude, config.perturbation, config.pixel_stride, tuple(one.task.indices))
        groups.setdefault(same, []).append(one)
    return [_Stream(group) for group in groups.values()]


def _new_map(config: Config, task: Task) -> FusionBackend:
    return new_map(config.backends[0], task, config)


_warm: set[tuple[str, str, int, bool]] = set()


def _warm_up(one: _Map, frame: Frame) -> None:
    """Let a backend load what it compiles, once a process: else the first frame would cost more than the others."""
    config, task = one.request.config, one.task
    (backend,) = config.backends
    kind = (backend.name, json.dumps(backend.options), len(task.mapping.target), frame.scores is None)
    if kind not in _warm:
        _new_map(config, task).integrate(frame)
        _warm.add(kind)


def _truth_map(config: Config, task: Task) -> FusionBackend | None:
    """An empty map for the ground truth, where there is any; its history is not wanted."""
    return _new_map(config.model_copy(update={"statistics": False}), task) if truth_task(task) else None


def _table(backend: FusionBackend, task: Task) -> VoxelTable:
    return dataclasses.replace(backend.table(), classes=task.mapping.target.classes)


def _ground_truth(scene: Scene, index: int) -> Frame | None:
    """A frame with its ground truth; None where the frame has none."""
    try:
        return scene.frame(index, GROUND_TRUTH, color=False)
    except DataError:
        return None


def _overview(task: Task, decoded: Frame) -> dict[str, Any]:
    """What a figure shows of a frame, no wider than SHOWN_WIDTH."""
    frame = prepare(task, decoded, -(-decoded.shape[1] // SHOWN_WIDTH))
    palette = np.array(task.mapping.target.colors, dtype=np.uint8)
    arrays: dict[str, Any] = {"frame": frame.index, "labels": frame.predicted, "palette": palette}
    return arrays if frame.color is None else arrays | {"color": frame.color}


def _save_arrays(arrays: Mapping[str, Any], path: Path) -> None:
    named: dict[str, Any] = dict(arrays)
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **named)


def _up(scene: Scene, table: VoxelTable, poses: Sequence[Any]) -> list[float] | None:
    """The scene's up axis, said or estimated; None where neither works."""
    try:
        up = estimate_up(table, poses) if scene.up is None else scene.up
    except (DataError, ImportError, OSError):
        return None
    return [float(value) for value in up]


def _resident_bytes() -> int:
    import psutil

    return int(psutil.Process().memory_info().rss)
