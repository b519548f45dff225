"""Flicker of a video without depth and poses: the motion between its images is removed by optical flow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Mask
from semstab.data.frames import Frame
from semstab.data.videos import LonePicture
from semstab.metrics.flicker import CompensatedFlicker
from semstab.metrics.image_space import SIDE, ImageSpaceMeter, picture_of
from semstab.metrics.temporal_consistency import image_flow, occluded
from semstab.metrics.video_measures import image_of


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion from an image to another one.

    Attributes:
        pixel: (H, W) row of the pixel of the other image that shows the same, in its ravelled pixels.
        seen: (H, W) whether the other image shows it: inside, and not hidden.
    """

    pixel: npt.NDArray[np.int64]
    seen: Mask

    @classmethod
    def of(cls, flow: Float32, back: Float32) -> Motion:
        """Return the motion of a flow (H, W, 2), pixels, with the flow back from the other image."""
        H, W = flow.shape[:2]
        column = np.clip(np.rint(np.arange(W) + flow[..., 0]), 0, W - 1).astype(np.int64)
        row = np.clip(np.rint(np.arange(H)[:, None] + flow[..., 1]), 0, H - 1).astype(np.int64)
        return cls(row * W + column, ~occluded(flow, back))

    def bring(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the other image's values (H, W) at the pixels that show the same."""
        return np.asarray(values.ravel()[self.pixel])


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


class Flows:
    """The motions between the two images that were asked for last: all models of a video share them.

    Flow is OpenCV's DIS (`image_flow`), without the pixels whose flow there and back does not return (`occluded`).
    """

    def __init__(self) -> None:
        self._pair: tuple[int, int, tuple[int, ...]] | None = None
        self._motions: tuple[Motion, Motion] | None = None

    def between(self, frame: Frame, other: Frame, shape: tuple[int, int]) -> tuple[Motion, Motion]:
        """Return the motion from a frame's image to another's and back, at (H, W) pixels."""
        pair = frame.index, other.index, shape
        if self._motions is None or pair != self._pair:
            images = image_of(frame, shape), image_of(other, shape)
            there, back = image_flow(*images), image_flow(*images[::-1])
            self._pair, self._motions = pair, (Motion.of(there, back), Motion.of(back, there))
        return self._motions


class VideoFlickerMeter(ImageSpaceMeter):
    """The image-space measures of a video's frames, taken in order, with the motion between its images removed.

    Frames have colour. Motion is that between images of at most SIDE pixels a side. Two frames stay in memory.

    Attributes:
        lone: How much of each frame stands alone, but of the first and the last, and beside a change of the size.
    """

    def __init__(self, flows: Flows | None = None) -> None:
        super().__init__()
        self.lone: list[LonePixels] = []
        self._flows = flows or Flows()
        self._earlier: tuple[Frame, Motion] | None = None
        """The sample two frames ago, and the motion to it from the last frame."""

    def between(self, previous: Frame, frame: Frame, sample: Frame) -> CompensatedFlicker:
        """Return flicker of the sample's pixels that the frame before shows, too."""
        before = previous.within(SIDE)
        if before.shape != sample.shape:
            self._earlier = None
            return CompensatedFlicker(math.nan, math.nan)
        motion, to_next = self._flows.between(frame, previous, sample.shape)
        if self._earlier is not None:
            self.lone.append(lone_pixels(before, [self._earlier, (sample, to_next)]))
        self._earlier = before, motion
        both = _met(sample, before, motion)
        changed = np.count_nonzero(both & (motion.bring(before.predicted) != sample.predicted))
        pixels, valid = np.count_nonzero(both), np.count_nonzero(sample.valid)
        return CompensatedFlicker(
            100.0 * changed / pixels if pixels else math.nan, pixels / valid if valid else math.nan
        )

    def recall(self, sample: Frame) -> float:
        """Return NaN: there are no edges of depth."""
        return math.nan


def lone_pixels(frame: Frame, neighbours: Sequence[tuple[Frame, Motion]]) -> LonePixels:
    """Return how much of a frame differs from two neighbours that agree, given with the motions to them."""
    both, alone = _alone(frame, neighbours)
    pixels = int(np.count_nonzero(both))
    return LonePixels(frame.index, pixels, np.count_nonzero(alone) / pixels if pixels else math.nan)


def video_picture(frame: Frame, others: Sequence[Frame]) -> LonePicture:
    """Return a frame as a picture, with the pixels at which two others agree on another label."""
    sample, flows = frame.within(SIDE), Flows()
    neighbours = [(other.within(SIDE), flows.between(frame, other, sample.shape)[0]) for other in others]
    return picture_of(frame, sample, _alone(sample, neighbours)[1])


def _alone(frame: Frame, neighbours: Sequence[tuple[Frame, Motion]]) -> tuple[Mask, Mask]:
    """Return the pixels (H, W) that both neighbours show, and those of them where they agree on another label."""
    (first, to_first), (second, to_second) = neighbours
    both = _met(frame, first, to_first) & _met(frame, second, to_second)
    one, other = to_first.bring(first.predicted), to_second.bring(second.predicted)
    return both, both & (one == other) & (one != frame.predicted)


def _met(frame: Frame, other: Frame, motion: Motion) -> Mask:
    """Return the labelled pixels (H, W) that the other frame shows, with a label there."""
    met: Mask = motion.seen & frame.valid & motion.bring(other.valid)
    return met
