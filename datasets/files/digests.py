"""Digests of the files of frames, as far as these were read."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

BYTES = 32


class Digests:
    """32 bytes for each file of a frame; several threads may keep them."""

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._kept: dict[str, npt.NDArray[np.uint8]] = {}

    def keep(self, index: int, what: str, digest: bytes) -> None:
        """That of what file of a frame it is."""
        if what not in self._kept:
            self._kept.setdefault(what, np.zeros((self._frames, BYTES), np.uint8))
        self._kept[what][index] = np.frombuffer(digest, np.uint8)

    def of(self, index: int, what: str) -> bytes | None:
        """That of a frame's file; None where it was not read."""
        if what not in self._kept:
            return None
        digest = self._kept[what][index].tobytes()
        return digest if any(digest) else None
