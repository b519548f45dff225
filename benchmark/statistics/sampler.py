"""A sample of voxels with all that was seen of them, pixel by pixel: what tells labels from geometry in one pass.

A voxel is in the sample by a hash of its index, so that maps of the same grid sample the same voxels; within it the
pixels go to cells a quarter as wide. Memory is bounded: whenever there is too much, every second voxel is let go.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import Rows
from semstab.core.types import Float64, Int32, Int64, UInt16, UInt32
from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.statistics.loops import SPAN
from semstab.statistics.observations import VIEW, CellObservations, ObservationSample, Views, Voxel

BUDGET = 1 << 19
"""Entries (cell, frame, class) that are kept at most."""

PIECE = 1 << 20
"""Scores that are looked at together, about: each takes some 40 bytes meanwhile."""

SIDE = 640
"""Of frames with more pixels on a side every n-th of each axis is looked at."""

REACH = SPAN // 2
"""Voxels from the first camera within which there is a sample."""

TYPES = np.int64, np.int32, np.uint16, np.float64, np.uint32
"""Of the columns of entries."""

Entries = tuple[Int64, UInt16, Float64, UInt32]


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels (n,) that show sampled voxels: keys of the cells, hashes of the voxels, labels, and numbers."""

    cell: Int64
    drawn: UInt32
    label: UInt16
    pixel: Int32

    def grouped(self, *, numbered: bool) -> tuple[int, Int64, Float64]:
        """Move each cell and label to the front, once; how many they are, which of them each pixel is, their pixels.

        Which they are is said only where it is asked for.
        """
        from semstab.statistics.loops.observations import grouped

        of, pixels = np.empty(len(self.cell) if numbered else 0, np.int64), np.empty(len(self.cell))
        return grouped(self.cell, self.label, self.drawn, of, pixels), of, pixels


