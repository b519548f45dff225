"""What a run or a study looks like in the terminal while it works, and what failed."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from semstab.check import Verdict
from semstab.config import BASE
from semstab.engine.observer import Observer
from semstab.engine.units import Plan, Planned
from semstab.model.records import Failure, Result
from semstab.task import Task

SECONDS_A_LINE = 10.0
"""Where there is no terminal for a bar, progress is a line that often."""


class ProgressBar(Observer):
    """One bar for all of it, in frames that go into maps."""

    def __init__(self, console: Console) -> None:
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("frames"),
        )
        self.bar = Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console, transient=True)
        self.work = self.bar.add_task("starting", total=None)
        self.notes: list[str] = []
        self._said = time.monotonic()

    def run_started(self, plan: Plan, kept: Sequence[Planned]) -> None:
        """Show the bar: the frames of every unit that is to be computed are its total."""
        units = plan.distinct()
        if kept:
            self.bar.console.print(f"kept from before: {len(kept)} of {len(units)} units", style="dim")
        for scene in plan.scenes.values():
            if scene.depth_from is not None:
                self.notes.append(f"{scene.name}: depth from {scene.depth_from}")
        missing = units.keys() - {each.identity for each in kept}
        self.bar.update(self.work, total=sum(units[identity].frames for identity in missing))
        if self.bar.console.is_interactive:
            self.bar.start()

    def geometry_checked(self, task: Task, verdict: Verdict) -> None:
        """Remember, until the run is through, what could not be told."""
        if verdict.state == "unclear":
            self.notes.append(f"{task.scene.name}: {verdict.text}")

    def remarked(self, line: str) -> None:
        """Say it at once."""
        self.bar.console.print(line, style="dim", soft_wrap=True, markup=False)

    def advanced(self, frames: int, what: str) -> None:
        """So many frames further."""
        self.bar.update(self.work, advance=frames, description=what[:40])
        if not self.bar.console.is_interactive and time.monotonic() - self._said > SECONDS_A_LINE:
            self._said = time.monotonic()
            (work,) = self.bar.tasks
            self.bar.console.print(
                f"{what}: {work.completed:.0f} of {work.total:.0f} frames", markup=False, soft_wrap=True
            )

    def run_finished(self, result: Result) -> None:
        """Take the bar away, and say what is to be known of the scenes."""
        self.close()
        for note in self.notes if not result.failures else ():
            self.bar.console.print(note, style="dim", soft_wrap=True, markup=False)

    def close(self) -> None:
        """Take the bar away, also where the run was interrupted."""
        if self.bar.live.is_started:
            self.bar.stop()


def failure_lines(result: Result) -> Iterator[str]:
    """One line for what failed for the same reason."""
    reasons: dict[str, list[Failure]] = {}
    for failure in result.failures:
        reasons.setdefault(failure.message, []).append(failure)
    for message, failures in reasons.items():
        places = list(dict.fromkeys(f"{failure.unit.scene}, {failure.unit.backbone}" for failure in failures))
        varied = [name for failure in failures if (name := _named(failure))]
        where = "" if message.startswith(places[0]) else f"{_first_of(places)}: "
        what = f"{_first_of(varied)}: " if varied else ""
        yield f"{where}{what}{message}"


def _first_of(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _named(failure: Failure) -> str:
    """What was varied; nothing of a unit at the base settings."""
    if failure.variation.sweep == BASE:
        return ""
    value = failure.variation.value
    return f"{failure.variation.sweep} {failure.unit.backend if value is None else f'{value:g}'}"
