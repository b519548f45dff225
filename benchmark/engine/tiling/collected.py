"""What frames see, added up in bounded memory: cells by frame, and a sample of the voxels."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semstab.core.files import read_arrays, write_arrays
from semstab.core.types import Int32, Int64

MOST_ROWS = 1 << 22
"""Pairs of frame and cell that are kept; where there are more, cells become twice as wide."""

BUDGET, SHARE = 1 << 18, 1 << 29
"""Sampled voxels that are kept: one in eight at first, and half of them go whenever there are too many."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What one frame sees, or some.

    size    edge of a cell of columns, voxels, a power of 2
    share   hashes of sampled voxels are below it
    frames  how many
    rows    (m, 3) int32 a frame and a cell that it sees
    key     (n,) of the sampled voxels, ascending, drawn (n,) their hashes, looks (n,) by how many frames each is seen
    """

    size: int
    share: int
    frames: int
    rows: Int32
    key: Int64
    drawn: Int64
    looks: Int64

    def below(self, share: int) -> Seen:
        """The same with those voxels alone whose hashes are below that share."""
        kept = self.drawn < share
        return dataclasses.replace(self, key=self.key[kept], drawn=self.drawn[kept], looks=self.looks[kept])

    def save(self, path: Path) -> None:
        """Write it, atomically; as it is, for it is soon read and gone."""
        write_arrays(path, vars(self), packed=False)

    @classmethod
    def load(cls, path: Path) -> Seen | None:
        """What `save` wrote; None where there is no such file, or it is damaged."""
        values = read_arrays(path)
        if values is None or values.keys() != {field.name for field in dataclasses.fields(cls)}:
            return None
        own: dict[str, Any] = {**values, **{name: int(values[name]) for name in ("size", "share", "frames")}}
        return cls(**own)


class Collected:
    """Adds up what frames see, one by one or by stretches; what comes out does not hang on how they were cut."""

    def __init__(self, cell: int) -> None:
        nothing = np.zeros(0, np.int64)
        self._all = Seen(cell, SHARE, 0, np.zeros((0, 3), np.int32), nothing, nothing, nothing)
        self._rows: list[Int32] = []
        self._count = self._frames = self._waiting = 0
        self._size, self._share = cell, SHARE
        self._parts: list[Seen] = []

    def add(self, seen: Seen) -> None:
        """The next frames, in order."""
        self._frames += seen.frames
        self._share = min(self._share, seen.share)
        while self._size < seen.size:
            self._widen()
        self._rows.append(_wider(seen.rows, self._size // seen.size))
        self._count += len(self._rows[-1])
        while self._count > MOST_ROWS:
            self._widen()
        self._parts.append(seen.below(self._share))
        self._waiting += len(self._parts[-1].key)
        if self._waiting > BUDGET:
            self._settle()

    def seen(self) -> Seen:
        """By all of them so far."""
        self._settle()
        return dataclasses.replace(self._all, size=self._size, frames=self._frames, rows=_joined(self._rows))

    def _widen(self) -> None:
        self._size *= 2
        self._rows = [_wider(_joined(self._rows), 2)]
        self._count = len(self._rows[0])

    def _settle(self) -> None:
        """Count what was seen since, and let voxels go where there are too many."""
        parts = [self._all, *self._parts]
        self._parts, self._waiting = [], 0
        keys, drawn, looks = (np.concatenate([getattr(part, k) for part in parts]) for k in ("key", "drawn", "looks"))
        key, first, of = np.unique(keys, return_index=True, return_inverse=True)
        looks = np.bincount(of, weights=looks, minlength=len(first)).astype(np.int64)
        found = dataclasses.replace(self._all, key=key, drawn=drawn[first], looks=looks)
        while np.count_nonzero(found.drawn < self._share) > BUDGET:
            self._share //= 2
        self._all = dataclasses.replace(found.below(self._share), share=self._share)


def _joined(rows: Iterable[Int32]) -> Int32:
    return np.concatenate([np.zeros((0, 3), np.int32), *rows])


def _wider(rows: Int32, factor: int) -> Int32:
    """The same for cells that are so many times as wide, a power of 2."""
    shift = factor.bit_length() - 1
    return np.unique(rows >> np.array([0, shift, shift], np.int32), axis=0) if shift else rows
