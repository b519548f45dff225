"""Asking for memory before it is needed, in compiled loops."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

AHEAD = 16
"""Rows whose memory is asked for before their turn comes."""


@intrinsic
def touch(_typing: Any, array: Any, _index: Any) -> Any:
    """touch(array, i): bring row i of an array (n,) into the cache; nothing waits for it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values = context.make_array(signature.args[0])(context, builder, arguments[0])
        pointer = cgutils.get_item_pointer(
            context, builder, signature.args[0], values, [arguments[1]], wraparound=False
        )
        ask_for(builder, pointer)
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


def ask_for(builder: Any, pointer: Any) -> None:
    """Code that asks for the memory at a pointer, to be written; there need be none."""
    number = ir.IntType(32)
    kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, number, number, number])
    prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    to_write, keep, data = (ir.Constant(number, value) for value in (1, 3, 1))
    builder.call(prefetch, [builder.bitcast(pointer, cgutils.voidptr_t), to_write, keep, data])
