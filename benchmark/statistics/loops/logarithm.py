"""Logarithm and power for compiled loops that the compiler turns into vector instructions, as it cannot a library's."""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from semstab.backends.shared.beliefs import plogp_of
from semstab.backends.shared.pixel_keys import bits_of
from semstab.backends.shared.score_loops import DOUBLES, LANES, spread
from semstab.core.compiled import serial

MANTISSA_BITS = 52
ROUNDER = 1.5 * 2.0**MANTISSA_BITS
"""What is added to it loses its fraction, which is rounded, and has it in its last bits."""

LOWEST = -1000.0
"""Powers below are 2^LOWEST."""

LN2 = math.log(2.0)

EIGHT = LANES


@intrinsic
def number_of(_typing: Any, _bits: Any) -> Any:
    """The double of these bits."""
    return types.float64(types.int64), lambda _, builder, __, given: builder.bitcast(given[0], ir.DoubleType())


@intrinsic
def add_plogp(_typing: Any, to: Any, _at: Any, by: Any, _from: Any, p: Any, _of: Any) -> Any:
    """add_plogp(to, at, by, i, p, j): to[at : at + 8] += by[i : i + 8] * p log2 p of p[j : j + 8], 0 for 0.

    Places are counted from an array's beginning, whatever its shape; it must be contiguous.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        total, factor, belief = (_eight(context, builder, signature, arguments, i) for i in (0, 2, 4))
        term = _times(builder, builder.load(factor, align=8), plogp_of(context, builder, builder.load(belief, align=8)))
        builder.store(_plus(builder, builder.load(total, align=8), term), total, align=8)
        return context.get_dummy_value()

    place = types.intp
    return types.void(to, place, by, place, p, place), generate


@intrinsic
def add_step(
    _typing: Any, drift: Any, _lane: Any, seen: Any, _at: Any, more: Any, _of: Any,
    _before: Any, _after: Any, _mixed: Any, _whole: Any,
) -> Any:  # fmt: skip
    """add_step(drift, lane, seen, at, more, j, before, after, mixed, whole): what more evidence of a class changes.

    seen[at : at + 8] += more[j : j + 8]. With p = before * evidence as it was, q = after * evidence as it is then:
    drift[lane : lane + 8] += whole * q log2 q - mixed * m log2 m of m = (p + q) / 2. Places as in `add_plogp`.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        total, own, new = (_eight(context, builder, signature, arguments, i) for i in (0, 2, 4))
        before, after, mixed, whole = (spread(builder, argument, DOUBLES) for argument in arguments[6:])
        was = builder.load(own, align=8)
        value = builder.fadd(was, builder.load(new, align=8))
        builder.store(value, own, align=8)
        q = _times(builder, value, after)
        m = _times(builder, _plus(builder, _times(builder, was, before), q), ir.Constant(DOUBLES, [0.5] * LANES))
        gone = _times(builder, mixed, plogp_of(context, builder, m))
        step = builder.fsub(_times(builder, whole, plogp_of(context, builder, q)), gone, flags=["contract"])
        builder.store(_plus(builder, builder.load(total, align=8), step), total, align=8)
        return context.get_dummy_value()

    place, number = types.intp, types.float64
    return types.void(drift, place, seen, place, more, place, number, number, number, number), generate


def _eight(context: Any, builder: Any, signature: Any, arguments: Any, i: int) -> Any:
    """Where eight numbers of array i lie, from the place on that the next argument says."""
    array = context.make_array(signature.args[i])(context, builder, arguments[i])
    return builder.bitcast(builder.gep(array.data, [arguments[i + 1]]), DOUBLES.as_pointer())


def _plus(builder: Any, a: Any, b: Any) -> Any:
    return builder.fadd(a, b, flags=["contract"])


def _times(builder: Any, a: Any, b: Any) -> Any:
    return builder.fmul(a, b, flags=["contract"])


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
