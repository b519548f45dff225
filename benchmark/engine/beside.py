"""What this process puts together while others do the work."""

from __future__ import annotations

import concurrent.futures as cf
from collections.abc import Callable
from typing import TypeVar

from semstab.errors import SemstabError

T = TypeVar("T")


class Beside:
    """One call after the other, in a thread beside where others do the work; at once where this process does it."""

    def __init__(self, *, threaded: bool = False) -> None:
        self._pool = cf.ThreadPoolExecutor(1) if threaded else None

    def submit(self, call: Callable[[], T]) -> cf.Future[T]:
        """What it will return, or raise."""
        if self._pool is not None:
            return self._pool.submit(call)
        future = cf.Future[T]()
        try:
            future.set_result(call())
        except SemstabError as error:
            future.set_exception(error)
        return future
