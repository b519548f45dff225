"""A conversion in the terminal: a bar while it works, and a line a scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from semstab.convert import Converted


@contextmanager
def frame_bar(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """Frames written of one label source; to be called with what, how many are done, of how many."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TextColumn("frames"))
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as bar:
        work = bar.add_task("starting", total=None)
        yield lambda what, done, total: bar.update(work, description=what, completed=done, total=total)


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
