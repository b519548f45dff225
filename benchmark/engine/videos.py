"""Flicker of videos without depth and poses: all models are measured in one pass over the images."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semstab.config import Config
from semstab.core.files import content_key, read_sealed, remove_leftovers, write_sealed
from semstab.core.json_form import from_json, to_json
from semstab.core.prefetch import prefetch
from semstab.data.frames import Frame
from semstab.data.measures import mean
from semstab.data.records import UNITS
from semstab.data.results import slug
from semstab.data.statistics import OutlyingFrames
from semstab.data.videos import LonePicture, VideoRecord, VideoResult, VideoRow
from semstab.datasets import Scene
from semstab.errors import DataError
from semstab.metrics.flicker import flicker_in_place
from semstab.metrics.image_space import PICTURED
from semstab.metrics.video_flicker import Flows, VideoFlickerMeter, video_picture
from semstab.metrics.video_measures import VideoMeter
from semstab.statistics.frame_disagreement import LoneDisagreement, outlying_frames
from semstab.task import Task, read, tasks_of, truth_task

logger = logging.getLogger("semstab")

FORMAT = 1
"""Part of every key: raise it with any change of the numbers that a video's settings and input lead to."""


class VideoObserver:
    """An observer of a run over videos; override what is of interest.

    Attributes:
        of_earlier_starts: Whether it is also told the frames of videos that an earlier start measured; they are read
            again for that.
    """

    of_earlier_starts = False

    def run_started(self, frames: int) -> None:
        """Take note that so many frames are to be measured, those of each model."""

    def measured_earlier(self, records: Sequence[VideoRecord], of: int) -> None:
        """Take note of the records, of so many in all, that an earlier start measured."""

    def frame_measured(self, task: Task, frame: Frame, numbers: Mapping[str, float]) -> None:
        """Take note of a frame of a model, whose labels are rows of the task's classes, and its numbers by column."""

    def run_finished(self, result: VideoResult) -> None:
        """Take note of the result."""

    def close(self) -> None:
        """Take note of the end, also after an interruption."""


@dataclass(frozen=True)
class MeasuredEarlier:
    """The videos that are measured, in a run's folder: a killed run goes on with the next one."""

    folder: Path
    config: Config

    def load(self, tasks: Sequence[Task]) -> list[VideoRecord] | None:
        """Return the records of the models on a video, if all were measured with these settings and this input."""
        records = [self._load(task) for task in tasks]
        known = [record for record in records if record is not None]
        return known if len(known) == len(tasks) else None

    def save(self, tasks: Sequence[Task], records: Sequence[VideoRecord]) -> None:
        """Store the records of the models on a video; their pictures are made again from its frames."""
        for task, record in zip(tasks, records, strict=True):
            bare = dataclasses.replace(record, pictures=())
            write_sealed(self._file(task), {"key": self._key(task), "record": to_json(bare)})

    def _load(self, task: Task) -> VideoRecord | None:
        path = self._file(task)
        if not path.is_file():
            return None
        try:
            content = read_sealed(path)
            if content.get("key") != self._key(task):
                return None
            record = from_json(VideoRecord, content.get("record"), path)
        except DataError:
            logger.warning("%s: damaged; the video is measured again", path)
            return None
        return dataclasses.replace(record, pictures=tuple(_pictures(task, record.outlying, self.config.pixel_stride)))

    def _file(self, task: Task) -> Path:
        return self.folder / UNITS / f"{slug(task.scene.name, task.model)}.json"

    def _key(self, task: Task) -> str:
        """Return a hash of all that the numbers follow from."""
        mapping, truth = task.mapping, truth_task(task)
        content = {
            "format": FORMAT,
            "settings": self.config.model_dump(mode="json", include={"pixel_stride", "video_measures"}),
            "unit": [task.scene.name, task.model],
            "frames": [*task.indices],
            "classes": [mapping.target.to_dict(), mapping.source.ids, mapping.rows],
            "input": task.digest,
            "truth": None if truth is None else [truth.mapping.rows, truth.scene.digest(_there(truth), truth.model)],
        }
        return content_key(to_json(content))


