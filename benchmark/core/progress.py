"""The look of a progress bar in the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn


def frame_progress(console: Console, *columns: ProgressColumn) -> Progress:
    """Return a bar of frames that vanishes at the end: what is done, the bar, how many of how many, `columns`."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("frames"),
        *columns,
        console=console,
        transient=True,
    )
