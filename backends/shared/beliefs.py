"""Terms of entropy and of the Jensen-Shannon divergence, as compiled loops over classes add them up."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from semstab.backends.shared.score_loops import DOUBLE, DOUBLES, INT, INT32, INTS, LANES, NUMBERS, spread
from semstab.core.compiled import compiled, helper

# A binary logarithm of eight numbers at a time, as instructions for compiled loops: a table and a short series.

MANTISSA_BITS = 52
STEP_BITS = 4
STEPS = 1 << STEP_BITS

LOWEST = 0x3FE5_8000_0000_0000
"""The bits of the least m: a step has 1 in its middle, so that the logarithm of numbers near 1 is exact to its bits."""

TERMS = 8
"""The terms of the series, which is off by 2^-50 of itself at most where |r| is at most 1/32."""


@functools.cache
def _series() -> list[float]:
    """Return the coefficients of log2(1 + r) / r in powers of r."""
    line = np.polynomial.Chebyshev.interpolate(lambda r: np.log1p(r) / r / np.log(2), TERMS - 1, [-1 / 32, 1 / 32])
    return [float(term) for term in line.convert(kind=np.polynomial.Polynomial).coef]


def _table() -> tuple[list[float], list[float]]:
    """Return the factor of m in each step, about 1 over its middle, and the logarithm of that factor."""
    edges = np.array([LOWEST + (i << (MANTISSA_BITS - STEP_BITS)) for i in range(STEPS + 1)]).view(np.float64)
    inverse = np.where((edges[:-1] < 1) & (edges[1:] > 1), 1.0, 2.0 / (edges[:-1] + edges[1:]))
    return inverse.tolist(), (-np.log2(inverse.astype(np.longdouble))).astype(np.float64).tolist()


INVERSE, LOGARITHM = _table()


def plogp_of(context: Any, builder: Any, p: Any) -> Any:
    """Return the vector of p log2 p of 0 <= p <= 2, 0 for 0.

    It is right to a few units in the last digit of the logarithm (with fused multiply-add, as machines have; else to
    2^-52).

    p = 2^e m, m from `LOWEST` to twice that; m c = 1 + r with c by m's step, and log p = e - log c + log(1 + r).
    """
    bits = builder.bitcast(p, INTS)
    above = builder.sub(bits, _all(INTS, LOWEST))
    e = builder.ashr(above, _all(INTS, MANTISSA_BITS))
    m = builder.bitcast(builder.sub(bits, builder.shl(e, _all(INTS, MANTISSA_BITS))), DOUBLES)
    step = builder.and_(builder.lshr(above, _all(INTS, MANTISSA_BITS - STEP_BITS)), _all(INTS, STEPS - 1))
    r = _fused(builder, m, _looked_up(context, builder, step, INVERSE), _all(DOUBLES, -1.0))
    approximate = builder.fadd(builder.sitofp(e, DOUBLES), _looked_up(context, builder, step, LOGARITHM))
    *coefficients, last = _series()
    series = _all(DOUBLES, last)
    for term in coefficients[::-1]:
        series = _fused(builder, series, r, _all(DOUBLES, term))
    return builder.fmul(p, _fused(builder, series, r, approximate), flags=["contract"])


def _all(vector: Any, value: float) -> Any:
    return ir.Constant(vector, [value] * LANES)


def _fused(builder: Any, a: Any, b: Any, c: Any) -> Any:
    return builder.fadd(builder.fmul(a, b, flags=["contract"]), c, flags=["contract"])


def _looked_up(context: Any, builder: Any, step: Any, table: list[float]) -> Any:
    """Return the table's number of each lane's step: from two registers, or else from memory."""
    _, _, features = context.codegen().magic_tuple()
    if "+avx512f" in features:
        kind = ir.FunctionType(DOUBLES, [DOUBLES, INTS, DOUBLES])
        pick = cgutils.get_or_insert_function(builder.module, kind, f"llvm.x86.avx512.vpermi2var.pd.{64 * LANES}")
        low, high = (ir.Constant(DOUBLES, table[half : half + LANES]) for half in (0, LANES))
        return builder.call(pick, [low, step, high])
    numbers = cgutils.global_constant(builder, "logarithms", ir.Constant(ir.ArrayType(DOUBLE, STEPS), table))
    values = ir.Constant(DOUBLES, ir.Undefined)
    for lane in range(LANES):
        index = builder.extract_element(step, INT32(lane))
        values = builder.insert_element(values, builder.load(builder.gep(numbers, [INT(0), index])), INT32(lane))
    return values


# The update of a voxel's dense evidence by an observation, eight classes at a time.

HALVES, ZEROS = ir.Constant(DOUBLES, [0.5] * LANES), ir.Constant(DOUBLES, [0.0] * LANES)
RESULT = types.Tuple([types.float64] * 5 + [types.intp])


@intrinsic
def observe_eights(_typing: Any, evidence: Any, _sums: Any, _share: Any, _before: Any, _after: Any) -> Any:
    """Add s = share * sums to evidence, and return sums over the result.

    Arguments: evidence, sums, share, before, after.
    Both arrays hold as many numbers, a multiple of `LANES`; those beyond the classes are 0. With p = before * evidence
    as it was, and q = after * evidence as it is then: the sums over classes of q log2 q, m log2 m of m = (p + q) / 2,
    s^2 and s log2 s; the largest evidence and its class, the lowest on a tie.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        evidence_array, sums_array = (
            context.make_array(signature.args[i])(context, builder, arguments[i]) for i in (0, 1)
        )
        share, before, after = (spread(builder, argument, DOUBLES) for argument in arguments[2:])
        number = NUMBERS[signature.args[0].dtype]
        size = context.get_abi_sizeof(context.get_data_type(signature.args[0].dtype))
        totals = [cgutils.alloca_once_value(builder, ZEROS) for _ in range(4)]
        most = cgutils.alloca_once_value(builder, ir.Constant(DOUBLES, [-1.0] * LANES))
        classes = cgutils.alloca_once_value(builder, ir.Constant(INTS, [0] * LANES))
        (length,) = cgutils.unpack_tuple(builder, evidence_array.shape, 1)

        def plus(a: Any, b: Any) -> Any:
            return builder.fadd(a, b, flags=["contract"])

        def times(a: Any, b: Any) -> Any:
            return builder.fmul(a, b, flags=["contract"])

        with cgutils.for_range_slice(builder, INT(0), length, INT(LANES), intp=INT) as (k, _):
            pointer = builder.bitcast(builder.gep(sums_array.data, [k]), DOUBLES.as_pointer())
            s = times(builder.load(pointer, align=8), share)
            pointer = builder.bitcast(builder.gep(evidence_array.data, [k]), ir.VectorType(number, LANES).as_pointer())
            was = builder.load(pointer, align=size)
            was = was if number == DOUBLE else builder.fpext(was, DOUBLES)
            p, value = times(was, before), plus(was, s)
            stored = value if number == DOUBLE else builder.fptrunc(value, ir.VectorType(number, LANES))
            builder.store(stored, pointer, align=size)
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
        sums = [
            _over_lanes(builder, "fadd", DOUBLE, [DOUBLE(0.0), builder.load(total)], ["reassoc"]) for total in totals
        ]
        return context.make_tuple(builder, RESULT, [*sums, top, _over_lanes(builder, "smin", INT, [first], [])])

    number = types.float64
    return RESULT(evidence, _sums, number, number, number), generate


