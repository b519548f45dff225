"""Run a configuration for a command: its executor, its observers, the answer, and the exit code."""

from __future__ import annotations

import contextlib
import gc
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from semstab.cli.options import Execution, print_lines, say
from semstab.errors import ConfigError

if TYPE_CHECKING:
    from semstab.config import Config
    from semstab.data.records import Result
    from semstab.engine import Executor, Observer


DISAGREE = 3
"""The exit code of a run whose backends disagree."""


def execute(config: Config, out: Path, execution: Execution, *, quiet: bool, verbose: bool = False) -> None:
    """Run a configuration, print the answer, and end with the exit code of its outcome."""
    executor = executor_of(execution.jobs, execution.scheduler)
    began = time.monotonic()
    from semstab.api import run_study
    from semstab.core.console import Console
    from semstab.report.terminal import ProgressBar, failure_lines, print_answer

    report, recording = _reported(execution), []
    if execution.rerun != "off":
        from semstab.recording import Recording, Target

        recording.append(Recording(Target.parse(execution.rerun, out / "recording.rrd")))
        if executor.elsewhere and recording[0].target.live:
            raise ConfigError("--rerun: a viewer follows a run in one process; leave out --jobs and --scheduler")
    observers: list[Observer] = [ProgressBar(Console(stderr=True, quiet=quiet)), *recording]
    gc.freeze()  # the garbage collector skips modules, which takes half a second of a short run otherwise
    try:
        result = run_study(
            config, out, executor=executor, observers=observers, command=sys.argv, report=report,
            overwrite=execution.overwrite,
        )  # fmt: skip
        for line in failure_lines(result):
            say(f"error: {line}")
        if result.select() and not quiet:
            print_answer(result, Console(), out=out, seconds=time.monotonic() - began, verbose=verbose)
        else:
            traces = out / "failures.log"
            print_lines([f"  traces  {traces}" if traces.exists() else f"  folder  {out}"], quiet=quiet)
        for recorder in recording:
            recorder.serve()
    finally:
        for observer in observers:
            observer.close()
    _require_success(result, out)


def _reported(execution: Execution) -> bool:
    """Return whether the report is written; raises ConfigError for another word than on or off."""
    if execution.report not in ("on", "off"):
        raise ConfigError(f"--report {execution.report}: write on or off")
    return execution.report == "on"


def _require_success(result: Result, out: Path) -> None:
    """End the command with an exit code where a unit failed or the backends disagree."""
    if result.failures:
        raise typer.Exit(2)
    if not result.agrees:
        first = next(row for row in result.agreement if not row.agrees)
        where = f" ({first.scene}, {first.model}: {first.first})" if first.first else ""
        say(f"error: the backends disagree{where}; the agreement in {out / 'summary.json'} shows where")
        raise typer.Exit(DISAGREE)


def executor_of(jobs: int, scheduler: str | None) -> Executor:
    """Return the executor of the work: this process, processes of this machine, or a cluster."""
    import logging

    from semstab.engine import DaskCluster, InProcess, LocalProcesses

    if scheduler is None:
        return LocalProcesses(jobs) if jobs > 1 else InProcess()
    if jobs > 1:
        raise ConfigError("--jobs and --scheduler: the scheduler's workers do the work; leave --jobs out")
    cluster = DaskCluster(scheduler)
    for name in ("distributed", "distributed.client"):  # the run itself prints one line for a unit that fails
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return cluster


@contextlib.contextmanager
def naming(out: Path) -> Iterator[None]:
    """Name the folder in which the same command resumes, if it is interrupted."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(*error.args, out) from error
