"""Intervals of differences and means of numbers that have nothing in common, from the intervals of these."""

from __future__ import annotations

import math
from collections.abc import Sequence

from semstab.model.statistics import NEXT_FLIGHT, THIS_MAP, Interval
from semstab.statistics.blocks import LEVEL


def unpaired(a: Interval, b: Interval, level: float = LEVEL) -> Interval:
    """A number less another one of which nothing is shared, from their intervals (Zou and Donner 2008)."""
    found = a.value - b.value
    low = found - math.hypot(a.value - a.low, b.high - b.value)
    high = found + math.hypot(a.high - a.value, b.value - b.low)
    return _combined(found, low, high, (a, b), 1.0, level)


def mean_of(found: Sequence[Interval], level: float = LEVEL) -> Interval:
    """The mean of numbers, of scenes for example, of which each errs by itself."""
    n = len(found)
    value = sum(own.value for own in found) / n
    low = value - math.hypot(*(own.value - own.low for own in found)) / n
    high = value + math.hypot(*(own.high - own.value for own in found)) / n
    return found[0] if n == 1 else _combined(value, low, high, found, 1 / n, level)


def _combined(
    value: float, low: float, high: float, parts: Sequence[Interval], weight: float, level: float
) -> Interval:
    """The p-value by the variances that the parts' intervals stand for, each with its degrees of freedom."""
    from scipy import special

    variances = [(weight * standard_error(own, level)) ** 2 for own in parts]
    spread = sum(v**2 / own.degrees for v, own in zip(variances, parts, strict=True) if v > 0 and own.degrees > 0)
    total = sum(variances)
    degrees = max(total**2 / spread, 1.0) if spread > 0 else math.inf
    p = float(2 * special.stdtr(degrees, -abs(value) / math.sqrt(total))) if total > 0 else math.nan
    questions = {own.question for own in parts}
    return Interval(
        value,
        low,
        high,
        question=NEXT_FLIGHT if questions == {NEXT_FLIGHT} else THIS_MAP,
        frames=min(own.frames for own in parts),
        places=sum(own.places for own in parts),
        block_size=max(own.block_size for own in parts),
        degrees=degrees,
        undecided="; ".join(dict.fromkeys(own.undecided for own in parts if own.undecided)),
        p_value=p,
    )


def standard_error(found: Interval, level: float = LEVEL) -> float:
    """That which an interval by Student's t stands for."""
    from scipy import special

    if not found.degrees > 0:
        return (found.high - found.low) / 2 / float(special.ndtri((1 + level) / 2))
    return (found.high - found.low) / 2 / float(special.stdtrit(found.degrees, (1 + level) / 2))
