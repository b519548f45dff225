"""Majorities of the last labels: at the pixel, or at the place."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from semstab.model.frames import Frame
from semstab.pixels.warp import warp
from semstab.predict.filters import Belief, Filter, Parameter, Shown, normalised

Rows = npt.NDArray[np.uint16]


class Vote(Filter):
    """Each class's share of the last N labels at the pixel, this one included: no later frame is looked at.

    Where classes tie, the newer labels win.
    """

    parameter = Parameter("how many labels vote", 5, 2, 1000, whole=True)
    sequential = True

    def __init__(self, value: float) -> None:
        super().__init__(value)
        self._last: deque[tuple[Rows, Frame | None]] = deque(maxlen=int(value))

    def __call__(self, belief: Belief, shown: Shown) -> Belief:
        """See `Filter`."""
        K, N = belief.shape[2], int(self.value)
        rows = np.where(belief.any(axis=2), belief.argmax(axis=2), K).astype(np.uint16)
        self._last.append((rows, shown.frame))
        counts = np.zeros((rows.size, K + 1), dtype=np.float32)
        pixels = np.arange(rows.size)
        for age, seen in enumerate(self._seen_now(shown, K)):
            counts[pixels, seen.reshape(-1)] += 1 + (N - age) / (N * (N + 1))  # of all N together less than 1
        return normalised(counts[:, :K].reshape(belief.shape))

    def _seen_now(self, shown: Shown, nothing: int) -> Iterator[Rows]:
        """The last label maps at the pixels of this one, the newest first; `nothing` where one says nothing."""
        return (rows for rows, _ in reversed(self._last))


class VoteWarped(Vote):
    """The same of each place: the last N - 1 frames are asked for the pixel's surface point, by depth and pose.

    A frame that did not see the point has no vote.
    """

    wants_geometry = True

    def _seen_now(self, shown: Shown, nothing: int) -> Iterator[Rows]:
        (rows, _), *before = reversed(self._last)
        yield rows
        for past, frame in before:
            assert frame is not None
            yield warp(past, frame, shown.geometry, fill=nothing)[0]
