"""Room for what would grow in memory with the length of a sequence: a file without a name, where it is large."""

from __future__ import annotations

import os
import tempfile
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

DISK = Path("/var/tmp")
"""Where TMPDIR says nothing: /tmp often is in memory, and this is for what is too large for that."""

SMALL = 1 << 21
"""Bytes that may be in memory."""


class Scratch:
    """A file that is gone with the process, however that ends. Raises OSError where it cannot be made or written."""

    def __init__(self) -> None:
        said = any(os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP"))
        folder = DISK if not said and os.access(DISK, os.W_OK) else None
        file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115  closed with the object
        self._file = file.fileno()
        weakref.finalize(self, file.close)

    def write(self, numbers: npt.NDArray[Any], at: int) -> None:
        """All of them, from that byte on; several threads may write."""
        data = np.ascontiguousarray(numbers).data.cast("B")
        while data:
            written = os.pwrite(self._file, data, at)
            data, at = data[written:], at + written

    def read(self, dtype: npt.DTypeLike, count: int, at: int) -> npt.NDArray[Any]:
        """So many numbers from that byte on; 0 where none were written."""
        found = np.zeros(count, dtype)
        os.preadv(self._file, [found.data.cast("B")], at)
        return found


class Memory:
    """The same in memory, of so many bytes."""

    def __init__(self, nbytes: int) -> None:
        self._bytes = np.zeros(nbytes, np.uint8)

    def write(self, numbers: npt.NDArray[Any], at: int) -> None:
        """All of them, from that byte on."""
        self._bytes[at : at + numbers.nbytes] = numbers.view(np.uint8)

    def read(self, dtype: npt.DTypeLike, count: int, at: int) -> npt.NDArray[Any]:
        """So many numbers from that byte on."""
        return self._bytes[at : at + count * np.dtype(dtype).itemsize].view(dtype)


def room_for(nbytes: int) -> Memory | Scratch:
    """Of that size: a file where that is much, and there can be one."""
    try:
        return Memory(nbytes) if nbytes <= SMALL else Scratch()
    except OSError:
        return Memory(nbytes)
