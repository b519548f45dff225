"""Units that fuse the very same frames, and what they share of each: preparation, flicker, ground truth, a picture."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from semstab.backends import FusionBackend
from semstab.backends.numpy_reference import NumpySample
from semstab.core.process import Stopwatch
from semstab.core.rows import Rows
from semstab.core.types import Float64
from semstab.engine.evaluation import truth_task
from semstab.engine.series import Series
from semstab.engine.work.image_space import ImageSpaceMeter
from semstab.engine.work.jobs import Request
from semstab.engine.work.sizes import SizeMaps
from semstab.metrics import FrameQualityMeter, flicker_percent
from semstab.model.events import Events
from semstab.model.frames import Frame
from semstab.model.results import FrameReport
from semstab.model.voxels import VoxelTable
from semstab.statistics import Sampler
from semstab.task import Task, prepare

AXES = 9
"""Numbers that tell where a camera is, which way it looks and how it is rolled."""

POSES = 1 << 16
"""Of more cameras every n-th is looked at for the up axis."""

SHOWN_WIDTH = 1280
"""Pixels of the frame that is kept for figures."""


class NoMap:
    """Stands for a map where frames are only looked at."""

    def integrate(self, frame: Frame) -> FrameReport:
        """Nothing is fused."""
        return FrameReport(frame.index, points=0, voxels=0, new_voxels=0, drift_sum=0.0, seconds=0.0, map_voxels=0)

    def table(self) -> VoxelTable:
        """There is none."""
        raise LookupError("nothing was fused")

    def events(self) -> Events | None:
        """There are none."""
        return None


@dataclass(eq=False)
class UnitMap:
    """A unit that is being fused; `truth` takes the ground truth of the same frames, samplers what statistics need.

    reference  follows a sample of its voxels, where it is checked so
    sizes      maps of some frames at other voxel sizes
    hard       of soft scores, a map of each pixel's likeliest class
    soft       whether the frames have scores
    """

    request: Request
    task: Task
    backend: FusionBackend
    truth: FusionBackend | NoMap | None = None
    sampler: Sampler | None = None
    truth_sampler: Sampler | None = None
    reference: NumpySample | None = None
    sizes: SizeMaps | None = None
    hard: FusionBackend | None = None
    rows: Series = field(default_factory=Series)
    observations: int = 0
    soft: bool = False


@dataclass(frozen=True, eq=False)
class Decoded:
    """A frame as its scene has it; or the error that came instead.

    truth  its ground truth, where that is wanted; model  what the model said before filters, where that is wanted
    """

    index: int
    frame: Frame | None = None
    truth: Frame | None = None
    model: Frame | None = None
    error: Exception | None = None

    @property
    def nbytes(self) -> int:
        """Bytes that it keeps in memory."""
        return sum(frame.nbytes for frame in (self.frame, self.truth, self.model) if frame is not None)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A frame ready to fuse, with its ground truth; its flicker in percent, and the seconds which that took."""

    frame: Frame
    truth: Frame | None
    flicker: float
    seconds: float


