"""Compiled loops behind video consistency: for how long each pixel has kept its label."""

from __future__ import annotations

from typing import Any

import numpy as np

from semstab.runtime.compiled import serial


@serial
def lengthen(labels: Any, before: Any, valid: Any, most: int, length: Any) -> None:
    """For how many frames, `most` at most, each pixel has counted and kept its label; all arrays are (n,)."""
    for i in range(len(length)):
        kept = np.int32(length[i]) if labels[i] == before[i] else np.int32(0)
        length[i] = min(kept + np.int32(1), np.int32(most)) if valid[i] else np.int32(0)


@serial
def count_long(counted: Any, constant: Any, n: int) -> tuple[int, int]:
    """The pixels whose first length is n, and those among them whose second one is too."""
    pixels = both = 0
    for i in range(len(counted)):
        long = counted[i] >= n
        pixels += long
        both += long & (constant[i] >= n)
    return pixels, both
