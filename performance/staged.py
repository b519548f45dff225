"""The command, which also says what each stage took: `python performance/staged.py FILE.json run --data ...`.

CPU seconds (of the main thread, and of all threads) and peak resident memory by stage of the stopwatch, as JSON. Where
numba has one thread, what the main thread takes in the stages of a frame is theirs; images are decoded in others.
"""

from __future__ import annotations

import contextlib
import json
import re
import resource
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from semstab.cli import main
from semstab.core.process import Stopwatch, resident_bytes

EVERY = 0.005
"""Seconds from one look at the memory to the next."""

found: dict[str, dict[str, float]] = {}
inside = ["beside"]


def entry_of(stage: str) -> dict[str, float]:
    """Return the entry of a stage, which begins with zeros."""
    return found.setdefault(stage, {"own_s": 0.0, "all_s": 0.0, "peak_gb": 0.0})


@contextlib.contextmanager
def watched(self: Stopwatch, stage: str) -> Iterator[Any]:
    """A stage of the stopwatch, of which CPU time is noted as well."""
    thread_began, everything = time.thread_time(), time.process_time()
    inside.append(stage)
    note(stage)
    try:
        with plain(self, stage) as lap:
            yield lap
    finally:
        inside.pop()
        note(stage)
        now = entry_of(stage)
        now["own_s"] += time.thread_time() - thread_began
        now["all_s"] += time.process_time() - everything


def note(stage: str) -> None:
    """The memory that the process has now, in that stage."""
    now = entry_of(stage)
    now["peak_gb"] = max(now["peak_gb"], resident_bytes() / 1e9)


def look() -> None:
    """Note the memory all the time."""
    while True:
        note(inside[-1])
        time.sleep(EVERY)


plain = Stopwatch.__call__
Stopwatch.__call__ = watched  # type: ignore[method-assign]

if __name__ == "__main__":
    file, sys.argv[1:] = Path(sys.argv[1]), sys.argv[2:]
    threading.Thread(target=look, daemon=True).start()
    try:
        main()
    finally:
        most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
        (most_resident,) = re.findall(
            r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text()
        )  # ru_maxrss has the parent's
        entry_of("all")["peak_gb"] = max(most, int(most_resident) * 1024) / 1e9
        file.write_text(json.dumps(found))
