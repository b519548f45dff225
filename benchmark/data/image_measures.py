"""Measures of the images of one unit: flicker and other measures of time, quality after filters, a video's pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

from semstab.data.statistics import OutlyingFrames


@dataclass(frozen=True)
class ImageSpace:
    """Stability in image coordinates, over the sampled frames of a unit; NaN if undefined.

    All but flicker_percent use every n-th pixel of each axis, if the longer side has more than 640.

    Attributes:
        flicker_percent: Pixels valid in both of two consecutive frames whose label differs.
        compensated_flicker_percent: The same after the previous map is warped by depth and pose, occluded pixels left
            out.
        edge_recall: Share of the edges of depth with a border of labels within two pixels.
        compensated_share: co-visible share: pixels that the warped map reaches, of the valid ones, 0 to 1.
        vc8, vc16: Video consistency over clips of 8 and 16 frames, 0 to 1: of the pixels whose ground truth stays the
            same, those whose prediction does; NaN without ground truth.
        self_vc8, self_vc16: The same of all pixels that are valid in each frame of a clip, without ground truth.
    """

    flicker_percent: float = math.nan
    compensated_flicker_percent: float = math.nan
    compensated_share: float = math.nan
    vc8: float = math.nan
    vc16: float = math.nan
    self_vc8: float = math.nan
    self_vc16: float = math.nan
    edge_recall: float = math.nan

    def without_classes(self) -> ImageSpace:
        """Return what is defined of a model without labels: the co-visible share."""
        return ImageSpace(compensated_share=self.compensated_share)

    @property
    def of_scans(self) -> bool:
        """Return whether it is of scans: their points meet in space alone, the pixels of images in the image, too."""
        return math.isnan(self.flicker_percent) and not math.isnan(self.compensated_flicker_percent)

    @property
    def changing(self) -> str:
        """Return what flicker is a share of, and how often: 'pixels per frame', 'points per scan'."""
        return "points per scan" if self.of_scans else "pixels per frame"


NO_IMAGES = ImageSpace()
"""Stability in image coordinates where nothing was measured."""


@dataclass(frozen=True)
class ClipMean:
    """The mean of video consistency over clips, 0 to 1; NaN without clips. Weigh by clips to pool videos."""

    value: float = math.nan
    clips: int = 0


@dataclass(frozen=True)
class WarpedOverlap:
    """TC of one video in three published forms, 0 to 1, see `semstab.metrics.TemporalConsistency`; NaN if undefined.

    Attributes:
        sums: (4, K) pixels by class, from which 'vspw' and 'etc' of several videos follow.
    """

    vspw: float
    etc: float
    ssp: float
    sums: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class VideoMeasures:
    """The published measures of time of one video, over all pixels of the sampled frames; see docs/metrics.md.

    Attributes:
        flow: 'depth' or 'dis', the motion by which TC warps.
        vc8_published, vc16_published: VC as VC_perclip.py counts it: without the last clip, labels of all pixels.
        vc8, vc16: VC over all clips, of the pixels that have a prediction and a true label in all frames of the clip.
        self_vc8, self_vc16: The same of the pixels that have a prediction, without ground truth.
        tc: TC of all pixels that the flow leads into the next image.
        tc_seen: Without those that are hidden there.
    """

    flow: str
    vc8_published: ClipMean
    vc16_published: ClipMean
    vc8: ClipMean
    vc16: ClipMean
    self_vc8: ClipMean
    self_vc16: ClipMean
    tc: WarpedOverlap
    tc_seen: WarpedOverlap


@dataclass(frozen=True)
class FrameQuality:
    """The quality of single frames' labels after filters; shares are 0 to 1, NaN if undefined.

    Attributes:
        model, filters: The source of the labels, and the filters over it ('ema:0.6+guided:8'; '' for nothing).
        changed: Share of the pixels that the model labels to which the filters give another label, or none.
        flicker: Share of the pixels that two frames in a row see whose label changes, camera motion removed: also where
            the frame before has no depth, unlike `ImageSpace.compensated_flicker_percent`.
        seen: The pixels behind flicker, for one that the model labels.
        coverage: Labelled pixels for one that the model labels.
        next_frame: Share of the pixels seen again by the next frame whose label the model then gives that surface
            point. No filter saw that frame: what it only repeats does not count for it.
        accuracy: Share of the labelled pixels that are right; miou the mean over classes of intersection over union.
        consistent_wrong: Share of the pixels seen again that keep a label that is wrong.
        lag: Frames by which labels follow a true change later than the model, see `semstab.metrics.frame_quality`;
            changes: the pixels that it was counted on.
        milliseconds: CPU time that the filters took for a frame, in the median.
        accuracy_by_frame, next_frame_by_frame: The same of each frame, and of each pair.
    """

    model: str
    filters: str = ""
    changed: float = math.nan
    flicker: float = math.nan
    seen: float = math.nan
    coverage: float = math.nan
    next_frame: float = math.nan
    accuracy: float = math.nan
    miou: float = math.nan
    consistent_wrong: float = math.nan
    lag: float = math.nan
    changes: int = 0
    milliseconds: float = 0.0
    accuracy_by_frame: tuple[float, ...] = ()
    next_frame_by_frame: tuple[float, ...] = ()


@dataclass(frozen=True)
class PixelStatistics:
    """Statistics of the labelled pixels of a video: without depth and poses there is no map to assess.

    Attributes:
        size: (width, height) of an image.
        classes: Names of the classes.
        outlying_frames: The frames that stand alone more often than the others; their places are pixels.
        largest_class, largest_share: The class of most labelled pixels, and its share of them, 0 to 1.
        effective_classes: 1 / sum of the squares of the classes' shares: 1 if all pixels have one class.
    """

    size: tuple[int, int]
    classes: tuple[str, ...]
    outlying_frames: OutlyingFrames
    largest_class: str
    largest_share: float
    effective_classes: float
