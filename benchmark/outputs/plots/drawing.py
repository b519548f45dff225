"""A second process that draws figures. It loads what drawing needs while frames are still fused."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path

from semstab.engine.folder import load_result
from semstab.outputs.plots import figures
from semstab.runtime.process import follow_parent


class DrawingProcess:
    """Started at once; it ends with `close`, or with its parent."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        listening, self._alive = context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(1, context, initializer=_begin, initargs=(listening,))
        self._pool.submit(_load)

    def draw(self, folder: Path, names: Sequence[str]) -> Future[None]:
        """Begin to draw the figures of those names from the finished folder."""
        return self._pool.submit(_draw, folder, names)

    def close(self) -> None:
        """End the process, also where it is at work."""
        self._alive.close()
        self._pool.shutdown(wait=False, cancel_futures=True)


def _begin(listening: Connection) -> None:
    follow_parent(listening)


def _load() -> None:
    import pyarrow.parquet  # noqa: F401


def _draw(folder: Path, names: Sequence[str]) -> None:
    for figure in figures(load_result(folder), folder):
        if figure.name in names:
            figure.save(folder / "figures")
