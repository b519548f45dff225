"""Video consistency: how many pixels keep their label over clips of n frames (Miao et al. 2021, CVPR, VSPW)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError, DataError
from semstab.model.labels import flat

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
        self._clips = _Clips(n)

    def add(self, labels: Labels, valid: Mask, truth: Labels) -> float:
        """Add the next frame; return the consistency of the clip that ends with it, NaN where none does.

        labels  (H, W) predicted ids
        valid   (H, W) pixels that count: neither prediction nor truth is to be ignored; a pixel counts in a clip where
                it counts in all of its frames
        truth   (H, W) ground truth ids

        Raises DataError where the sizes differ.
        """
        return self._clips.add(self._prediction.add(labels, valid), self._truth.add(truth, valid))

    def skip(self) -> float:
        """The next frame has no ground truth, and is in no clip: where its truth stays the same is not known. NaN."""
        self._prediction.end()
        self._truth.end()
        return math.nan

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
        self._clips = _Clips(n)

    def add(self, labels: Labels, valid: Mask) -> float:
        """Add the next frame's ids (H, W) and its pixels that count; return its clip's consistency, NaN for none.

        Raises DataError where the sizes differ.
        """
        return self._clips.add(self._prediction.add(labels, valid), self._valid.add(valid.view(np.uint8), valid))

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
        self.end()

    def end(self) -> None:
        """The next frame does not follow those before it."""
        self._length: npt.NDArray[np.int16] = np.zeros((0, 0), dtype=np.int16)
        self._labels: Labels = np.zeros((0, 0), dtype=np.uint8)

    def add(self, labels: Labels, valid: Mask) -> npt.NDArray[np.int16]:
        """Take the next frame in; of each pixel for how many frames its label has been the same and has counted."""
        from semstab.metrics.video_kernel import lengthen

        if labels.shape != valid.shape:
            sizes = " and ".join(f"{W}x{H}" for H, W in (labels.shape, valid.shape))
            raise DataError(f"labels and the mask of what counts differ in size ({sizes})")
        if labels.shape != self._labels.shape:
            self._length, self._labels = np.zeros(labels.shape, np.int16), np.zeros_like(labels)
        lengthen(flat(labels), flat(self._labels), flat(valid), self.n, self._length.reshape(-1))
        self._labels = labels.copy()
        return self._length


class _Clips:
    """The mean over clips of n frames."""

    def __init__(self, n: int) -> None:
        self.n = n
        self._sum = 0.0
        self._count = 0

    def add(self, constant: npt.NDArray[np.int16], counted: npt.NDArray[np.int16]) -> float:
        """Of the pixels that have counted for n frames, the share whose prediction has been constant as long."""
        from semstab.metrics.video_kernel import count_long

        pixels, consistent = count_long(flat(counted), flat(constant), self.n)
        if not pixels:
            return math.nan
        value: float = consistent / pixels
        self._sum += value
        self._count += 1
        return value

    @property
    def mean(self) -> float:
        return self._sum / self._count if self._count else math.nan
