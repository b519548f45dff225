"""What a study looks like in the terminal while it works, and what failed."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from semstab.study.grid import Cell, RegionCell
from semstab.study.results import Failure, StudyResult, Variation
from semstab.study.run import StudyObserver


class StudyProgress(StudyObserver):
    """One bar for the whole study, in units; those of a sequence finish together."""

    def __init__(self, console: Console) -> None:
        columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(20), MofNCompleteColumn())
        times = (TextColumn("units"), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
        self.bar = Progress(*columns, *times, console=console, transient=True)
        self.work = self.bar.add_task("starting", total=None)

    def study_started(self, units: int, kept: int) -> None:
        """Show the bar: the units that are to be computed are its total."""
        if kept:
            self.bar.console.print(f"kept from before: {kept} of {units} units", style="dim")
        self.bar.update(self.work, total=units - kept)
        if self.bar.console.is_interactive:
            self.bar.start()

    def unit_finished(self, cell: Cell | RegionCell, error: str | None) -> None:
        """One unit further."""
        self.bar.update(self.work, advance=1, description=f"{cell.unit.scene} · {cell.unit.backbone}"[:28])

    def study_finished(self, result: StudyResult) -> None:
        """Take the bar away."""
        self.close()

    def close(self) -> None:
        """Take the bar away, also where the study was interrupted."""
        if self.bar.live.is_started:
            self.bar.stop()


def failure_lines(result: StudyResult) -> Iterator[str]:
    """One line for what failed for the same reason."""
    reasons: dict[tuple[str, str, str], list[Failure]] = {}
    for failure in result.failures:
        reasons.setdefault((failure.unit.scene, failure.unit.backbone, failure.message), []).append(failure)
    for (scene, backbone, message), failures in reasons.items():
        first, *more = (_named(failure.variation, failure.unit.backend) for failure in failures)
        others = f" and {len(more)} more" if more else ""
        yield f"{scene}, {backbone}: {first}{others}: {message}"


def _named(variation: Variation, backend: str) -> str:
    return f"{variation.sweep} {backend if variation.value is None else variation.value}"
