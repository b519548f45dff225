"""Stability in image coordinates: flicker, clips, and borders at edges of depth, frame by frame."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import GrowingRows
from semstab.core.types import Mask, UInt8
from semstab.data.frames import Frame
from semstab.data.image_measures import ImageSpace
from semstab.data.measures import mean
from semstab.metrics.flicker import (
    CompensatedFlicker,
    SelfConsistency,
    VideoConsistency,
    changed_pixels,
    compensated_flicker,
)
from semstab.metrics.summary import macro_mean
from semstab.pixels.edges import depth_edges, label_edges

CLIPS = (8, 16)
"""Frames a clip, as VSPW reports."""

COLUMNS = ("compensated_flicker_percent", "compensated_share", "vc8", "vc16", "self_vc8", "self_vc16", "edge_recall")
"""Numbers of a frame and those before it, by the name of their mean over all frames."""

EDGES_EVERY = 8
"""Every n-th frame is searched for edges, n being this number."""

SIDE = 640
"""Pixels of the longer side from which on every n-th pixel of each axis is measured, so that fusion does not wait."""

PICTURED, THUMBNAIL = 3, 320
"""The most frames of a unit that stand out and are kept as pictures, and the most pixels of their longer side."""


def edge_recall(frame: Frame) -> float:
    """Return which part of the edges of depth has a border of labels within two pixels; NaN without edges."""
    import cv2

    edges, borders = depth_edges(frame.depth) & frame.valid, label_edges(frame.predicted, frame.ignore_id)
    near = cv2.dilate(borders.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return mean(near[edges].astype(np.float64))


class ImageSpaceMeter:
    """The image-space measures of a unit's frames, taken in order; only the last one stays in memory.

    Scans have none but compensated flicker, by voxels of a size in metres.
    """

    def __init__(self, rows: npt.ArrayLike = (), *, voxel_size: float = math.nan) -> None:
        self.rows = GrowingRows(len(COLUMNS), rows)
        self._voxel_size = voxel_size
        self._previous: Frame | None = None
        self._by_truth = [VideoConsistency(n) for n in CLIPS]
        self._by_itself = [SelfConsistency(n) for n in CLIPS]

    def add(self, frame: Frame, truth: Frame | None) -> float:
        """Add the next frame, and its truth in the same label space if there is any; return compensated flicker."""
        sample, true = frame.within(SIDE), None if truth is None else truth.within(SIDE)
        flicker, share = math.nan, math.nan
        if self._previous is not None:
            pair = self.between(self._previous, frame, sample)
            flicker, share = pair.flicker_percent, pair.share
        self._previous = frame
        if frame.is_scan:
            self.rows.append((flicker, share, *[math.nan] * (len(COLUMNS) - 2)))
            return flicker
        by_itself = [meter.add(sample.predicted, sample.valid) for meter in self._by_itself]
        by_truth = [
            meter.skip() if true is None else meter.add(sample.predicted, sample.valid & true.valid, true.predicted)
            for meter in self._by_truth
        ]
        self.rows.append((flicker, share, *by_truth, *by_itself, self.recall(sample)))
        return flicker

    def between(self, previous: Frame, frame: Frame, sample: Frame) -> CompensatedFlicker:
        """Return flicker of the sample's pixels, each of which is looked up in the whole frame before."""
        return compensated_flicker(previous, sample, voxel_size=self._voxel_size)

    def recall(self, sample: Frame) -> float:
        """Return the edge recall of some frames, NaN of the others."""
        return math.nan if len(self.rows) % EDGES_EVERY else edge_recall(sample)

    def result(self, flicker_percent: float) -> ImageSpace:
        """Return means over the frames so far, in addition to the flicker of the unit's summary."""
        return ImageSpace(flicker_percent, **{name: mean(self.rows.column(k)) for k, name in enumerate(COLUMNS)})


def mean_over_scenes(rows: Iterable[ImageSpace]) -> ImageSpace:
    """Return the macro mean of each number over scenes: each scene with the number counts once."""
    scene_rows = list(rows)
    names = [field.name for field in dataclasses.fields(ImageSpace)]
    return ImageSpace(**{name: macro_mean([getattr(row, name) for row in scene_rows]) for name in names})


@dataclass(frozen=True, eq=False)
class LonePicture:
    """A frame as a small picture, with the pixels at which it stands alone.

    Attributes:
        frame: Its index.
        labels: (h, w) rows 0..K-1, and above where a pixel has none.
        alone: (h, w) pixels whose label differs from that of each other frame, which all see the same surface point.
        color: (h, w, 3) its image; None without an image.
    """

    frame: int
    labels: npt.NDArray[Any]
    alone: Mask
    color: UInt8 | None


def lone_picture(frame: Frame, others: Sequence[Frame]) -> LonePicture:
    """Hold a frame against others, with the camera's motion removed."""
    sample = frame.within(SIDE)
    alone = np.logical_and.reduce([changed_pixels(other, sample) for other in others])
    return picture_of(frame, sample, alone)


def picture_of(frame: Frame, sample: Frame, alone: Mask) -> LonePicture:
    """Return a frame, a sample of its pixels, and those of them that stand alone (H, W), as a small picture."""
    pixels = thumbnail(sample.shape)
    color = None if frame.color is None else frame.color[thumbnail(frame.color.shape)]
    return LonePicture(frame.index, sample.predicted[pixels], alone[pixels], color)


def picture_arrays(pictures: Sequence[LonePicture]) -> dict[str, npt.NDArray[Any]]:
    """Return pictures as arrays (n, ...) by name, those with the size of the first; colour where all have it."""
    same = [picture for picture in pictures if picture.labels.shape == pictures[0].labels.shape]
    if not same:
        return {}
    arrays = {"lone_frames": np.array([picture.frame for picture in same])}
    arrays |= {"lone_labels": np.stack([picture.labels for picture in same])}
    arrays |= {"lone_alone": np.stack([picture.alone for picture in same])}
    images = [picture.color for picture in same if picture.color is not None]
    alike = len(images) == len(same) and len({image.shape for image in images}) == 1
    return arrays | ({"lone_color": np.stack(images)} if alike else {})


def thumbnail(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return every n-th pixel of both axes, so that at most THUMBNAIL are left of the longer one."""
    stride = slice(None, None, -(-max(shape[:2]) // THUMBNAIL))
    return stride, stride
