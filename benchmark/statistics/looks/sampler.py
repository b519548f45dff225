"""A sample of voxels with all that was seen of them, pixel by pixel: what tells labels from geometry in one pass.

A voxel is in the sample by a hash of its index, so that maps of the same grid sample the same voxels; within it the
pixels go to cells a quarter as wide. Memory is bounded: whenever there is too much, every second voxel is let go.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.model.voxels import Events, index_columns

BUDGET = 1 << 19
"""Entries (cell, frame, class) that are kept at most."""

LEAST_FRAMES = 2
"""What a cell shows counts where so many frames saw it: its label is to be more than one frame's own."""

REACH = 1 << 18
"""Voxels from the first camera within which there is a sample."""

OWN, TRUTH = "its own labels in finer cells", "the ground truth"

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class View:
    """Where a frame was taken: its index, camera centre (3,) in metres, and time stamp in seconds or NaN."""

    frame: int
    centre: Float64
    timestamp: float


@dataclass(frozen=True, eq=False)
class Sample:
    """What was seen of the sampled voxels, and what would have been had their labels not depended on the view.

    seen   observations (s_bar of a voxel in a frame), of the cells that LEAST_FRAMES or more saw
    limit  the same rows, each cell having the dominant label of all frames in each of them
    views  of all frames, in order of integration
    soft   whether the evidence is scores
    by     whose labels the limit has: the map's own in finer cells, or those of the ground truth
    """

    seen: Events
    limit: Events
    views: tuple[View, ...]
    soft: bool
    by: str = OWN

    def against(self, truth: Sample) -> Sample:
        """The same with the ground truth's labels as the limit, of a sample of the same frames."""
        return dataclasses.replace(self, limit=truth.seen, by=TRUTH)


class Sampler:
    """Takes frames one by one, as they are fused; `sample` says what is there. About a tenth of the cost of fusion."""

    def __init__(self, voxel_size: float, num_classes: int, budget: int = BUDGET) -> None:
        self.voxel_size, self.K, self.budget = voxel_size, num_classes, budget
        self._share = 1 << 32
        self._origin: Int64 | None = None
        self._parts: list[tuple[npt.NDArray[Any], ...]] = []
        self._entries = 0
        self._views: list[View] = []
        self._soft = False

    def add(self, frame: Frame) -> None:
        """What the frame's valid pixels show of the sampled voxels."""
        from semstab.statistics.looks.loops import draw

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
        entries_of = self._labels if frame.scores is None else self._scores
        key, label, weight, first = entries_of(frame, cell[:n], pixel[:n])
        when_seen = np.full(len(key), len(self._views) - 1, dtype=np.int32)
        self._parts.append((key, when_seen, label.astype(np.uint16), weight, drawn[:n][first]))
        self._entries += len(key)
        while self._entries > self.budget:
            self._halve()

    def sample(self) -> Sample:
        """What is there so far."""
        key, frame, label, weight = self._joined()
        F = max(len(self._views), 1)
        cells, cell = np.unique(key, return_inverse=True)
        looks, look = np.unique(cell * F + frame, return_inverse=True)
        pixels = np.bincount(look, weights=weight)
        often = np.bincount(looks // F, minlength=len(cells)) >= LEAST_FRAMES
        shown = _dominant(cell, label, weight / pixels[look], self.K, len(cells))
        kept = often[cell]
        voxels, voxel = np.unique(key[kept] >> 6, return_inverse=True)
        rows, row = np.unique(voxel * F + frame[kept], return_inverse=True)
        index, order = self._index(voxels), np.array([view.frame for view in self._views], dtype=np.int32)

        def log(labels: Int64) -> Events:
            sums = np.bincount(row * self.K + labels, weights=weight[kept], minlength=len(rows) * self.K)
            sums = sums.reshape(len(rows), self.K)
            total = sums.sum(axis=1)
            return Events(
                **index_columns(index),
                voxel=rows // F,
                frame=order[rows % F],
                evidence=sums / total[:, None],
                pixels=np.rint(total).astype(np.int64),
                voxel_size=self.voxel_size,
            )

        return Sample(log(label[kept]), log(shown[cell[kept]]), tuple(self._views), self._soft)

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

    def _joined(self) -> tuple[Int64, Int64, Int64, Float64]:
        """Cell, frame, class and weight of all entries."""
        nothing = (
            np.zeros(0, np.int64),
            np.zeros(0, np.int64),
            np.zeros(0, np.int64),
            np.zeros(0),
            np.zeros(0, np.int64),
        )
        key, frame, label, weight, _ = (np.concatenate(column) for column in zip(nothing, *self._parts, strict=True))
        return key, frame, label, weight

    def _index(self, key: Int64) -> Int64:
        """Voxel indices (n, 3) of voxel keys."""
        mask = 2 * REACH - 1
        relative = np.stack([key >> 38, (key >> 19) & mask, key & mask], axis=1) - REACH
        return relative if self._origin is None else relative + self._origin


def _dominant(cell: Int64, label: Int64, share: Float64, K: int, cells: int) -> Int64:
    """The class (cells,) of the largest sum of shares of each cell, the lowest on ties."""
    pairs, pair = np.unique(cell * K + label, return_inverse=True)
    evidence = np.bincount(pair, weights=share)
    order = np.lexsort((pairs % K, -evidence, pairs // K))
    first = np.searchsorted(pairs[order] // K, np.arange(cells))
    classes: Int64 = pairs[order][first] % K
    return classes
