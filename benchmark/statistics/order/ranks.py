"""Sorting small numbers in linear time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Int64 = npt.NDArray[np.int64]


def ranked(numbers: Int64) -> Int64:
    """The order (n,) that sorts numbers from 0 on, stably: by radix where they have 16 bits at most."""
    order: Int64 = np.argsort(numbers.astype(np.min_scalar_type(int(numbers.max(initial=0)))), kind="stable")
    return order
