"""One pass over a sequence: each frame is decoded once, and goes into the maps of all works that want it."""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
from collections import defaultdict
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from semstab.core.prefetch import Fetched, prefetch
from semstab.core.process import Stopwatch
from semstab.data.frames import Frame
from semstab.data.records import RegionFlicker
from semstab.datasets import GROUND_TRUTH, Dataset, Scene, open_dataset
from semstab.engine.live_maps import Decoded, Decodings, LiveMap, Stream, frame_order, streams_of
from semstab.engine.measurement import finish
from semstab.engine.memory_budget import MemoryBudget
from semstab.engine.observer import Observers
from semstab.engine.work import Job, Work
from semstab.errors import DataError
from semstab.metrics import macro_mean
from semstab.metrics.flicker import region_flicker
from semstab.pixels.preparation import leave_out, perturb


def run_job(job: Job, observers: Observers | None = None) -> Iterator[Work]:
    """Compute works that read one sequence. A work that fails does not keep the other works from finishing.

    Observers see the works that are computed in their process.
    """
    unfinished = [*job]
    try:
        scene = _scene(job[0])
        for work in (work for work in job if work.unit.regions):
            yield _measured_regions(scene, work)
            unfinished.remove(work)
        while unfinished:
            fusion = Fusion(scene, unfinished, observers or Observers())
            yield from fuse_sequence(fusion)
            unfinished = fusion.put_off
    except Exception as error:  # noqa: BLE001 - whatever happens to a job is reported, and the other jobs continue
        yield from (work.failed(error) for work in unfinished)


def fuse_sequence(fusion: Fusion) -> Iterator[Work]:
    """Fuse the frames of a sequence into all maps that want them; then measure and write each map."""
    with contextlib.closing(fusion.decoded_frames()) as frames:
        for index, fetched in zip(fusion.order, frames, strict=True):
            for stream in (stream for stream in fusion.streams if index in stream.frames):
                with fusion.failing(stream.maps):
                    frame, reports = stream.prepare(fetched), {}
                    fusion.drain()
                    for live in (live for live in stream.maps if index in live.frames):
                        with fusion.failing([live]):
                            live.warm_up(frame.frame)
                            reports[live] = live.integrate(frame, fusion.watch)
                    for live in (live for live in stream.maps if live in reports):
                        with fusion.failing([live]):
                            live.sample(frame, fusion.watch)
                    rows = stream.measure(frame, reports)
                    stream.notify(frame, rows)
            if not fusion.keep_within_memory():
                break  # no map is left
    for stream in fusion.streams:
        while stream.maps:
            live = stream.maps.pop(0)  # let go of before the next one
            with fusion.failing([live]):
                yield replace(finish(live, stream, fusion.watch), seconds=fusion.lap())
    yield from fusion.failed


