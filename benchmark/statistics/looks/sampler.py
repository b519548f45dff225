"""A sample of voxels with all that was seen of them, pixel by pixel: what tells labels from geometry in one pass.

A voxel is in the sample by a hash of its index, so that maps of the same grid sample the same voxels; within it the
pixels go to cells a quarter as wide. Memory is bounded: whenever there is too much, every second voxel is let go.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.statistics.looks.entries import CELLS, Looks, Sample, View

BUDGET = 1 << 19
"""Entries (cell, frame, class) that are kept at most."""

PIECE = 1 << 20
"""Scores that are looked at together, about: each takes some 40 bytes meanwhile."""

SIDE = 640
"""Of frames with more pixels on a side every n-th of each axis is looked at."""

REACH = 1 << 18
"""Voxels from the first camera within which there is a sample."""

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


class Sampler:
    """Takes frames one by one, as they are fused; `sample` says what is there.

    origin  (3,) voxel of the first camera, where the first frame that is added is not the map's first
    """

    def __init__(
        self,
        voxel_size: float,
        num_classes: int,
        budget: int = BUDGET,
        origin: tuple[int, int, int] | None = None,
    ) -> None:
        self.voxel_size, self.K, self.budget = voxel_size, num_classes, budget
        self._share = 1 << 32
        self._origin: Int64 | None = None if origin is None else np.array(origin, dtype=np.int64)
        self._parts: list[tuple[npt.NDArray[Any], ...]] = []
        self._entries = 0
        self._views: list[View] = []
        self._soft = False

    def add(self, frame: Frame) -> None:
        """What the frame's valid pixels show of the sampled voxels."""
        from semstab.statistics.looks.loops import draw

        frame = frame.every(math.ceil(max(frame.shape) / SIDE))
        centre = frame.T_wc[:3, 3]
        if self._origin is None:
            self._origin = np.floor(centre / self.voxel_size).astype(np.int64)
        when = math.nan if frame.timestamp is None else frame.timestamp
        self._views.append(View(frame.index, centre, when))
        self._soft = self._soft or frame.scores is not None
        H, W = frame.shape
        camera = frame.intrinsics
        cell, drawn, pixel = np.empty(H * W, np.int64), np.empty(H * W, np.uint32), np.empty(H * W, np.int64)
        n = draw(
            fixed(frame.depth), fixed(frame.valid), (np.arange(W) - camera.cx) / camera.fx,
            (np.arange(H) - camera.cy) / camera.fy, fixed(frame.T_wc), self.voxel_size, self._origin, REACH,
            self._share, cell, drawn, pixel,
        )  # fmt: skip
        for piece in self._pieces(frame, cell[:n]):
            some = piece[drawn[piece] < self._share]  # less than before, where the pieces before it were too many
            entries_of = self._labels if frame.scores is None else self._scores
            key, label, weight, first = entries_of(frame, cell[some], pixel[some])
            when_seen = np.full(len(key), len(self._views) - 1, dtype=np.int32)
            self._parts.append((key, when_seen, label.astype(np.uint16), weight, drawn[some][first]))
            self._entries += len(key)
            while self._entries > self.budget:
                self._halve()

    def _pieces(self, frame: Frame, cell: Int64) -> list[Int64]:
        """Pixels of whole cells, in their order, so few at a time that their scores take little memory."""
        if frame.scores is None:
            return [np.arange(len(cell))]
        order = np.argsort(cell, kind="stable")
        first = np.flatnonzero(np.diff(cell[order], prepend=-1))
        cuts = np.searchsorted(first, np.arange(PIECE // self.K, len(cell), max(1, PIECE // self.K)))
        return np.split(order, np.unique(first[np.minimum(cuts, len(first) - 1)]))

    def sample(self) -> Sample:
        """What is there so far, as observations of the sampled voxels."""
        return self.looks().sample()

    def looks(self, classes: tuple[str, ...] = ()) -> Looks:
        """What is there so far, cell by cell."""
        nothing = [np.zeros(0, dtype) for dtype in (np.int64, np.int64, np.int64, np.float64, np.int64)]
        key, view, label, weight, drawn = (np.concatenate(column) for column in zip(nothing, *self._parts, strict=True))
        return Looks(
            self._cells(key), view, label, weight, drawn, tuple(self._views), self.voxel_size, self.K, self._share,
            self._soft, classes,
        )  # fmt: skip

    def _labels(self, frame: Frame, cell: Int64, pixel: Int64) -> tuple[Int64, Int64, Float64, Int64]:
        """Entries (cell, class, pixels) of a frame's labels, and a pixel of each."""
        assert frame.labels is not None
        label = frame.labels.reshape(-1)[pixel].astype(np.int64)
        order = np.lexsort((label, cell))
        cell, label = cell[order], label[order]
        new = np.flatnonzero((np.diff(cell, prepend=-1) != 0) | (np.diff(label, prepend=-1) != 0))
        pixels = np.diff(np.append(new, len(cell))).astype(np.float64)
        return cell[new], label[new], pixels, order[new].astype(np.int64)

    def _scores(self, frame: Frame, cell: Int64, pixel: Int64) -> tuple[Int64, Int64, Float64, Int64]:
        """Entries (cell, class, sum of scores) of a frame's scores, and a pixel of each."""
        assert frame.scores is not None
        s = frame.scores.reshape(-1, self.K)[pixel].astype(np.float64)
        s /= s.sum(axis=1, keepdims=True)
        cells, first, of = np.unique(cell, return_index=True, return_inverse=True)
        sums: Float64 = np.stack([np.bincount(of, weights=column, minlength=len(cells)) for column in s.T], axis=1)
        row, label = np.nonzero(sums)
        weight: Float64 = sums[row, label]
        return cells[row], label.astype(np.int64), weight, first[row].astype(np.int64)

    def _halve(self) -> None:
        self._share //= 2
        kept = [tuple(column[part[4] < self._share] for column in part) for part in self._parts]
        self._parts = kept
        self._entries = sum(len(part[0]) for part in kept)

    def _cells(self, key: Int64) -> Int64:
        """Indices (n, 3) of cells by their keys: three voxel indices of 19 bits, three digits of 2 bits."""
        of_voxel = np.stack([key >> 44, (key >> 25) & (2 * REACH - 1), (key >> 6) & (2 * REACH - 1)], axis=1) - REACH
        child = np.stack([(key >> 4) & 3, (key >> 2) & 3, key & 3], axis=1)
        origin = np.zeros(3, dtype=np.int64) if self._origin is None else self._origin
        return CELLS * (of_voxel + origin) + child


def merged(stretches: Sequence[Looks], budget: int = BUDGET) -> Looks:
    """What one sampler would have of the stretches of a sequence, in order: voxels go by their hash alone."""
    share = min(looks.share for looks in stretches)
    while sum(np.count_nonzero(looks.drawn < share) for looks in stretches) > budget:
        share //= 2
    kept = [looks.only(looks.drawn < share) for looks in stretches]
    before = np.cumsum([0, *(len(looks.views) for looks in stretches)])

    def joined(name: str) -> npt.NDArray[Any]:
        return np.concatenate([getattr(looks, name) for looks in kept])

    return dataclasses.replace(
        stretches[0],
        cell=joined("cell"),
        label=joined("label"),
        weight=joined("weight"),
        drawn=joined("drawn"),
        view=np.concatenate([looks.view + first for looks, first in zip(kept, before, strict=False)]),
        views=tuple(view for looks in stretches for view in looks.views),
        share=share,
        soft=any(looks.soft for looks in stretches),
    )
