"""Sums over the scores of pixels, eight classes at a time, for compiled loops.

Scores are flat arrays of float32 or float64, or of half-precision numbers by their bits (uint16), since compiled code
knows no such type. They are added up in float64, in an order that depends on the number of classes only. A pixel's last
classes are read together with what follows them: behind the last pixel there must be `LANES` numbers of whatever value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from semstab.backends.shared.prefetch import ask_for

LANES = 8

SOON = 8
"""Rows of sums that are asked for before their turn comes."""

NUMBERS = {types.float32: ir.FloatType(), types.float64: ir.DoubleType(), types.uint16: ir.HalfType()}

INT, INT32, DOUBLE = ir.IntType(64), ir.IntType(32), ir.DoubleType()
DOUBLES, INTS = ir.VectorType(DOUBLE, LANES), ir.VectorType(INT, LANES)
ZEROS = ir.Constant(DOUBLES, [0.0] * LANES)


@intrinsic
def scale_eight(_typing: Any, scores: Any, _at: Any, _K: Any, keys: Any, scale: Any, _u: Any) -> Any:
    """scale_eight(scores, at, K, keys, scale, u): 1 / the sum of each of eight pixels' scores, from scores[at] on.

    Leaves it in scale[u : u + 8]; keys[u : u + 8], int64, become -1 where it is not a positive number.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, at, K, _, _, u = arguments
        pixels = [builder.add(at, builder.mul(K, INT(pixel))) for pixel in range(LANES)]
        total = _folded(builder, _sums(context, builder, signature.args[0], array, pixels, K))
        key, scales = (
            builder.bitcast(builder.gep(_data(context, builder, signature, arguments, i), [u]), kind.as_pointer())
            for i, kind in ((3, INTS), (4, DOUBLES))
        )
        sound = builder.and_(
            builder.fcmp_ordered(">", total, ZEROS),
            builder.fcmp_ordered("<", total, ir.Constant(DOUBLES, [float("inf")] * LANES)),
        )
        kept = builder.select(sound, builder.load(key, align=8), ir.Constant(INTS, [-1] * LANES))
        builder.store(kept, key, align=8)
        builder.store(builder.fdiv(ir.Constant(DOUBLES, [1.0] * LANES), total), scales, align=8)
        return context.get_dummy_value()

    number = types.intp
    return types.void(scores, number, number, keys, scale, number), generate