class Stream:
    """Units that fuse the very same frames: those of one taxonomy, noise, pixel stride and selection of frames."""

    def __init__(self, maps: Sequence[UnitMap]) -> None:
        self.maps = list(maps)
        self.task = dataclasses.replace(
            maps[0].task, backends=tuple(one.task.backends[0] for one in maps if one.request.kept)
        )
        self.whole = any(one.request.within is None for one in maps)
        self.pixel_stride = maps[0].request.config.pixel_stride
        frames = self.task.indices
        self.indices: range | frozenset[int] = frames if isinstance(frames, range) else frozenset(frames)
        self.previous: Frame | None = None
        self.image_space = ImageSpaceMeter() if any(one.request.image_space for one in maps) else None
        wanted = self.image_space is not None and maps[0].request.config.frame_quality
        self.judge = FrameQualityMeter(len(self.task.mapping.target)) if wanted else None
        takes_truth = self.image_space is not None or any(one.truth is not None for one in maps)
        self.truth_task = truth_task(self.task) if takes_truth else None
        self._poses = Rows(AXES) if self.image_space is not None and self.task.scene.up is None else None
        stretch = maps[0].request.stretch
        self.lead = 0 if stretch is None else stretch.lead
        self.ahead = frozenset(self.task.indices[: self.lead])  # seen for the sake of those after them
        middle = self.task.indices[len(self.task.indices) // 2]
        self.shown = None if self.image_space is None else middle if stretch is None else stretch.shown
        self.overview: dict[str, Any] = {}

    @property
    def poses(self) -> Float64:
        """(F, 3, 3) down, forward and centre of cameras in the world; of none where up need not be estimated."""
        return np.zeros((0, 3, 3)) if self._poses is None else some_poses(self._poses)

    def next_frame(self, decoded: Decoded, watch: Stopwatch, *, color: bool) -> Prepared:
        """The frame as the stream's units fuse it; with its colour only where somebody but the figures wants it."""
        if decoded.error is not None:
            raise decoded.error
        assert decoded.frame is not None
        frame = prepare(self.task, decoded.frame, self.pixel_stride)
        with watch("flicker") as lap:
            flicker = _flicker_between(self.previous, frame) if self.whole else math.nan
        truth = self._truth(decoded)
        if self.image_space is not None:
            with watch("image space"):
                self.image_space.add(frame, truth)
        if self.judge is not None:
            with watch("frame quality"):
                model = frame if decoded.model is None else prepare(self.task, decoded.model, self.pixel_stride)
                self.judge.add(frame, model, truth)
        if decoded.index == self.shown and decoded.index not in self.ahead:
            self.overview = _overview(self.task, decoded.frame)
            frame = frame if color else dataclasses.replace(frame, color=None)
        if self._poses is not None and decoded.index not in self.ahead:
            self._poses.append(frame.T_wc[:3, 1:].ravel())
        self.previous = frame
        return Prepared(frame, truth, flicker, lap.seconds)

    def _truth(self, decoded: Decoded) -> Frame | None:
        if self.truth_task is None or decoded.truth is None:
            return None
        return prepare(self.truth_task, decoded.truth, self.pixel_stride)


def some_poses(rows: Rows) -> Float64:
    """(F, 3, 3) of each row, or of every n-th where there are more than are needed to tell where up is."""
    return rows.table(step=max(1, -(-len(rows) // POSES))).reshape(-1, 3, 3)


def streams_of(maps: Iterable[UnitMap]) -> list[Stream]:
    """The maps by the frames that they share."""
    groups: dict[Any, list[UnitMap]] = {}
    for one in maps:
        config = one.request.config
        same = (config.taxonomy, config.exclude, config.perturbation, config.pixel_stride, config.top_k)
        frames = one.task.indices
        groups.setdefault((*same, frames if isinstance(frames, range) else tuple(frames)), []).append(one)
    return [Stream(group) for group in groups.values()]


def in_order(streams: Iterable[Stream]) -> Sequence[int]:
    """The frames of all of them."""
    first, *others = {stream.indices for stream in streams} or {range(0)}
    return first if isinstance(first, range) and not others else sorted({*first}.union(*others))


def _flicker_between(previous: Frame | None, frame: Frame) -> float:
    """Flicker against the frame before; undefined for the first one, and where the image size changes."""
    if previous is None or previous.shape != frame.shape:
        return math.nan
    return flicker_percent(previous, frame)


def _overview(task: Task, decoded: Frame) -> dict[str, Any]:
    """What a figure shows of a frame, no wider than SHOWN_WIDTH."""
    frame = prepare(task, decoded, -(-decoded.shape[1] // SHOWN_WIDTH))
    palette = np.array(task.mapping.target.colors, dtype=np.uint8)
    arrays: dict[str, Any] = {"frame": frame.index, "labels": frame.predicted, "palette": palette}
    return arrays if frame.color is None else arrays | {"color": frame.color}
