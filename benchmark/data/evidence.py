"""Evidence of voxels or observations: rows of class weights, of which only the entries that are not 0 are stored."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from numpy.lib.mixins import NDArrayOperatorsMixin

from semstab.core.types import Float64, Int64, UInt16
from semstab.data.information import Concentration

CHUNK_VALUES = 1 << 18
"""Number of values of the rows that are made dense at a time: they fit into a core's cache, and cost no new memory."""

PAIRWISE = 8
"""The number of classes from which on NumPy's sum depends on their layout; below, class by class is the faster one."""

STRETCH = 1 << 17
"""The voxels that are looked at together, where sums over all of them are wanted."""

STRETCH_ENTRIES = 1 << 20
"""Likewise for entries, of which soft scores have K a voxel."""

ByEntry = Callable[[Float64, Int64], Float64]
"""A value of each entry (e,), from its weight (e,) and its row (e,)."""


def row_chunks(rows: int, K: int) -> Iterator[slice]:
    """Return slices of consecutive rows whose dense evidence has at most `CHUNK_VALUES` values.

    There is one at least, empty if there are no rows.
    """
    step = max(1, CHUNK_VALUES // max(K, 1))
    return (slice(first, min(first + step, rows)) for first in range(0, max(rows, 1), step))


def stretches(rows: int, most: int = STRETCH) -> Iterator[slice]:
    """Return consecutive rows, few enough that computations on them take little memory; one stretch at least."""
    return (slice(first, min(first + most, rows)) for first in range(0, max(rows, 1), most))


@dataclass(frozen=True, eq=False)
class Evidence(NDArrayOperatorsMixin):
    """An array (n, K) by its entries that are not 0. Indexed by rows it gives dense rows; NumPy sees all of it dense.

    Attributes:
        starts: (n + 1,) int64 first entry of each row.
        label: (m,) uint16 the entry's class, ascending within a row.
        weight: (m,) float64.
        K: Number of classes.
        known: The spread of rows over the classes, where that is known already: see `measured`.
    """

    starts: Int64
    label: UInt16
    weight: Float64
    K: int
    known: Concentration | None = field(default=None, kw_only=True)

    @classmethod
    def from_rows(cls, rows: npt.ArrayLike | Evidence) -> Evidence:
        """Return dense rows (n, K), or evidence as it is."""
        if isinstance(rows, Evidence):
            return rows
        dense = np.asarray(rows, dtype=np.float64)
        return cls.read(len(dense), dense.shape[1], lambda chunk: dense[chunk])

    @classmethod
    def read(cls, rows: int, K: int, dense: Callable[[slice], Float64]) -> Evidence:
        """Read `rows` rows of an array or `Evidence`, dense (r, K)."""
        counts, labels, weights = [np.zeros(1, np.int64)], [], []
        for chunk in row_chunks(rows, K):
            part = dense(chunk)
            row, label = np.nonzero(part)
            counts.append(np.bincount(row, minlength=len(part)))
            labels.append(label.astype(np.uint16))
            weights.append(part[row, label].astype(np.float64))
        return cls(np.cumsum(np.concatenate(counts)), np.concatenate(labels), np.concatenate(weights), K)

    @classmethod
    def joined(cls, parts: Sequence[Evidence], order: Int64 | None = None) -> Evidence:
        """Return the rows of one after the other, or of all of them in an order (n,), for which no copy is made."""
        counts = np.concatenate([np.diff(part.starts) for part in parts])
        if order is None:
            label, weight = (np.concatenate([getattr(part, name) for part in parts]) for name in ("label", "weight"))
            return cls(_starts(counts), label, weight, parts[0].K)
        from semstab.data.kernels import copy_rows

        starts, to, done = _starts(counts[order]), np.empty_like(counts), 0
        to[order] = starts[:-1]
        label, weight = np.empty(starts[-1], np.uint16), np.empty(starts[-1])
        for part in parts:
            copy_rows(*part.bounds, to[done : done + len(part)], part.label, part.weight, label, weight)
            done += len(part)
        return cls(starts, label, weight, parts[0].K)

    @property
    def bounds(self) -> tuple[Int64, Int64]:
        """(n,), (n,): the first entry of each row, and that after its last one."""
        return self.starts[:-1], self.starts[1:]

    @property
    def shape(self) -> tuple[int, int]:
        """(n, K)."""
        return len(self), self.K

    @property
    def nbytes(self) -> int:
        """Bytes of its entries."""
        return self.starts.nbytes + self.label.nbytes + self.weight.nbytes

    @property
    def entries(self) -> tuple[Int64, UInt16, Float64]:
        """starts, label and weight, as compiled loops take them."""
        return self.starts, self.label, self.weight

    @property
    def ndim(self) -> int:
        """2."""
        return 2

    def __len__(self) -> int:
        return len(self.starts) - 1

    def __getitem__(self, rows: Any) -> Any:
        if isinstance(rows, tuple):
            return self[:][rows]
        if isinstance(rows, slice) and rows.step in (None, 1):
            return self._stretch(*rows.indices(len(self))[:2])
        if np.ndim(rows) == 0 and not isinstance(rows, slice):
            row = range(len(self))[rows]
            return self._stretch(row, row + 1)[0]
        return self.take(rows)._stretch()

    def take(self, rows: Any) -> Evidence:
        """Return the rows (r,) of these numbers, or for which a mask (n,) holds."""
        concentration = None if self.known is None else self.known.take(rows)
        if isinstance(rows, slice) and rows.step in (None, 1):
            first, last, _ = rows.indices(len(self))
            starts = self.starts[first : max(first, last) + 1]
            entries = slice(starts[0], starts[-1])
            return Evidence(starts - starts[0], self.label[entries], self.weight[entries], self.K, known=concentration)
        from semstab.data.kernels import copy_rows

        first, end = (bound[rows] for bound in self.bounds)
        starts = _starts(end - first)
        label, weight = np.empty(starts[-1], np.uint16), np.empty(starts[-1])
        copy_rows(first, end, starts[:-1], self.label, self.weight, label, weight)
        return Evidence(starts, label, weight, self.K, known=concentration)

    def only(self, labels: UInt16) -> Evidence:
        """Return the evidence of these ascending classes (k,), which have all the entries: they become 0 to k - 1."""
        label = np.searchsorted(labels, self.label).astype(np.uint16)
        return Evidence(self.starts, label, self.weight, len(labels))

    @property
    def concentration(self) -> Concentration:
        """Return how the rows are spread over the classes."""
        return self.known or Concentration.from_entries(*self.entries)

    def measured(self) -> Self:
        """Return the same, with its concentration, so that nobody computes that again: 34 bytes a row."""
        return replace(self, known=self.concentration)

    def chunks(self) -> Iterator[slice]:
        """Return consecutive rows that together are small when dense."""
        return row_chunks(len(self), self.K)

    def stretches(self) -> Iterator[tuple[slice, Int64]]:
        """Yield stretches of about `STRETCH_ENTRIES` entries, of whole rows, on which computations take little memory.

        They are where the entries are, and the row of each of them.
        """
        rows = len(self)
        for stretch in stretches(rows, max(1, STRETCH_ENTRIES * rows // max(len(self.weight), 1))):
            starts = self.starts[stretch.start : stretch.stop + 1]
            yield slice(starts[0], starts[-1]), np.repeat(np.arange(stretch.start, stretch.stop), np.diff(starts))

    def sums_by_class(self, group: npt.NDArray[np.signedinteger[Any]], groups: int, *values: ByEntry) -> list[Float64]:
        """Return the sums (groups, K) of values of entries by the group (n,) of their row; it is -1 if none counts."""
        sums = np.zeros((len(values), groups * self.K))
        for entries, row in self.stretches():
            of = group[row]
            counted = np.flatnonzero(of >= 0)
            weight, rows = self.weight[entries][counted], row[counted]
            key = of[counted].astype(np.int64) * self.K + self.label[entries][counted]
            for total, value in zip(sums, values, strict=True):
                np.add(total, np.bincount(key, weights=value(weight, rows), minlength=sums.shape[1]), out=total)
        return [total.reshape(groups, self.K) for total in sums]

    def rowwise(self, formula: Callable[[Float64], npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Return what a formula makes of dense rows (r, K), chunk by chunk: (n, ...)."""
        return np.concatenate([formula(self[chunk]) for chunk in self.chunks()])

    @property
    def dtype(self) -> np.dtype[np.float64]:
        """float64."""
        return np.dtype(np.float64)

    def sum(self, axis: int, *, keepdims: bool = False) -> Float64:
        """Return the sum of each row (n,) for axis 1, of each class (K,) for axis 0."""
        if axis == 0:
            return np.bincount(self.label, weights=self.weight, minlength=self.K).astype(np.float64)
        return self.rowwise(lambda rows: rows.sum(axis=1, keepdims=keepdims))

    def max(self, axis: int) -> Float64:
        """Return the largest of each row (n,)."""
        return self.rowwise(lambda rows: rows.max(axis=axis))

    def argmax(self, axis: int) -> Int64:
        """Return the class of the largest of each row (n,), the lowest on ties."""
        return self.rowwise(lambda rows: rows.argmax(axis=axis).astype(np.int64))

    def tolist(self) -> list[list[float]]:
        """Return all of it, dense."""
        content: list[list[float]] = self[:].tolist()
        return content

    def _stretch(self, first: int = 0, last: int | None = None) -> Float64:
        """Return dense rows from the first to before the last."""
        starts = self.starts[first : (len(self) if last is None else max(first, last)) + 1]
        dense = np.zeros((len(starts) - 1, self.K), order="F" if self.K < PAIRWISE else "C")
        entries = slice(starts[0], starts[-1])
        dense[np.repeat(np.arange(len(dense)), np.diff(starts)), self.label[entries]] = self.weight[entries]
        return dense

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        return self._stretch().astype(dtype or np.float64, copy=False)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **settings: Any) -> Any:
        dense = (np.asarray(value) if isinstance(value, Evidence) else value for value in inputs)
        return getattr(ufunc, method)(*dense, **settings)


def _starts(counts: Int64) -> Int64:
    """Return the first entry of each row, from the numbers of entries `counts` (n,), and the end: (n + 1,)."""
    return np.concatenate([[0], np.cumsum(counts)])
