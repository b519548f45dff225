"""Video consistency: how many pixels keep their label over clips of n frames (Miao et al. 2021, CVPR, VSPW)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError, DataError

Labels = npt.NDArray[np.integer[Any]]
Mask = npt.NDArray[np.bool_]


class VideoConsistency:
    """VC_n with ground truth, as in VSPW: 1 is a prediction that never changes where the truth does not.

    Of the pixels whose ground truth is the same in all n frames of a clip, the share whose prediction is the same in
    all of them, right or wrong; `value` is the mean over all clips of n consecutive frames, the last one included.
    Frames are added one by one and none is kept. Clips do not reach across a change of the image size.

    n  frames a clip, at least 2; VSPW reports 8 and 16
    """

    def __init__(self, n: int) -> None:
        self._prediction = _Run(n)
        self._truth = _Run(n)
        self._clips = _Clips()

    def add(self, labels: Labels, valid: Mask, truth: Labels) -> float:
        """Add the next frame; return the consistency of the clip that ends with it, NaN where none does.

        labels  (H, W) predicted ids
        valid   (H, W) pixels that count: neither prediction nor truth is to be ignored; a pixel counts in a clip where
                it counts in all of its frames
        truth   (H, W) ground truth ids

        Raises DataError where the sizes differ.
        """
        constant = self._prediction.add(labels, valid)
        counted = self._truth.add(truth, valid)
        return self._clips.add(counted & constant, counted)

    @property
    def value(self) -> float:
        """Mean over the clips in which a pixel counts, 0 to 1; NaN where there is none."""
        return self._clips.mean


class SelfConsistency:
    """VC_n without ground truth: the share of the pixels that are valid in all n frames whose prediction is constant.

    It counts objects and cameras that move as inconsistency, as flicker does. See `VideoConsistency` for the rest.
    """

    def __init__(self, n: int) -> None:
        self._prediction = _Run(n)
        self._valid = _Run(n)
        self._clips = _Clips()

    def add(self, labels: Labels, valid: Mask) -> float:
        """Add the next frame's ids (H, W) and its pixels that count; return its clip's consistency, NaN for none.

        Raises DataError where the sizes differ.
        """
        constant = self._prediction.add(labels, valid)
        counted = self._valid.add(np.zeros(valid.shape, dtype=np.uint8), valid)
        return self._clips.add(counted & constant, counted)

    @property
    def value(self) -> float:
        """Mean over the clips in which a pixel counts, 0 to 1; NaN where there is none."""
        return self._clips.mean


class _Run:
    """For how many frames, up to n, each pixel has counted and kept its label."""

    def __init__(self, n: int) -> None:
        if not 2 <= n <= np.iinfo(np.int16).max:
            raise ConfigError(f"a clip of {n} frames: use 2 to {np.iinfo(np.int16).max}")
        self.n = n
        self._length: npt.NDArray[np.int16] = np.zeros((0, 0), dtype=np.int16)
        self._labels: Labels = np.zeros((0, 0), dtype=np.uint8)

    def add(self, labels: Labels, valid: Mask) -> Mask:
        """Where the label has been the same, and has counted, in the last n frames."""
        if labels.shape != valid.shape:
            sizes = " and ".join(f"{W}x{H}" for H, W in (labels.shape, valid.shape))
            raise DataError(f"labels and the mask of what counts differ in size ({sizes})")
        if labels.shape == self._labels.shape:
            self._length[labels != self._labels] = 0
            self._length += self._length < self.n
            self._length[~valid] = 0
        else:
            self._length = valid.astype(np.int16)
        self._labels = labels.copy()
        return self._length >= self.n


class _Clips:
    """The mean over clips."""

    def __init__(self) -> None:
        self._sum = 0.0
        self._count = 0

    def add(self, consistent: Mask, counted: Mask) -> float:
        pixels = np.count_nonzero(counted)
        if not pixels:
            return math.nan
        value = np.count_nonzero(consistent) / pixels
        self._sum += value
        self._count += 1
        return value

    @property
    def mean(self) -> float:
        return self._sum / self._count if self._count else math.nan
