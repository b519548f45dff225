"""A progress bar while a run works, and its failures."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence

from rich.console import Console
from rich.progress import TimeElapsedColumn, TimeRemainingColumn

from semstab.check import Verdict
from semstab.config import BASE
from semstab.core.progress import frame_progress
from semstab.data.records import Failure, Record, RegionFlicker, Result
from semstab.engine.observer import Observer
from semstab.engine.units import Plan
from semstab.task import Task

SECONDS_A_LINE = 10.0
"""The seconds between two lines of progress, without a terminal for a bar."""


class ProgressBar(Observer):
    """A progress bar for the whole run, in frames that are fused."""

    def __init__(self, console: Console) -> None:
        self.bar = frame_progress(console, TimeElapsedColumn(), TimeRemainingColumn())
        self.work = self.bar.add_task("starting", total=None)
        self.notes: list[str] = []
        self._printed = time.monotonic()

    def run_started(self, plan: Plan, finished: Mapping[str, Record | RegionFlicker]) -> None:
        """Show the bar: the frames of every unit that is to be computed are its total."""
        units = plan.distinct()
        if finished:
            self.bar.console.print(f"finished earlier: {len(finished)} of {len(units)} units", style="dim")
        for scene in plan.scenes.values():
            if scene.depth_from is not None:
                self.notes.append(f"{scene.name}: depth from {scene.depth_from}")
            if scene.placed is not None:
                self.notes.append(f"{scene.name}: {scene.placed}")
        missing = units.keys() - finished.keys()
        self.begin(sum(len(units[identity].task.indices) for identity in missing))

    def begin(self, frames: int) -> None:
        """Show the bar, which is full after `frames` frames."""
        self.bar.update(self.work, total=frames)
        if self.bar.console.is_interactive:
            self.bar.start()

    def geometry_checked(self, task: Task, verdict: Verdict) -> None:
        """Store an unclear or imprecise result until the run is finished."""
        if verdict.state in ("unclear", "imprecise"):
            self.notes.append(f"{task.scene.name}: {verdict.text}")

    def advanced(self, frames: int, what: str) -> None:
        """Advance the bar by a number of frames."""
        self.bar.update(self.work, advance=frames, description=what[:40])
        if not self.bar.console.is_interactive and time.monotonic() - self._printed > SECONDS_A_LINE:
            self._printed = time.monotonic()
            (work,) = self.bar.tasks
            self.bar.console.print(
                f"{what}: {work.completed:.0f} of {work.total:.0f} frames", markup=False, soft_wrap=True
            )

    def run_finished(self, result: Result) -> None:
        """Remove the bar, and print the notes on the scenes."""
        self.close()
        for note in self.notes if not result.failures else ():
            self.bar.console.print(note, style="dim", soft_wrap=True, markup=False)

    def close(self) -> None:
        """Remove the bar, also if the run was interrupted."""
        if self.bar.live.is_started:
            self.bar.stop()


def failure_lines(result: Result) -> Iterator[str]:
    """Yield one line for all failures with the same reason."""
    reasons: dict[str, list[Failure]] = {}
    for failure in result.failures:
        reasons.setdefault(failure.message, []).append(failure)
    for message, failures in reasons.items():
        units = list(dict.fromkeys(f"{failure.unit.scene}, {failure.unit.model}" for failure in failures))
        varied = [name for failure in failures if (name := _named_task(failure))]
        where = "" if message.startswith(units[0]) else f"{_first_of(units)}: "
        what = f"{_first_of(varied)}: " if varied else ""
        yield f"{where}{what}{message}"


def _first_of(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _named_task(failure: Failure) -> str:
    """Return the setting that was varied; an empty text for a unit at the base settings."""
    if failure.variation.sweep == BASE:
        return ""
    value = failure.variation.value
    return f"{failure.variation.sweep} {failure.unit.backend if value is None else f'{value:g}'}"
