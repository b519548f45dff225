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


class ImageSpaceMeter:
    """Takes the sampled frames of a unit in order; none but the last is kept."""

    def __init__(self) -> None:
        self._previous: Frame | None = None
        self._compensated: list[CompensatedFlicker] = []
        self._by_truth = [VideoConsistency(n) for n in CLIPS]
        self._by_itself = [SelfConsistency(n) for n in CLIPS]

    def add(self, frame: Frame, truth: Frame | None) -> None:
        """Add the next frame, with its ground truth in the same label space where there is any."""
        if self._previous is not None:
            self._compensated.append(compensated_flicker(self._previous, frame))
        for by_itself in self._by_itself:
            by_itself.add(frame.predicted, frame.valid)
        # without ground truth no pixel counts, and the clips that the frame is part of do not either
        known = np.zeros_like(frame.valid) if truth is None else frame.valid & truth.valid
        for by_truth in self._by_truth:
            by_truth.add(frame.predicted, known, frame.predicted if truth is None else truth.predicted)
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
