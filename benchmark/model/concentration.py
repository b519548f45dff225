"""How evidence is spread over the classes, row by row: what the measures of a belief are functions of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
UInt16 = npt.NDArray[np.uint16]

BLOCK = 1 << 13
"""Rows that are added one after the other."""

TOGETHER = 4
"""Columns that are added side by side, as sums wait for what they were before."""


APART = 8
"""Columns of a block begin as many numbers further: a power of 2 apart, a core's cache has no room for many of them."""


@dataclass(frozen=True, eq=False)
class Concentration:
    """Of rows of evidence e (n, K), in one pass over their entries; p is e scaled to sum to 1.

    largest  (n,) max_k p_k
    lead     (n,) the largest p less the second largest
    bits     (n,) entropy of p
    label    (n,) uint16 argmax_k e_k, the lowest on ties
    squares  (n,) ||e||^2
    """

    largest: Float64
    lead: Float64
    bits: Float64
    label: UInt16
    squares: Float64

    @classmethod
    def of(
        cls,
        starts: Int64,
        label: UInt16,
        weight: Float64,
        K: int,
        rest: Float64 | None = None,
        bits: Float64 | None = None,
    ) -> Concentration:
        """Of entries as `Evidence` has them; rest (n,) is what each class without one has, 0 where it is not given.

        bits (n,) is the entropy, where that is known.
        """
        from semstab.model.row_kernel import concentrate

        n = len(starts) - 1
        largest, lead, squares = (np.empty(n) for _ in range(3))
        found, own = np.empty(n, np.uint16), np.empty(n) if bits is None else bits
        others = np.zeros(0) if rest is None else rest
        concentrate(starts, label, weight, others, K, bits is not None, largest, lead, own, found, squares)
        return cls(largest, lead, own, found, squares)

    def take(self, rows: Any) -> Concentration:
        """Of some rows: a slice, their numbers, or a mask (n,)."""
        return Concentration(*(values[rows] for values in vars(self).values()))


def by_group(
    group: npt.NDArray[Any],
    values: Sequence[npt.NDArray[Any]] | Float64,
    groups: int,
    voxels: Float64 | None = None,
) -> tuple[Float64, Float64]:
    """(groups, C) sums of C values (n,) by group (n,), and how often they are defined; -1 is no group.

    Each row counts as so many voxels (n,), as one where that is not given.
    """
    from semstab.model.row_kernel import add_by_group

    wide = -(-len(values) // TOGETHER) * TOGETHER
    sums, defined = np.zeros((2, wide, groups))
    of, many = group.astype(np.int32, copy=False), np.zeros(0) if voxels is None else voxels
    for first in range(0, wide, TOGETHER):
        own = [np.ascontiguousarray(column, dtype=np.float64) for column in values[first : first + TOGETHER]]
        some = slice(first, first + TOGETHER)
        add_by_group(of, *own, *(TOGETHER - len(own)) * own[:1], many, max(BLOCK, groups), sums[some], defined[some])
    return tuple(np.ascontiguousarray(found[: len(values)].T) for found in (sums, defined))  # type: ignore[return-value]


def blockwise(sums: Callable[[slice], Float64], rows: int, groups: int) -> Float64:
    """Sums by group of so many rows, block by block: rounding adds up within a block only."""
    step = max(BLOCK, groups)
    return reduce(np.add, (sums(slice(first, min(first + step, rows))) for first in range(0, max(rows, 1), step)))
