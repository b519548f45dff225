"""What a unit comes to at half, once and twice its voxel size, from some of its frames."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.backends.shared.keys import HALF
from semstab.check.reprojection import evenly
from semstab.config import Config
from semstab.core.types import Int64, Mask, UInt8
from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.model.results import SizeAlpha
from semstab.statistics.agreement import alpha_of
from semstab.statistics.ranks import ordered
from semstab.task import Task

FACTORS = (0.5, 1.0, 2.0)

FRAMES, PIXELS = 16, 2**16
"""At most so many frames, evenly spaced, are fused once more a voxel size, and about so many pixels of each."""

ALIGNED = round(FACTORS[-1] / FACTORS[0])
"""The smallest voxels along an edge of the largest: those of one stay together."""

PIXEL_BYTES = 80
"""Of a pixel: its voxel and label, and what putting them in order takes."""


def sizes_bytes(first: Frame, frames: int, K: int, *, soft: bool) -> float:
    """What fusing some of so many frames once more takes."""
    return min(frames, FRAMES) * _some(first).depth.size * (PIXEL_BYTES + (4 * K if soft else 0))


def _some(frame: Frame) -> Frame:
    """About PIXELS of its pixels."""
    H, W = frame.shape
    return frame.every(max(1, round(math.sqrt(H * W / PIXELS))))


class SizeMaps:
    """Maps of some pixels of some of a task's frames, by voxel size: the smallest voxels make up the larger ones."""

    def __init__(self, task: Task, config: Config) -> None:
        self._frames = frozenset(task.indices[k] for k in evenly(len(task.indices), FRAMES))
        self._K = len(task.mapping.target)
        self._sizes = [config.voxel_size * factor for factor in FACTORS]
        self._origin: Int64 | None = None
        self._keys: list[Int64] = []
        self._said: npt.NDArray[Any] = np.empty(0, np.uint16)
        self._lost = False

    def add(self, index: int, frame: Frame) -> None:
        """Keep some pixels of the frame of that index, if it is one of them."""
        if index not in self._frames:
            return
        some = _some(frame)
        keys = self._placed(some)
        here = keys >= 0
        self._keep(some.labels if some.scores is None else some.scores, here)
        self._keys.append(keys[here])

    def _keep(self, said: Any, here: Mask) -> None:
        """Labels (n,) or scores (n, K) of pixels behind those that are there: once, as they may be most of memory."""
        n, kind = sum(map(len, self._keys)), np.uint16 if said.ndim == 2 else np.promote_types(said.dtype, np.float32)
        rows = said.astype(kind, copy=False)[here]  # compiled loops know no half precision
        if not n:
            self._said = np.empty((len(self._frames) * here.size, *rows.shape[1:]), kind)
        if (self._said.ndim, self._said.dtype) == (rows.ndim, rows.dtype) and n + len(rows) <= len(self._said):
            self._said[n : n + len(rows)] = rows
        else:  # frames of several kinds or sizes
            parts, soft = (self._said[:n], rows), 2 in (self._said.ndim, rows.ndim)
            self._said = np.concatenate(
                [_one_hot(part, self._K) if soft and part.ndim == 1 else part for part in parts]
            )

    def _placed(self, frame: Frame) -> Int64:
        """Packed keys (H, W) of the smallest voxels that its pixels show, -1 where one is not valid."""
        from semstab.backends.shared.pixel_keys import frame_terms
        from semstab.engine.work.size_loops import keys_of

        (H, W), camera, T_wc, size = frame.shape, frame.intrinsics, fixed(frame.T_wc), self._sizes[0]
        if self._origin is None:
            self._origin = ALIGNED * np.floor(T_wc[:3, 3] / (ALIGNED * size)).astype(np.int64)
        ray_x, ray_y = (np.arange(W) - camera.cx) / camera.fx, (np.arange(H) - camera.cy) / camera.fy
        keys, valid = np.empty((H, W), np.int64), fixed(frame.valid).view(np.uint8)
        lost = keys_of(
            fixed(frame.depth), valid, ray_x, ray_y, T_wc, size, self._origin, *frame_terms(ray_x, T_wc, size), keys
        )
        self._lost = self._lost or bool(lost)
        return keys

    def alphas(self) -> tuple[SizeAlpha, ...]:
        """Krippendorff's alpha at each voxel size; none where the scene is larger than a map of the smallest."""
        if self._lost or not self._keys:
            return ()
        frame = np.repeat(np.arange(len(self._keys), dtype=np.uint8), list(map(len, self._keys)))
        sums = self._sums(_codes(self._keys), frame)
        return tuple(
            SizeAlpha(size, len(self._frames), float(alpha_of(of))) for size, of in zip(self._sizes, sums, strict=True)
        )

    def _sums(self, code: Int64, frame: UInt8) -> Iterator[Any]:
        """(3 + K,) what alpha is a function of, of each map: its voxels are the codes without their last bits."""
        from semstab.engine.work.size_loops import runs, sums_of_labels, sums_of_scores

        F, shifts = len(self._keys), range(0, 3 * len(FACTORS), 3)
        code, order = ordered(code)
        if self._said.ndim == 2:
            frame, ones = frame[order], np.ones(len(code), np.int32)
            return (sums_of_scores(code, shift, frame, ones, order, self._said, F) for shift in shifts)
        kinds: tuple[Any, ...] = np.int64, np.uint8, np.uint16, np.int32
        own, seen, label, many = (np.empty(len(code), kind) for kind in kinds)
        m = runs(code, order, frame, self._said, own, seen, label, many)
        of = own[:m], seen[:m], label[:m], many[:m]
        return (sums_of_labels(*of, shift, F, self._K) for shift in shifts)


def _codes(keys: Sequence[Int64]) -> Int64:
    """See `interleave`: of the keys of all frames, from the lowest voxel of each axis on, so that codes are short."""
    from semstab.engine.work.size_loops import interleave, lowest

    low, code = np.full(3, 2 * HALF, np.uint64), np.empty(sum(map(len, keys)), np.int64)
    for part in keys:
        lowest(part, low)
    bounds = itertools.accumulate(map(len, keys), initial=0)
    for part, (first, last) in zip(keys, itertools.pairwise(bounds), strict=True):
        interleave(part, low // ALIGNED * ALIGNED, code[first:last])
    return code


def _one_hot(labels: npt.NDArray[Any], K: int) -> Any:
    return np.eye(K, dtype=np.float32)[labels]
