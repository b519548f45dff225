"""A sample of cells, as wide as a pixel's footprint, with the labels that each view gives them.

A cell is in the sample by a hash of the block that holds it, so that all models of a flight sample the same cells.
Memory is bounded: whenever there are too many entries, every second block is dropped.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import Rows
from semstab.core.types import Float64, Int64, UInt16, UInt32
from semstab.data.frames import Frame
from semstab.data.labels import fixed
from semstab.statistics.loops import CELLS, SPAN
from semstab.statistics.observations import VIEW, CellObservations, Views

BUDGET = 1 << 19
"""Most entries (cell, view, class)."""

SIDE = 640
"""Most pixels on a side: every n-th pixel of each axis of a larger frame is taken, or every n-th point of a scan."""

FEW = 4
"""The median depth is taken of every FEW-th pixel of each axis."""

REACH = SPAN // 2
"""Blocks from the first camera within which there is a sample."""

RISE = 8.0
"""Growth of the median footprint beyond the cells from which on the sample begins anew, as after a take-off."""

STILL = 1.0
"""Pixels by which no point of an image moves while a camera stands still."""

TYPES = np.int64, np.int32, np.uint16, np.float64, np.uint32
"""Types of the columns of entries."""


@dataclass(frozen=True, eq=False)
class Anchor:
    """The frame that a view began with: its pose, and the footprint of a pixel in the image's middle."""

    view: int
    T_wc: Float64
    focal: float
    depth: float

    def sees_alike(self, frame: Frame) -> bool:
        """Return whether no point moves by more than STILL pixels from this frame to another."""
        turned = self.T_wc[:3, :3].T @ frame.T_wc[:3, :3]
        angle = math.acos(min(max((float(np.trace(turned)) - 1) / 2, -1.0), 1.0))
        moved = float(np.linalg.norm(frame.T_wc[:3, 3] - self.T_wc[:3, 3])) / self.depth
        return self.focal * (angle + moved) <= STILL


class Sampler:
    """Takes frames one by one, as they are fused; `sample` returns the entries so far.

    The first frame sets the size of the cells: the power of 2 next above the median footprint of its pixels. Frames
    that a standing camera takes are one view, and so are frames with the same pose and the same labels.

    Args:
        num_classes: K, the number of classes.
        budget: Most entries of a sample.
    """

    def __init__(self, num_classes: int, budget: int = BUDGET) -> None:
        self.K, self.budget = num_classes, budget
        self._cell_size = math.nan
        self._origin: Int64 = np.zeros(3, np.int64)
        self._columns: tuple[npt.NDArray[Any], ...] = tuple(np.empty(budget, dtype) for dtype in TYPES)
        self._views = Rows(VIEW)
        self._frames, self._sparse = 0, False
        self._anchor: Anchor | None = None
        self._seen: dict[bytes, Anchor] = {}
        self._clear()

    def _clear(self) -> None:
        self._share, self._entries = 1 << 32, 0

    def add(self, frame: Frame) -> None:
        """Add the labels of a frame's pixels with depth in sampled cells."""
        self._frames += 1
        self._sparse = self._sparse or frame.is_scan
        frame = frame.within(SIDE)
        with_depth = frame.valid if frame.unlabelled is None else frame.valid | frame.unlabelled
        if not with_depth.any():
            return
        labels = np.where(frame.valid, frame.predicted, self.K).astype(np.uint16)
        few = frame.depth[::FEW, ::FEW][with_depth[::FEW, ::FEW]]  # a median of a few pixels is as good
        view = self._view_of(frame, labels, float(np.median(few if len(few) else frame.depth[with_depth])))
        if view is not None:
            self._take(view, *self._drawn(frame, with_depth, labels))

    def _view_of(self, frame: Frame, labels: UInt16, depth: float) -> int | None:
        """Return the view of a frame, which may be a new one; None where the frame repeats another."""
        same = self._seen.get(digest := hashlib.blake2b(labels.tobytes(), digest_size=16).digest())
        if same is not None and same.sees_alike(frame):
            return None
        if self._anchor is not None and self._anchor.sees_alike(frame):
            return self._anchor.view
        focal = 1.0 / frame.ray_angle
        self._anchor = self._seen[digest] = Anchor(len(self._views), frame.T_wc.copy(), focal, depth)
        centre, when = frame.T_wc[:3, 3], math.nan if frame.timestamp is None else frame.timestamp
        self._views.append([frame.index, *centre.tolist(), when, depth / focal])
        footprint = float(np.median(self._views.table()[:, -1]))
        if not footprint <= RISE * self._cell_size:
            self._cell_size = 2.0 ** math.ceil(math.log2(footprint))
            self._origin = np.floor(centre / (CELLS * self._cell_size)).astype(np.int64)
            self._clear()
        return self._anchor.view

    def _drawn(self, frame: Frame, with_depth: Any, labels: UInt16) -> tuple[Int64, UInt16, Float64, UInt32]:
        """Return cells, labels, pixels and hashes of the frame's entries."""
        from semstab.statistics.loops.observations import draw, grouped

        H, W = frame.shape
        ray_x, ray_y = frame.rays
        points = np.zeros((0, 0, 3), np.float32) if frame.points is None else frame.points
        cell, drawn, label = np.empty(H * W, np.int64), np.empty(H * W, np.uint32), np.empty(H * W, np.uint16)
        n = draw(
            fixed(frame.depth), fixed(points), fixed(with_depth), labels, ray_x, ray_y, fixed(frame.T_wc),
            CELLS * self._cell_size, self._share, self._origin, REACH, cell, drawn, label,
        )  # fmt: skip
        near = slice(n) if cell[:n].min(initial=0) >= 0 else np.flatnonzero(cell[:n] >= 0)
        cell, drawn, label = cell[near], drawn[near], label[near]
        pixels = np.empty(len(cell))
        m = grouped(cell, label, drawn, pixels)
        return cell[:m], label[:m], pixels[:m], drawn[:m]

    def _take(self, view: int, cell: Int64, label: UInt16, weight: Float64, drawn: UInt32) -> None:
        """Add entries of a view; drop every second block while they are too many."""
        while self._entries + np.count_nonzero(drawn < self._share) > self.budget:
            self._share //= 2
            rows = np.flatnonzero(self._columns[-1][: self._entries] < self._share)
            for column in self._columns:
                column[: len(rows)] = column[rows]
            self._entries = len(rows)
        some = np.flatnonzero(drawn < self._share)
        end = self._entries + len(some)
        taken: tuple[npt.NDArray[Any], ...] = cell, np.full(len(drawn), view), label, weight, drawn
        for column, values in zip(self._columns, taken, strict=True):
            column[self._entries : end] = values[some]
        self._entries = end

    def sample(self, classes: tuple[str, ...] = ()) -> CellObservations:
        """Return a copy of the sample so far."""
        x, y, z = (self._origin - REACH).tolist()
        key, view, label, weight, drawn = (column[: self._entries].copy() for column in self._columns)
        size = self._cell_size if len(self._views) else 1.0
        own = (key, view, label, weight, drawn, (x, y, z), Views.of(self._views.table().copy()), size, self.K)
        return CellObservations(*own, self._share, classes, self._frames, self._sparse)
