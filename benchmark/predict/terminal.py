"""A prediction in the terminal: progress with frames a second and time left, and at the end what lies where."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from semstab.predict.disk.sequence import PredictionObserver, SequenceReport


class PredictionBar(PredictionObserver):
    """One bar a sequence. Speed and time left count frames that the model saw, not those kept from before."""

    def __init__(self, console: Console) -> None:
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("frames"),
        )
        self._bar = Progress(*columns, TextColumn("{task.fields[speed]}"), console=console, transient=True)
        self._work = self._bar.add_task("starting", total=None, speed="")
        self._left = self._predicted = 0
        self._started = time.monotonic()

    def sequence_started(self, name: str, frames: int) -> None:
        """Show the bar."""
        self._left, self._predicted, self._started = frames, 0, time.monotonic()
        self._bar.reset(self._work, total=frames, description=name, speed="")
        self._bar.start()

    def frame_done(self, kept: bool) -> None:
        """One frame further."""
        self._left -= 1
        if kept and not self._predicted:
            self._started = time.monotonic()
        self._predicted += not kept
        speed = speed_text(self._predicted, time.monotonic() - self._started, self._left)
        self._bar.update(self._work, advance=1, speed=speed)

    def close(self) -> None:
        """Take the bar away, also after an interruption."""
        self._bar.stop()


def speed_text(frames: int, seconds: float, left: int) -> str:
    """Speed and time left.

    >>> speed_text(10, 20.0, 30)
    '0.50 frames/s, 0:01:00 left'
    """
    if not frames or seconds <= 0:
        return ""
    remaining = int(left * seconds / frames)
    clock = f"{remaining // 3600}:{remaining // 60 % 60:02d}:{remaining % 60:02d}"
    return f"{frames / seconds:.2f} frames/s, {clock} left"


def print_report(report: SequenceReport, console: Console) -> None:
    """One sequence: how many frames, how fast, where; of regions, how much they change."""
    kept = f", {report.kept} kept from before" if report.kept else ""
    speed = ""
    if report.predicted:
        model = 1e3 * report.model_seconds / report.predicted
        speed = f", {report.frames_per_second:.2f} frames/s (model {model:.0f} ms a frame)"
    console.print(f"{report.sequence}: {report.predicted} frames predicted{kept}{speed}", soft_wrap=True)
    for folder in report.folders:
        console.print(f"  {folder}", soft_wrap=True)
    if report.regions is not None:
        line = f"  flicker of matched regions {report.regions.flicker_percent:.2f} %"
        if report.regions.compensated:
            line += f", camera motion taken out {report.regions.compensated_flicker_percent:.2f} %"
        console.print(line, soft_wrap=True)