@intrinsic
def plogp_eights(_typing: Any, evidence: Any, _before: Any) -> Any:
    """Return the sum of p log2 p over p = before * evidence, an array as `observe_eights` takes it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        evidence_array = context.make_array(signature.args[0])(context, builder, arguments[0])
        before = spread(builder, arguments[1], DOUBLES)
        total = cgutils.alloca_once_value(builder, ZEROS)
        (length,) = cgutils.unpack_tuple(builder, evidence_array.shape, 1)
        with cgutils.for_range_slice(builder, INT(0), length, INT(LANES), intp=INT) as (k, _):
            pointer = builder.bitcast(builder.gep(evidence_array.data, [k]), DOUBLES.as_pointer())
            p = builder.fmul(builder.load(pointer, align=8), before)
            builder.store(builder.fadd(builder.load(total), plogp_of(context, builder, p)), total)
        return _over_lanes(builder, "fadd", DOUBLE, [DOUBLE(0.0), builder.load(total)], ["reassoc"])

    return types.float64(evidence, types.float64), generate


def _over_lanes(builder: Any, what: str, kind: Any, values: list[Any], flags: list[str]) -> Any:
    """Return a sum, or an extreme, of the lanes of a vector."""
    name = f"llvm.vector.reduce.{what}.v{LANES}{'i64' if kind == INT else 'f64'}"
    reduce = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(kind, [value.type for value in values]), name
    )
    return builder.call(reduce, values, fastmath=flags)


@helper
def plogp(p):
    """Return p log2 p, 0 for 0."""
    return p * np.log2(p) if p > 0.0 else 0.0


@helper
def js_term(p, q):
    """Return one class's part of the Jensen-Shannon divergence, bits."""
    m = 0.5 * (p + q)
    term = 0.0
    if p > 0.0 and m > 0.0:
        term += p * np.log2(p / m)
    if q > 0.0 and m > 0.0:
        term += q * np.log2(q / m)
    return 0.5 * term


