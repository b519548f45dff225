"""Sums over the scores of a pixel, eight classes at a time, for compiled loops.

Scores are flat arrays of float32 or float64, or of half-precision numbers by their bits (uint16), since compiled code
knows no such type. They are added up in float64, in an order that depends on the number of classes only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

LANES = 8
NUMBERS = {types.float32: ir.FloatType(), types.float64: ir.DoubleType(), types.uint16: ir.HalfType()}
NAMES = {types.float32: "f32", types.float64: "f64", types.uint16: "f16"}

INT, INT32, DOUBLE = ir.IntType(64), ir.IntType(32), ir.DoubleType()
DOUBLES, INTS = ir.VectorType(DOUBLE, LANES), ir.VectorType(INT, LANES)


@intrinsic
def total_of(_typing: Any, scores: Any, _at: Any, _K: Any) -> Any:
    """total_of(scores, at, K): the sum of scores[at : at + K]."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        total = cgutils.alloca_once_value(builder, ir.Constant(DOUBLES, [0.0] * LANES))

        def add(values: Any, _: Any) -> None:
            builder.store(builder.fadd(builder.load(total), values), total)

        _each_eight(context, builder, signature.args[0], arguments, add)
        kind = ir.FunctionType(DOUBLE, [DOUBLE, DOUBLES])
        reduce = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.fadd.v{LANES}f64")
        return builder.call(reduce, [ir.Constant(DOUBLE, 0.0), builder.load(total)], fastmath=["reassoc"])

    return types.float64(scores, types.intp, types.intp), generate


@intrinsic
def add_scaled(_typing: Any, scores: Any, _at: Any, _K: Any, _scale: Any, sums: Any, _to: Any) -> Any:
    """add_scaled(scores, at, K, scale, sums, to): sums[to : to + K] += scale * scores[at : at + K].

    `sums` is float64, and has room for a multiple of `LANES` values at `to`: those beyond K get 0 added.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        factor = spread(builder, arguments[3], DOUBLES)
        row = builder.gep(context.make_array(sums)(context, builder, arguments[4]).data, [arguments[5]])

        def add(values: Any, k: Any) -> None:
            place = builder.bitcast(builder.gep(row, [k]), DOUBLES.as_pointer())
            scaled = builder.fmul(values, factor, flags=["contract"])
            builder.store(builder.fadd(builder.load(place, align=8), scaled, flags=["contract"]), place, align=8)

        _each_eight(context, builder, signature.args[0], arguments, add)
        return context.get_dummy_value()

    return types.void(scores, types.intp, types.intp, types.float64, sums, types.intp), generate


def _each_eight(context: Any, builder: Any, kind: Any, arguments: Any, do: Callable[[Any, Any], None]) -> None:
    """Code that does something with each eight of `K` numbers of an array from `at`, and with the rest filled up by 0.

    arguments  array, at, K
    do         is given a vector of doubles and the place of its first one among the K
    """
    array = context.make_array(kind)(context, builder, arguments[0])
    at, K = arguments[1:3]
    number, vector = NUMBERS[kind.dtype], ir.VectorType(NUMBERS[kind.dtype], LANES)
    start = builder.gep(builder.bitcast(array.data, number.as_pointer()), [at])
    size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    whole = builder.and_(K, INT(-LANES))
    rest = builder.sub(K, whole)

    def place(k: Any) -> Any:
        return builder.bitcast(builder.gep(start, [k]), vector.as_pointer())

    def widened(values: Any) -> Any:
        return values if vector == DOUBLES else builder.fpext(values, DOUBLES)

    with cgutils.for_range_slice(builder, INT(0), whole, INT(LANES), intp=INT) as (k, _):
        do(widened(builder.load(place(k), align=size)), k)
    with builder.if_then(builder.icmp_signed(">", rest, INT(0))):
        values = cgutils.alloca_once(builder, vector)
        lanes = ir.Constant(ir.VectorType(INT, LANES), list(range(LANES)))
        kept = builder.icmp_signed("<", lanes, spread(builder, rest, ir.VectorType(INT, LANES)))
        nothing = ir.Constant(vector, [0.0] * LANES)
        (length,) = cgutils.unpack_tuple(builder, array.shape, 1)
        beyond = builder.add(builder.add(at, whole), INT(LANES))
        # not every machine has masked loads; all but the last pixels may read into the next one instead
        with builder.if_else(builder.icmp_signed("<=", beyond, length)) as (inside, at_the_end):
            with inside:
                builder.store(builder.select(kept, builder.load(place(whole), align=size), nothing), values)
            with at_the_end:
                mask = ir.VectorType(ir.IntType(1), LANES)
                load = ir.FunctionType(vector, [vector.as_pointer(), mask, vector])
                name = f"llvm.masked.load.v{LANES}{NAMES[kind.dtype]}.p0"
                masked = cgutils.get_or_insert_function(builder.module, load, name)
                builder.store(builder.call(masked, [place(whole), kept, nothing]), values)
        do(widened(builder.load(values)), whole)


def spread(builder: Any, value: Any, vector: Any) -> Any:
    """A vector of equal values."""
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, INT32(0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(INT32, vector.count), [0] * vector.count))
