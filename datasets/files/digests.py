"""Digests of the files of frames, as far as these were read."""

from __future__ import annotations

import contextlib

import numpy as np

from semstab.runtime.scratch import Memory, Scratch, room_for

BYTES = 32


class Digests:
    """32 bytes for each file of a frame, of a long sequence in a file; several threads may keep them."""

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._kept: dict[str, Memory | Scratch] = {}

    def keep(self, index: int, what: str, digest: bytes) -> None:
        """That of what file of a frame it is; not where the disk is full: the frame's file is read again then."""
        if what not in self._kept:
            self._kept.setdefault(what, room_for(BYTES * self._frames))
        with contextlib.suppress(OSError):
            self._kept[what].write(np.frombuffer(digest, np.uint8), BYTES * index)

    def of(self, index: int, what: str) -> bytes | None:
        """That of a frame's file; None where it was not read."""
        if what not in self._kept:
            return None
        digest = self._kept[what].read(np.uint8, BYTES, BYTES * index).tobytes()
        return digest if any(digest) else None
