"""The answer of a run on one screen: verdicts, classes, warnings, the check of backends, files to open."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console

from semstab.backends import is_builtin
from semstab.core.console import WIDTH, wrapped
from semstab.data.records import Result
from semstab.data.results import Agreement
from semstab.data.statistics import CONFIDENCE
from semstab.engine.executors import InProcess
from semstab.metrics import macro_mean
from semstab.report.filter_study import filter_studies
from semstab.report.narrative import warnings
from semstab.report.tables import tables
from semstab.report.tables.backends import largest_share, one_in
from semstab.report.tables.table import to_terminal
from semstab.report.terminal.filters import print_filter_study
from semstab.report.terminal.many_scenes import many_scenes
from semstab.report.terminal.one_model import one_model
from semstab.report.terminal.several_models import several_models
from semstab.report.terminal.videos import videos

MOST_WARNINGS = 3
STAGE_NAMES = {
    "read": "reading",
    "check": "check of the data",
    "sample": "sampling of spots",
    "observe": "pixels into voxels",
    "reference": "check of the fusion",
    "sizing": "estimate of memory",
    "network": "network",
    "write": "writing",
}


def print_answer(
    result: Result, console: Console, *, out: Path | None = None, seconds: float | None = None, verbose: bool = False
) -> None:
    """Print the answer of a run or a study: of a filter study the recommended filters."""
    if filter_studies(result):
        print_filter_study(result, console)
    else:
        print_summary(result, console, out=out, seconds=seconds, verbose=verbose)


def print_summary(
    result: Result, console: Console, *, out: Path | None = None, seconds: float | None = None, verbose: bool = False
) -> None:
    """Print the answer, then the files to open; `verbose` adds every table of the run."""
    for line in screen(result, out=out, seconds=seconds, width=console.width):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    for table in tables(result) if verbose else ():
        console.print(f"\n{to_terminal(table)}", highlight=False, markup=False, soft_wrap=True)


def screen(
    result: Result, *, out: Path | None = None, seconds: float | None = None, width: int = WIDTH
) -> Iterator[str]:
    """Yield the lines of a run or a study for a terminal of `width` columns; sentences are wrapped at 80.

    They are verdicts, the classes that disagree most, warnings, the check, the time and the files to open.
    """
    records, width = result.select(), max(width, WIDTH)
    if not result.maps.records:
        yield from videos(result, records, width)
    elif len(records) == 1:
        yield from one_model(result, records[0], width)
    elif len(result.scenes) > 1:
        yield from many_scenes(result, records, width)
    else:
        yield from several_models(result, records, width)
    for sweep in result.sweeps():
        yield f"  sweep over {sweep.replace('_', ' ')}: semstab-bench show {out or 'RUN'} sensitivity_{sweep}"
    if any(record.video_measures is not None for record in records):
        yield f"  VC and TC as published: semstab-bench show {out or 'RUN'} video_measures"
    for text in list(warnings(result))[:MOST_WARNINGS]:
        with_folder = text.replace("show RUN", f"show {out or 'RUN'}")
        yield from wrapped(f"warning: {with_folder}")
    if result.benchmark:
        yield f"  benchmark {result.benchmark}"
    yield from _checks(result)
    yield from _where(result, out, seconds)


def _checks(result: Result) -> Iterator[str]:
    """Yield the agreement of the backends, and how far others differ by design: one line for each pair."""
    for pair in dict.fromkeys(row.backends for row in result.agreement):
        rows = [row for row in result.agreement if row.backends == pair]
        yield from wrapped(_check(pair, rows))
    for first, other in dict.fromkeys(row.backends for row in result.compared):
        of_pair = [row for row in result.compared if row.backends == (first, other)]
        shares = sorted(f"{100 * row.differences['label'].mean:.1f}" for row in of_pair)
        least, most = min(shares, key=float), max(shares, key=float)
        relabelled = least if least == most else f"{least} to {most}"
        yield from wrapped(f"{other} differs from {first} by design: {relabelled} % of the labels")


def _check(pair: tuple[str, str], rows: Sequence[Agreement]) -> str:
    checked, reference = pair
    voxels, bad = sum(row.voxels[-1] for row in rows), [row for row in rows if not row.agrees]
    share = f", {one_in(rows)}" if one_in(rows) else ""
    if not voxels and not bad:
        return f"fusion by {checked} was not compared with {reference}: the random sample{share} has no voxel"
    of_sample = f" of a random sample ({one_in(rows)})" if share else ""
    if not bad and is_builtin(checked):
        return f"fusion by {checked} equals {reference} in {'' if share else 'all '}{voxels:,} voxels{of_sample}"
    if not bad and not share:
        return f"fusion by {checked} equals {reference} in all {voxels:,} voxels"
    if not bad:
        most = f"{100 * largest_share(voxels):.2g}".removeprefix("0")
        return (
            f"fusion by {checked} equals {reference} in {voxels:,} voxels{of_sample}; with {CONFIDENCE:.0%} confidence"
            f" at most {most} % of all voxels differ"
        )
    row = bad[0]
    only = f"; {sum(row.only_in):,} voxels in one only" if any(row.only_in) else ""
    causes = "" if is_builtin(checked) else "; the likely cause: docs/tutorials/own-backend.md, the test suite"
    return (
        f"{checked} and {reference} DISAGREE in {len(bad)} of {len(rows)} maps: {row.scene}, {row.model}:"
        f" {f'in {checked} {row.first}' if row.first else 'the agreement in summary.json shows where'}{only}{causes}"
    )


def _where(result: Result, out: Path | None, seconds: float | None) -> Iterator[str]:
    """Yield the time that the run took, and the files and commands that come next."""
    if seconds is not None:
        stages = {STAGE_NAMES.get(k, k): v for k, v in result.manifest.get("seconds", {}).items() if k != "all"}
        longest = sorted(stages, key=lambda name: -stages[name])[:3]
        parts = ", ".join(f"{name} {stages[name]:.0f} s" for name in longest if stages[name] >= 1)
        in_process = result.manifest.get("units", {}).get("executor") == InProcess.name
        what = (
            f"longest{'' if in_process else ', sums of all workers'}"  # of all workers they may exceed the run's time
        )
        yield f"  time    {seconds:.0f} s{f' ({what}: {parts})' if parts else ''}"
    if speeds := _speeds(result):
        yield from wrapped(f"speed of prediction: {speeds}")
    if out is None:
        return
    if (out / "report.html").exists():
        yield f"  report  {out / 'report.html'}"
    if (out / "recording.rrd").exists():
        yield f"  viewer  semstab-bench view {out}"
    yield f"  more    semstab-bench show {out}"


def _speeds(result: Result) -> str:
    """Return the frames a second that each network predicts; '' where labels were read."""
    took: dict[str, list[float]] = {}
    for record in result.select():
        milliseconds = record.stages_ms.get("network", math.nan)
        if milliseconds > 0:
            took.setdefault(record.unit.model, []).append(milliseconds)
    return ", ".join(f"{model} {1e3 / macro_mean(times):.3g} frames/s" for model, times in took.items())
