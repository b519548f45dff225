"""What an observation changes in a voxel's dense evidence, eight classes at a time."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from semstab.backends.shared.scores.logarithm import plogp_of
from semstab.backends.shared.scores.vectors import DOUBLE, DOUBLES, INT, INTS, LANES, NUMBERS, spread

HALVES, ZEROS = ir.Constant(DOUBLES, [0.5] * LANES), ir.Constant(DOUBLES, [0.0] * LANES)
FOUND = types.Tuple([types.float64] * 5 + [types.intp])


@intrinsic
def observe_eights(_typing: Any, evidence: Any, _sums: Any, _share: Any, _before: Any, _after: Any) -> Any:
    """observe_eights(evidence, sums, share, before, after): add s = share * sums to evidence, and what comes of it.

    Both arrays hold as many numbers, a multiple of `LANES`; those beyond the classes are 0. With p = before * evidence
    as it was, and q = after * evidence as it is then: the sums over classes of q log2 q, m log2 m of m = (p + q) / 2,
    s^2 and s log2 s; the largest evidence and its class, the lowest on a tie.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        own, seen = (context.make_array(signature.args[i])(context, builder, arguments[i]) for i in (0, 1))
        share, before, after = (spread(builder, argument, DOUBLES) for argument in arguments[2:])
        number = NUMBERS[signature.args[0].dtype]
        size = context.get_abi_sizeof(context.get_data_type(signature.args[0].dtype))
        totals = [cgutils.alloca_once_value(builder, ZEROS) for _ in range(4)]
        most = cgutils.alloca_once_value(builder, ir.Constant(DOUBLES, [-1.0] * LANES))
        classes = cgutils.alloca_once_value(builder, ir.Constant(INTS, [0] * LANES))
        (length,) = cgutils.unpack_tuple(builder, own.shape, 1)

        def plus(a: Any, b: Any) -> Any:
            return builder.fadd(a, b, flags=["contract"])

        def times(a: Any, b: Any) -> Any:
            return builder.fmul(a, b, flags=["contract"])

        with cgutils.for_range_slice(builder, INT(0), length, INT(LANES), intp=INT) as (k, _):
            place = builder.bitcast(builder.gep(seen.data, [k]), DOUBLES.as_pointer())
            s = times(builder.load(place, align=8), share)
            place = builder.bitcast(builder.gep(own.data, [k]), ir.VectorType(number, LANES).as_pointer())
            was = builder.load(place, align=size)
            was = was if number == DOUBLE else builder.fpext(was, DOUBLES)
            p, value = times(was, before), plus(was, s)
            stored = value if number == DOUBLE else builder.fptrunc(value, ir.VectorType(number, LANES))
            builder.store(stored, place, align=size)
            value = value if number == DOUBLE else builder.fpext(stored, DOUBLES)
            q = times(value, after)
            terms = (
                plogp_of(context, builder, q), plogp_of(context, builder, times(plus(p, q), HALVES)), times(s, s),
                plogp_of(context, builder, s),
            )  # fmt: skip
            for total, term in zip(totals, terms, strict=True):
                builder.store(plus(builder.load(total), term), total)
            larger = builder.fcmp_ordered(">", value, builder.load(most))
            builder.store(builder.select(larger, value, builder.load(most)), most)
            builder.store(builder.select(larger, spread(builder, k, INTS), builder.load(classes)), classes)
        top = _over_lanes(builder, "fmax", DOUBLE, [builder.load(most)], ["nnan"])
        lanes = builder.add(builder.load(classes), ir.Constant(INTS, list(range(LANES))))
        leads = builder.fcmp_ordered("==", builder.load(most), spread(builder, top, DOUBLES))
        first = builder.select(leads, lanes, ir.Constant(INTS, [1 << 62] * LANES))
        found = [
            *(
                _over_lanes(builder, "fadd", DOUBLE, [DOUBLE(0.0), builder.load(total)], ["reassoc"])
                for total in totals
            ),
            top,
            _over_lanes(builder, "smin", INT, [first], []),
        ]
        return context.make_tuple(builder, FOUND, found)

    number = types.float64
    return FOUND(evidence, _sums, number, number, number), generate


def _over_lanes(builder: Any, what: str, kind: Any, values: list[Any], flags: list[str]) -> Any:
    """Such a sum, or such an extreme, of the lanes of a vector."""
    name = f"llvm.vector.reduce.{what}.v{LANES}{'i64' if kind == INT else 'f64'}"
    reduce = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(kind, [value.type for value in values]), name
    )
    return builder.call(reduce, values, fastmath=flags)
