"""Live maps, and the frames that they share: preparation, ground truth, and meters of flicker and image space."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import time
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from semstab.backends import FusionBackend, create, is_builtin, takes_option
from semstab.backends.numpy_reference import NumpySample
from semstab.config import Config
from semstab.core.arrays import GrowingRows
from semstab.core.background import Background
from semstab.core.prefetch import Fetched
from semstab.core.process import Stopwatch
from semstab.core.types import Float64, Int32
from semstab.data.features import OF_FEATURES
from semstab.data.frames import Frame
from semstab.data.results import FrameReport, UnitName
from semstab.datasets import Scene
from semstab.engine.memory import truth_backend
from semstab.engine.observer import Observers
from semstab.engine.series import FrameRow, Series
from semstab.engine.tiles import tiles_met
from semstab.engine.work import Work
from semstab.errors import ConfigError
from semstab.metrics import FrameQualityMeter, VideoMeter
from semstab.metrics.flicker import flicker_in_place
from semstab.metrics.image_space import ImageSpaceMeter
from semstab.metrics.video_flicker import Flows, VideoFlickerMeter
from semstab.pixels.scans import pictured
from semstab.statistics import Sampler
from semstab.statistics.feature_spots import FeatureObservations
from semstab.statistics.observations import SpotObservations
from semstab.task import Task, class_distances, prepare, truth_task

WARM_UP_STRIDE = 8
"""A backend is warmed up with every n-th pixel of each axis of the first frame."""

POSE = 9
"""Numbers of a row of poses: down, forward and centre of a camera."""

OVERVIEW_WIDTH = 1280
"""Pixels of the frame that is saved for figures."""


@dataclass(eq=False)
class LiveMap:
    """A work whose frames are being fused, and what goes with its map.

    Attributes:
        backend: The backend, or None if nothing is fused; `truth` fuses the ground truth, `hard` the likeliest class of
            soft scores.
        background, sampling: The threads that fuse a frame into the reference, and find spots in it, while it is
            measured.
        tiles: (n, 3) each frame and a tile that it meets, if nothing is fused; `origin` is the voxel of the first
            camera.
    """

    work: Work
    task: Task
    backend: FusionBackend | None = None
    truth: FusionBackend | None = None
    sampler: Sampler | None = None
    reference: NumpySample | None = None
    background: Background = field(default_factory=lambda: Background("semstab-reference", 1))
    sampling: Background = field(default_factory=lambda: Background("semstab-sample", 1))
    hard: FusionBackend | None = None
    rows: Series = field(default_factory=Series)
    observations: int = 0
    soft: bool = False
    frames: range | frozenset[int] = range(0)
    tiles: list[Int32] = field(default_factory=list)
    origin: tuple[int, int, int] | None = None
    _seconds: float = math.nan
    """Seconds of the fusion of the last frame."""

    @classmethod
    def from_work(cls, work: Work, scene: Scene) -> LiveMap:
        """Return an empty map for a work on its scene."""
        unit, task = work.unit, work.unit.task_on(scene)
        task = task if work.tile is None else dataclasses.replace(task, indices=work.frames)
        config, K = unit.config, len(task.mapping.target)
        live = cls(work, task, frames=_as_set(work.frames))
        if work.fuses:
            live.backend = live.new_map()
            live._reserve()
            if unit.compares_truth and truth_task(task) is not None:
                live.truth = live.new_truth_map()
            if unit.sampled:
                all_voxels = not is_builtin(config.backends[0].name)
                ruled = config.backends[0].ruled
                live.reference = NumpySample(config.voxel_size, K, work.within, whole=all_voxels, **ruled)
        if unit.assessed and work.measures_images:
            live.sampler = Sampler(K, moving=config.moving == "tell" and scene.surface is None)
        return live

    @property
    def name(self) -> UnitName:
        """Its scene, model and backend."""
        return self.work.unit.name

    @property
    def config(self) -> Config:
        """Its settings."""
        return self.work.unit.config

    def new_map(self, *, log: bool = True, by_rule: bool = True) -> FusionBackend:
        """Return an empty map; it keeps its log where that is to be written, or statistics are computed from it.

        Without its rule it is a map of the mean.
        """
        config, (backend,), K = self.config, self.config.backends, len(self.task.mapping.target)
        backend = backend if by_rule else backend.fusing_by("mean")
        keeps_history = log and (config.events or config.statistics) and takes_option(backend.name, "history")
        options = ({"history": True} if keeps_history else {}) | backend.options
        return create(backend.name, voxel_size=config.voxel_size, num_classes=K, within=self.work.within, **options)

    def new_truth_map(self) -> FusionBackend:
        """Return an empty map for the ground truth: of the fastest backend with the same voxels."""
        name = truth_backend(self.config.backends[0].name)
        if name != self.config.backends[0].name:
            size, K = self.config.voxel_size, len(self.task.mapping.target)
            return create(name, voxel_size=size, num_classes=K, within=self.work.within)
        return self.new_map(log=False, by_rule=False)

    def _reserve(self) -> None:
        """Make as much room as the last map of these frames had, if growth costs the backend much."""
        room = _rooms.get(self.task.scene, {}).get(self._room_key())
        if room is not None and (reserve := getattr(self.backend, "reserve", None)) is not None:
            reserve(room)

    def remember_room(self) -> None:
        """Let further maps of these frames begin with the room of this one."""
        if (room := getattr(self.backend, "room", None)) is not None:
            _rooms.setdefault(self.task.scene, {})[self._room_key()] = room()

    def _room_key(self) -> tuple[object, ...]:
        """Return what the room of a map depends on, besides its scene."""
        config, tile = self.config, self.work.tile
        backend = self.name.backend, json.dumps(config.backends[0].options, sort_keys=True)
        return *backend, config.voxel_size, config.pixel_stride, tuple(self.task.indices), tile and tile.name

    def warm_up(self, frame: Frame) -> None:
        """Let the backend load and compile what it needs for such frames, once a process: no frame is timed with it."""
        if self.backend is None:
            return
        options, K = json.dumps(self.config.backends[0].options), len(self.task.mapping.target)
        kind = self.name.backend, options, K, frame.scores is None
        if kind not in _warm:
            _warm.add(kind)
            self.new_map().integrate(frame.every(WARM_UP_STRIDE))

    def integrate(self, prepared: Decoded, watch: Stopwatch) -> FrameReport:
        """Fuse a frame, and its ground truth, into the maps."""
        frame = prepared.frame
        if self.backend is None:
            points = int(np.count_nonzero(frame.valid)) if self.work.tile is None else 0
            return FrameReport(frame.index, points, voxels=0, new_voxels=0, drift_sum=0.0, seconds=0.0, map_voxels=0)
        started = time.perf_counter()
        with watch(f"fuse {self.name.backend}"):
            report = self.backend.integrate(frame)
        self._seconds = time.perf_counter() - started
        if not isinstance(report, FrameReport):
            raise ConfigError(
                f"backend '{self.name.backend}': integrate returned a {type(report).__name__}; it returns a"
                " semstab.data.results.FrameReport (docs/tutorials/own-backend.md)"
            )
        if frame.scores is not None and self.work.unit.image_space:
            with watch("reduced scores"):
                self.hard = self.hard or self.new_map(log=False)
                self.hard.integrate(dataclasses.replace(frame, labels=frame.predicted, scores=None))
        if self.truth is not None and prepared.truth is not None:
            self.truth.integrate(prepared.truth)
        self.observations += report.voxels
        self.soft = self.soft or frame.scores is not None
        if self.task.mapping.target == OF_FEATURES:
            nan = math.nan
            return dataclasses.replace(report, drift_sum=nan, map_vss_all=nan, map_entropy_all=nan)
        return report

    def sample(self, prepared: Decoded, watch: Stopwatch) -> None:
        """Begin to take the frame into the reference and into the sample of spots, in threads; see `drain`."""
        if self.reference is not None:
            self.background.submit(partial(self._add_to_reference, self.reference, prepared.frame, watch))
        if self.sampler is not None:
            self.sampling.submit(partial(self._add_to_sample, self.sampler, prepared.frame, watch))
        if not self.work.fuses and self.work.tile is not None:
            frame, voxel_size = prepared.frame, self.config.voxel_size
            if self.origin is None:
                x, y, z = np.floor(frame.T_wc[:3, 3] / voxel_size).astype(int).tolist()
                self.origin = x, y, z
            met = tiles_met(frame, voxel_size, self.work.tile.size)
            self.tiles.append(np.column_stack([np.full(len(met), frame.index, np.int32), met]))

    def _add_to_reference(self, reference: NumpySample, frame: Frame, watch: Stopwatch) -> None:
        with watch("reference"):
            reference.integrate(frame, self._seconds)

    @staticmethod
    def _add_to_sample(sampler: Sampler, frame: Frame, watch: Stopwatch) -> None:
        with watch("sample"):
            sampler.add(frame)

    @contextlib.contextmanager
    def threads(self) -> Iterator[None]:
        """End the threads after the block."""
        with contextlib.closing(self.background), contextlib.closing(self.sampling):
            yield

    def drain(self) -> None:
        """Wait for the threads, which would take the time of whatever map is timed next."""
        self.background.drain()
        self.sampling.drain()

    @property
    def left_out(self) -> list[int]:
        """The classes whose locations are left out of the map."""
        return [self.task.mapping.target.classes.index(name) for name in self.config.exclude.classes]

    def sampled_observations(self) -> SpotObservations | None:
        """Return the sampled observations, without the locations that are left out."""
        if self.sampler is None:
            return None
        space = self.task.mapping.target
        sample = self.sampler.sample(space.classes, class_distances(self.task, self.config))
        return sample.without(self.left_out)

    def sampled_features(self) -> FeatureObservations | None:
        """Return the sampled features; None without any."""
        return None if self.sampler is None else self.sampler.features()


_warm: set[tuple[str, str, int, bool]] = set()

_rooms: weakref.WeakKeyDictionary[Scene, dict[tuple[object, ...], int]] = weakref.WeakKeyDictionary()
"""The room that the last map of a scene's frames had."""


