"""Frame-wise flicker: what image space sees of instability (paper, Frame-wise Temporal Semantic Flicker)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from semstab.errors import DataError
from semstab.model.frames import Frame
from semstab.model.labels import flat
from semstab.pixels.warp import DEPTH_TOLERANCE, correspond


def flicker_percent(previous: Frame, current: Frame) -> float:
    """Share of the pixels valid in both frames whose label differs, same pixel coordinates, in percent.

    Soft scores count by their largest class. NaN where no pixel is valid in both.
    Raises DataError where the frames differ in size.
    """
    if previous.shape != current.shape:
        sizes = " and ".join(f"{W}x{H}" for H, W in (previous.shape, current.shape))
        raise DataError(
            f"{current.where('depth')}: frames {previous.index} and {current.index} differ in size ({sizes})"
        )
    from semstab.model.pixel_kernel import count_changed

    images = (previous.valid, previous.predicted, current.valid, current.predicted)
    both, changed = count_changed(*(flat(image) for image in images))
    return 100.0 * changed / both if both else math.nan


@dataclass(frozen=True)
class CompensatedFlicker:
    """Flicker between two views of the same surface points.

    flicker_percent  of the co-visible pixels, those whose label differs; NaN where no pixel is co-visible
    share            co-visible pixels, of the current frame's valid ones, 0 to 1; NaN where none is valid
    """

    flicker_percent: float
    share: float


def compensated_flicker(
    previous: Frame, current: Frame, *, depth_tolerance: float = DEPTH_TOLERANCE
) -> CompensatedFlicker:
    """Flicker after the previous frame's labels are warped into the current one, so that camera motion is not counted.

    A pixel is co-visible where it is valid, the previous camera saw the same surface point (see
    `semstab.pixels.warp.correspond`), and the pixel that saw it was valid too. Soft scores count by their largest
    class; the frames may differ in size. Equals `flicker_percent` where camera and depth stay as they are.

    Raises ConfigError where depth_tolerance is not above 0 and below 1.
    """
    from semstab.model.pixel_kernel import count_changed_at

    seen = correspond(current, previous, depth_tolerance=depth_tolerance).pixel
    images = (seen, current.valid, current.predicted, previous.valid, previous.predicted)
    covisible, changed = count_changed_at(*(flat(image) for image in images))
    return CompensatedFlicker(
        100.0 * changed / covisible if covisible else math.nan,
        covisible / valid if (valid := int(np.count_nonzero(current.valid))) else math.nan,
    )