def _there(truth: Task) -> list[int]:
    """Return the frames that have ground truth."""
    return [index for index in truth.indices if not truth.scene.missing(index, [truth.model])]


def measured_videos(
    config: Config, scenes: Mapping[str, Scene], observers: Sequence[VideoObserver], folder: Path | None = None
) -> Iterator[VideoRecord]:
    """Yield the record of each model on each video; take those that an earlier start left in the folder.

    Raises:
        ConfigError, DataError: If labels, images or classes are missing or do not fit.
    """
    tasks = [_tasks(scene, config) for scene in scenes.values()]
    earlier = None if folder is None else MeasuredEarlier(folder, config)
    if folder is not None:
        remove_leftovers(folder / UNITS)
    known = [None if earlier is None else earlier.load(own) for own in tasks]
    for observer in observers:
        observer.measured_earlier([record for records in known for record in records or ()], sum(map(len, tasks)))
        missing = [own for own, records in zip(tasks, known, strict=True) if records is None]
        observer.run_started(sum(len(task.indices) for own in missing for task in own))
    for own, records in zip(tasks, known, strict=True):
        if records is not None:
            _show(own, records, config, [observer for observer in observers if observer.of_earlier_starts])
            yield from records
            continue
        measured = _measured(own, config, observers)
        if earlier is not None:
            earlier.save(own, measured)
        yield from measured


def _tasks(scene: Scene, config: Config) -> list[Task]:
    own = config.model_copy(update={"frames": config.scene_frames.get(scene.name, config.frames)})
    tasks = list(tasks_of(scene, own))
    if len(tasks[0].indices) < 2:
        raise DataError(f"{scene.name}: a single frame is selected; flicker takes two; change 'frames'")
    return tasks


def _measured(tasks: Sequence[Task], config: Config, observers: Sequence[VideoObserver]) -> list[VideoRecord]:
    """Return the records of the models on one video, whose images are decoded once."""
    indices, flows = tasks[0].indices, Flows()
    meters = [_Meter(task, config, flows) for task in tasks]

    def decoded(index: int) -> list[tuple[Frame, Frame | None]]:
        frames = _frames(tasks, index, config.pixel_stride)
        return [(frame, meter.true(index)) for meter, frame in zip(meters, frames, strict=True)]

    with _reading(tasks) as stack:
        fetched = prefetch(decoded, indices, threads=config.threads, size=lambda each: sum(f.nbytes for f, _ in each))
        for each in stack.enter_context(contextlib.closing(fetched)):
            for meter, (frame, truth) in zip(meters, each.item, strict=True):
                numbers = meter.add(frame, truth)
                for observer in observers:
                    observer.frame_measured(meter.task, frame, numbers)
    return [meter.record() for meter in meters]


@contextlib.contextmanager
def _reading(tasks: Sequence[Task]) -> Iterator[contextlib.ExitStack]:
    """Announce to the video that its frames are read, each once, with the labels of all models."""
    with contextlib.ExitStack() as stack:
        for task in tasks:
            stack.enter_context(task.scene.reading([*task.indices], task.model))
        yield stack


def _frames(tasks: Sequence[Task], index: int, stride: int) -> list[Frame]:
    """Return a frame of each model; its image is decoded once."""
    frames = [read(task, index, stride, color=k == 0) for k, task in enumerate(tasks)]
    return [dataclasses.replace(frame, color=frames[0].color) for frame in frames]


def _show(
    tasks: Sequence[Task], records: Sequence[VideoRecord], config: Config, observers: Sequence[VideoObserver]
) -> None:
    """Tell observers the frames of a video that is measured already."""
    if not observers:
        return
    with _reading(tasks):
        for k, index in enumerate(tasks[0].indices):
            for task, record, frame in zip(tasks, records, _frames(tasks, index, config.pixel_stride), strict=True):
                numbers = {name: getattr(record.rows[k], name) for name in OF_A_FRAME}
                for observer in observers:
                    observer.frame_measured(task, frame, numbers)


OF_A_FRAME = ("flicker_percent", "compensated_flicker_percent")
"""The numbers of a frame that are known when it is measured."""


