"""Pictures of drift, of a map in tiles: each part writes what its frames did to its own pixels, frame by frame.

A part's file holds its frames in order; files of all parts are read side by side, a few pictures of each at a time, and
what the parts say of a frame is laid into one picture, for each pixel's voxel is in one part alone.
"""

from __future__ import annotations

import heapq
import itertools
import math
import shutil
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from semstab.backends import FusionBackend, GrowingMap
from semstab.engine.tiling.partition import Part
from semstab.model.frames import Frame
from semstab.outputs.recording.camera import coarse_stride
from semstab.outputs.recording.maps.drift_colors import levels_of
from semstab.outputs.recording.maps.tracker import Tracker
from semstab.task import Task

HEAD = struct.Struct("<iiiidI")
"""Before each picture: the fields of `Picture` but its levels, and how many bytes these are."""

DRIFT, STARTED = "drift", ".started"
"""Folder in which parts leave their files, unit by unit; and how one ends that is still being written."""

BATCH = 16
"""Pictures of a part that are read together."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Levels of drift behind every stride-th pixel of a frame of that height and width."""

    frame: int
    height: int
    width: int
    stride: int
    timestamp: float | None
    levels: npt.NDArray[np.uint8]


class DriftParts:
    """What the parts leave in a folder; nothing where there is none."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._tracker: Tracker | None = None
        self._file = Path()
        self._stream: BinaryIO | None = None

    def start(self, task: Task, voxel_size: float, part: Part, backend: FusionBackend) -> None:
        """A part's frames are fused from now on, into that map."""
        self.end()
        if self._folder is None:
            return
        growing = backend if isinstance(backend, GrowingMap) else None
        self._tracker = Tracker(voxel_size, len(task.mapping.target), growing, part.extent)
        self._file = self._folder / DRIFT / task.units[0].slug / part.name
        self._file.parent.mkdir(parents=True, exist_ok=True)
        self._stream = self._file.with_suffix(STARTED).open("wb")

    def add(self, frame: Frame) -> None:
        """The part's map has fused the frame."""
        if self._stream is None or self._tracker is None:
            return
        self._tracker.follow(frame)
        stride = coarse_stride(frame.shape)
        data = zlib.compress(levels_of(*self._tracker.drift_of(frame).at(stride)).tobytes(), 1)
        timestamp = math.nan if frame.timestamp is None else frame.timestamp
        self._stream.write(HEAD.pack(frame.index, *frame.shape, stride, timestamp, len(data)) + data)

    def finish(self) -> None:
        """All frames of the part are there: the file gets its name, and the map is let go of."""
        if self._stream is not None:
            self._stream.close()
            self._file.with_suffix(STARTED).replace(self._file)
        self._stream = self._tracker = None

    def end(self) -> None:
        """Leave nothing behind of a part that was not finished."""
        if self._stream is not None:
            self._stream.close()
            self._file.with_suffix(STARTED).unlink(missing_ok=True)
        self._stream = self._tracker = None

    def pictures(self, task: Task) -> Iterator[Picture]:
        """Frame after frame, what all parts say of each; of the first unit of the task whose parts left some."""
        left = [] if self._folder is None else [self._folder / DRIFT / unit.slug for unit in task.units]
        files = next((sorted(unit.iterdir()) for unit in left if unit.is_dir()), [])
        found = heapq.merge(*(_read(file) for file in files if file.suffix != STARTED), key=attrgetter("frame"))
        for _, parts in itertools.groupby(found, key=attrgetter("frame")):
            first, *others = parts
            for other in others:
                np.maximum(first.levels, other.levels, out=first.levels)
            yield first

    def remove(self) -> None:
        """The folder, with all that is in it."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)


def _read(file: Path) -> Iterator[Picture]:
    """Opened for a few at a time: there may be more parts than files that may be open."""
    at, more = 0, True
    while more:
        with file.open("rb") as stream:
            stream.seek(at)
            some = list(itertools.islice(iter(lambda: _next(stream), None), BATCH))
            at, more = stream.tell(), len(some) == BATCH
        yield from some


def _next(stream: BinaryIO) -> Picture | None:
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    frame, height, width, stride, timestamp, size = HEAD.unpack(head)
    levels = np.frombuffer(zlib.decompress(stream.read(size)), np.uint8).reshape(-(-height // stride), -1).copy()
    return Picture(frame, height, width, stride, None if math.isnan(timestamp) else timestamp, levels)
