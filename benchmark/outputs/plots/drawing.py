"""A second process that draws figures. It loads what drawing needs while frames are still fused."""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from pathlib import Path

from semstab.model.records import Result
from semstab.outputs.plots import Views, figures
from semstab.runtime.process import follow_parent


class DrawingProcess:
    """Started at once; it ends with `close`, or with its parent."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        listening, self._alive = context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(1, context, initializer=_begin, initargs=(listening,))
        self._given: list[Future[None]] = []
        with contextlib.suppress(BrokenProcessPool):
            self._given.append(self._pool.submit(_load))

    def draw(self, result: Result, folder: Path, views: Views, names: Sequence[str]) -> Callable[[], bool]:
        """Begin to draw the figures of those names of a result in the folder.

        What is returned waits for them, and says whether they are there: not where the process died, or never came to
        life, as in a script that cannot be imported.
        """
        drawing = None
        with contextlib.suppress(BrokenProcessPool, RuntimeError):
            drawing = self._pool.submit(_draw, result, folder, views, names)
            self._given.append(drawing)

        def drawn() -> bool:
            with contextlib.suppress(BrokenProcessPool):
                return drawing is not None and drawing.result() is None
            return False

        return drawn

    def close(self) -> None:
        """End the process, also where it is at work; one that is idle ends by itself, without a word."""
        if all(future.done() for future in self._given):
            self._pool.shutdown()
        self._alive.close()
        self._pool.shutdown(wait=False, cancel_futures=True)


def _begin(listening: Connection) -> None:
    follow_parent(listening)


def _load() -> None:
    import pyarrow.parquet  # noqa: F401


def _draw(result: Result, folder: Path, views: Views, names: Sequence[str]) -> None:
    found = {figure.name: figure for figure in figures(result, folder, views)}
    for name in names:
        found[name].save(folder / "figures")
