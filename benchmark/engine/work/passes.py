"""One pass over a sequence: each frame is decoded once, and goes into the maps of all units that want it."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import json
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from semstab.backends import FusionBackend, create, takes_option
from semstab.backends.numpy_reference import NumpySample
from semstab.config import Config
from semstab.core.prefetch import Fetched, prefetch
from semstab.core.process import Stopwatch, available_bytes, resident_bytes
from semstab.datasets import GROUND_TRUTH, Dataset, Scene, open_dataset
from semstab.datasets.formats.disk import file_digest
from semstab.engine.evaluation import truth_task
from semstab.engine.observer import Observers
from semstab.engine.series import FrameRow
from semstab.engine.tiling.again import Again, SeenAgain
from semstab.engine.tiling.portion import PORTIONS
from semstab.engine.tiling.sights import seen_by
from semstab.engine.work.finish import Savers, finish, finish_portion, further_columns, save_voxels, written
from semstab.engine.work.jobs import Job, Outcome, Request, failed, shared_marker
from semstab.engine.work.memory import Room
from semstab.engine.work.sizes import SizeMaps
from semstab.engine.work.stream import Decoded, NoMap, Prepared, Stream, UnitMap, in_order, streams_of
from semstab.errors import DataError
from semstab.metrics import macro_mean, matched_region_flicker
from semstab.model.frames import Frame
from semstab.model.parquet import tile_of
from semstab.model.records import TRUTH, VOXELS, RegionFlicker, UnitContent
from semstab.model.voxels import Extent, VoxelTable
from semstab.pixels.preparation import leave_out, perturb
from semstab.pixels.warp import correspond
from semstab.statistics import Sampler, Truth, join_truth
from semstab.statistics.kinds import Kinds, spread
from semstab.statistics.sums import SecondSums, second_look
from semstab.task import Task, frame_indices, tasks_of

# What a stretch of frames sees, found by a job.


def look(job: Job, scene: Scene, request: Request) -> Outcome:
    """Write what the frames see; raises what `seen_by` raises."""
    assert request.looking is not None
    (task,) = tasks_of(scene, request.config)
    to, config = request.looking, request.config
    seen = seen_by(task, config.voxel_size, config.pixel_stride, to.origin, to.cell, job.threads)
    _, files = written(job, {to.file: seen.save})
    return Outcome(request.identity, files=files)


# The second look at the voxels of a part, taken by a job.


def looked_again(job: Job, request: Request) -> Outcome:
    """What was found; nothing where the folder is not to be seen from here, so that who sees it has to look."""
    assert request.again is not None
    shared = shared_marker(job.folder, job.start).exists()
    found = look_again(request.again, job.folder) if shared else None
    return Outcome(request.identity, portion=request.again.name, again=found)


def look_again(again: Again, folder: Path) -> SeenAgain:
    """Tile by tile."""
    files, found = dict[str, str](), list[SecondSums]()
    for name in again.tiles:
        file, table = folder / name, VoxelTable.load(folder / name)
        true = file.parents[1] / "truth" / file.name
        truth = VoxelTable.load(true) if name.startswith(f"{PORTIONS}/") and true.exists() else None
        kinds = Kinds.found(table, truth=_known(table, truth) if again.overall.true else None)
        sums, more = second_look(kinds, again.overall, truth)
        found.append(sums)
        if again.written:
            maps = VoxelTable.columns(file, further_columns(file))
            columns, tile = {**maps, **spread(more, kinds.of), **again.overall.maps(table, maps)}, tile_of(file)
            savers: Savers = {
                f"{VOXELS}/{again.slug}/{file.name}": partial(save_voxels, table, columns=columns, tile=tile)
            }
            if truth is not None and again.true:
                savers[f"{TRUTH}/{again.slug}/{file.name}"] = partial(truth.save, tile=tile)
            for path, save in savers.items():
                save(folder / path)
                files[path] = file_digest(folder / path).hex()
    return SeenAgain(SecondSums.merged(found), files)


def _known(table: VoxelTable, truth: VoxelTable | None) -> Truth:
    """The true classes of a tile; none where the ground truth saw nothing of it."""
    if truth is None:
        return Truth(np.zeros(len(table), np.bool_), np.full(len(table), -1, np.int64))
    return join_truth(table, truth)


# Flicker of label sources that hold regions without classes, as Segment Anything's proposals do; none is fused.


def measure_regions(job: Job, scene: Scene, request: Request) -> Outcome:
    """The outcome of a unit of regions: the means over its pairs of sampled frames."""
    frames = _frames(job, scene, request)
    rows = [_compared(previous, current) for previous, current in itertools.pairwise(frames)]
    flicker, compensated, share = zip(*rows, strict=True) if rows else ((), (), ())
    found = RegionFlicker(job.scene, job.backbone, macro_mean(flicker), macro_mean(compensated), macro_mean(share))
    digest = scene.digest(frame_indices(scene, request.config, [job.backbone]), job.backbone)
    return Outcome(request.identity, UnitContent(digest, regions=found))


def _frames(job: Job, scene: Scene, request: Request) -> Iterator[Frame]:
    """The sampled frames with the regions' own ids."""
    config = request.config

    def decode(index: int) -> Frame:
        frame = scene.frame(index, job.backbone, color=False)
        if frame.labels is None:
            raise DataError(f"{frame.where('scores')}: regions are label maps of ids, not scores")
        frame = leave_out(frame, masks=config.exclude.masks)
        if config.perturbation is not None:
            frame = perturb(frame, config.perturbation, job.scene)
        return frame.every(config.pixel_stride)

    indices = frame_indices(scene, config, [job.backbone])
    with contextlib.closing(prefetch(decode, indices, threads=job.threads, size=lambda frame: frame.nbytes)) as fetched:
        for each in fetched:
            yield each.item


