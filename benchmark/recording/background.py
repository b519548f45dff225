"""The thread that makes and logs what the next frame need not wait for."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import rerun as rr

from semstab.recording.entities import Clock

LOOK_BEHIND = 4
"""Jobs that may be waiting; they hold their frames."""


class Background:
    """Does jobs one after the other, each at the time of its frame."""

    def __init__(self, stream: rr.RecordingStream, clock: Clock) -> None:
        self._stream = stream
        self._clock = clock
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="semstab-recording")
        self._pending: deque[Future[None]] = deque()

    def submit(self, frame: int, timestamp: float | None, job: Callable[[], None]) -> None:
        """Leave a job to the thread, and wait while too many are pending; raises what an earlier job raised."""
        self._wait(LOOK_BEHIND)
        self._pending.append(self._thread.submit(self._do, frame, timestamp, job))

    def drain(self) -> None:
        """Wait until all jobs are done; raises what one of them raised."""
        self._wait(0)

    def close(self) -> None:
        """Do what is pending, and end the thread."""
        self._thread.shutdown()
        self.drain()

    def _do(self, frame: int, timestamp: float | None, job: Callable[[], None]) -> None:
        self._clock.set(self._stream, frame, timestamp)  # a stream has a time for each thread
        job()

    def _wait(self, pending: int) -> None:
        while len(self._pending) > pending:
            self._pending.popleft().result()