class _Meter:
    """The measures of a model on a video."""

    def __init__(self, task: Task, config: Config, flows: Flows) -> None:
        self.task, self._truth = task, truth_task(task)
        self._stride = config.pixel_stride
        self._meter = VideoFlickerMeter(flows)
        flow = config.video_measures
        if flow == "depth":
            raise DataError(f"{task.scene.name}: a video has no depth; use --video-measures dis")
        self._video = None if flow is None else VideoMeter(len(task.mapping.target), flow)
        self._flicker: list[float] = []
        self._times: list[float] = []
        self._pixels = np.zeros(len(task.mapping.target), np.int64)
        self._previous: Frame | None = None

    def true(self, index: int) -> Frame | None:
        """Return the ground truth of a frame, where there is any."""
        if self._truth is None or self._truth.scene.missing(index, [self._truth.model]):
            return None
        return read(self._truth, index, self._stride)

    def add(self, frame: Frame, truth: Frame | None) -> dict[str, float]:
        """Add the next frame; return its numbers."""
        flicker = flicker_in_place(self._previous, frame)
        compensated = self._meter.add(frame, truth)
        if self._video is not None:
            self._video.add(frame, truth)
        self._flicker.append(flicker)
        labelled = frame.predicted[frame.valid]
        self._pixels += np.bincount(labelled, minlength=len(self._pixels))[: len(self._pixels)]
        self._times.append(math.nan if frame.timestamp is None else frame.timestamp)
        self._previous = frame
        return dict(zip(OF_A_FRAME, (flicker, compensated), strict=True))

    def record(self) -> VideoRecord:
        """Return the measures of all frames."""
        task, frame = self.task, self._previous
        assert frame is not None
        if not (total := self._pixels.sum()):
            raise DataError(
                f"{task.scene.name}, {task.model}: no pixel of {len(task.indices)} frames has a label; check the ignore"
                " id and the taxonomy"
            )
        share, largest = self._pixels / total, int(self._pixels.argmax())
        outlying, alone = self._outlying(), {own.frame: 100 * own.share for own in self._meter.lone}
        named = {each.frame for each in outlying.frames}
        rows = self._meter.rows.table()
        height, width = frame.shape if frame.color is None else frame.color.shape[:2]
        return VideoRecord(
            scene=task.scene.name,
            model=task.model,
            frames=len(task.indices),
            size=(width, height),
            classes=tuple(task.mapping.target.classes),
            image_space=self._meter.result(mean(np.array(self._flicker))),
            outlying=outlying,
            video_measures=None if self._video is None else self._video.result(),
            largest_class=task.mapping.target.classes[largest],
            largest_share=float(share[largest]),
            effective_classes=float(1 / (share**2).sum()),
            input=task.digest,
            pictures=tuple(_pictures(task, outlying, self._stride)),
            colors=tuple(task.mapping.target.colors),
            rows=tuple(
                VideoRow(
                    index, self._times[k], self._flicker[k], rows[k, 0], rows[k, 1], alone.get(index, math.nan),
                    index in named, task.scene.frame_name(index),
                )
                for k, index in enumerate(task.indices)
            ),
        )  # fmt: skip

    def _outlying(self) -> OutlyingFrames:
        known = [own for own in self._meter.lone if own.pixels]
        share = np.array([own.share for own in known], np.float64)
        disagreement = LoneDisagreement(
            np.array([own.frame for own in known], np.int64),
            np.array([own.pixels for own in known], np.int64),
            share,
            np.full(len(share), share.mean() if len(share) else math.nan),
        )
        return outlying_frames(disagreement, len(known), name=self.task.scene.frame_name)


def _pictures(task: Task, outlying: OutlyingFrames, stride: int) -> Iterator[LonePicture]:
    """Yield the frames that stand out most as pictures; they are read once more, with those beside them."""
    indices = [*task.indices]
    for each in outlying.frames[:PICTURED]:
        at = indices.index(each.frame)
        before, frame, after = (read(task, index, stride, color=True) for index in indices[at - 1 : at + 2])
        if before.shape == frame.shape == after.shape:
            yield video_picture(frame, [before, after])
