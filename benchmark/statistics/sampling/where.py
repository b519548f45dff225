"""Which cube of space, and which group of frames, each row of some sums is of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64
from semstab.statistics.ranks import distinct_rows, numbered


@dataclass(frozen=True, eq=False)
class Where:
    """Of rows (m,), some of which belong to no frame.

    places  (G, 3) the cubes, sorted, of an edge in metres; row (m,) which of them
    frames  (F,) the groups of `step` frames, sorted; known (r,) the rows that belong to one, column (r,) which of them
    """

    places: Int64
    row: Int64
    frames: Int64
    known: Int64
    column: Int64
    edge: float
    step: int

    @classmethod
    def of(
        cls, cell: npt.NDArray[np.integer], frame: npt.NDArray[np.integer] | None, edge: float, step: int = 0
    ) -> Where:
        """By cube (m, 3) and group of frames (m,), -1 where that is not known; without frames all are of one."""
        places, row = distinct_rows(cell)
        if frame is None:
            return cls(places, row, np.array([-1]), np.arange(len(row)), np.zeros(len(row), np.int64), edge, 0)
        known = np.flatnonzero((frame >= 0) | (step == 0))
        frames, column = numbered(frame[known].astype(np.int64))
        return cls(places, row, frames, known, column, edge, step)

    def by_place(self, values: Float64) -> Float64:
        """(G,) the sums of values (m,)."""
        sums: Float64 = np.bincount(self.row, weights=values, minlength=len(self.places)).astype(np.float64)
        return sums

    def by_both(self, values: Float64) -> Float64:
        """(G, F) the sums of values (m,)."""
        shape = len(self.places), len(self.frames)
        cell = self.row[self.known] * shape[1] + self.column
        sums = np.bincount(cell, weights=values[self.known], minlength=shape[0] * shape[1])
        return np.asarray(sums.reshape(shape), np.float64)
