"""Conformance as data: small frames with the voxel tables that belong to them, for fusion programs in any language.

README.md is the specification. `semstab-bench conform CMD` runs a program over the cases; the backends that ship pass
through the same door: `python -m semstab.conformance.fuse BACKEND CASE OUT`.
"""

from __future__ import annotations

import importlib.resources
import shlex
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from semstab.config import nearest
from semstab.conformance.cases import EXPECTED, differences, read_rows
from semstab.errors import ConfigError, DataError, one_line

TOLERANCE = 1e-9
"""Largest difference of a sum or a measure; counts are equal."""

SECONDS = 60.0
"""How long a program may take for a case."""


@dataclass(frozen=True)
class Verdict:
    """What came of a case: nothing where the program's table is the expected one, else where it differs."""

    case: str
    problem: str = ""


def case_names() -> tuple[str, ...]:
    """Names of the cases, in the order in which they are best passed."""
    return tuple(_cases().joinpath("order.txt").read_text(encoding="utf-8").split())


def case_folder(name: str) -> Path:
    """The folder of a case. Raises ConfigError where there is none of that name."""
    if name not in case_names():
        raise ConfigError(f"no case '{name}'; {nearest(name, case_names())}")
    return _cases() / name


def conform(command: str, only: Sequence[str] = (), tolerance: float = TOLERANCE) -> Iterator[Verdict]:
    """Run `command CASE OUT` for each case, or for some, and compare what it wrote to OUT with what is expected.

    Raises ConfigError for a case that there is not, or a command that cannot be read or started.
    """
    folders = [case_folder(name) for name in only or case_names()]
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"{command}: {one_line(error)}") from error
    if not words:
        raise ConfigError("name the program that fuses a case: semstab-bench conform 'PROGRAM OPTIONS'")
    for folder in folders:
        with tempfile.TemporaryDirectory() as temporary:
            out = Path(temporary) / "table.csv"
            problem = _ran(words, folder, out) or compared(folder, out, tolerance)
        yield Verdict(folder.name, problem)


def compared(folder: Path, out: Path, tolerance: float = TOLERANCE) -> str:
    """Where a program's table differs from the expected one; empty where it does not."""
    try:
        return next(differences(read_rows(folder / EXPECTED), read_rows(out), tolerance), "")
    except DataError as error:
        return str(error)


def _ran(words: Sequence[str], folder: Path, out: Path) -> str:
    """Run the program; what went wrong, where it did not end well."""
    try:
        done = subprocess.run(
            [*words, str(folder), str(out)], capture_output=True, timeout=SECONDS, check=False, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired:
        return f"the program took longer than {SECONDS:g} s"
    except (OSError, ValueError) as error:
        raise ConfigError(f"{words[0]}: cannot be started ({one_line(error)})") from error
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        return f"the program ended with code {done.returncode}" + (f" ({said[-1][:200]})" if said else "")
    return "" if out.is_file() else "the program wrote no table"


def _cases() -> Path:
    return Path(str(importlib.resources.files("semstab.conformance") / "cases"))
