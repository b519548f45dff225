"""Stability in image coordinates, measured frame by frame beside fusion."""

from __future__ import annotations

import numpy as np

from semstab.metrics import (
    CompensatedFlicker,
    SelfConsistency,
    VideoConsistency,
    compensated_flicker,
    macro_mean,
)
from semstab.model.frames import Frame
from semstab.model.records import ImageSpace

CLIPS = (8, 16)
"""Frames a clip, as VSPW reports."""

SIDE = 640
"""Pixels of the longer side from which on every n-th pixel of each axis is measured, so that fusion does not wait."""


class ImageSpaceMeter:
    """Takes the sampled frames of a unit in order; none but the last is kept."""

    def __init__(self) -> None:
        self._previous: Frame | None = None
        self._compensated: list[CompensatedFlicker] = []
        self._by_truth = [VideoConsistency(n) for n in CLIPS]
        self._by_itself = [SelfConsistency(n) for n in CLIPS]

    def add(self, frame: Frame, truth: Frame | None) -> None:
        """Add the next frame, with its ground truth in the same label space where there is any."""
        step = -(-max(frame.shape) // SIDE)
        sample, true = frame.every(step), None if truth is None else truth.every(step)
        if self._previous is not None:  # each pixel of the sample is looked up in the whole frame before
            self._compensated.append(compensated_flicker(self._previous, sample))
        for by_itself in self._by_itself:
            by_itself.add(sample.predicted, sample.valid)
        # without ground truth no pixel counts, and the clips that the frame is part of do not either
        known = np.zeros_like(sample.valid) if true is None else sample.valid & true.valid
        for by_truth in self._by_truth:
            by_truth.add(sample.predicted, known, sample.predicted if true is None else true.predicted)
        self._previous = frame

    def result(self, flicker_percent: float) -> ImageSpace:
        """Means over the frames so far, beside the flicker that the unit's summary has."""
        (vc8, vc16), (self_vc8, self_vc16) = self._by_truth, self._by_itself
        return ImageSpace(
            flicker_percent=flicker_percent,
            compensated_flicker_percent=macro_mean([pair.flicker_percent for pair in self._compensated]),
            compensated_share=macro_mean([pair.share for pair in self._compensated]),
            vc8=vc8.value,
            vc16=vc16.value,
            self_vc8=self_vc8.value,
            self_vc16=self_vc16.value,
        )
