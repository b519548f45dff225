"""Stability in image coordinates, measured frame by frame beside fusion."""

from __future__ import annotations

import math

from semstab.core.rows import Rows
from semstab.metrics import SelfConsistency, VideoConsistency, compensated_flicker
from semstab.model.frames import Frame
from semstab.model.measures import mean
from semstab.model.records import ImageSpace

CLIPS = (8, 16)
"""Frames a clip, as VSPW reports."""

COLUMNS = ("compensated_flicker_percent", "compensated_share", "vc8", "vc16", "self_vc8", "self_vc16")
"""What a frame tells together with those before it, by the name of the mean over all of them."""

SIDE = 640
"""Pixels of the longer side from which on every n-th pixel of each axis is measured, so that fusion does not wait."""


class ImageSpaceMeter:
    """Takes the sampled frames of a unit in order; none but the last is kept. rows has COLUMNS of each."""

    def __init__(self) -> None:
        self.rows = Rows(len(COLUMNS))
        self._previous: Frame | None = None
        self._by_truth = [VideoConsistency(n) for n in CLIPS]
        self._by_itself = [SelfConsistency(n) for n in CLIPS]

    def add(self, frame: Frame, truth: Frame | None) -> None:
        """Add the next frame, with its ground truth in the same label space where there is any."""
        step = -(-max(frame.shape) // SIDE)
        sample, true = frame.every(step), None if truth is None else truth.every(step)
        flicker, share = math.nan, math.nan
        if self._previous is not None:  # each pixel of the sample is looked up in the whole frame before
            pair = compensated_flicker(self._previous, sample)
            flicker, share = pair.flicker_percent, pair.share
        by_itself = [each.add(sample.predicted, sample.valid) for each in self._by_itself]
        by_truth = [
            each.skip() if true is None else each.add(sample.predicted, sample.valid & true.valid, true.predicted)
            for each in self._by_truth
        ]
        self.rows.append((flicker, share, *by_truth, *by_itself))
        self._previous = frame

    def result(self, flicker_percent: float) -> ImageSpace:
        """Means over the frames so far, beside the flicker that the unit's summary has."""
        return image_space_of(self.rows, flicker_percent)


def image_space_of(rows: Rows, flicker_percent: float) -> ImageSpace:
    """Means over frames, of which a row of COLUMNS each says what it told."""
    return ImageSpace(flicker_percent, **{name: mean(rows.column(k)) for k, name in enumerate(COLUMNS)})