# --- Frames -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Decoded:
    """A frame with the labels of a model: as its scene has it, or as the maps of a stream fuse it.

    Attributes:
        truth: Its ground truth.
        model: The model's frame before filters.
        overview: What is saved of it for figures, of the frame that is shown.
        network: Seconds of the model's prediction on it; NaN if labels are read.
        seconds, waited: Seconds of decoding and preparing it, in a worker thread, and of waiting for it.
    """

    frame: Frame
    truth: Frame | None = None
    model: Frame | None = None
    overview: dict[str, Any] = field(default_factory=dict)
    network: float = math.nan
    seconds: float = math.nan
    waited: float = math.nan

    @property
    def nbytes(self) -> int:
        """Bytes that it keeps in memory."""
        return sum(frame.nbytes for frame in (self.frame, self.truth, self.model) if frame is not None)


class Stream:
    """Maps that fuse the same prepared frames: of one taxonomy, noise, pixel stride and selection of frames."""

    def __init__(self, maps: Sequence[LiveMap], watch: Stopwatch, observers: Observers, flows: Flows) -> None:
        self.maps, self._watch, self._observers = list(maps), watch, observers
        self.watched = [live for live in maps if live.work.watched]
        self.task = dataclasses.replace(maps[0].task, backends=tuple(live.name.backend for live in self.watched))
        self.pixel_stride = maps[0].config.pixel_stride
        self.frames = maps[0].frames if len(maps) == 1 else _as_set({index for live in maps for index in live.frames})
        self._sequential = any(live.work.measures_images for live in maps)
        self._previous: Frame | None = None
        base = any(live.work.unit.image_space and live.work.measures_images for live in maps)
        series = any(live.work.unit.stored and live.work.measures_images for live in maps)  # theirs hold flicker
        voxel_size, posed = maps[0].config.voxel_size, self.task.scene.posed
        self.pixels = None if posed else VideoFlickerMeter(len(self.task.mapping.target), flows)
        self.image_space = self.pixels or (ImageSpaceMeter(voxel_size=voxel_size) if base or series else None)
        quality = base and maps[0].config.frame_quality
        self.quality = FrameQualityMeter(len(self.task.mapping.target)) if quality else None
        flow = maps[0].config.video_measures if base else None
        self.video = None if flow is None else VideoMeter(len(self.task.mapping.target), flow)
        self.wants_color = flow == "dis" or not posed
        self.truth_task = truth_task(self.task) if base or maps[0].work.unit.compares_truth else None
        self._poses = GrowingRows(POSE)
        self._estimates_up = base and posed and self.task.scene.up is None
        self.shown = self.task.indices[len(self.task.indices) // 2] if base else None
        self.overview: dict[str, Any] = {}

    @property
    def poses(self) -> Float64:
        """(F, 3, 3) down, forward and centre of cameras in the world; of none where up need not be estimated."""
        return self._poses.table().reshape(-1, 3, 3)

    def prepare_ahead(self, decoded: Decoded) -> Decoded:
        """Return a frame as the stream's maps fuse it: labels in the run's label space, without moving objects.

        It has its colour only where an observer wants it.
        """
        frame, truth, overview = prepare(self.task, decoded.frame, self.pixel_stride), None, dict[str, Any]()
        if self.truth_task is not None and decoded.truth is not None:
            truth = prepare(self.truth_task, decoded.truth, self.pixel_stride)
        if decoded.frame.index == self.shown:
            overview = _overview(self.task, decoded.frame)
            needs_color = self._observers.want_color or self.wants_color
            frame = frame if needs_color else dataclasses.replace(frame, color=None)
        _ = frame.valid  # known from here on
        return dataclasses.replace(decoded, frame=frame, truth=truth, overview=overview)

    def prepare(self, fetched: Fetched[Decodings]) -> Decoded:
        """Return the frame that was prepared ahead; what was raised then is raised now."""
        decoded = fetched.item[self]
        if isinstance(decoded, Exception):
            raise decoded
        self.overview = decoded.overview or self.overview
        return dataclasses.replace(decoded, seconds=fetched.seconds, waited=fetched.waited)

    def measure(self, now: Decoded, reports: Mapping[LiveMap, FrameReport]) -> dict[LiveMap, FrameRow]:
        """Return flicker and stability in image coordinates with the reports of the maps: a row of each series."""
        frame, compensated = now.frame, math.nan
        with self._watch("flicker") as lap:
            flicker = flicker_in_place(self._previous, frame)
        of_features = self.task.mapping.target == OF_FEATURES
        if self.image_space is not None:
            with self._watch("image space"):
                compensated = self.image_space.add(frame, now.truth)
        if self.quality is not None:
            with self._watch("frame quality"):
                model = frame if now.model is None else prepare(self.task, now.model, self.pixel_stride)
                self.quality.add(frame, model, now.truth)
        if self.video is not None:
            with self._watch("video measures"):
                self.video.add(frame, now.truth)
        if self._estimates_up:
            x, y, z, centre = frame.T_wc[:3].T
            self._poses.append(np.stack([-z, x, centre] if frame.is_scan else [y, z, centre], axis=1).ravel())
        self._previous = frame if self._sequential else None
        cut = frame.scores_left_out
        return {
            live: FrameRow(
                report,
                timestamp=frame.timestamp,
                flicker_percent=math.nan if of_features else flicker,
                compensated_flicker_percent=math.nan if of_features else compensated,
                decode_seconds=now.seconds,
                network_seconds=now.network,
                wait_seconds=now.waited,
                flicker_seconds=lap.seconds,
                left_out=frame.left_out_pixels,
                scores_left_out=math.nan if cut is None else cut.mean,
                most_scores_left_out=math.nan if cut is None else cut.most,
            )
            for live, report in reports.items()
        }

    def notify(self, now: Decoded, rows: Mapping[LiveMap, FrameRow]) -> None:
        """Show the frame to observers, and append each row to the series of its map."""
        seconds = math.nan
        if watched := {live.name: row for live, row in rows.items() if live.work.watched}:
            with self._watch("observe") as lap:
                self._observers.tell(lambda observer: observer.frame_fused(self.task, now.frame, watched))
            seconds = lap.seconds / len(watched)
        for live, row in rows.items():
            live.rows.append(dataclasses.replace(row, logging_seconds=seconds) if live.work.watched else row)
            if live.work.tile is None:
                what = live.name.stated
                self._observers.tell(lambda observer, what=what: observer.advanced(1, what))  # type: ignore[misc]


Decodings = Mapping[Stream, Decoded | Exception]
"""A frame as each stream's maps fuse it, or why there is none."""


def streams_of(maps: Iterable[LiveMap], watch: Stopwatch, observers: Observers) -> list[Stream]:
    """Return the maps by what they share of each frame; tiles share frames though each fuses those that see it."""
    groups: dict[Any, list[LiveMap]] = {}
    flows = Flows()
    for live in maps:
        config = live.config
        shared_settings = (config.taxonomy, config.exclude, config.perturbation, config.pixel_stride, config.top_k)
        frames = None if live.work.within is not None else live.frames
        groups.setdefault((live.name.model, *shared_settings, frames), []).append(live)
    return [Stream(group, watch, observers, flows) for group in groups.values()]


def frame_order(streams: Iterable[Stream]) -> Sequence[int]:
    """Return the frames of all of them."""
    first, *rest = {stream.frames for stream in streams} or {range(0)}
    return first if isinstance(first, range) and not rest else sorted({*first}.union(*rest))


def _as_set(frames: Iterable[int]) -> range | frozenset[int]:
    return frames if isinstance(frames, range) else frozenset(frames)


def _overview(task: Task, decoded: Frame) -> dict[str, Any]:
    palette = np.array(task.mapping.target.colors, dtype=np.uint8)
    if decoded.is_scan:
        frame = prepare(task, decoded)
        return {"frame": frame.index, "labels": pictured(frame, frame.predicted, frame.ignore_id), "palette": palette}
    frame = prepare(task, decoded, -(-decoded.shape[1] // OVERVIEW_WIDTH))
    arrays: dict[str, Any] = {"frame": frame.index, "labels": frame.predicted, "palette": palette}
    return arrays if frame.color is None else arrays | {"color": frame.color}