@compiled(helper=True, forceinline=True)
def observe_row(evidence, sums, pixels, op, dominant, plogp_before, out):
    """Add one observation to a voxel's dense evidence, seen `op` times before.

    - `evidence`, `sums`: as `observe_eights` takes them; `sums` adds up the normalised scores of the frame's pixels

    `dominant` and `plogp_before` are out[4] and out[7] of the observation before, which spares the search for them.
    `out` receives eight numbers, in this order:

    - the change of VSS
    - the change of the entropy, bits
    - the drift, bits
    - the dominant class before the observation
    - the dominant class after the observation
    - the squared length of s_bar
    - the entropy of s_bar, bits
    - the sum of p log2 p over the classes
    """
    before, after = 1.0 / max(op, 1), 1.0 / (op + 1)
    top_before = evidence[dominant] * before
    result: Any = observe_eights(evidence, sums, 1.0 / pixels, before, after)
    plogp_after, plogp_between, squares, plogp_seen, top, then = result
    out[0] = top * after - top_before
    out[1] = plogp_before - plogp_after
    out[2] = min(max(0.5 * (plogp_before + plogp_after) - plogp_between, 0.0), 1.0) if op > 0 else 0.0
    out[3], out[4], out[5], out[6], out[7] = dominant, then, squares, -plogp_seen, plogp_after


@compiled(helper=True, forceinline=True)
def observe_few(evidence, shares, n, op, most_before, out):
    """Add one observation to a voxel's evidence of the n classes that it or the frame has seen, in any order.

    - `evidence`, `shares`: room for a multiple of `LANES` numbers, 0 from n on: of the voxel, and s_bar of the frame
    - `most_before`: the largest evidence

    Leaves in `out` what `observe_row` does, but for the dominant classes and the last number.
    """
    room = -(-n // LANES) * LANES
    before, after = 1.0 / max(op, 1), 1.0 / (op + 1)
    plogp_before: Any = plogp_eights(evidence[:room], before)
    result: Any = observe_eights(evidence[:room], shares[:room], 1.0, before, after)
    plogp_after, plogp_between, squares, plogp_seen, top, _ = result
    out[0] = top * after - most_before * before
    out[1] = plogp_before - plogp_after
    out[2] = min(max(0.5 * (plogp_before + plogp_after) - plogp_between, 0.0), 1.0) if op > 0 else 0.0
    out[5], out[6] = squares, -plogp_seen
