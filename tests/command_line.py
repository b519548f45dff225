"""The installed `semstab-bench`, run as a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

COMMAND = str(Path(sys.executable).with_name("semstab-bench"))


def environment(columns: int, **more: str) -> dict[str, str]:
    return {**os.environ, "COLUMNS": str(columns), "NO_COLOR": "1", **more}


def command(words: Sequence[object], report: bool = False) -> list[str]:
    """The command of these words; runs and studies draw no report unless a test looks at it: most of their time."""
    fuses = bool(words) and (str(words[0]) in ("run", "study") or str(words[0]).startswith("-"))
    plain = fuses and not report and not {"--report", "--help", "--version"}.intersection(map(str, words))
    return [COMMAND, *map(str, words), *(("--report", "off") if plain else ())]


def bench(
    *words: object, cwd: Path, code: int = 0, columns: int = 160, report: bool = False, **more: str
) -> subprocess.CompletedProcess[str]:
    """What it did, in a terminal of so many columns; it ends with this code. `more` is of its environment."""
    done = subprocess.run(
        command(words, report),
        cwd=cwd, env=environment(columns, **more), capture_output=True, text=True, check=False,
    )  # fmt: skip
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
