"""Stability in image coordinates: flicker, clips, and borders at edges of depth, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import Rows
from semstab.core.types import Mask, UInt8
from semstab.data.frames import Frame
from semstab.data.measures import mean
from semstab.data.records import ImageSpace
from semstab.metrics.flicker import SelfConsistency, VideoConsistency, changed_pixels, compensated_flicker
from semstab.pixels.edges import depth_edges, label_edges

CLIPS = (8, 16)
"""Frames a clip, as VSPW reports."""

COLUMNS = ("compensated_flicker_percent", "compensated_share", "vc8", "vc16", "self_vc8", "self_vc16", "edge_recall")
"""Numbers of a frame and those before it, by the name of their mean over all frames."""

EDGES_EVERY = 8
"""One frame out of so many is searched for edges."""

SIDE = 640
"""Pixels of the longer side from which on every n-th pixel of each axis is measured, so that fusion does not wait."""

WORST, THUMBNAIL = 3, 320
"""The number of frames with the most flicker that the report keeps, and the most pixels of their longer side."""


def edge_recall(frame: Frame) -> float:
    """Return which part of the edges of depth has a border of labels within two pixels; NaN without edges."""
    import cv2

    edges, borders = depth_edges(frame.depth) & frame.valid, label_edges(frame.predicted, frame.ignore_id)
    near = cv2.dilate(borders.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return mean(near[edges].astype(np.float64))


class ImageSpaceMeter:
    """The image-space measures of a unit's frames, taken in order; only the last one stays in memory."""

    def __init__(self, rows: npt.ArrayLike = ()) -> None:
        self.rows = Rows(len(COLUMNS), rows)
        self._previous: Frame | None = None
        self._by_truth = [VideoConsistency(n) for n in CLIPS]
        self._by_itself = [SelfConsistency(n) for n in CLIPS]
        self._worst: list[tuple[float, int, npt.NDArray[Any], Mask]] = []

    def add(self, frame: Frame, truth: Frame | None) -> float:
        """Add the next frame, and its truth in the same label space if there is any; return compensated flicker."""
        step = -(-max(frame.shape) // SIDE)
        sample, true = frame.every(step), None if truth is None else truth.every(step)
        flicker, share = math.nan, math.nan
        if self._previous is not None:  # each pixel of the sample is looked up in the whole frame before
            pair = compensated_flicker(self._previous, sample)
            flicker, share = pair.flicker_percent, pair.share
        by_itself = [each.add(sample.predicted, sample.valid) for each in self._by_itself]
        by_truth = [
            each.skip() if true is None else each.add(sample.predicted, sample.valid & true.valid, true.predicted)
            for each in self._by_truth
        ]
        recall = math.nan if len(self.rows) % EDGES_EVERY else edge_recall(sample)
        self.rows.append((flicker, share, *by_truth, *by_itself, recall))
        if self._previous is not None and flicker > (self._worst[-1][0] if len(self._worst) == WORST else 0.0):
            some = _thumbnail(sample.shape)
            labels, changed = sample.predicted[some].copy(), changed_pixels(self._previous, sample)[some].copy()
            same = [one for one in self._worst if one[3].shape == changed.shape]
            worst = sorted([*same, (flicker, sample.index, labels, changed)], key=lambda one: -one[0])
            self._worst = worst[:WORST]
        self._previous = frame
        return flicker

    def worst(self, color_of: Callable[[int], UInt8 | None] | None = None) -> dict[str, Any]:
        """Return the frames with the most flicker as arrays (n, h, w): labels, changed pixels, and colour.

        Args:
            color_of: Reads the colour (H, W, 3) of a frame by its index; without it there is none.
        """
        if not self._worst:
            return {}
        flicker, frames, labels, changed = zip(*self._worst, strict=True)
        arrays = {"worst_frames": np.array(frames), "worst_flicker": np.array(flicker)}
        arrays |= {"worst_labels": np.stack(labels), "worst_changed": np.stack(changed)}
        images = [color_of(index) for index in frames] if color_of else []
        known = [image[_thumbnail(image.shape)] for image in images if image is not None]
        return arrays | ({"worst_color": np.stack(known)} if known and len(known) == len(frames) else {})

    def result(self, flicker_percent: float) -> ImageSpace:
        """Return means over the frames so far, in addition to the flicker of the unit's summary."""
        return ImageSpace(flicker_percent, **{name: mean(self.rows.column(k)) for k, name in enumerate(COLUMNS)})


def _thumbnail(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return every n-th pixel of both axes, so that at most THUMBNAIL are left of the longer one."""
    every = slice(None, None, -(-max(shape[:2]) // THUMBNAIL))
    return every, every
