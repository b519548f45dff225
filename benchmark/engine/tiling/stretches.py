"""The frames of a unit by themselves, cut into stretches that are looked at side by side and say what one look says."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

LEAST, MOST = 60, 4096
"""Frames of a stretch: in fewer the frames before it would count too much, more would be lost with a process."""


@dataclass(frozen=True)
class Stretch:
    """Frames of a selection that one task looks at.

    first, last  positions in the selection, from the first one up to but without the last one
    frames       their indices, after those of the frames before them that they are compared with
    lead         how many of those are before them
    shown        the frame of the whole selection that figures show
    origin       (3,) voxel of the first camera of the selection
    """

    first: int
    last: int
    frames: tuple[int, ...]
    lead: int
    shown: int
    origin: tuple[int, int, int]

    @property
    def name(self) -> str:
        """As no part is called."""
        return f"frames_{self.first}-{self.last}"


def stretches_of(
    frames: Sequence[int], origin: tuple[int, int, int], *, lead: int, width: int = 1, whole: bool = False
) -> list[Stretch]:
    """Stretches of a selection, some more than tasks that run at once, where it has so many frames.

    lead   frames that the first one of a stretch is compared with
    whole  whether there may be but one
    """
    n = len(frames)
    wanted = max(2 * width if width > 1 else 1, -(-n // MOST))
    count = 1 if whole else max(1, min(wanted, n // LEAST))
    bounds = [k * n // count for k in range(count + 1)]
    return [
        Stretch(
            first,
            last,
            tuple(frames[max(0, first - lead) : last]),
            first - max(0, first - lead),
            frames[n // 2],
            origin,
        )
        for first, last in itertools.pairwise(bounds)
    ]
