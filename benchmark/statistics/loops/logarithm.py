"""Logarithms for compiled loops that the compiler turns into vector instructions, as it cannot a library's."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from semstab.backends.shared.beliefs import plogp_of
from semstab.backends.shared.score_loops import DOUBLES, LANES, spread

EIGHT = LANES


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
