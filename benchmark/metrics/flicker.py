"""Frame-wise flicker: instability in image space (paper, Frame-wise Temporal Semantic Flicker)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Int64, Mask
from semstab.data.frames import Frame
from semstab.data.information import entropy_bits
from semstab.data.labels import flat
from semstab.errors import ConfigError, DataError
from semstab.pixels.scans import dominant_before
from semstab.pixels.warp import DEPTH_TOLERANCE, Correspondence, correspond


def flicker_percent(previous: Frame, current: Frame) -> float:
    """Return the share of the pixels valid in both frames whose label differs, same pixel coordinates, in percent.

    Soft scores count by their largest class. NaN if no pixel is valid in both.

    Raises:
        DataError: If the frames differ in size.
    """
    if previous.shape != current.shape:
        sizes = " and ".join(f"{W}x{H}" for H, W in (previous.shape, current.shape))
        raise DataError(
            f"{current.where('depth')}: frames {previous.index} and {current.index} differ in size ({sizes})"
        )
    from semstab.data.kernels import count_changed

    images = (previous.valid, previous.predicted, current.valid, current.predicted)
    num_valid, changed = count_changed(*(flat(image) for image in images))
    return 100.0 * changed / num_valid if num_valid else math.nan


def flicker_in_place(previous: Frame | None, current: Frame) -> float:
    """Return `flicker_percent`; NaN for a first frame, for frames of two sizes, and for scans."""
    if previous is None or previous.shape != current.shape or current.is_scan:
        return math.nan
    return flicker_percent(previous, current)


@dataclass(frozen=True)
class CompensatedFlicker:
    """Flicker between two views of the same surface points.

    Attributes:
        flicker_percent: Percentage of the co-visible pixels whose label differs; NaN if no pixel is co-visible.
        share: Share of the current frame's valid pixels that are co-visible, 0 to 1; NaN if no pixel is valid.
    """

    flicker_percent: float
    share: float


def compensated_flicker(
    previous: Frame, current: Frame, *, depth_tolerance: float = DEPTH_TOLERANCE, voxel_size: float = math.nan,
    correspondence: Correspondence | None = None,
) -> CompensatedFlicker:  # fmt: skip
    """Return flicker after the previous frame's labels are warped into the current one: camera motion is not counted.

    A pixel is co-visible if it is valid, the previous camera saw the same surface point (see
    `semstab.pixels.warp.correspond`), and the pixel that saw it was valid too. Soft scores count by their largest
    class; the frames may differ in size. Equals `flicker_percent` if camera and depth stay as they are.

    Scans are matched by voxels of `voxel_size`, in metres: a point is compared with the label that most points of the
    previous scan have in its voxel (see `semstab.pixels.scans.dominant_before`).

    `seen` has the pixels of the previous frame that show the same, if they do not follow from depth and pose.

    Raises:
        ConfigError: If depth_tolerance is not above 0 and below 1.
    """
    if current.is_scan or previous.is_scan:
        return _between_scans(previous, current, voxel_size)
    from semstab.data.kernels import count_changed_at

    if correspondence is None:
        correspondence = correspond(current, previous, depth_tolerance=depth_tolerance)
    images = (correspondence.pixel, current.valid, current.predicted, previous.valid, previous.predicted)
    num_covisible, changed = count_changed_at(*(flat(image) for image in images))
    return CompensatedFlicker(
        100.0 * changed / num_covisible if num_covisible else math.nan,
        num_covisible / valid if (valid := int(np.count_nonzero(current.valid))) else math.nan,
    )


def _between_scans(previous: Frame, current: Frame, voxel_size: float) -> CompensatedFlicker:
    valid = int(np.count_nonzero(current.valid))
    before = dominant_before(previous, current, voxel_size)
    met = before >= 0
    num_covisible = int(np.count_nonzero(met))
    changed = int(np.count_nonzero(before[met] != current.predicted[current.valid][met]))
    return CompensatedFlicker(
        100.0 * changed / num_covisible if num_covisible else math.nan, num_covisible / valid if valid else math.nan
    )


def covisible(previous: Frame, current: Frame, correspondence: Correspondence) -> Mask:
    """Return the valid pixels (H, W) of the current frame that the previous one shows at a valid pixel."""
    is_covisible: Mask = current.valid & correspondence.bring(previous.valid, fill=False)
    return is_covisible


def changed_pixels(previous: Frame, current: Frame, correspondence: Correspondence | None = None) -> Mask:
    """Return the co-visible pixels (H, W) whose label changed since the previous frame; see `compensated_flicker`."""
    correspondence = correspond(current, previous) if correspondence is None else correspondence
    before = correspondence.bring(previous.predicted)
    changed: Mask = covisible(previous, current, correspondence) & (before != current.predicted)
    return changed


# Video consistency: the share of pixels that keep their label over clips of n frames (Miao et al. 2021, CVPR, VSPW).

Labels = npt.NDArray[np.integer[Any]]


class VideoConsistency:
    """VC_n with ground truth, as in VSPW: 1 is a prediction that never changes where the truth does not.

    A clip has the share of the pixels with constant ground truth in its n frames whose prediction is constant too,
    right or wrong; `value` is the mean over all clips of n consecutive frames, the last one included. `published` is
    the mean that VSPW's VC_perclip.py computes: it leaves out the last clip of each video, and so videos of n frames;
    the script counts every pixel, so give masks that are True everywhere for its number.
    Frames are added one by one, and none stays in memory. Clips do not reach across a change of the image size.

    Attributes:
        n: Frames per clip, at least 2; VSPW reports 8 and 16.
    """

    def __init__(self, n: int) -> None:
        self._prediction = _Run(n)
        self._truth = _Run(n)
        self._clips = _Clips(n)

    def add(self, labels: Labels, valid: Mask, truth: Labels) -> float:
        """Add the next frame; return the consistency of the clip that ends with it, or NaN without such a clip.

        Args:
            labels: (H, W) predicted ids.
            valid: (H, W) pixels that count: neither prediction nor truth is ignored; a pixel counts in a clip
                if it counts in all frames of the clip.
            truth: (H, W) ground truth ids.

        Raises:
            DataError: If the sizes differ.
        """
        return self._clips.add(self._prediction.add(labels, valid), self._truth.add(truth, valid))

    def skip(self) -> float:
        """Skip the next frame, which has no ground truth and so is in no clip; return NaN.

        Without its truth nobody knows where the truth stays the same.
        """
        self._prediction.end()
        self._truth.end()
        return math.nan

    def end_video(self) -> None:
        """End a video: the next frame is of another one."""
        self.skip()
        self._clips.end()

    @property
    def value(self) -> float:
        """Mean over the clips in which a pixel counts, 0 to 1; NaN without clips."""
        return self._clips.mean

    @property
    def published(self) -> float:
        """Mean without the last clip of each video, 0 to 1; NaN without clips."""
        return self._clips.published

    @property
    def clips(self) -> int:
        """The number of clips behind `value`."""
        return self._clips.count

    @property
    def published_clips(self) -> int:
        """The number of clips behind `published`."""
        return self._clips.published_count


class SelfConsistency:
    """VC_n without ground truth: the share of the pixels that are valid in all n frames whose prediction is constant.

    It counts objects and cameras that move as inconsistency, as flicker does. See `VideoConsistency` for the rest.
    """

    def __init__(self, n: int) -> None:
        self._prediction = _Run(n)
        self._valid = _Run(n)
        self._clips = _Clips(n)

    def add(self, labels: Labels, valid: Mask) -> float:
        """Add the next frame's ids (H, W) and its pixels that count; return its clip's consistency, NaN for none.

        Raises:
            DataError: If the sizes differ.
        """
        return self._clips.add(self._prediction.add(labels, valid), self._valid.add(valid.view(np.uint8), valid))

    @property
    def value(self) -> float:
        """Mean over the clips in which a pixel counts, 0 to 1; NaN without clips."""
        return self._clips.mean

    @property
    def clips(self) -> int:
        """The number of clips behind `value`."""
        return self._clips.count


class _Run:
    """The number of frames, up to n, for which each pixel has counted and had its label."""

    def __init__(self, n: int) -> None:
        if not 2 <= n <= np.iinfo(np.int16).max:
            raise ConfigError(f"a clip of {n} frames: use 2 to {np.iinfo(np.int16).max}")
        self.n = n
        self.end()

    def end(self) -> None:
        """End the run: the next frame does not follow those before it."""
        self._length: npt.NDArray[np.int16] = np.zeros((0, 0), dtype=np.int16)
        self._labels: Labels = np.zeros((0, 0), dtype=np.uint8)

    def add(self, labels: Labels, valid: Mask) -> npt.NDArray[np.int16]:
        """Add the next frame; return for how many frames the label of each pixel has been the same and has counted."""
        from semstab.pixels.kernels import lengthen

        if labels.shape != valid.shape:
            sizes = " and ".join(f"{W}x{H}" for H, W in (labels.shape, valid.shape))
            raise DataError(f"labels and the mask of pixels that count differ in size ({sizes})")
        if labels.shape != self._labels.shape:
            self._length, self._labels = np.zeros(labels.shape, np.int16), np.zeros_like(labels)
        lengthen(flat(labels), flat(self._labels), flat(valid), self.n, self._length.reshape(-1))
        self._labels = labels.copy()
        return self._length


class _Clips:
    """The mean over clips of n frames."""

    def __init__(self, n: int) -> None:
        self.n = n
        self._sum, self.count = 0.0, 0
        self._last = math.nan  # of the video so far
        self._lasts, self._videos = 0.0, 0  # of the videos before

    def add(self, constant: npt.NDArray[np.int16], counted: npt.NDArray[np.int16]) -> float:
        """Return the share of the pixels that have counted for n frames whose prediction has been constant as long."""
        from semstab.pixels.kernels import count_long

        pixels, consistent = count_long(flat(counted), flat(constant), self.n)
        if not pixels:
            return math.nan
        self._last = consistent / pixels
        self._sum += self._last
        self.count += 1
        return self._last

    def end(self) -> None:
        """End a video."""
        if not math.isnan(self._last):
            self._lasts += self._last
            self._videos += 1
        self._last = math.nan

    @property
    def mean(self) -> float:
        return self._sum / self.count if self.count else math.nan

    @property
    def published_count(self) -> int:
        return self.count - self._videos - (not math.isnan(self._last))

    @property
    def published(self) -> float:
        open_ = 0.0 if math.isnan(self._last) else self._last
        count = self.published_count
        return (self._sum - self._lasts - open_) / count if count else math.nan


# Regions without classes: the change of a segmentation between two frames, whatever its ids are.

Regions = npt.NDArray[np.integer[Any]]

UNASSIGNED = 0
"""The id of a pixel that belongs to no region."""

IOU_THRESHOLD = 0.25
"""Two regions can be one where their IoU is larger. Below 1/2, so that half of a region that is split stays it."""


@dataclass(frozen=True)
class RegionChange:
    """The change of regions between two frames.

    Attributes:
        flicker_percent: Percentage of the pixels valid in both that left their region; NaN without such pixels.
        matched: Number of regions in both frames.
        births, deaths: Number of new regions of the current frame, and of lost ones of the previous frame.
        variation_of_information: Bits between the two partitions, in which the unassigned pixels are one part; NaN
            without valid pixels.
    """

    flicker_percent: float
    matched: int
    births: int
    deaths: int
    variation_of_information: float


def matched_region_flicker(
    previous: Regions,
    current: Regions,
    valid: Mask | None = None,
    *,
    iou_threshold: float = IOU_THRESHOLD,
) -> RegionChange:
    """Return the flicker of region maps whose ids mean nothing across frames, such as Segment Anything's proposals.

    Regions are matched one to one so that the sum of their IoUs over the valid pixels is largest (Hungarian method);
    pairs with an IoU of at most iou_threshold are separated again. flicker = 1 - (pixels in both regions of a pair +
    pixels unassigned in both) / valid pixels. To leave out camera motion, warp the previous map first
    (`semstab.pixels.warp.warp`) and count where that is defined.

    Args:
        previous: (H, W) region ids of the previous frame, 0 for a pixel without a region.
        current: (H, W) region ids of the current frame.
        valid: (H, W) pixels that count; all by default.
        iou_threshold: IoU that a pair must exceed.

    Raises:
        DataError: If the maps differ in size.
        ConfigError: For a threshold that is not from 0 to below 1.
    """
    if not 0 <= iou_threshold < 1:
        raise ConfigError(f"iou_threshold = {iou_threshold:g}: use a share from 0 to below 1")
    if previous.shape != current.shape:
        sizes = " and ".join(f"{W}x{H}" for H, W in (previous.shape, current.shape))
        raise DataError(f"region maps differ in size ({sizes}); bring them to one size")
    counted = slice(None) if valid is None else valid
    table = _Contingency.between(previous[counted].ravel(), current[counted].ravel())
    pairs = table.pairs(iou_threshold)
    stayed = table.both_unassigned + sum(int(table.shared[pair]) for pair in pairs)
    return RegionChange(
        flicker_percent=100 * (1 - stayed / table.pixels) if table.pixels else math.nan,
        matched=len(pairs),
        births=int(np.count_nonzero(table.current_ids)) - len(pairs),
        deaths=int(np.count_nonzero(table.previous_ids)) - len(pairs),
        variation_of_information=table.variation_of_information(),
    )


def compensated_regions(
    previous: Frame, current: Frame, counted: tuple[Mask, Mask] | None = None
) -> tuple[RegionChange, float]:
    """Return the change of regions after the previous frame is warped into the current one, and the co-visible share.

    `counted` has the pixels of the previous and of the current frame that count, all by default; the share is of the
    current ones.
    """
    correspondence = correspond(current, previous)
    before, now = counted or (np.ones(previous.shape, bool), np.ones(current.shape, bool))
    is_covisible, pixels = now & correspondence.bring(before, fill=False), np.count_nonzero(now)
    change = matched_region_flicker(correspondence.bring(previous.predicted), current.predicted, is_covisible)
    return change, np.count_nonzero(is_covisible) / pixels if pixels else math.nan


def region_flicker(previous: Frame, current: Frame) -> tuple[float, float, float]:
    """Return flicker of matched regions in place and with the camera's motion removed, percent, and the share."""
    change, share = compensated_regions(previous, current, (previous.valid, current.valid))
    if previous.shape != current.shape:
        return math.nan, change.flicker_percent, share
    plain = matched_region_flicker(previous.predicted, current.predicted, previous.valid & current.valid)
    return plain.flicker_percent, change.flicker_percent, share


