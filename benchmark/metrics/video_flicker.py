"""Flicker of a video without depth and poses: the motion between its images is removed by optical flow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float32
from semstab.data.frames import Frame
from semstab.metrics.flicker import CompensatedFlicker, changed_pixels, compensated_flicker, covisible
from semstab.metrics.image_space import SIDE, ImageSpaceMeter, LonePicture, picture_of
from semstab.metrics.temporal_consistency import image_flow, occluded
from semstab.metrics.video_measures import image_of
from semstab.pixels.warp import Correspondence


@dataclass(frozen=True)
class LonePixels:
    """How much of a frame stands alone.

    Attributes:
        frame: Its index.
        pixels: Labelled pixels that the frames before and after it show, too, with a label.
        share: Share of these at which the two agree on another label than the frame's, 0 to 1; NaN without any.
    """

    frame: int
    pixels: int
    share: float


def by_flow(flow: Float32, back: Float32) -> Correspondence:
    """Return the pixels of another image that show the same, by the flow (H, W, 2) to it, pixels, and the flow back."""
    H, W = flow.shape[:2]
    column = np.clip(np.rint(np.arange(W) + flow[..., 0]), 0, W - 1).astype(np.int32)
    row = np.clip(np.rint(np.arange(H)[:, None] + flow[..., 1]), 0, H - 1).astype(np.int32)
    return Correspondence(np.where(occluded(flow, back), np.int32(-1), row * np.int32(W) + column))


class Flows:
    """The motions between the two images that were asked for last: all models of a video share them.

    Flow is OpenCV's DIS (`image_flow`), without the pixels whose flow there and back does not return (`occluded`).
    """

    def __init__(self) -> None:
        self._pair: tuple[int, int, tuple[int, ...]] | None = None
        self._seen: tuple[Correspondence, Correspondence] | None = None

    def between(self, frame: Frame, other: Frame, shape: tuple[int, int]) -> tuple[Correspondence, Correspondence]:
        """Return the pixels of another image that show what a frame shows, and the reverse, at (H, W) pixels."""
        pair = frame.index, other.index, shape
        if self._seen is None or pair != self._pair:
            images = image_of(frame, shape), image_of(other, shape)
            there, back = image_flow(*images), image_flow(*images[::-1])
            self._pair, self._seen = pair, (by_flow(there, back), by_flow(back, there))
        return self._seen


class VideoFlickerMeter(ImageSpaceMeter):
    """The image-space measures of a video's frames, taken in order, with the motion between its images removed.

    Frames have colour. Motion is that between images of at most SIDE pixels a side. Two frames stay in memory.

    Attributes:
        lone: How much of each frame stands alone, but for the first and the last frame, and next to a change of the
            size.
        pixels: (K,) labelled pixels of each class.
        size: (width, height) of the last image.
    """

    def __init__(self, num_classes: int, flows: Flows | None = None) -> None:
        super().__init__()
        self.lone: list[LonePixels] = []
        self.pixels, self.size = np.zeros(num_classes, np.int64), (0, 0)
        self._flows = flows or Flows()
        self._earlier: tuple[Frame, Correspondence] | None = None
        """The sample two frames ago, and its pixels that show what the last frame shows."""

    def add(self, frame: Frame, truth: Frame | None) -> float:
        """Add the next frame, and its truth in the same label space if there is any; return compensated flicker."""
        height, width = frame.shape if frame.color is None else frame.color.shape[:2]
        self.size, K = (width, height), len(self.pixels)
        self.pixels += np.bincount(frame.predicted[frame.valid], minlength=K)[:K]
        return super().add(frame, truth)

    def between(self, previous: Frame, frame: Frame, sample: Frame) -> CompensatedFlicker:
        """Return flicker of the sample's pixels that the frame before shows, too."""
        before = previous.within(SIDE)
        if before.shape != sample.shape:
            self._earlier = None
            return CompensatedFlicker(math.nan, math.nan)
        correspondence, to_next = self._flows.between(frame, previous, sample.shape)
        if self._earlier is not None:
            self.lone.append(lone_pixels(before, [self._earlier, (sample, to_next)]))
        self._earlier = before, correspondence
        return compensated_flicker(before, sample, correspondence=correspondence)

    def recall(self, sample: Frame) -> float:
        """Return NaN: there are no edges of depth."""
        return math.nan


def lone_pixels(frame: Frame, neighbours: Sequence[tuple[Frame, Correspondence]]) -> LonePixels:
    """Return how much of a frame differs from two neighbours that agree, given with the pixels that show the same."""
    (first, in_first), (second, in_second) = neighbours
    is_covisible = covisible(first, frame, in_first) & covisible(second, frame, in_second)
    one, other = in_first.bring(first.predicted), in_second.bring(second.predicted)
    pixels = int(np.count_nonzero(is_covisible))
    alone = np.count_nonzero(is_covisible & (one == other) & (one != frame.predicted))
    return LonePixels(frame.index, pixels, alone / pixels if pixels else math.nan)


def video_picture(frame: Frame, others: Sequence[Frame]) -> LonePicture:
    """Hold a frame against others, with the motion between their images removed."""
    sample, flows = frame.within(SIDE), Flows()
    correspondences = [flows.between(frame, other, sample.shape)[0] for other in others]
    changed = [
        changed_pixels(other.within(SIDE), sample, correspondence)
        for other, correspondence in zip(others, correspondences, strict=True)
    ]
    return picture_of(frame, sample, np.logical_and.reduce(changed))
