"""Entropy and Jensen-Shannon divergence in bits, over the last axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, UInt16

Array = Float64


def normalise(evidence: npt.ArrayLike) -> Array:
    """Return the belief p: non-negative evidence (..., K) scaled to sum to 1 (paper, Persistent Voxel Evidence)."""
    e = np.asarray(evidence, dtype=np.float64)
    belief: Array = e / e.sum(axis=-1, keepdims=True)
    return belief


def entropy_bits(p: npt.ArrayLike) -> Array:
    """Return Shannon entropy -sum_k p_k log2 p_k of distributions (..., K), in bits; 0 log 0 = 0.

    >>> float(entropy_bits([0.5, 0.5]))
    1.0
    """
    p = np.asarray(p, dtype=np.float64)
    logs = np.log2(p, out=np.zeros_like(p), where=p > 0)
    entropy: Array = -(p * logs).sum(axis=-1)
    return np.maximum(entropy, 0.0)


def js_divergence(p: npt.ArrayLike, q: npt.ArrayLike) -> Array:
    """Return Jensen-Shannon divergence of distributions (..., K), in bits, so in [0, 1] (Lin 1991, IEEE TIT 37).

    D_JS(p, q) = 1/2 sum_k p_k log2(p_k / m_k) + 1/2 sum_k q_k log2(q_k / m_k), with m = (p + q) / 2.

    >>> float(js_divergence([1.0, 0.0], [0.0, 1.0]))
    1.0
    >>> round(float(js_divergence([1.0, 0.0], [0.5, 0.5])), 5)
    0.31128
    """
    p = np.asarray(p, dtype=np.float64)
    q = np.asarray(q, dtype=np.float64)
    m = (p + q) / 2
    divergence: Array = (_relative_entropy(p, m) + _relative_entropy(q, m)) / 2
    return np.clip(divergence, 0.0, 1.0)


def _relative_entropy(p: Array, m: Array) -> Array:
    """Return Kullback-Leibler divergence sum_k p_k log2(p_k / m_k), in bits; 0 where m_k underflows to 0."""
    p, m = np.broadcast_arrays(p, m)
    ratio = np.divide(p, m, out=np.ones(p.shape), where=np.minimum(p, m) > 0)
    divergence: Array = (p * np.log2(ratio)).sum(axis=-1)
    return divergence


# The spread of evidence over the classes, row by row: the measures of a belief are functions of it.

BLOCK = 1 << 13
"""Rows that are added one after the other."""

TOGETHER = 4
"""Columns that are added side by side, as sums wait for what they were before."""


APART = 8
"""Columns of a block begin as many numbers further: a power of 2 apart, a core's cache has no room for many of them."""


@dataclass(frozen=True, eq=False)
class Concentration:
    """The concentration of rows of evidence e (n, K), in one pass over their entries; p is e scaled to sum to 1.

    Attributes:
        largest: (n,) max_k p_k.
        lead: (n,) the largest p less the second largest.
        bits: (n,) entropy of p.
        label: (n,) uint16 argmax_k e_k, the lowest on ties.
        squares: (n,) ||e||^2.
    """

    largest: Float64
    lead: Float64
    bits: Float64
    label: UInt16
    squares: Float64

    @classmethod
    def from_entries(cls, starts: Int64, label: UInt16, weight: Float64) -> Concentration:
        """Compute it of entries as `Evidence` has them."""
        from semstab.data.kernels import concentrate

        largest, lead, bits, squares = np.empty((4, len(starts) - 1))
        dominant = np.empty(len(starts) - 1, np.uint16)
        concentrate(starts, label, weight, largest, lead, bits, dominant, squares)
        return cls(largest, lead, bits, dominant, squares)

    def take(self, rows: Any) -> Concentration:
        """Return the concentration of some rows: a slice, their numbers, or a mask (n,)."""
        return Concentration(*(values[rows] for values in vars(self).values()))


def by_group(
    group: npt.NDArray[Any],
    values: Sequence[npt.NDArray[Any]] | Float64,
    groups: int,
) -> tuple[Float64, Float64]:
    """Return (groups, C) sums of C values (n,) by group (n,), and how often they are defined; -1 is no group."""
    from semstab.data.kernels import add_by_group

    wide = -(-len(values) // TOGETHER) * TOGETHER
    sums, defined = np.zeros((2, wide, groups))
    of = group.astype(np.int32, copy=False)
    for first in range(0, wide, TOGETHER):
        columns = [np.ascontiguousarray(column, dtype=np.float64) for column in values[first : first + TOGETHER]]
        chunk = slice(first, first + TOGETHER)
        add_by_group(
            of, *columns, *(TOGETHER - len(columns)) * columns[:1], max(BLOCK, groups), sums[chunk], defined[chunk]
        )
    return tuple(np.ascontiguousarray(part[: len(values)].T) for part in (sums, defined))  # type: ignore[return-value]
