"""A run or a study from Python, as the command line has it, with its tables, figures and report."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from semstab.config import Config
from semstab.configure import as_config
from semstab.core.files import ScratchFolder
from semstab.data.records import Result
from semstab.engine import Executor, Observer, execute
from semstab.engine.folder import without_files
from semstab.errors import DataError
from semstab.report import Reporting


def run(
    config: Config | Mapping[str, Any] | str | Path,
    *,
    out: str | Path | None = None,
    executor: Executor | None = None,
    observers: Sequence[Observer] = (),
    command: Sequence[str] = (),
    report: bool = True,
    overwrite: bool = False,
) -> Result:
    """Fuse, measure and compare what the configuration selects, without printing; it may be a dict or a YAML file.

    A folder `out`, whose finished units of an earlier start are reused, gets the summary, voxels, time series and,
    unless `report` is False, tables and report.html.

    Args:
        config: Settings, or a YAML file with them.
        out: Folder of the results; without it they are in memory alone.
        executor: Executor of the work; this process by default.
        observers: Objects that are notified of each step.
        command: The command line, for the manifest.
        report: Whether tables and report.html are written.
        overwrite: Whether the results of another run in the folder may be replaced.

    Returns:
        The summaries of all units, with their voxels where `out` is given.

    Raises:
        ConfigError, DataError: If the plan cannot be made, or a unit failed, once everything else has been written.

    Examples:
        >>> city = {"name": "city", "options": {"width": 160, "height": 90, "frames": 24}}
        >>> result = semstab.run({"dataset": city, "scenes": ["scene0"], "voxel_size": 0.5}, out="again", report=False)
        >>> result.models
        ('sim-steady', 'sim-flicker')
    """
    with contextlib.ExitStack() as stack:
        if out is None:
            scratch = ScratchFolder()
            stack.callback(scratch.remove)
        folder = scratch.path if out is None else Path(out)
        reporting = [Reporting(folder)] if report and out is not None else []
        watching = [*reporting, *observers]  # the recording is completed beside the report
        result, causes = execute(as_config(config), folder, executor, watching, command, overwrite=overwrite)
    if result.failures:
        first = result.failures[0]
        raise causes.get(first.message) or DataError(first.message)
    if out is None:
        records = tuple(without_files(record) for record in result.records)
        return dataclasses.replace(result, records=records)
    return result


def run_study(
    config: Config | Mapping[str, Any] | str | Path,
    out: str | Path,
    *,
    executor: Executor | None = None,
    observers: Sequence[Observer] = (),
    command: Sequence[str] = (),
    report: bool = True,
    overwrite: bool = False,
) -> Result:
    """Run a study as `run` does: a unit that fails is among the result's failures, and the others finish.

    Args:
        config: Settings, or a YAML file with them.
        out: Folder of the results.
        executor: Executor of the work; this process by default.
        observers: Objects that are notified of each step.
        command: The command line, for the manifest.
        report: Whether tables and report.html are written.
        overwrite: Whether the results of another run in the folder may be replaced.

    Returns:
        The summaries of all units that finished, and the failures of the others.

    Examples:
        >>> study = {**config, "sweeps": {"voxel_size": [0.5, 1.0]}}
        >>> len(semstab.run_study(study, "study", report=False).records)
        6
    """
    observing = [*([Reporting(out)] if report else []), *observers]  # the recording is completed beside the report
    return execute(as_config(config), Path(out), executor, observing, command, overwrite=overwrite)[0]
