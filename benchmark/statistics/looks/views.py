"""Where the frames of a sample of looks were taken."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64

VIEW = 5
"""Numbers of a view: frame, centre, time stamp."""

AT_ONCE = 4096
"""Views that are made text together."""


@dataclass(frozen=True, eq=False)
class Views:
    """Indices (V,) of frames, camera centres (V, 3) in metres, and time stamps (V,) in seconds or NaN."""

    frame: Int64
    centre: Float64
    timestamp: Float64

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def of(cls, rows: Sequence[Sequence[float]] | Float64) -> Views:
        """Of rows (V, 5). Raises ValueError where they are of another shape, or an index is not a finite number."""
        table = np.asarray(rows, np.float64).reshape(len(rows), VIEW)
        if not np.isfinite(table[:, 0]).all():
            raise ValueError("a frame without an index")
        return cls(table[:, 0].astype(np.int64), table[:, 1:4].copy(), table[:, 4].copy())

    @classmethod
    def joined(cls, parts: Sequence[Views]) -> Views:
        """One after the other."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))

    def rows(self) -> Float64:
        """(V, 5) what `of` takes."""
        return np.concatenate([self.frame[:, None], self.centre, self.timestamp[:, None]], axis=1)

    def text(self) -> str:
        """Its rows as JSON, made some at a time: as Python's numbers all of them would take ten times the memory."""
        rows = self.rows()
        return f"[{', '.join(json.dumps(rows[k : k + AT_ONCE].tolist())[1:-1] for k in range(0, len(rows), AT_ONCE))}]"

    def take(self, rows: Int64) -> Views:
        """Some of them."""
        return Views(self.frame[rows], self.centre[rows], self.timestamp[rows])

    def rank(self, frame: npt.NDArray[np.integer]) -> Int64:
        """Which of these, in their order, the frames (m,) of these indices are."""
        order = np.argsort(self.frame)
        return np.asarray(order[np.searchsorted(self.frame, frame, sorter=order)], np.int64)
