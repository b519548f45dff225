"""P-values of many voxels at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64

ROUNDED = 12
"""Bits of p-values that are kept: so few different ones are told apart that they can be counted."""


@dataclass(frozen=True, eq=False)
class PValues:
    """P-values of many voxels, which add up over the parts of a map: rounded up to ROUNDED bits, and how often each.

    value  (v,) ascending; count (v,)
    """

    value: Float64
    count: Int64

    @classmethod
    def of(cls, p: Float64) -> PValues:
        """Those that are no NaN, which is not a test."""
        value, count = np.unique(_rounded_up(p[~np.isnan(p)]), return_counts=True)
        return cls(value, count.astype(np.int64))

    @classmethod
    def merged(cls, parts: Sequence[PValues]) -> PValues:
        """Those of a map from its parts."""
        value, of = np.unique(np.concatenate([part.value for part in parts]), return_inverse=True)
        count = np.bincount(of, weights=np.concatenate([part.count for part in parts]), minlength=len(value))
        return cls(value, count.astype(np.int64))

    def adjusted(self, p: Float64) -> Float64:
        """What `benjamini_hochberg` makes of some of them (n,); NaN stays."""
        q = self._adjusted()
        found = np.full(len(p), np.nan)
        tested = ~np.isnan(p)
        found[tested] = q[np.searchsorted(self.value, _rounded_up(p[tested]))]
        return found

    def found(self, rate: float) -> int:
        """How many are below that rate when they are adjusted."""
        return int(self.count[self._adjusted() <= rate].sum())

    def _adjusted(self) -> Float64:
        return _raised(self.value, self.count)


def _rounded_up(p: Float64) -> Float64:
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
