"""A binary logarithm of eight numbers at a time, as instructions for compiled loops: a table and a short series."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils

from semstab.backends.shared.scores.vectors import DOUBLE, DOUBLES, INT, INT32, INTS, LANES

MANTISSA_BITS = 52
STEP_BITS = 4
STEPS = 1 << STEP_BITS

LOWEST = 0x3FE5_8000_0000_0000
"""The bits of the least m: a step has 1 in its middle, so that the logarithm of what is near 1 is exact to its bits."""

TERMS = 8
"""Of the series, which is off by 2^-50 of itself at most where |r| is at most 1/32."""


@functools.cache
def _series() -> list[float]:
    """log2(1 + r) / r in powers of r."""
    line = np.polynomial.Chebyshev.interpolate(lambda r: np.log1p(r) / r / np.log(2), TERMS - 1, [-1 / 32, 1 / 32])
    return [float(term) for term in line.convert(kind=np.polynomial.Polynomial).coef]


def _table() -> tuple[list[float], list[float]]:
    """What m is multiplied by in each step, about 1 over its middle, and what that takes from the logarithm."""
    edges = np.array([LOWEST + (i << (MANTISSA_BITS - STEP_BITS)) for i in range(STEPS + 1)]).view(np.float64)
    inverse = np.where((edges[:-1] < 1) & (edges[1:] > 1), 1.0, 2.0 / (edges[:-1] + edges[1:]))
    return inverse.tolist(), (-np.log2(inverse.astype(np.longdouble))).astype(np.float64).tolist()


INVERSE, LOGARITHM = _table()


def plogp_of(context: Any, builder: Any, p: Any) -> Any:
    """The vector of p log2 p of 0 <= p <= 2, 0 for 0, to a few units in the last place of the logarithm (with fused
    multiply-add, as machines have; else to 2^-52 beside them).

    p = 2^e m, m from `LOWEST` to twice that; m c = 1 + r with c by m's step, and log p = e - log c + log(1 + r).
    """
    bits = builder.bitcast(p, INTS)
    above = builder.sub(bits, _all(INTS, LOWEST))
    e = builder.ashr(above, _all(INTS, MANTISSA_BITS))
    m = builder.bitcast(builder.sub(bits, builder.shl(e, _all(INTS, MANTISSA_BITS))), DOUBLES)
    step = builder.and_(builder.lshr(above, _all(INTS, MANTISSA_BITS - STEP_BITS)), _all(INTS, STEPS - 1))
    r = _fused(builder, m, _looked_up(context, builder, step, INVERSE), _all(DOUBLES, -1.0))
    whole = builder.fadd(builder.sitofp(e, DOUBLES), _looked_up(context, builder, step, LOGARITHM))
    *others, last = _series()
    series = _all(DOUBLES, last)
    for term in others[::-1]:
        series = _fused(builder, series, r, _all(DOUBLES, term))
    return builder.fmul(p, _fused(builder, series, r, whole), flags=["contract"])


def _all(vector: Any, value: float) -> Any:
    return ir.Constant(vector, [value] * LANES)


def _fused(builder: Any, a: Any, b: Any, c: Any) -> Any:
    return builder.fadd(builder.fmul(a, b, flags=["contract"]), c, flags=["contract"])


def _looked_up(context: Any, builder: Any, step: Any, table: list[float]) -> Any:
    """The table's number of each lane's step: from two registers, or else from memory."""
    _, _, features = context.codegen().magic_tuple()
    if "+avx512f" in features:
        kind = ir.FunctionType(DOUBLES, [DOUBLES, INTS, DOUBLES])
        pick = cgutils.get_or_insert_function(builder.module, kind, f"llvm.x86.avx512.vpermi2var.pd.{64 * LANES}")
        low, high = (ir.Constant(DOUBLES, table[half : half + LANES]) for half in (0, LANES))
        return builder.call(pick, [low, step, high])
    numbers = cgutils.global_constant(builder, "logarithms", ir.Constant(ir.ArrayType(DOUBLE, STEPS), table))
    values = ir.Constant(DOUBLES, ir.Undefined)
    for lane in range(LANES):
        at = builder.extract_element(step, INT32(lane))
        values = builder.insert_element(values, builder.load(builder.gep(numbers, [INT(0), at])), INT32(lane))
    return values