def _compared(previous: Frame, current: Frame) -> tuple[float, float, float]:
    """Flicker, compensated flicker (percent), and the co-visible share of two successive frames."""
    before, now = _labels(previous), _labels(current)
    flicker = math.nan
    if previous.shape == current.shape:
        flicker = matched_region_flicker(before, now, previous.valid & current.valid).flicker_percent
    seen = correspond(current, previous)
    both = current.valid & seen.bring(previous.valid, fill=False)
    compensated = matched_region_flicker(seen.bring(before), now, both).flicker_percent
    valid = np.count_nonzero(current.valid)
    return flicker, compensated, np.count_nonzero(both) / valid if valid else math.nan


def _labels(frame: Frame) -> Any:
    assert frame.labels is not None
    return frame.labels


logger = logging.getLogger("semstab")

WARM_UP_STRIDE = 8
"""A backend is warmed up with so few pixels of the first frame."""


def run_job(job: Job, observers: Observers | None = None) -> tuple[Outcome, ...]:
    """Compute the units of a job. One that fails does not keep the others from finishing.

    `observers` see it where it is done in their process.
    """
    told = observers or Observers()
    outcomes: list[Outcome] = []
    requests = job.requests
    try:
        scene = _scene(job)
        regions = [request for request in requests if request.regions]
        outcomes += [measure_regions(job, scene, request) for request in regions]
        outcomes += [look(job, scene, request) for request in requests if request.looking is not None]
        outcomes += [looked_again(job, request) for request in requests if request.again is not None]
        requests = tuple(request for request in requests if request.reads_frames)
        while requests:
            fused = Pass(job, scene, requests, told)
            outcomes += fused.run()
            requests = tuple(fused.put_off)
    except Exception as error:  # noqa: BLE001 - whatever happens to a job is reported, and the other jobs go on
        outcomes += failed(requests, error)
    return tuple(outcomes)


_lent: dict[str, Mapping[str, Scene]] = {}


@contextlib.contextmanager
def lend(start: str, scenes: Mapping[str, Scene]) -> Iterator[None]:
    """Let jobs of that start that are done in this process read open scenes while the block lasts."""
    _lent[start] = scenes
    try:
        yield
    finally:
        del _lent[start]


def _scene(job: Job) -> Scene:
    if job.start in _lent:
        return _lent[job.start][job.scene]
    dataset = job.requests[0].config.dataset
    return _dataset(job.start, dataset.name, json.dumps(dataset.options)).scene(job.scene)


@functools.lru_cache(maxsize=1)
def _dataset(_start: str, name: str, options: str) -> Dataset:
    """The dataset, opened once for a start: its scenes share what they read or render."""
    return open_dataset(name, json.loads(options))


