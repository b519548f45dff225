"""Alpha of voxels at half, once and twice the voxel size, from a few frames that are fused once more."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from semstab.backends import create
from semstab.core.arrays import evenly
from semstab.core.types import UInt8, UInt16
from semstab.data.frames import Frame
from semstab.data.results import SizeAlpha
from semstab.errors import DataError
from semstab.statistics.agreement import krippendorff_alpha

FACTORS = (0.5, 1.0, 2.0)

SIZE_FRAMES, SIZE_PIXELS = 12, 2**15
"""The most frames, evenly spaced, that are fused once more at each voxel size, and the pixels of each, about."""


class SizeSample:
    """Pixels of some of the frames of a unit, from which alpha follows at half, once and twice the voxel size."""

    def __init__(self, indices: Sequence[int], voxel_size: float, num_classes: int) -> None:
        self._indices = frozenset(indices[k] for k in evenly(len(indices), SIZE_FRAMES))
        self._K, self._voxel_size = num_classes, voxel_size
        self._frames: list[Frame] = []

    def add(self, frame: Frame) -> None:
        """Keep some pixels of the frame, if it is one of them."""
        if frame.index in self._indices:
            times = math.prod(frame.shape) / SIZE_PIXELS
            some = frame.every(max(1, round(times if frame.is_scan else math.sqrt(times))))
            images = {
                name: image.copy()
                for name in ("depth", "points", "labels", "scores")
                if (image := getattr(some, name)) is not None
            }
            self._frames.append(dataclasses.replace(some, color=None, mask=None, left_out=None, **images))

    def alphas(self) -> tuple[SizeAlpha, ...]:
        """Return Krippendorff's alpha at each voxel size; none where the scene is larger than a map of the smallest."""
        frames = self._frames
        if any(frame.scores is not None for frame in frames):
            frames = [frame if frame.labels is None else self._one_hot(frame, frame.labels) for frame in frames]
        try:
            return tuple(self._at(factor * self._voxel_size, frames) for factor in FACTORS) if frames else ()
        except DataError:
            return ()

    def _one_hot(self, frame: Frame, labels: UInt8 | UInt16) -> Frame:
        scores = np.eye(self._K, dtype=np.float32)[np.where(frame.valid, labels, 0)]
        return dataclasses.replace(frame, labels=None, scores=scores, depth=np.where(frame.valid, frame.depth, 0))

    def _at(self, voxel_size: float, frames: Sequence[Frame]) -> SizeAlpha:
        backend = create("numba", voxel_size=voxel_size, num_classes=self._K)
        for frame in frames:
            backend.integrate(frame)
        return SizeAlpha(voxel_size, len(self._indices), krippendorff_alpha(backend.table()))
