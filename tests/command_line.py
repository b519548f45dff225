"""The command line: `bench` in this process, or as the installed `semstab-bench` in a process of its own."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

from typer.testing import CliRunner

from semstab.cli import app

COMMAND = str(Path(sys.executable).with_name("semstab-bench"))


def environment(columns: int, **more: str) -> dict[str, str]:
    return {**os.environ, "COLUMNS": str(columns), "NO_COLOR": "1", **more}


def command(words: Sequence[object], report: bool = False, recording: bool = False) -> list[str]:
    """The command of these words; runs and studies draw and record nothing unless a test looks: most of their time."""
    said = {*map(str, words)}
    fuses = bool(words) and (str(words[0]) in ("run", "study") or str(words[0]).startswith("-"))
    fuses = fuses and not {"--help", "--version"} & said
    off = [name for name, wanted in (("--report", report), ("--rerun", recording)) if not wanted and name not in said]
    return [COMMAND, *map(str, words), *(word for name in off if fuses for word in (name, "off"))]


def bench(
    *words: object,
    cwd: Path,
    code: int = 0,
    columns: int = 160,
    report: bool = False,
    recording: bool = False,
    apart: bool = False,
    **more: str,
) -> Any:
    """Its stdout and stderr, in a terminal of so many columns; it ends with this code.

    apart  in a process of its own; `more` is of its environment then
    """
    line, variables = command(words, report, recording), environment(columns, **more)
    if apart or more:
        done: Any = subprocess.run(line, cwd=cwd, env=variables, capture_output=True, text=True, check=False)
    else:
        logger, handler = logging.getLogger("semstab"), logging.lastResort
        assert handler is not None
        logger.addHandler(handler)  # as in a process without pytest's own handler
        try:
            with contextlib.chdir(cwd), mock.patch.dict(os.environ, variables), mock.patch.object(sys, "argv", line):
                result = CliRunner().invoke(app, line[1:])
        finally:
            logger.removeHandler(handler)
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        done = SimpleNamespace(returncode=result.exit_code, stdout=result.stdout, stderr=result.stderr)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def started(*words: object, cwd: Path, columns: int = 80) -> subprocess.Popen[str]:
    """The process at work."""
    return subprocess.Popen(
        command(words),
        cwd=cwd, env=environment(columns), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def error_of(*words: object, cwd: Path) -> str:
    """The one line that bad input leaves; exit code 2, no traceback."""
    lines = bench(*words, cwd=cwd, code=2).stderr.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    return lines[0]
