"""Stored values that mean 'no depth', where they are taken for metres: 65535 of 16 bits is 65 m away."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FULL = 65535.0
"""What 16 bits hold at most: hardly ever a distance."""

LEAST_SHARE = 1e-3
"""Of the pixels with depth that have one and the same value, the largest of all."""

GAP = 2.0
"""A value marks pixels where it is so many times the largest depth below it."""


@dataclass(frozen=True)
class Sentinel:
    """A value that stands alone at the far end of the depths.

    value   as it is stored
    metres  what it is read as
    share   of the pixels with depth
    next    the largest depth below it, metres
    """

    value: float
    metres: float
    share: float
    next: float

    def __str__(self) -> str:
        return (
            f"{self.share:.1%} of the pixels with depth have the value {self.value:.15g} ({self.metres:.4g} m), and"
            f" nothing lies between it and {self.next:.4g} m: it means 'no depth'"
        )


def find_sentinel(depths: Iterable[npt.NDArray[np.float32]], scale: float) -> Sentinel | None:
    """The value of which `depths` (metres, `scale` stored units each) have many at the far end, and none near it."""
    valid = [depth[(depth > 0) & (depth < np.inf)] for depth in depths]
    pixels = sum(values.size for values in valid)
    largest = max((values.max() for values in valid if values.size), default=np.float32(0))
    below = max((rest.max() for values in valid if (rest := values[values < largest]).size), default=np.float32(0))
    share = sum(np.count_nonzero(values == largest) for values in valid) / max(1, pixels)
    value = float(f"{float(largest) * scale:.6g}")
    stands_alone = largest >= GAP * below or value == FULL
    if below == 0 or share < LEAST_SHARE or not stands_alone:
        return None
    return Sentinel(value, float(largest), share, float(below))
