"""VC and TC as published, frame by frame: what papers on the segmentation of videos report."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semstab.config import FlowName
from semstab.core.types import Mask, UInt8
from semstab.data.frames import Frame
from semstab.data.image_measures import ClipMean, VideoMeasures, WarpedOverlap
from semstab.errors import DataError
from semstab.metrics.flicker import SelfConsistency, VideoConsistency
from semstab.metrics.image_space import CLIPS
from semstab.metrics.temporal_consistency import TemporalConsistency, flow_by_depth, image_flow, occluded, warp_labels

CLIP_FIELDS = ("vc8_published", "vc16_published", "vc8", "vc16", "self_vc8", "self_vc16")
"""The fields of `VideoMeasures` that are means over clips."""


class VideoMeter:
    """The published measures of time of one video, whose frames are taken in order; only the last stays in memory.

    Frames have labels in one label space of K classes, rows 0..K-1. A pixel needs no depth to count, but where TC warps
    by it. Frames of another size than the one before begin new clips, and make no pair with it.

    Args:
        num_classes: K.
        flow: The motion by which TC warps: by depth and pose, or by optical flow between the images.
    """

    def __init__(self, num_classes: int, flow: FlowName) -> None:
        self._flow = flow
        self._published = [VideoConsistency(n) for n in CLIPS]
        self._by_truth = [VideoConsistency(n) for n in CLIPS]
        self._by_itself = [SelfConsistency(n) for n in CLIPS]
        self._tc, self._tc_seen = TemporalConsistency(num_classes), TemporalConsistency(num_classes)
        self._previous: Frame | None = None

    def add(self, frame: Frame, truth: Frame | None) -> None:
        """Add the next frame, and its ground truth in the same label space if there is any.

        Raises:
            DataError: If optical flow is asked for, and the frame has no image.
        """
        labels, labelled = frame.predicted, frame.predicted != frame.ignore_id
        for meter in self._by_itself:
            meter.add(labels, labelled)
        for published, own_by_truth in zip(self._published, self._by_truth, strict=True):
            if truth is None:
                published.skip()
                own_by_truth.skip()
            else:
                published.add(labels, np.ones_like(labelled), truth.predicted)
                own_by_truth.add(labels, labelled & (truth.predicted != truth.ignore_id), truth.predicted)
        if self._previous is not None and self._previous.shape == frame.shape:
            self._compare(self._previous, frame)
        self._previous = frame

    def result(self) -> VideoMeasures:
        """Return the measures of the frames so far."""
        published = [ClipMean(meter.published, meter.published_clips) for meter in self._published]
        by_truth = [ClipMean(meter.value, meter.clips) for meter in self._by_truth]
        by_itself = [ClipMean(meter.value, meter.clips) for meter in self._by_itself]
        clips = dict(zip(CLIP_FIELDS, (*published, *by_truth, *by_itself), strict=True))
        return VideoMeasures(self._flow, **clips, tc=_overlap(self._tc), tc_seen=_overlap(self._tc_seen))

    def _compare(self, frame: Frame, following: Frame) -> None:
        flow, is_visible = _by_depth(frame, following) if self._flow == "depth" else _by_images(frame, following)
        inside = warp_labels(np.zeros(frame.shape, np.uint8), flow) == 0
        warped = warp_labels(following.predicted, flow)
        self._tc.add(frame.predicted, warped, inside)
        self._tc_seen.add(frame.predicted, warped, inside & is_visible)


Motion = tuple[npt.NDArray[np.floating], Mask]
"""Motion (H, W, 2) from a frame to the next one, pixels, and the pixels (H, W) that the next one shows, not hidden."""


def _by_depth(frame: Frame, following: Frame) -> Motion:
    """Return the motion of all pixels with depth; `flow_by_depth` leaves out what the next frame hides."""
    _, is_visible = flow_by_depth(frame, following)
    return flow_by_depth(frame, following, depth_tolerance=np.inf)[0], is_visible


def _by_images(frame: Frame, following: Frame) -> Motion:
    images = image_of(frame, frame.shape), image_of(following, following.shape)
    forward = image_flow(*images)
    return forward, ~occluded(forward, image_flow(*images[::-1]))


def image_of(frame: Frame, shape: tuple[int, int]) -> UInt8:
    """Return the frame's colour at (H, W) pixels, (H, W, 3).

    Raises:
        DataError: If it has none.
    """
    import cv2

    if frame.color is None:
        raise DataError(f"{frame.where('color')}: there is no image for optical flow; use --video-measures depth")
    if frame.color.shape[:2] == shape:
        return frame.color
    return np.asarray(cv2.resize(frame.color, shape[::-1], interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _overlap(metric: TemporalConsistency) -> WarpedOverlap:
    sums = tuple(tuple(row) for row in metric.sums.tolist())
    return WarpedOverlap(metric.score("vspw"), metric.score("etc"), metric.score("ssp"), sums)
