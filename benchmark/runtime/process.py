"""What a process that fuses frame after frame asks of its threads, of the system's memory, and of rerun."""

from __future__ import annotations

import functools
import os
import signal
import sys
import threading
from typing import TYPE_CHECKING, Any

from semstab.runtime.memory import resident_bytes

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8
"""The parameters' numbers in glibc's malloc.h; see mallopt(3)."""

LARGEST_IMAGE = 64 << 20
"""Bytes up to which freed memory is used again: the depth of a 3840x2160 frame has 33 million."""
KEPT = 1 << 30
"""Bytes of freed memory that are kept."""


def settle() -> None:
    """Prepare this process; to be called before any thread is started. Changes no result.

    Threads that wait do not spin, for they would take the time of those that decode the next frames. Memory of a
    decoded image is used for the next one, instead of being returned to the system, which clears it each time (glibc).
    Rerun logs nothing of its own to the terminal: what cannot be recorded is said in one line.
    """
    os.environ.setdefault("RUST_LOG", "off")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if hasattr(libc := _libc(), "gnu_get_libc_version"):
        for parameter, value in ((MMAP_THRESHOLD, LARGEST_IMAGE), (TRIM_THRESHOLD, KEPT), (ARENA_MAX, 1)):
            libc.mallopt(parameter, value)


def give_back(*, least: int = 0) -> None:
    """Return freed memory to the system at once: what `settle` has kept for the next images (glibc).

    least  bytes that the process must have: of a small one what comes next uses it again, and need not clear it
    """
    if resident_bytes() >= least and hasattr(libc := _libc(), "malloc_trim"):
        libc.malloc_trim(0)


@functools.cache
def _libc() -> Any:
    """The C library; nothing where its memory cannot be settled."""
    import ctypes

    return ctypes.CDLL(None) if sys.platform == "linux" else None


def follow_parent(listening: Connection) -> None:
    """Let this worker process end with its parent, which holds the other end of a pipe, and leave Ctrl-C to it."""
    from multiprocessing.connection import wait

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it reaches all processes; the parent decides

    def end_with_parent() -> None:
        wait([listening])  # readable once the other end is closed: by the parent, or by its death
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
