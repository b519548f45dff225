"""Ctrl-C, which may come in the midst of anything: an import, a callback from compiled code."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt, whatever it is taken for on its way out of the block.

    An import that it hits may fail in another way, and what a callback raises is printed and forgotten: the first
    becomes the interruption that it was, of the second nothing is printed.
    """
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        yield
        return
    came: list[int] = []

    def interrupt(number: int, _frame: Any) -> None:
        came.append(number)
        sys.unraisablehook = lambda _: None
        raise KeyboardInterrupt

    before, hook = signal.signal(signal.SIGINT, interrupt), sys.unraisablehook
    try:
        yield
    except Exception as error:
        if came:
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, before)
        sys.unraisablehook = hook
