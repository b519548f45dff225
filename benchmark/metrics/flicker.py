"""Frame-wise flicker: what image space sees of instability (paper, Frame-wise Temporal Semantic Flicker)."""

from __future__ import annotations

import math

import numpy as np

from semstab.errors import DataError
from semstab.frames import Frame


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
    both = previous.valid & current.valid
    changed = np.count_nonzero(both & (previous.predicted != current.predicted))
    total = np.count_nonzero(both)
    return 100.0 * changed / total if total else math.nan