@dataclass(frozen=True, eq=False)
class _Contingency:
    """Pixels (P, Q) that the p-th region of the previous and the q-th of the current map share, region 0 included."""

    previous_ids: Regions
    current_ids: Regions
    shared: Int64

    @classmethod
    def between(cls, previous: Regions, current: Regions) -> _Contingency:
        previous_ids, p = np.unique(previous, return_inverse=True)
        current_ids, q = np.unique(current, return_inverse=True)
        shape = (len(previous_ids), len(current_ids))
        shared = np.bincount(p * shape[1] + q, minlength=shape[0] * shape[1]).reshape(shape)
        return cls(previous_ids, current_ids, shared)

    @property
    def pixels(self) -> int:
        return int(self.shared.sum())

    @property
    def both_unassigned(self) -> int:
        p, q = self.previous_ids == UNASSIGNED, self.current_ids == UNASSIGNED
        return int(self.shared[np.ix_(p, q)].sum())

    def pairs(self, iou_threshold: float) -> list[tuple[int, int]]:
        """Return rows and columns of the regions that are one."""
        from scipy.optimize import linear_sum_assignment

        rows, columns = np.flatnonzero(self.previous_ids), np.flatnonzero(self.current_ids)
        shared = self.shared[np.ix_(rows, columns)]
        either = self.shared.sum(axis=1)[rows, None] + self.shared.sum(axis=0)[None, columns] - shared
        iou = shared / np.maximum(either, 1)
        matched = zip(*linear_sum_assignment(iou, maximize=True), strict=True)
        return [(int(rows[i]), int(columns[j])) for i, j in matched if iou[i, j] > iou_threshold]

    def variation_of_information(self) -> float:
        """Return H(previous | current) + H(current | previous) = 2 H(both) - H(previous) - H(current).

        Meila 2007, JMVA 98.
        """
        if not self.pixels:
            return math.nan
        joint, before, after = (
            float(entropy_bits(part / self.pixels))
            for part in (self.shared.ravel(), self.shared.sum(axis=1), self.shared.sum(axis=0))
        )
        return max(0.0, 2 * joint - before - after)
