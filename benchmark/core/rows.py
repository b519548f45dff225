"""Rows of numbers that grow, frame by frame."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64


class Rows:
    """A table of float64 that grows row by row, a few hundred bytes for each frame.

    rows  (n, columns) the first ones
    """

    def __init__(self, columns: int, rows: npt.ArrayLike = ()) -> None:
        self.columns = columns
        self._numbers = array("d", np.ravel(np.asarray(rows, dtype=np.float64)))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._numbers) // self.columns

    def __iter__(self) -> Iterator[list[float]]:
        """Yield each row in turn."""
        return (self.row(k) for k in range(len(self)))

    def append(self, row: Iterable[float]) -> None:
        """Add a row; None is NaN."""
        self._numbers.extend(np.array([*row], dtype=np.float64))

    def row(self, at: int) -> list[float]:
        """Return one row. Raises IndexError where there is none."""
        start = range(len(self))[at] * self.columns
        return self._numbers[start : start + self.columns].tolist()

    def column(self, k: int) -> Float64:
        """Return a copy (n,) of the k-th number of each row."""
        return self.table()[:, k]

    def table(self) -> Float64:
        """Return a copy (n, columns) of the rows."""
        return np.array(self._numbers, dtype=np.float64).reshape(-1, self.columns)
