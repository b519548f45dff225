"""P-values of many voxels at once."""

from __future__ import annotations

import numpy as np

from semstab.core.types import Float64, Int64

ROUNDED = 12
"""Bits to which the p-values of trends are rounded up before they are adjusted."""


def rounded_up(p: Float64) -> Float64:
    """Return p-values (n,) rounded up to ROUNDED bits, so that few different ones are told apart."""
    part, exponent = np.frexp(p)
    rounded: Float64 = np.ldexp(np.ceil(np.ldexp(part, ROUNDED)), exponent - ROUNDED)
    return rounded


def benjamini_hochberg(p: Float64) -> Float64:
    """Adjusted p-values of the same shape: rejecting those <= q keeps the false discovery rate at q (1995, JRSS B 57).

    NaN is not a test. It holds for independent tests and for those that depend positively (Benjamini and Yekutieli
    2001), as neighbouring voxels do.
    """
    adjusted, tested = np.full(p.shape, np.nan), ~np.isnan(p)
    value, of, count = np.unique(p[tested], return_inverse=True, return_counts=True)
    adjusted[tested] = _raised(value, count)[of]
    return adjusted


def _raised(value: Float64, count: Int64) -> Float64:
    """Adjusted p-values of those (v,) that there are, ascending, and how often each is there."""
    by_rank = value * count.sum() / np.cumsum(count)
    lowest: Float64 = np.minimum.accumulate(by_rank[::-1])[::-1]
    return np.minimum(lowest, 1.0)
