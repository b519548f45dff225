"""TC: do labels agree with those of the next frame, warped by optical flow, or by depth and pose?

Three published forms differ in what they average, see `TemporalConsistency`; their scripts also differ in how they
warp, see `warp_labels`.
"""

from __future__ import annotations

import math
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Float64, Mask, UInt8
from semstab.data.frames import Frame
from semstab.errors import ConfigError, DataError
from semstab.metrics.correctness import iou, mean_iou
from semstab.pixels.warp import DEPTH_TOLERANCE, correspond

Form = Literal["vspw", "etc", "ssp"]
Sampling = Literal["nearest", "vspw", "etc"]

Labels = npt.NDArray[np.integer[Any]]

NO_LABEL = 255
"""Id that a warped label map has where the next frame does not show the pixel."""


class TemporalConsistency:
    """TC of one or more videos: mean IoU between a frame's labels and the next frame's, warped to it.

    - 'vspw': intersections and unions are summed over all pairs of all videos; the mean is over the classes that any
      frame's own labels have (Miao et al. 2021, CVPR, VSPW; TC_cal.py).
    - 'etc': the same sums, but the mean is over all K classes; a class that occurs nowhere counts 0 (Liu et al. 2020,
      ECCV, ETC; tool/eval_tc.py).
    - 'ssp': the mean over the videos of the mean over their pairs of the mean over the classes that the pair has
      (Hesham et al. 2025, CVPR, SSP; utils/metrics.py).

    A pixel whose own label is not one of the K classes does not count. A pixel whose warped label is not a class counts
    for 'etc' only, in the union of its own class. The scripts of VSPW and SSP end with an error at such a pixel.

    Args:
        num_classes: K.
        form: What is averaged.

    Raises:
        ConfigError: For another form, or less than one class.
    """

    def __init__(self, num_classes: int, form: Form = "vspw") -> None:
        if form not in get_args(Form):
            raise ConfigError(f"form '{form}' of TC: use one of {', '.join(get_args(Form))}")
        if num_classes < 1:
            raise ConfigError(f"num_classes = {num_classes}: TC needs at least 1")
        self.num_classes, self.form = num_classes, form
        self._sums = np.zeros((SUMS, num_classes), dtype=np.int64)
        self._pairs: list[float] = []
        self._videos: list[float] = []

    def add(self, labels: Labels, warped: Labels, counted: Mask | None = None) -> float:
        """Add a pair of frames; return its own mean IoU over the classes that it has, or NaN if no pixel counts.

        Args:
            labels: (H, W) ids of a frame.
            warped: (H, W) ids of the next frame at the frame's pixels, see `warp_labels`.
            counted: (H, W) pixels that count, such as pixels that are not occluded; all by default.

        Raises:
            DataError: If the sizes differ.
        """
        if labels.shape != warped.shape or (counted is not None and counted.shape != labels.shape):
            raise DataError(f"labels {labels.shape}, warped labels {warped.shape}: give images of one size")
        K = self.num_classes
        valid = (labels >= 0) & (labels < K)
        valid = valid if counted is None else valid & counted
        label, other = labels[valid].astype(np.int64), warped[valid].astype(np.int64)
        other = np.where((other >= 0) & (other < K), other, K)
        pair = np.bincount(label * (K + 1) + other, minlength=K * (K + 1)).reshape(K, K + 1)
        sums = np.stack([np.diag(pair), pair[:, :K].sum(axis=1), pair[:, :K].sum(axis=0), pair[:, K]])
        self._sums += sums
        value = float(mean_iou(*sums[:3]))
        if not math.isnan(value):
            self._pairs.append(value)
        return value

    def end_video(self) -> None:
        """End a video: the next pair is of another one."""
        if self._pairs:
            self._videos.append(float(np.mean(self._pairs)))
        self._pairs = []

    @property
    def value(self) -> float:
        """TC of the videos so far, 0 to 1; NaN if no pixel counts."""
        return self.score(self.form)

    def score(self, form: Form) -> float:
        """Return TC of the same pairs in another form."""
        if form == "ssp":
            videos = [*self._videos, *([float(np.mean(self._pairs))] if self._pairs else [])]
            return float(np.mean(videos)) if videos else math.nan
        return pooled_tc(self._sums, form)

    @property
    def sums(self) -> npt.NDArray[np.int64]:
        """(4, K) pixels of each class, from which 'vspw' and 'etc' are computed; sums of several videos add up.

        The rows count pixels that have the class in the own and the warped labels, in the own labels, and in the warped
        labels. The last row counts pixels of the own labels whose warped label is not a class, which the first three
        rows leave out.
        """
        return self._sums.copy()


SUMS = 4
"""Rows of `TemporalConsistency.sums`."""


def pooled_tc(sums: npt.NDArray[np.int64], form: Literal["vspw", "etc"]) -> float:
    """Return TC in a form that pools pixels, from `TemporalConsistency.sums`; NaN if no pixel counts."""
    same, num_labelled, warped, lost = sums
    if form == "vspw":
        there = num_labelled > 0
        return float(mean_iou(same[there], num_labelled[there], warped[there]))
    return float(np.nan_to_num(iou(same, num_labelled + lost, warped)).mean()) if sums.any() else math.nan


