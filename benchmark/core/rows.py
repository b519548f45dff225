"""Rows of numbers that grow, frame by frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from semstab.core.types import Float64

FIRST = 64
"""Rows that there is room for at first; the room doubles when it is full."""


class Rows:
    """A table of float64 that grows row by row, a few hundred bytes for each frame.

    rows  (n, columns) the first ones
    """

    def __init__(self, columns: int, rows: Float64 | None = None) -> None:
        self.columns = columns
        self._rows: Float64 = np.empty((FIRST, columns)) if rows is None else np.array(rows, dtype=np.float64)
        self._used = 0 if rows is None else len(rows)

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._used

    def __iter__(self) -> Iterator[list[float]]:
        """Yield each row in turn."""
        return (self.row(k) for k in range(len(self)))

    def __reduce__(self) -> tuple[type[Rows], tuple[int, Float64]]:
        """Pickle the rows without the room for more."""
        return Rows, (self.columns, self.table())

    def append(self, row: Iterable[float]) -> None:
        """Add a row."""
        if self._used == len(self._rows):
            room = np.empty((max(FIRST, 2 * self._used), self.columns))
            room[: self._used] = self._rows
            self._rows = room
        self._rows[self._used] = [*row]
        self._used += 1

    def row(self, at: int) -> list[float]:
        """Return one row. Raises IndexError where there is none."""
        return self._rows[range(len(self))[at]].tolist()  # type: ignore[no-any-return]

    def column(self, k: int) -> Float64:
        """Return a copy (n,) of the k-th number of each row."""
        return self._rows[: len(self), k].copy()

    def table(self) -> Float64:
        """Return a copy (n, columns) of the rows."""
        return self._rows[: len(self)].copy()
