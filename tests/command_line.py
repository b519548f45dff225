"""The command line as a test calls it: in this process, or as the installed `semstab-bench` in one of its own."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from typer.testing import CliRunner

from semstab.cli import _Once, app

COMMAND = str(Path(sys.executable).with_name("semstab-bench"))


def environment(columns: int, **more: str) -> dict[str, str]:
    return {**os.environ, "COLUMNS": str(columns), "NO_COLOR": "1", "SEMSTAB_CONFIG": "", **more}


def command(words: Sequence[object], report: bool = False, recording: bool = False) -> list[str]:
    """Return the command of these words.

    Runs and studies draw and record nothing unless a test looks: most of their time.
    """
    said, first = {*map(str, words)}, str(words[0]) if words else "run"
    fuses = first in ("run", "study") or first not in _commands()  # bare options, or data: short for `run --data`
    fuses = fuses and not {"--help", "-h", "--version"} & said
    off = [name for name, wanted in (("--report", report), ("--rerun", recording)) if not wanted and name not in said]
    return [COMMAND, *map(str, words), *(word for name in off if fuses for word in (name, "off"))]


@functools.cache
def _commands() -> frozenset[str]:
    return frozenset(entry.name or entry.callback.__name__ for entry in app.registered_commands)  # type: ignore[union-attr]


def bench(
    *words: object, cwd: Path, code: int | None = 0, columns: int = 160, report: bool = False, recording: bool = False,
    process: bool = False, **more: str,
) -> subprocess.CompletedProcess[str]:  # fmt: skip
    """Return what a command in a terminal of so many columns prints; it ends with this code, or with any (None).

    - `process`: start the installed command: what it imports, its signals, plug-ins; the imports take seconds
    - `more`: of its environment
    """
    line, variables = command(words, report, recording), environment(columns, **more)
    if process:
        done = subprocess.run(line, cwd=cwd, env=variables, capture_output=True, text=True, check=False)
    else:
        done = _in_this_process(line, cwd, variables)
    assert code is None or done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def _in_this_process(line: list[str], cwd: Path, variables: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Call the command as `main` does: warnings go to standard error, each of them once."""
    logger, handler = logging.getLogger("semstab"), logging._StderrHandler(logging.WARNING)  # as logging.lastResort
    handler.addFilter(_Once())
    logger.addHandler(handler)
    try:
        with contextlib.chdir(cwd):
            done = CliRunner().invoke(app, line[1:], env=variables, catch_exceptions=False)
    finally:
        logger.removeHandler(handler)
    return subprocess.CompletedProcess(line, done.exit_code, done.stdout, done.stderr)


def started(*words: object, cwd: Path, columns: int = 80) -> subprocess.Popen[str]:
    """Return the process at work."""
    return subprocess.Popen(
        command(words),
        cwd=cwd, env=environment(columns), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def error_of(*words: object, cwd: Path) -> str:
    """Return the one line that bad input leaves; exit code 2, no traceback."""
    lines = bench(*words, cwd=cwd, code=2).stderr.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    return lines[0]
