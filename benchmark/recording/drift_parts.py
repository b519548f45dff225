"""What parts of a map in tiles leave for the recording: pictures of drift, frame by frame, and who drifted most.

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
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO

import numpy as np

from semstab.backends import FusionBackend, GrowingMap
from semstab.core.files import read_arrays, write_arrays, write_text
from semstab.core.types import UInt8
from semstab.engine.tiling.partition import Part
from semstab.model.frames import Frame
from semstab.model.results import Unit
from semstab.recording.camera import coarse_stride, levels_of
from semstab.recording.flips import VIEW, FlipLog, Suspect, Tracker, of_arrays, to_arrays, view_of, worst_of
from semstab.task import Task

HEAD = struct.Struct(f"<{VIEW}diI")
"""Before each picture: the fields of `Picture` but its levels, and how many bytes these are."""

DRIFT, FLIPS = "drift", "flips"
"""Folders in which parts leave their files, unit by unit."""

STARTED, ARRAYS = ".started", ".npz"
"""How a file in the first ends that is still being written, and one in the second."""

KEY = "key"
"""Beside these, whose parts they are."""

MOST_MOVES = 1 << 19
"""Moves of voxels that a part keeps."""

BATCH = 16
"""Pictures of a part that are read together."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Levels of drift behind every stride-th pixel of a frame; see `view_of`."""

    view: tuple[float, ...]
    stride: int
    levels: UInt8

    @property
    def frame(self) -> int:
        """Its number."""
        return int(self.view[0])

    @property
    def timestamp(self) -> float | None:
        """In seconds, where it has one."""
        return None if math.isnan(self.view[1]) else self.view[1]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return int(self.view[2]), int(self.view[3])


class DriftParts:
    """What the parts leave in a folder; nothing where there is none."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._tracker: Tracker | None = None
        self._flips = FlipLog()
        self._file = Path()
        self._stream: BinaryIO | None = None

    def start(self, task: Task, voxel_size: float, part: Part, backend: FusionBackend) -> None:
        """A part's frames are fused from now on, into that map."""
        self.end()
        if self._folder is None:
            return
        growing = backend if isinstance(backend, GrowingMap) else None
        self._tracker = Tracker(voxel_size, len(task.mapping.target), growing, part.extent)
        self._flips = FlipLog(MOST_MOVES)
        self._file = self._folder / DRIFT / task.units[0].slug / part.name
        self._file.parent.mkdir(parents=True, exist_ok=True)
        self._stream = self._file.with_suffix(STARTED).open("wb")

    def add(self, frame: Frame) -> None:
        """The part's map has fused the frame."""
        if self._stream is None or self._tracker is None:
            return
        self._tracker.follow(frame)
        self._flips.update(self._tracker, frame)
        stride = coarse_stride(frame.shape)
        data = zlib.compress(levels_of(*self._tracker.drift_of(frame).at(stride)).tobytes(), 1)
        self._stream.write(HEAD.pack(*view_of(frame), stride, len(data)) + data)

    def finish(self) -> None:
        """All frames of the part are there: the file gets its name, and the map is let go of."""
        if self._stream is not None and self._tracker is not None and self._folder is not None:
            self._stream.close()
            self._file.with_suffix(STARTED).replace(self._file)
            found = to_arrays([*self._flips.suspects(self._tracker)]) | {"voxels": np.int64(len(self._tracker.map))}
            write_arrays(self._folder / FLIPS / self._file.parent.name / f"{self._file.name}{ARRAYS}", found)
        self._stream = self._tracker = None

    def end(self) -> None:
        """Leave nothing behind of a part that was not finished."""
        if self._stream is not None:
            self._stream.close()
            self._file.with_suffix(STARTED).unlink(missing_ok=True)
        self._stream = self._tracker = None

    def pictures(self, unit: Unit) -> Iterator[Picture]:
        """Frame after frame, what all parts of a unit's map say of each."""
        files = [file for file in self._files(DRIFT, unit) if file.suffix != STARTED]
        found = heapq.merge(*(_read(file) for file in files), key=attrgetter("frame"))
        for _, parts in itertools.groupby(found, key=attrgetter("frame")):
            first, *others = parts
            for other in others:
                np.maximum(first.levels, other.levels, out=first.levels)
            yield first

    def suspects(self, unit: Unit, voxels: int) -> list[Suspect] | None:
        """The voxels of its map, of so many, that drifted most; None where not all parts have said which those are."""
        left = [file for file in self._files(FLIPS, unit) if file.suffix == ARRAYS]
        found = [arrays for file in left if (arrays := read_arrays(file)) is not None]
        if sum(int(arrays["voxels"]) for arrays in found) != voxels:
            return None
        return worst_of([suspect for arrays in found for suspect in of_arrays(arrays)])

    def keep(self, unit: Unit, key: str, parts: Collection[str]) -> bool:
        """Of what is there of a unit that of these parts, if it is of the same key; the rest is removed.

        Whether it is of the same key.
        """
        if self._folder is None:
            return False
        known = self._folder / FLIPS / unit.slug / KEY
        same = known.is_file() and known.read_text() == key
        kept = {*parts} if same else set[str]()
        for file in (*self._files(DRIFT, unit), *self._files(FLIPS, unit)):
            if file.name.removesuffix(ARRAYS) not in kept:
                file.unlink()
        write_text(known, key)
        return same

    @property
    def recording(self) -> str:
        """The identity of the recording that has the other pictures of these units; '' where none is known."""
        known = None if self._folder is None else self._folder / KEY
        return known.read_text() if known is not None and known.is_file() else ""

    def belong_to(self, recording: str | None) -> None:
        """The recording of that identity has them."""
        if self._folder is not None and recording is not None:
            write_text(self._folder / KEY, recording)

    def remove(self, unit: Unit) -> None:
        """What is there of a unit."""
        if self._folder is not None:
            for kind in (DRIFT, FLIPS):
                shutil.rmtree(self._folder / kind / unit.slug, ignore_errors=True)

    def _files(self, kind: str, unit: Unit) -> list[Path]:
        """Of the parts of a unit; none where there is no folder."""
        return [] if self._folder is None else sorted((self._folder / kind / unit.slug).glob("*"))


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
    *view, stride, size = HEAD.unpack(head)
    rows = -(-int(view[2]) // stride)
    levels = np.frombuffer(zlib.decompress(stream.read(size)), np.uint8).reshape(rows, -1).copy()
    return Picture(tuple(view), stride, levels)
