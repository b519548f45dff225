"""Jobs in parallel with the caller, in a thread of their own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

Result = TypeVar("Result")


class Background:
    """A thread that does jobs one after the other, in the order in which they are submitted.

    Args:
        name: Name of the thread.
        most_pending: The most jobs that may wait; they hold their frames in memory.
    """

    def __init__(self, name: str, most_pending: int) -> None:
        self._thread, self._most_pending = ThreadPoolExecutor(1, thread_name_prefix=name), most_pending
        self._pending: deque[Future[Any]] = deque()

    def submit(self, job: Callable[[], Result]) -> Future[Result]:
        """Submit a job, and wait while too many are pending; an error of an earlier job is raised here."""
        self._drain(self._most_pending)
        submitted = self._thread.submit(job)
        self._pending.append(submitted)
        return submitted

    def drain(self) -> None:
        """Wait until all jobs are done; an error of a job is raised here."""
        self._drain(0)

    def _drain(self, pending: int) -> None:
        while len(self._pending) > pending:
            self._pending.popleft().result()

    def close(self) -> None:
        """Finish the pending jobs, and end the thread."""
        self._thread.shutdown()
        self.drain()