class Pass:
    """A pass with as many maps as the memory bound allows; the requests of the others are put off to another one."""

    def __init__(self, job: Job, scene: Scene, requests: Sequence[Request], observers: Observers) -> None:
        self.job = job
        self.put_off: list[Request] = []
        self.observers = observers
        self._scene = scene
        self._outcomes: list[Outcome] = []
        self._watch = Stopwatch()
        self._streams = streams_of([one for request in requests for one in self._created(request)])
        self._memory_before = resident_bytes()
        self._room = Room(requests[0].config.memory_gb, job.width)
        self._bound = available_bytes() / 2 if job.memory_bytes is None else job.memory_bytes

    def run(self) -> list[Outcome]:
        """Fuse and measure; the outcome of every unit that was not put off."""
        order = in_order(self._streams)
        decode = prefetch(self._decode, order, threads=self.job.threads, size=lambda decoded: decoded.nbytes)
        watched = [one for stream in self._streams for one in stream.maps if one.request.kept]
        if watched:
            task = dataclasses.replace(watched[0].task, backends=tuple(one.task.backends[0] for one in watched))
            config, backends = watched[0].request.config, {one.task.units[0]: one.backend for one in watched}
            self.observers.tell(lambda observer: observer.group_started(task, config, backends))
        with contextlib.closing(decode) as frames:
            for index, fetched in zip(order, frames, strict=True):
                self._watch.seconds["read"] += fetched.waited
                for stream in self._streams:
                    if stream.maps and index in stream.indices:
                        self._feed(stream, fetched)
                self._make_room()
                self._require_room()
                if not any(stream.maps for stream in self._streams):
                    break  # all of them failed
        for stream in self._streams:
            self._finish(stream)
        if self._outcomes:
            self._outcomes[0] = dataclasses.replace(self._outcomes[0], seconds=dict(self._watch.seconds))
        return self._outcomes

    def _parts(self) -> list[UnitMap]:
        """Of maps in tiles; a job fuses no more than one."""
        return [one for stream in self._streams for one in stream.maps if one.request.part is not None]

    def _created(self, request: Request) -> list[UnitMap]:
        """An empty map for a unit; none where it fails."""
        with self._failing([request]):
            (task,) = tasks_of(self._scene, request.config)
            task = dataclasses.replace(task, left_out=request.left_out)
            truth = _truth_map(request, task) if request.config.statistics else None
            sampler = _sampler(request, task) if request.judged else None
            of_truth = None if sampler is None or truth is None else _sampler(request, task)
            fused = _new_map(request.config, task, request.within) if request.fuses else NoMap()
            made = UnitMap(request, task, fused, truth, sampler, of_truth)
            if request.sampled:
                made.reference = NumpySample(request.config.voxel_size, len(task.mapping.target), request.within)
            if request.sized:
                made.sizes = SizeMaps(task, request.config)
            return [made]
        return []

    def _decode(self, index: int) -> Decoded:
        """Decode a frame in a worker thread; an error fails the units that need the frame, not those that do not."""
        try:
            color = self.observers.want_color or any(stream.shown == index for stream in self._streams)
            frame = self._scene.frame(index, self.job.backbone, color=color)
            wanted = any(stream.truth_task is not None and index in stream.indices for stream in self._streams)
            truth = _ground_truth(self._scene, index) if wanted else None
            return Decoded(index, frame, truth, self._unfiltered(index))
        except Exception as error:  # noqa: BLE001 - raised again by `_feed`
            return Decoded(index, error=error)

    def _unfiltered(self, index: int) -> Frame | None:
        """What the model says of a frame without filters; None where that is not wanted, or it has none."""
        if all(stream.judge is None for stream in self._streams):
            return None
        name = self._scene.filtering(self.job.backbone).model
        return None if name == self.job.backbone else self._scene.frame(index, name, color=False)

    def _feed(self, stream: Stream, fetched: Fetched[Decoded]) -> None:
        """A frame into every map of a stream."""
        watched = [one for one in stream.maps if one.request.kept]
        with self._failing([one.request for one in stream.maps]):
            now = stream.next_frame(fetched.item, self._watch, color=self.observers.want_color)
            if now.frame.index in stream.ahead:
                return
            rows = {}
            for one in stream.maps:
                with self._failing([one.request]):
                    row = self._integrate(one, now, fetched)
                    self._tell_advanced(one)
                    one.rows.append(row)
                    rows[one.task.units[0]] = row
                    one.observations += row.report.voxels
                    one.soft = one.soft or now.frame.scores is not None
            if watched:
                with self._watch("observe"):
                    seen = {one.task.units[0]: rows[one.task.units[0]] for one in watched if one.task.units[0] in rows}
                    self.observers.tell(lambda observer: observer.frame_fused(stream.task, now.frame, seen))
        lost = {outcome.identity for outcome in self._outcomes}
        stream.maps = [one for one in stream.maps if one.request.identity not in lost]

    def _integrate(self, one: UnitMap, now: Prepared, fetched: Fetched[Decoded]) -> FrameRow:
        frame = now.frame
        if not one.rows and one.request.fuses:
            _warm_up(one, frame)
        with self._watch(f"fuse {one.task.backends[0]}"):
            report = one.backend.integrate(frame)
        with self._watch("sample"):
            if one.sampler is not None:
                one.sampler.add(frame)
        if one.reference is not None:
            with self._watch("reference"):
                one.reference.integrate(frame)
        if one.sizes is not None:
            with self._watch("voxel sizes"):
                one.sizes.add(fetched.item.index, frame)
        if frame.scores is not None and one.request.reduces:
            with self._watch("reduced scores"):
                one.hard = one.hard or _map_without_log(one.request.config, one.task, one.request.within)
                one.hard.integrate(dataclasses.replace(frame, labels=frame.predicted, scores=None))
        if one.truth is not None and now.truth is not None:
            one.truth.integrate(now.truth)
            if one.truth_sampler is not None:
                one.truth_sampler.add(now.truth)
        cut = frame.scores_left_out
        return FrameRow(
            report, frame.timestamp, now.flicker, fetched.seconds, fetched.waited, now.seconds,
            left_out=frame.left_out_pixels,
            scores_left_out=math.nan if cut is None else cut.mean,
            most_scores_left_out=math.nan if cut is None else cut.most,
        )  # fmt: skip

    def _tell_advanced(self, one: UnitMap) -> None:
        unit = one.task.units[0]
        what = f"{unit.scene} · {unit.backbone} · {unit.backend}"
        if one.request.portion is None:
            self.observers.tell(lambda observer: observer.advanced(1, what))

    def _finish(self, stream: Stream) -> None:
        """Measure the finished maps of a stream, and let go of each."""
        while stream.maps:
            one = stream.maps.pop(0)
            with self._failing([one.request]):
                self._outcomes.append(self._ended(stream, one))

    def _ended(self, stream: Stream, one: UnitMap) -> Outcome:
        if one.request.portion is not None:
            return finish_portion(self.job, stream, one, self._watch)
        return finish(self.job, stream, one, self._watch)

    def _make_room(self) -> None:
        """Put maps off to the next pass where they take more than the memory bound: half, but none that is watched."""
        maps = [one for stream in self._streams for one in stream.maps]
        if len(maps) < 2 or resident_bytes() - self._memory_before <= self._bound:
            return
        most = sorted(maps, key=lambda one: not one.request.kept)[max(1, len(maps) // 2) :]
        off = {one.request.identity for one in most if not one.request.kept}
        self.put_off += [one.request for one in maps if one.request.identity in off]
        for stream in self._streams:
            stream.maps = [one for one in stream.maps if one.request.identity not in off]

    def _require_room(self) -> None:
        """Fail the largest map where the memory left would not do for its end, before the system ends the process."""
        maps = [one for stream in self._streams for one in stream.maps if one.rows and one.request.fuses]
        largest = self._room.lacking(maps) if maps else None
        if largest is None:
            return
        with self._failing([largest.request]):
            raise self._room.outgrown(largest)
        if largest.request.portion is None:  # it may be begun again, in tiles
            self.observers.tell(lambda observer: observer.advanced(-len(largest.rows), largest.task.scene.name))
        for stream in self._streams:
            stream.maps = [one for one in stream.maps if one is not largest]

    @contextlib.contextmanager
    def _failing(self, requests: Sequence[Request]) -> Iterator[None]:
        """What is raised in the block becomes the outcome of these units, but of those that failed before."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 - a failing unit is reported, and the others go on
            lost = {outcome.identity for outcome in self._outcomes}
            self._outcomes += failed([request for request in requests if request.identity not in lost], error)


def _new_map(config: Config, task: Task, within: Extent | None = None) -> FusionBackend:
    """An empty map; it keeps the history where that is to be written, or statistics are computed from it."""
    (backend,) = config.backends
    wanted = (config.events or config.statistics) and takes_option(backend.name, "history")
    options = ({"history": True} if wanted else {}) | backend.options
    K = len(task.mapping.target)
    return create(backend.name, voxel_size=config.voxel_size, num_classes=K, within=within, **options)


def _truth_map(request: Request, task: Task) -> FusionBackend | NoMap | None:
    """An empty map for the ground truth, where there is any; its history is not wanted."""
    if truth_task(task) is None or not (request.fuses or request.judged):
        return None
    return _map_without_log(request.config, task, request.within) if request.fuses else NoMap()


def _map_without_log(config: Config, task: Task, within: Extent | None = None) -> FusionBackend:
    return _new_map(config.model_copy(update={"statistics": False, "events": False}), task, within)


def _sampler(request: Request, task: Task) -> Sampler:
    origin = None if request.stretch is None else request.stretch.origin
    return Sampler(request.config.voxel_size, len(task.mapping.target), origin=origin)


_warm: set[tuple[str, str, int, bool]] = set()


def _warm_up(one: UnitMap, frame: Frame) -> None:
    """Let a backend load what it compiles, once a process: else the first frame would cost more than the others."""
    config, task = one.request.config, one.task
    (backend,) = config.backends
    kind = (backend.name, json.dumps(backend.options), len(task.mapping.target), frame.scores is None)
    if kind not in _warm:
        _new_map(config, task).integrate(frame.every(WARM_UP_STRIDE))
        _warm.add(kind)


def _ground_truth(scene: Scene, index: int) -> Frame | None:
    """A frame with its ground truth; None where the frame has none."""
    try:
        return scene.frame(index, GROUND_TRUTH, color=False)
    except DataError:
        return None
