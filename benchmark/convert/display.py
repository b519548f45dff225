"""A conversion in the terminal: a bar while it works, and a line a scene."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from semstab.convert import Converted


class FrameBar:
    """Frames written of one label source; called with what, how many are done, of how many."""

    def __init__(self, console: Console) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("frames"))
        self._bar = Progress(*columns, TimeRemainingColumn(), console=console, transient=True)
        self._work = self._bar.add_task("starting", total=None)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._bar.stop()

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show how far a label source is."""
        self._bar.update(self._work, description=what, completed=done, total=total)


def print_converted(converted: Converted, console: Console) -> None:
    """What was written, and what is different or missing in it."""
    kept = converted.frames - converted.written
    there = f", {kept} of them from before" if kept else ""
    console.print(
        f"{converted.scene}: {converted.frames} frames{there}, depth as {converted.depth}: {converted.folder}",
        soft_wrap=True,
    )
    for old, new in converted.renamed.items():
        console.print(f"  {old} is called {new} there")
    for lost in converted.lost:
        console.print(f"  not kept: {lost}")
