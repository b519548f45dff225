"""The memory that a process has and can still take: of the machine, of its control groups, of its own limit."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

PROC, CGROUPS = Path("/proc/self"), Path("/sys/fs/cgroup")

V1_FILES = ("memory.limit_in_bytes", "memory.usage_in_bytes", ("total_inactive_file", "total_active_file"))
V2_FILES = ("memory.max", "memory.current", ("inactive_file", "active_file"))
"""Names of a group's limit, of what it uses, and of the entries of memory.stat that say what of that is page cache."""


def available_bytes() -> int:
    """Memory that this process can still take."""
    import psutil

    return max(0, min([int(psutil.virtual_memory().available), *_of_groups(PROC, CGROUPS), *_of_process()]))


def resident_bytes() -> int:
    """Memory that this process takes."""
    return int(_process(os.getpid()).memory_info().rss)


@functools.cache
def _process(pid: int):  # type: ignore[no-untyped-def]
    import psutil

    return psutil.Process(pid)


def group_bytes(proc: Path, cgroups: Path) -> int | None:
    """What the control groups of a process leave to it; None where none of them has a limit.

    proc     as /proc/self: its file `cgroup` names the groups
    cgroups  as /sys/fs/cgroup: version 2, or version 1 with a folder `memory`
    """
    return min(_of_groups(proc, cgroups), default=None)


def _of_groups(proc: Path, cgroups: Path) -> Iterator[int]:
    """Of each group from the process's own up to the root: every one of them bounds those below it."""
    for controllers, path in _groups(proc):
        root, files = (cgroups, V2_FILES) if not controllers else (cgroups / "memory", V1_FILES)
        if controllers and "memory" not in controllers:
            continue
        own = root / path.lstrip("/")
        for folder in (own, *own.parents):  # in a container, the path may be that of the host: then only the root is
            if folder.is_relative_to(root) and (left := _left(folder, *files)) is not None:
                yield left


def _groups(proc: Path) -> Iterator[tuple[list[str], str]]:
    """Controllers and path of each group, by lines such as '4:memory:/user' or, of version 2, '0::/user'."""
    try:
        lines = (proc / "cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = (*line.split(":", 2), "", "")[:3]
        yield [name for name in controllers.split(",") if name], path


def _left(folder: Path, limit: str, used: str, cache: tuple[str, ...]) -> int | None:
    """A group's limit less what it uses; page cache is given back when memory is short."""
    try:
        most, taken = ((folder / name).read_text().strip() for name in (limit, used))
        stat = _stat(folder)
        return None if most == "max" else int(most) - int(taken) + sum(stat.get(name, 0) for name in cache)
    except (OSError, ValueError):
        return None


def _stat(folder: Path) -> Mapping[str, int]:
    lines = (line.split() for line in (folder / "memory.stat").read_text().splitlines())
    return {name: int(value) for name, value in lines}


def _of_process() -> Iterator[int]:
    """What `ulimit -v` leaves of the address space."""
    try:
        import resource
    except ImportError:
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY:
        yield limit - int(_process(os.getpid()).memory_info().vms)
