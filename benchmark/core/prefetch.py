"""Reading ahead in worker threads while the caller works on an item, and a cache of what was loaded last."""

from __future__ import annotations

import contextvars
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Generic, TypeVar

LOOK_AHEAD_BYTES = 1 << 30
MOST_THREADS = 8
"""Default number of threads: more threads only hold more frames in memory."""

K = TypeVar("K")
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Fetched(Generic[T]):
    """An item, the wall-clock seconds that its worker took, and those that the caller stood still for it."""

    item: T
    seconds: float
    waited: float


def default_threads() -> int:
    """Return one thread for each core that this process may use, at least 2, at most `MOST_THREADS`."""
    return min(max(2, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2), MOST_THREADS)


def prefetch(
    read: Callable[[K], T],
    indices: Sequence[K],
    *,
    threads: int | None = None,
    size: Callable[[T], int] = lambda item: 0,
    limit: int = LOOK_AHEAD_BYTES,
) -> Generator[Fetched[T], None, None]:
    """Yield read(index) for each index in order; `threads` workers are at most `threads` + 1 items ahead, 0 none.

    If that many items, each of `size` bytes, exceed `limit` bytes, fewer are read ahead, but always one.
    An error that `read` raises for an index is raised after the items before it. Closing the iterator drops what
    was not begun and waits for what was: no thread outlives it.
    """
    if threads == 0:
        yield from (Fetched(item, seconds, seconds) for item, seconds in (_timed(read, index) for index in indices))
        return
    threads = threads or default_threads()
    waiting = iter(indices)
    ahead: deque[Future[tuple[T, float]]] = deque()
    room = 2  # until the size of an item is known
    pool = ThreadPoolExecutor(threads, thread_name_prefix="semstab-read")

    def fill() -> None:
        while len(ahead) < room and (index := next(waiting, None)) is not None:
            ahead.append(pool.submit(contextvars.copy_context().run, _timed, read, index))

    try:
        fill()
        while ahead:
            (item, seconds), waited = _timed(lambda future: future.result(), ahead.popleft())
            room = max(1, min(threads + 1, limit // max(1, size(item))))
            fill()
            fetched = Fetched(item, seconds, waited)
            del item  # a suspended generator keeps its variables alive
            yield fetched
            del fetched
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _timed(read: Callable[[K], T], index: K) -> tuple[T, float]:
    started = time.perf_counter()
    return read(index), time.perf_counter() - started


class SizedCache(Generic[K, T]):
    """A cache that loads by key and retains the items used last, at least one, while sizes sum to at most `most`."""

    def __init__(self, load: Callable[[K], T], size: Callable[[T], int], most: int) -> None:
        self._load, self._size, self._most = load, size, most
        self._loaded, self._lock = dict[K, T](), threading.Lock()

    def __getitem__(self, key: K) -> T:
        with self._lock:
            value = self._loaded[key] = self._loaded.pop(key) if key in self._loaded else self._load(key)
            while len(self._loaded) > 1 and sum(map(self._size, self._loaded.values())) > self._most:
                del self._loaded[next(iter(self._loaded))]
            return value
