"""Memory, threads and clocks of a process that fuses frame after frame."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import resource
import signal
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    import psutil


_aside, _depth = threading.RLock(), 0


@contextlib.contextmanager
def printing_aside() -> Iterator[None]:
    """Send what other people's code prints in the block to standard error, apart from the results.

    One thread at a time is in such a block; it may be nested.
    """
    global _depth  # noqa: PLW0603 - sys.stdout is global as well
    with _aside:
        _depth += 1
        stdout = sys.stdout
        if _depth == 1:
            sys.stdout = sys.stderr
        try:
            yield
        finally:
            _depth -= 1
            sys.stdout = stdout


PROC, CGROUPS = Path("/proc/self"), Path("/sys/fs/cgroup")

V1_FILES = ("memory.limit_in_bytes", "memory.usage_in_bytes", ("total_inactive_file", "total_active_file"))
V2_FILES = ("memory.max", "memory.current", ("inactive_file", "active_file"))
"""Names of a group's limit, of what it uses, and of the entries of memory.stat that are page cache."""


def available_bytes() -> int:
    """Return the memory that this process can still take."""
    import psutil

    free = [int(psutil.virtual_memory().available)]
    if (group := group_bytes(PROC, CGROUPS)) is not None:
        free.append(group)
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)  # `ulimit -v` bounds the address space
    if limit != resource.RLIM_INFINITY:
        free.append(limit - int(psutil.Process().memory_info().vms))
    return max(0, min(free))


def resident_bytes() -> int:
    """Return the memory that this process takes."""
    return int(_process(os.getpid()).memory_info().rss)


@functools.lru_cache(maxsize=1)
def _process(pid: int) -> psutil.Process:
    """Return this process, made once: a process is asked for its memory with every frame."""
    import psutil

    return psutil.Process(pid)


def group_bytes(proc: Path, cgroups: Path) -> int | None:
    """Return the memory that the control groups of a process leave to it, page cache included; None without a limit.

    Args:
        proc: A folder like /proc/self; lines of its file `cgroup` are such as '4:memory:/user' or, of version 2,
            '0::/user'.
        cgroups: A folder like /sys/fs/cgroup: version 2, or version 1 with a folder `memory`.
    """
    available, lines = list[int](), list[str]()
    with contextlib.suppress(OSError):
        lines = (proc / "cgroup").read_text().splitlines()
    for line in lines:
        _, controllers, path = (*line.split(":", 2), "", "")[:3]
        if controllers and "memory" not in controllers.split(","):
            continue
        root, (limit, used, cache) = (cgroups / "memory", V1_FILES) if controllers else (cgroups, V2_FILES)
        group = root / path.lstrip("/")  # in a container, the path may be that of the host: then only the root is there
        for folder in (candidate for candidate in (group, *group.parents) if candidate.is_relative_to(root)):
            with contextlib.suppress(OSError, ValueError):  # 'max' is no limit
                most, taken = (int((folder / name).read_text()) for name in (limit, used))
                stat = dict(entry.split() for entry in (folder / "memory.stat").read_text().splitlines())
                available.append(most - taken + sum(int(stat.get(name, 0)) for name in cache))
    return min(available, default=None)


def configure_process() -> None:
    """Prepare this process; to be called before any thread is started. Changes no result.

    Threads of compiled loops sleep while they wait: threads that spin take the cores from this and from other
    processes. NumPy's products of matrices, which are small, take one thread: the others would be waited for. Rerun
    logs nothing of its own to the terminal.
    """
    os.environ.setdefault("RUST_LOG", "off")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read when OpenMP is loaded
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is loaded


def trim_malloc(*, least: int = 0) -> None:
    """Return freed memory to the system at once (glibc), where the process has `least` bytes."""
    if resident_bytes() >= least and hasattr(libc := _libc(), "malloc_trim"):
        libc.malloc_trim(0)


@functools.cache
def _libc() -> Any:
    """Return the C library; nothing where its memory cannot be settled."""
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


class Stopwatch:
    """Wall-clock seconds added up by stage."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[Lap]:
        """Time the block; the yielded lap has its own seconds once it is over."""
        lap, started = Lap(), time.perf_counter()
        try:
            yield lap
        finally:
            lap.seconds = time.perf_counter() - started
            self.seconds[stage] += lap.seconds


@dataclass
class Lap:
    """The time of one block."""

    seconds: float = math.nan