@intrinsic
def add_two(
    _typing: Any, scores: Any, _at: Any, _K: Any, scale: Any, _u: Any, _end: Any, sums: Any, _to: Any, _fresh: Any
) -> Any:
    """add_two(scores, at, K, scale, u, end, sums, to, fresh): add u's scores and the next pixel's to their voxel.

    sums[to : to + K] += scale[u] * scores[at + u * K : at + (u + 1) * K], or = where `fresh`, and likewise of u + 1 if
    that is below `end`; it is read in any case, as nobody can predict whether it is, and must be there.

    `sums` is float64, and has room for a multiple of `LANES` values at `to`: those beyond K get 0 added. Rows of
    as many lie one behind the other, and a later one, which may not have been written to yet, is asked for.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, at, K, _, u, end, _, to, fresh = arguments
        pixels = [u, builder.add(u, INT(1))]
        places = [builder.add(at, builder.mul(K, pixel)) for pixel in pixels]
        counted = [builder.icmp_signed("<", pixel, end) for pixel in pixels]
        scales = _data(context, builder, signature, arguments, 3)
        factors = [
            spread(builder, builder.select(counts, builder.load(builder.gep(scales, [pixel])), DOUBLE(0.0)), DOUBLES)
            for pixel, counts in zip(pixels, counted, strict=True)
        ]
        row = builder.gep(_data(context, builder, signature, arguments, 6), [to])
        ahead = builder.mul(builder.and_(builder.add(K, INT(LANES - 1)), INT(-LANES)), INT(SOON))

        def add(values: list[Any], k: Any) -> None:
            place = builder.bitcast(builder.gep(row, [k]), DOUBLES.as_pointer())
            total = builder.select(fresh, ZEROS, builder.load(place, align=8))
            for value, factor, counts in zip(values, factors, counted, strict=True):
                scaled = builder.fmul(builder.select(counts, value, ZEROS), factor, flags=["contract"])
                total = builder.fadd(total, scaled, flags=["contract"])
            builder.store(total, place, align=8)
            ask_for(builder, builder.gep(row, [builder.add(k, ahead)]))

        _by_eights(context, builder, signature.args[0], array, places, K, add)
        return context.get_dummy_value()

    number = types.intp
    return types.void(scores, number, number, scale, number, number, sums, number, types.boolean), generate


def _data(context: Any, builder: Any, signature: Any, arguments: Any, i: int) -> Any:
    return context.make_array(signature.args[i])(context, builder, arguments[i]).data


def _sums(context: Any, builder: Any, kind: Any, array: Any, places: list[Any], K: Any) -> list[Any]:
    """For each place the vector of sums of every eighth of the K numbers from there on."""
    totals = [cgutils.alloca_once_value(builder, ZEROS) for _ in places]
    for total in totals:
        builder.store(ZEROS, total)

    def add(values: list[Any], _: Any) -> None:
        for total, value in zip(totals, values, strict=True):
            builder.store(builder.fadd(builder.load(total), value), total)

    _by_eights(context, builder, kind, array, places, K, add)
    return [builder.load(total) for total in totals]


def _folded(builder: Any, vectors: list[Any]) -> Any:
    """The sums of the lanes of eight vectors, as one vector: the lanes of each are halved three times, in pairs."""
    lanes = LANES
    while len(vectors) > 1:
        half = lanes // 2
        first = [i for i in range(2 * LANES) if i % lanes < half]
        low, high = (ir.Constant(ir.VectorType(INT32, LANES), [i + by for i in first]) for by in (0, half))
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = [
            builder.fadd(builder.shuffle_vector(a, b, low), builder.shuffle_vector(a, b, high)) for a, b in pairs
        ]
        lanes = half
    return vectors[0]


def _by_eights(
    context: Any, builder: Any, kind: Any, array: Any, places: list[Any], K: Any,
    do: Callable[[list[Any], Any], None],
) -> None:  # fmt: skip
    """Code that does something with each eight of the K numbers from each place, the rest filled up by 0.

    do  is given a vector of doubles for each place, and the place of its first one among the K
    """
    number, vector = NUMBERS[kind.dtype], ir.VectorType(NUMBERS[kind.dtype], LANES)
    data = builder.bitcast(context.make_array(kind)(context, builder, array).data, number.as_pointer())
    starts = [builder.gep(data, [place]) for place in places]
    size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    whole = builder.and_(K, INT(-LANES))
    rest = builder.sub(K, whole)

    def eight(start: Any, k: Any) -> Any:
        return builder.load(builder.bitcast(builder.gep(start, [k]), vector.as_pointer()), align=size)

    def widened(values: Any) -> Any:
        return values if vector == DOUBLES else builder.fpext(values, DOUBLES)

    with cgutils.for_range_slice(builder, INT(0), whole, INT(LANES), intp=INT) as (k, _):
        do([widened(eight(start, k)) for start in starts], k)
    with builder.if_then(builder.icmp_signed(">", rest, INT(0))):
        lanes = ir.Constant(INTS, list(range(LANES)))
        kept, nothing = builder.icmp_signed("<", lanes, spread(builder, rest, INTS)), ir.Constant(vector, [0.0] * LANES)
        do([widened(builder.select(kept, eight(start, whole), nothing)) for start in starts], whole)


def spread(builder: Any, value: Any, vector: Any) -> Any:
    """A vector of equal values."""
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, INT32(0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(INT32, vector.count), [0] * vector.count))
