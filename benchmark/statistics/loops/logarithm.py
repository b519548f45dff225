"""A binary logarithm for compiled loops that the compiler turns into vector instructions, as it cannot a library's."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from semstab.backends.shared.bits import bits_of
from semstab.runtime.compiled import serial

MANTISSA_BITS = 52
ROOT_HALF = 0x3FE6A09E667F3BCD
"""The bits of 1 / sqrt(2)."""

TWO_OVER_LN2 = 2.8853900817779268


@intrinsic
def number_of(_typing: Any, _bits: Any) -> Any:
    """The double of these bits."""
    return types.float64(types.int64), lambda _, builder, __, given: builder.bitcast(given[0], ir.DoubleType())


@serial
def plogp_fast(p):
    """p log2 p of 0 <= p <= 2, 0 for 0, to a few units in the last place of the logarithm.

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
    return p * (float(e) + TWO_OVER_LN2 * s * series)
