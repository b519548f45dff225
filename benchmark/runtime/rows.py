"""Rows of numbers that grow, frame by frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

BLOCK = 1024
"""Rows that room is made for at a time."""

Float64 = npt.NDArray[np.float64]


class Rows:
    """In blocks, so that nothing is copied when they grow: as objects they would take ten times the memory."""

    def __init__(self, columns: int, numbers: Float64 | None = None) -> None:
        self.columns = columns
        self._full = [] if numbers is None else [numbers]
        self._before = sum(map(len, self._full))
        self._last = np.empty((0, columns))
        self._used = 0

    def __len__(self) -> int:
        """The number of rows."""
        return self._before + self._used

    def __iter__(self) -> Iterator[list[float]]:
        """Each in turn."""
        for block in self._blocks():
            for first in range(0, len(block), BLOCK):
                yield from block[first : first + BLOCK].tolist()

    def append(self, row: Iterable[float]) -> None:
        """One more."""
        if self._used == len(self._last):
            self._full.append(self._last)
            self._before += self._used
            self._last, self._used = np.empty((BLOCK, self.columns)), 0
        self._last[self._used] = [*row]
        self._used += 1

    def row(self, at: int) -> list[float]:
        """One of them. Raises IndexError where there is none."""
        at = range(len(self))[at]
        if at >= self._before:
            return self._last[at - self._before].tolist()  # type: ignore[no-any-return]
        return self.table()[at].tolist()  # type: ignore[no-any-return]

    def column(self, k: int) -> Float64:
        """(n,) the k-th number of each row."""
        return np.concatenate([np.empty(0), *(block[:, k] for block in self._blocks())])

    def table(self, first: int = 0) -> Float64:
        """(n, columns), from a row on."""
        return np.concatenate([np.empty((0, self.columns)), *self._blocks()])[first:]

    def _blocks(self) -> list[Float64]:
        return [*self._full, self._last[: self._used]]