class Fusion:
    """The maps of a pass, and the bookkeeping around it: failures, memory, time by stage.

    Attributes:
        failed: The works that failed.
        put_off: Works for another pass, where all maps do not fit into the memory.
    """

    def __init__(self, scene: Scene, works: Sequence[Work], observers: Observers) -> None:
        self.watch, self.put_off, self.failed = Stopwatch(), list[Work](), list[Work]()
        self._scene, self._observers, self._threads = scene, observers, works[0].start.threads
        maps = list[LiveMap]()
        for work in works:
            try:
                maps.append(LiveMap.from_work(work, scene))
            except Exception as error:  # noqa: BLE001 - a failing unit is reported, and the others continue
                self.failed.append(work.failed(error))
        self.streams = streams_of(maps, self.watch, observers)
        self.order = frame_order(self.streams)
        self._budget = MemoryBudget(works[0].unit.config.memory_gb, works[0].start.width)
        for stream in self.streams:
            if watched := stream.watched:
                backends = {live.name: live.backend for live in watched if live.backend is not None}
                task, config = stream.task, watched[0].work.unit.config
                observers.tell(lambda observer: observer.group_started(task, config, backends))  # noqa: B023

    def decoded_frames(self) -> Generator[Fetched[Decodings], None, None]:
        """Yield frames in order, decoded and prepared ahead by threads."""
        fetched = prefetch(
            self._decode,
            self.order,
            threads=self._threads,
            size=lambda decodings: sum(decoded.nbytes for decoded in _of(decodings.values())),
        )
        with contextlib.ExitStack() as stack:
            for model in dict.fromkeys(stream.task.model for stream in self.streams):
                stack.enter_context(self._scene.reading(self.order, model))
            for fetched_frame in stack.enter_context(contextlib.closing(fetched)):
                network = {
                    stream.task.model: decoded.network
                    for stream, decoded in fetched_frame.item.items()
                    if isinstance(decoded, Decoded) and decoded.network > 0
                }
                in_network = min(fetched_frame.waited, sum(network.values()))
                self.watch.seconds["read"] += fetched_frame.waited - in_network
                if in_network:
                    self.watch.seconds["network"] += in_network
                yield fetched_frame

    def _decode(self, index: int) -> Decodings:
        """Decode a frame in a worker thread, and prepare it for each stream; its image and truth are decoded once."""
        wanting = [stream for stream in self.streams if index in stream.frames]
        color = self._observers.want_color or any(stream.wants_color or stream.shown == index for stream in wanting)
        decodings: dict[str, Decoded | Exception] = {}
        for model in dict.fromkeys(stream.task.model for stream in wanting):
            model_streams = [stream for stream in wanting if stream.task.model == model]
            decoded_before = next(_of(decodings.values()), None)
            decodings[model] = self._decoded(index, model, model_streams, decoded_before, color=color)
        return {stream: _prepared(stream, decodings[stream.task.model]) for stream in wanting}

    def _decoded(
        self, index: int, model: str, wanting: Sequence[Stream], decoded_before: Decoded | None, *, color: bool
    ) -> Decoded | Exception:
        """Decode a model's frame; an error fails the units that need the frame, not those that do not."""
        scene, shared_frame = self._scene, None if decoded_before is None else decoded_before.frame
        try:
            frame = scene.frame(index, model, color=color and shared_frame is None)
            frame = frame if shared_frame is None else replace(frame, color=shared_frame.color)
            truth = None if decoded_before is None else decoded_before.truth
            if decoded_before is None and any(stream.truth_task is not None for stream in wanting):
                truth = _ground_truth(scene, index)
            measures_quality = any(stream.quality is not None for stream in wanting)
            name = scene.filtering(model).model if measures_quality else model  # without filters
            unfiltered = None if name == model else scene.frame(index, name, color=False)
            return Decoded(frame, truth, unfiltered, network=scene.prediction_seconds(index, model))
        except Exception as error:  # noqa: BLE001 - raised again by `Stream.prepare`
            return error

    @contextlib.contextmanager
    def failing(self, maps: Sequence[LiveMap]) -> Iterator[None]:
        """Turn an error that is raised in the block into failed works of these maps, which are given up."""
        lost = list(maps)
        try:
            yield
        except Exception as error:  # noqa: BLE001 - a failing unit is reported, and the others continue
            self.failed += [live.work.failed(error) for live in lost]
            self._give_up(lost)

    def _give_up(self, lost: Sequence[LiveMap]) -> None:
        for stream in self.streams:
            stream.maps = [live for live in stream.maps if live not in lost]

    def drain(self) -> None:
        """Wait for the threads of all maps, so that none takes the time of a map that is timed next."""
        for live in [live for stream in self.streams for live in stream.maps]:
            with self.failing([live]):
                live.drain()

    def lap(self) -> dict[str, float]:
        """Return the seconds of each stage since the last work."""
        seconds, self.watch.seconds = self.watch.seconds, defaultdict(float)
        return dict(seconds)

    def keep_within_memory(self) -> bool:
        """Put maps off, or give up one that outgrows the memory. Return whether one is left to fuse."""
        maps = [live for stream in self.streams for live in stream.maps]
        growing = [live for live in maps if live.rows and live.backend is not None]
        if growing and (largest := self._budget.lacking(growing)) is not None:
            later = sorted(maps, key=lambda live: not live.work.watched)[max(1, len(maps) // 2) :]
            if later := [live for live in later if not live.work.watched]:
                self.put_off += [live.work for live in later]
                self._give_up(later)
            else:
                with self.failing([largest]):
                    raise self._budget.outgrown(largest)
        return any(stream.maps for stream in self.streams)


def _of(decodings: Iterable[Decoded | Exception]) -> Iterator[Decoded]:
    """Yield what could be decoded."""
    return (decoded for decoded in decodings if isinstance(decoded, Decoded))


def _prepared(stream: Stream, decoded: Decoded | Exception) -> Decoded | Exception:
    """Return a decoded frame as the stream's maps fuse it, or why there is none."""
    if isinstance(decoded, Exception):
        return decoded
    try:
        return stream.prepare_ahead(decoded)
    except Exception as error:  # noqa: BLE001 - raised again by `Stream.prepare`
        return error


# --- Open scenes ------------------------------------------------------------------------------------------------------

_shared: dict[str, Mapping[str, Scene]] = {}


@contextlib.contextmanager
def share_open_scenes(start: str, scenes: Mapping[str, Scene]) -> Iterator[None]:
    """Let works of that start that are done in this process read open scenes while the block lasts."""
    _shared[start] = scenes
    try:
        yield
    finally:
        del _shared[start]


def _scene(work: Work) -> Scene:
    if work.start.name in _shared:
        return _shared[work.start.name][work.unit.name.scene]
    dataset = work.unit.config.dataset
    return _dataset(work.start.name, work.start.folder, dataset.name, json.dumps(dataset.options)).scene(
        work.unit.name.scene
    )


@functools.lru_cache(maxsize=1)
def _dataset(_start: str, folder: Path, name: str, options: str) -> Dataset:
    """Return the dataset, opened once for a start: its scenes share what they read or render."""
    return open_dataset(name, json.loads(options), folder)


def _ground_truth(scene: Scene, index: int) -> Frame | None:
    try:
        return scene.frame(index, GROUND_TRUTH, color=False)
    except DataError:
        return None


# --- Flicker of label sources that hold regions without classes, as Segment Anything's proposals do; none is fused ----


def _measured_regions(scene: Scene, work: Work) -> Work:
    """Return a unit of regions with the means over its pairs of sampled frames."""
    name = work.unit.name
    try:
        rows = [region_flicker(*pair) for pair in itertools.pairwise(_region_frames(scene, work))]
        flicker, compensated, share = zip(*rows, strict=True) if rows else ((), (), ())
        means = macro_mean(flicker), macro_mean(compensated), macro_mean(share)
        digest = scene.digest([*work.frames], name.model)
    except Exception as error:  # noqa: BLE001 - a failing unit is reported, and the others continue
        return work.failed(error)
    return replace(work, record=RegionFlicker(name.scene, name.model, *means, input=digest))


def _region_frames(scene: Scene, work: Work) -> Iterator[Frame]:
    config, name = work.unit.config, work.unit.name

    def decode(index: int) -> Frame:
        frame = scene.frame(index, name.model, color=False)
        if frame.labels is None:
            raise DataError(f"{frame.where('scores')}: regions are label maps of ids, not scores")
        frame = leave_out(frame, masks=config.exclude.masks)
        if config.perturbation is not None:
            frame = perturb(frame, config.perturbation, name.scene)
        return frame.every(config.pixel_stride)

    fetched = prefetch(decode, work.frames, threads=work.start.threads, size=lambda frame: frame.nbytes)
    with contextlib.closing(fetched):
        for fetched_frame in fetched:
            yield fetched_frame.item