class Sampler:
    """Takes frames one by one, as they are fused; `sample` says what is there.

    origin  (3,) voxel of the first camera, where the first frame that is added is not the map's first
    """

    def __init__(self, voxel_size: float, num_classes: int, budget: int = BUDGET, origin: Voxel | None = None) -> None:
        self.voxel_size, self.K, self.budget = voxel_size, num_classes, budget
        self._share = 1 << 32
        self._origin: Int64 | None = None if origin is None else np.array(origin, dtype=np.int64)
        self._columns: tuple[npt.NDArray[Any], ...] = tuple(np.empty(budget, dtype) for dtype in TYPES)
        self._entries = 0
        self._views = Rows(VIEW)
        self._soft = False

    def add(self, frame: Frame) -> None:
        """What the frame's valid pixels show of the sampled voxels."""
        frame = frame.every(math.ceil(max(frame.shape) / SIDE))
        centre = frame.T_wc[:3, 3]
        if self._origin is None:
            self._origin = np.floor(centre / self.voxel_size).astype(np.int64)
        when = math.nan if frame.timestamp is None else frame.timestamp
        self._views.append([frame.index, *centre.tolist(), when])
        self._soft = self._soft or frame.scores is not None
        entries_of = self._labels if frame.scores is None else self._scores
        for entries in entries_of(frame, self._drawn(frame)):
            self._take(entries)

    def _drawn(self, frame: Frame) -> Pixels:
        """The frame's pixels with depth in sampled voxels; soft ones are labelled 0, what has no label K."""
        from semstab.statistics.loops.observations import draw

        (H, W), camera, T_wc = frame.shape, frame.intrinsics, fixed(frame.T_wc)
        ray_x, ray_y = (np.arange(W) - camera.cx) / camera.fx, (np.arange(H) - camera.cy) / camera.fy
        cell, drawn = np.empty(H * W, np.int64), np.empty(H * W, np.uint32)
        label, pixel = np.empty(H * W, np.uint16), np.empty(H * W, np.int32)
        there = frame.valid if frame.unlabelled is None else frame.valid | frame.unlabelled
        own = np.zeros(frame.shape, np.uint16) if frame.labels is None else frame.labels.astype(np.uint16)
        labels = np.where(frame.valid, own, np.uint16(self.K))
        n = draw(
            fixed(frame.depth), fixed(there), labels, ray_x, ray_y, T_wc, self.voxel_size, self._share, self._origin,
            REACH, cell, drawn, label, pixel,
        )  # fmt: skip
        near = slice(n) if cell[:n].min(initial=0) >= 0 else np.flatnonzero(cell[:n] >= 0)
        return Pixels(cell[near], drawn[near], label[near], pixel[near])

    def _take(self, entries: Entries) -> None:
        """Take entries of the last view in; where they would be too many, every second voxel goes until they are not.

        A part of the view that came before may have lowered the share.
        """
        cell, label, weight, drawn = entries
        while self._entries + np.count_nonzero(drawn < self._share) > self.budget:
            self._share //= 2
            rows = np.flatnonzero(self._columns[-1][: self._entries] < self._share)
            for column in self._columns:
                column[: len(rows)] = column[rows]
            self._entries = len(rows)
        some = np.flatnonzero(drawn < self._share)
        end, view = self._entries + len(some), np.full(len(drawn), len(self._views) - 1)
        taken: tuple[npt.NDArray[Any], ...] = cell, view, label, weight, drawn
        for column, own in zip(self._columns, taken, strict=True):
            column[self._entries : end] = own[some]
        self._entries = end

    def sample(self) -> ObservationSample:
        """What is there so far, as observations of the sampled voxels."""
        return self._so_far().sample()

    def looks(self, classes: tuple[str, ...] = ()) -> CellObservations:
        """What is there so far, cell by cell."""
        return dataclasses.replace(self._so_far().copied(), classes=classes)

    def _so_far(self) -> CellObservations:
        """What is there until the next frame changes it."""
        x, y, z = (0, 0, 0) if self._origin is None else (self._origin - REACH).tolist()
        key, view, label, weight, drawn = (column[: self._entries] for column in self._columns)
        own = (key, view, label, weight, drawn, (x, y, z), Views.of(self._views.table()))
        return CellObservations(*own, self.voxel_size, self.K, self._share, self._soft)

    def _labels(self, _frame: Frame, pixels: Pixels) -> Iterator[Entries]:
        """Entries (cell, class, pixels, hash) of a frame's labels."""
        m, _, count = pixels.grouped(numbered=False)
        yield pixels.cell[:m], pixels.label[:m], count[:m], pixels.drawn[:m]

    def _scores(self, frame: Frame, pixels: Pixels) -> Iterator[Entries]:
        """Entries (cell, class, sum of scores, hash) of a frame's scores, of a few cells at a time."""
        from semstab.statistics.loops.observations import add_rows

        assert frame.scores is not None
        m, of, count = pixels.grouped(numbered=True)
        none = np.flatnonzero(pixels.label[:m] == self.K)
        yield pixels.cell[none], pixels.label[none], count[none], pixels.drawn[none]
        labelled = np.flatnonzero(pixels.label[of] != self.K)
        for piece in (labelled[part] for part in _pieces(of[labelled], max(1, PIECE // self.K))):
            some = piece[pixels.drawn[of[piece]] < self._share]  # less than before, if the pieces before were too many
            s = frame.scores[np.divmod(pixels.pixel[some], frame.shape[1])].astype(np.float64)
            s /= s.sum(axis=1, keepdims=True)
            own, number = np.unique(of[some], return_inverse=True)
            sums = np.zeros((len(own), self.K))
            add_rows(s, number, sums)
            row, label = np.nonzero(sums)
            yield pixels.cell[own[row]], label.astype(np.uint16), sums[row, label], pixels.drawn[own[row]]


def _pieces(of: Int64, most: int) -> list[Int64]:
    """Pixels by the number of their cell: of whole cells, in order, about so many at a time."""
    if len(of) <= most:
        return [np.arange(len(of))]
    order = np.argsort(of, kind="stable")
    first = np.flatnonzero(np.diff(of[order], prepend=-1))
    cuts = np.searchsorted(first, np.arange(most, len(of), most))
    return np.split(order, np.unique(first[np.minimum(cuts, len(first) - 1)]))