def warp_labels(labels: Labels, flow: npt.NDArray[np.floating[Any]], sampling: Sampling = "nearest") -> Labels:
    """Return the next frame's labels at a frame's pixels: q(x, y) = labels(x + flow_x, y + flow_y).

    - 'nearest': the nearest pixel's label, NO_LABEL outside the image.
    - 'vspw': as TC_cal.py and SSP: the nearest pixel of a grid that is scaled by (W / (W - 1), H / (H - 1)) and half a
      pixel off, and class 0 outside the image.
    - 'etc': as eval_tc.py: ids are interpolated linearly, and rounded down; beyond the border they are the border's.

    Args:
        labels: (H, W) ids of the next frame.
        flow: (H, W, 2) pixels, from the frame to the next one; not finite where nothing is known.
        sampling: How ids between pixels are taken.

    Raises:
        ConfigError: For another sampling.
        DataError: If the sizes differ.
    """
    if flow.shape != (*labels.shape, 2):
        raise DataError(f"flow {flow.shape} does not fit labels {labels.shape}: it is (H, W, 2)")
    H, W = labels.shape
    x: npt.NDArray[Any] = np.arange(W, dtype=np.float64) + flow[..., 0]
    y: npt.NDArray[Any] = np.arange(H, dtype=np.float64)[:, None] + flow[..., 1]
    if sampling == "nearest":
        return _nearest(labels, x, y, NO_LABEL)
    if sampling == "vspw":
        # in float32 as torch's grid_sample has it, whose rounding decides at halves
        gx, gy = (np.float32(2) * v.astype(np.float32) / np.float32(max(n - 1, 1)) - np.float32(1)
                  for v, n in ((x, W), (y, H)))  # fmt: skip
        x, y = (((g + np.float32(1)) * np.float32(n) - np.float32(1)) / np.float32(2) for g, n in ((gx, W), (gy, H)))
        return _nearest(labels, x, y, 0)
    if sampling == "etc":
        return _linear(labels, x.astype(np.float32), y.astype(np.float32))
    raise ConfigError(f"sampling '{sampling}' of warped labels: use one of {', '.join(get_args(Sampling))}")


def _nearest(labels: Labels, x: npt.NDArray[Any], y: npt.NDArray[Any], outside: int) -> Labels:
    H, W = labels.shape
    column, row = np.rint(x), np.rint(y)
    inside = (column >= 0) & (column < W) & (row >= 0) & (row < H)  # False if not finite
    warped = np.full(labels.shape, outside, dtype=labels.dtype)
    warped[inside] = labels[row[inside].astype(np.int64), column[inside].astype(np.int64)]
    return warped


def _linear(labels: Labels, x: Float32, y: Float32) -> Labels:
    H, W = labels.shape
    left, top = np.floor(x), np.floor(y)
    a, b = x - left, y - top
    west, east = (np.clip(left + k, 0, W - 1).astype(np.int64) for k in (0, 1))
    north, south = (np.clip(top + k, 0, H - 1).astype(np.int64) for k in (0, 1))
    ids = labels.astype(np.float32)
    upper = (1 - a) * (1 - b) * ids[north, west] + a * (1 - b) * ids[north, east]
    value = upper + (1 - a) * b * ids[south, west] + a * b * ids[south, east]
    warped: Labels = value.astype(labels.dtype)
    return warped


# Flow, and the pixels at which it cannot be known.


def image_flow(image: UInt8, following: UInt8) -> Float32:
    """Return the optical flow (H, W, 2) in pixels from one image (H, W, 3) uint8 RGB to the next one.

    OpenCV's dense inverse search (Kroeger et al. 2016, ECCV) at its medium preset. The scripts of VSPW, ETC and SSP use
    networks (RAFT, FlowNet2) instead.
    """
    import cv2

    grey = [cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in (image, following)]
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow: Any = search.calc(grey[0], grey[1], np.zeros((*grey[0].shape, 2), np.float32))
    return np.asarray(flow, dtype=np.float32)


def occluded(forward: Float32, backward: Float32) -> Mask:
    """Return the pixels (H, W) whose flow to the next frame and back does not return: they are hidden in it.

    |f + b|^2 > 0.01 (|f|^2 + |b|^2) + 0.5 (Sundaram et al. 2010, ECCV), b being the flow back at the pixel where f
    leads to.

    Args:
        forward: (H, W, 2) pixels, from a frame to the next one.
        backward: (H, W, 2) pixels, back from the next one.
    """
    H, W = forward.shape[:2]
    x, y = np.arange(W) + forward[..., 0], np.arange(H)[:, None] + forward[..., 1]
    column, row = np.rint(x), np.rint(y)
    inside = (column >= 0) & (column < W) & (row >= 0) & (row < H)
    hidden: Mask = ~inside
    f, b = forward[inside], backward[row[inside].astype(np.int64), column[inside].astype(np.int64)]
    lengths = (f**2).sum(axis=1) + (b**2).sum(axis=1)
    hidden[inside] = ((f + b) ** 2).sum(axis=1) > 0.01 * lengths + 0.5
    return hidden


def flow_by_depth(frame: Frame, following: Frame, *, depth_tolerance: float = DEPTH_TOLERANCE) -> tuple[Float64, Mask]:
    """Return the motion (H, W, 2) in pixels of each surface point from a frame to the next one, by depth and pose.

    Also the pixels (H, W) whose point the next frame shows, not occluded (`semstab.pixels.warp.correspond`); elsewhere
    the motion is NaN. It ends in the middle of a pixel of the next frame.
    """
    correspondence = correspond(frame, following, depth_tolerance=depth_tolerance)
    row, column = np.divmod(correspondence.pixel, following.shape[1])
    H, W = frame.shape
    flow = np.stack([column - np.arange(W), row - np.arange(H)[:, None]], axis=2).astype(np.float64)
    flow[~correspondence.visible] = np.nan
    return flow, correspondence.visible
