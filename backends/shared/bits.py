"""Doubles as the integers of the same bits, in compiled loops."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


@intrinsic
def bits_of(_typing: Any, _value: Any) -> Any:
    """The bits of a double, as int64; those of numbers from 0 on sort like the numbers."""
    return types.int64(types.float64), lambda _, builder, __, given: builder.bitcast(given[0], ir.IntType(64))
