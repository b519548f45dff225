"""Runs of equal words, eight at a time, for compiled loops; no branch guesses where a run ends."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

LANES = 8
"""Words that `runs_of_eight` looks at, and room that it needs beyond the runs there are."""

INT = ir.IntType(64)
WORDS, MASK = ir.VectorType(INT, LANES), ir.VectorType(ir.IntType(1), LANES)


@intrinsic
def runs_of_eight(_typing: Any, word: Any, _at: Any, run_word: Any, run_end: Any, _n: Any) -> Any:
    """runs_of_eight(word, at, run_word, run_end, n): how many runs there are after words `at` to `at + 7`, n before.

    A run ends with a word that differs from the one that follows, which must be there. All arrays are int64.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at, n = arguments[1], arguments[4]
        own, words, ends = (
            builder.gep(context.make_array(signature.args[i])(context, builder, arguments[i]).data, [first])
            for i, first in ((0, at), (2, n), (3, n))
        )
        _, _, features = context.codegen().magic_tuple()
        keep = _compressed if "+avx512f" in features else _one_by_one
        return keep(builder, own, words, ends, at, n)

    return types.intp(word, types.intp, run_word, run_end, types.intp), generate


def _compressed(builder: Any, own: Any, words: Any, ends: Any, at: Any, n: Any) -> Any:
    """By instructions that put the chosen numbers of a vector side by side."""
    word = builder.load(builder.bitcast(own, WORDS.as_pointer()), align=8)
    following = builder.load(builder.bitcast(builder.gep(own, [INT(1)]), WORDS.as_pointer()), align=8)
    last = builder.icmp_unsigned("!=", word, following)
    spread = builder.insert_element(ir.Constant(WORDS, ir.Undefined), at, ir.IntType(32)(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    end = builder.add(builder.shuffle_vector(spread, spread, zeros), ir.Constant(WORDS, list(range(1, LANES + 1))))
    kind = ir.FunctionType(WORDS, [WORDS, WORDS, MASK])
    compress = cgutils.get_or_insert_function(builder.module, kind, f"llvm.x86.avx512.mask.compress.v{LANES}i64")
    for values, to in ((word, words), (end, ends)):
        chosen = builder.call(compress, [values, ir.Constant(WORDS, [0] * LANES), last])
        builder.store(chosen, builder.bitcast(to, WORDS.as_pointer()), align=8)
    number = builder.ctpop(builder.bitcast(last, ir.IntType(LANES)))
    return builder.add(n, builder.zext(number, INT))


def _one_by_one(builder: Any, own: Any, words: Any, ends: Any, at: Any, n: Any) -> Any:
    """Each word where the last run would end, to be written over unless it does."""
    so_far = INT(0)
    word = builder.load(own)
    for lane in range(LANES):
        following = builder.load(builder.gep(own, [INT(lane + 1)]))
        builder.store(word, builder.gep(words, [so_far]))
        builder.store(builder.add(at, INT(lane + 1)), builder.gep(ends, [so_far]))
        so_far = builder.add(so_far, builder.zext(builder.icmp_unsigned("!=", word, following), INT))
        word = following
    return builder.add(n, so_far)
