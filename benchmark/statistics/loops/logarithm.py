"""Logarithm and power for compiled loops that the compiler turns into vector instructions, as it cannot a library's."""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from semstab.backends.shared.bits import bits_of
from semstab.runtime.compiled import compiled, serial

MANTISSA_BITS = 52
ROOT_HALF = 0x3FE6A09E667F3BCD
"""The bits of 1 / sqrt(2)."""

ROUNDER = 1.5 * 2.0**MANTISSA_BITS
"""What is added to it loses its fraction, which is rounded, and has it in its last bits."""

LOWEST = -1000.0
"""Powers below are 2^LOWEST."""

LN2, TWO_OVER_LN2 = math.log(2.0), 2.0 / math.log(2.0)


@intrinsic
def number_of(_typing: Any, _bits: Any) -> Any:
    """The double of these bits."""
    return types.float64(types.int64), lambda _, builder, __, given: builder.bitcast(given[0], ir.DoubleType())


@compiled(fastmath={"contract"})
def log2_fast(p):
    """log2 p of p > 0, finite for 0, to a few units in the last place.

    p = 2^e m, m in [1/sqrt 2, sqrt 2), and log m = 2 artanh((m - 1) / (m + 1)): odd powers, whose 11th adds 2^-56.
    """
    bits: Any = bits_of(p)
    e = (bits - ROOT_HALF) >> MANTISSA_BITS
    m: Any = number_of(bits - (e << MANTISSA_BITS))
    s = (m - 1.0) / (m + 1.0)
    t = s * s
    series = 1.0 / 21.0
    series = series * t + 1.0 / 19.0
    series = series * t + 1.0 / 17.0
    series = series * t + 1.0 / 15.0
    series = series * t + 1.0 / 13.0
    series = series * t + 1.0 / 11.0
    series = series * t + 1.0 / 9.0
    series = series * t + 1.0 / 7.0
    series = series * t + 1.0 / 5.0
    series = series * t + 1.0 / 3.0
    series = series * t + 1.0
    return float(e) + TWO_OVER_LN2 * s * series


@compiled(fastmath={"contract"})
def plogp_fast(p):
    """p log2 p of p >= 0, 0 for 0."""
    return p * log2_fast(p)


@serial
def exp2_fast(x):
    """2^x of x <= 0, to a few units in the last place: its fraction by a series, whose 14th term adds 2^-57."""
    above = max(x, LOWEST)
    rounded: Any = above + ROUNDER
    y = (above - (rounded - ROUNDER)) * LN2
    series = 1.0 / 6227020800.0
    series = series * y + 1.0 / 479001600.0
    series = series * y + 1.0 / 39916800.0
    series = series * y + 1.0 / 3628800.0
    series = series * y + 1.0 / 362880.0
    series = series * y + 1.0 / 40320.0
    series = series * y + 1.0 / 5040.0
    series = series * y + 1.0 / 720.0
    series = series * y + 1.0 / 120.0
    series = series * y + 1.0 / 24.0
    series = series * y + 1.0 / 6.0
    series = series * y + 0.5
    series = series * y + 1.0
    series = series * y + 1.0
    whole: Any = bits_of(rounded) << MANTISSA_BITS
    scaled: Any = number_of(bits_of(series) + whole)
    return scaled
