"""Rows of numbers that grow, frame by frame."""

from __future__ import annotations

import contextlib
import os
import tempfile
import weakref
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64

# Room for what would grow in memory with the length of a sequence: a file without a name, where it is large.

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


BLOCK = 1024
"""Rows that room is made for at a time."""

KEPT = 64
"""Blocks that stay in memory; where there are more, all that are full go to a file."""


class Rows:
    """In blocks of columns, so that nothing is copied when they grow, and memory is bounded however many there are.

    rows  (n, columns) the first ones
    """

    def __init__(self, columns: int, rows: Float64 | None = None) -> None:
        self.columns = columns
        self._file: Scratch | None = None
        self._filed = 0  # blocks in the file; those that came after them are in memory
        self._full: list[Float64] = []
        self._last, self._used = np.empty((columns, 0)), 0
        if rows is not None:
            self.extend(rows)

    def __len__(self) -> int:
        """The number of rows."""
        return BLOCK * (self._filed + len(self._full)) + self._used

    def __iter__(self) -> Iterator[list[float]]:
        """Each in turn."""
        for block in self.blocks():
            yield from block.tolist()

    def __reduce__(self) -> tuple[type[Rows], tuple[int, Float64]]:
        """As numbers: another process has a file of its own."""
        return Rows, (self.columns, self.table())

    def append(self, row: Iterable[float]) -> None:
        """One more."""
        if self._used == self._last.shape[1]:
            self._begin()
        self._last[:, self._used] = [*row]
        self._used += 1

    def extend(self, rows: Float64) -> None:
        """Some more, (m, columns)."""
        while len(rows):
            if self._used == self._last.shape[1]:
                self._begin()
            some = rows[: BLOCK - self._used]
            self._last[:, self._used : self._used + len(some)] = some.T
            self._used += len(some)
            rows = rows[len(some) :]

    def row(self, at: int) -> list[float]:
        """One of them. Raises IndexError where there is none."""
        block, k = divmod(range(len(self))[at], BLOCK)
        return self._block(block)[:, k].tolist()  # type: ignore[no-any-return]

    def column(self, k: int, first: int = 0, last: int | None = None) -> Float64:
        """(n,) the k-th number of each row, from one of them up to but without another."""
        last = len(self) if last is None else last
        blocks = range(first // BLOCK, -(-last // BLOCK))
        found = [np.empty(0), *(self._block(block, slice(k, k + 1))[0] for block in blocks)]
        return np.concatenate(found)[first - BLOCK * blocks.start :][: last - first]

    def put(self, k: int, values: Float64) -> None:
        """Make these (n,) the k-th numbers of the rows. Raises OSError where the file cannot be written."""
        for block in range(self._count):
            some = values[BLOCK * block :][:BLOCK]
            if block >= self._filed:
                self._block(block)[k] = some
            else:
                assert self._file is not None
                self._file.write(some, 8 * BLOCK * (block * self.columns + k))

    def blocks(self) -> Iterator[Float64]:
        """The rows (m, columns), some at a time."""
        return (self._block(block).T for block in range(self._count))

    def table(self, first: int = 0, step: int = 1) -> Float64:
        """(n, columns), from a row on, and every step-th of these."""
        found = np.empty((len(range(first, len(self), step)), self.columns))
        done = 0
        for k, block in enumerate(self.blocks()):
            some = block[max(first - BLOCK * k, (first - BLOCK * k) % step) :: step]
            found[done : done + len(some)] = some
            done += len(some)
        return found

    @property
    def _count(self) -> int:
        """Blocks, with the one that is being filled."""
        return self._filed + len(self._full) + (self._used > 0)

    def _begin(self) -> None:
        """Room for more rows."""
        if self._used:
            self._full.append(self._last)
            if len(self._full) >= KEPT or self._filed:
                self._put_aside()
        self._last, self._used = np.empty((self.columns, BLOCK)), 0

    def _put_aside(self) -> None:
        """Full blocks go to the file. Where its disk is full they stay: a long run does not end for a few megabytes."""
        with contextlib.suppress(OSError):
            self._file = self._file or Scratch()
            while self._full:
                self._file.write(self._full[0], self._filed * self._full[0].nbytes)
                self._filed += 1
                del self._full[0]

    def _block(self, block: int, columns: slice = slice(None)) -> Float64:
        """(columns, m) some columns of a block."""
        if block >= self._filed:
            full = self._full[block - self._filed :]
            return full[0][columns] if full else self._last[columns, : self._used]
        assert self._file is not None
        first, last, _ = columns.indices(self.columns)
        at = 8 * BLOCK * (block * self.columns + first)
        return self._file.read(np.float64, BLOCK * (last - first), at).reshape(-1, BLOCK)
