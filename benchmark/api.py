"""The command line from Python: a run or a study, with its tables, figures and report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from semstab.config import Config
from semstab.data.records import Result
from semstab.engine import Executor, Observer
from semstab.engine.execution import run as execute
from semstab.engine.execution import run_study as execute_study
from semstab.report import Reporting
from semstab.settings import as_config


def run(
    config: Config | Mapping[str, Any] | str | Path,
    *,
    out: str | Path | None = None,
    executor: Executor | None = None,
    observers: Sequence[Observer] = (),
    command: Sequence[str] = (),
    report: bool = True,
) -> Result:
    """Fuse, measure and compare what the configuration selects, without printing; it may be a dict or a YAML file.

    A folder `out`, whose finished units of an earlier start are reused, gets the summary, voxels, time series and,
    unless `report` is False, tables, figures and report.html.

    Args:
        config: Settings, or a YAML file with them.
        out: Folder of the results; without it they are in memory alone.
        executor: Executor of the work; this process by default.
        observers: Objects that are notified of each step.
        command: The command line, for the manifest.
        report: Whether tables, figures and report.html are written.

    Returns:
        The summaries of all units, with their voxels where `out` is given.

    Raises:
        ConfigError, DataError: If something cannot be used or read; what was finished before stays in the folder.
    """
    reporting = [Reporting(out)] if report and out is not None else []
    return execute(as_config(config), out=out, executor=executor, observers=[*observers, *reporting], command=command)


def run_study(
    config: Config | Mapping[str, Any] | str | Path,
    out: str | Path,
    *,
    executor: Executor | None = None,
    observers: Sequence[Observer] = (),
    command: Sequence[str] = (),
    report: bool = True,
) -> Result:
    """Run a study as `run` does: a unit that fails is among the result's failures, and the others finish."""
    reporting = [Reporting(out)] if report else []
    return execute_study(as_config(config), out, executor=executor, observers=[*observers, *reporting], command=command)
