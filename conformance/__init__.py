"""Conformance as data: small frames with the voxel tables that belong to them, for fusion programs in any language.

README.md is the specification. `semstab-bench conform CMD` runs a program over the cases; the backends that ship pass
through the same door: `python -m semstab.conformance.fuse BACKEND CASE OUT`.
"""

from __future__ import annotations

import functools
import importlib.resources
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from semstab.config import nearest
from semstab.conformance.causes import likely_cause
from semstab.conformance.files import (
    CASE,
    EXPECTED,
    as_rows,
    differences,
    read_case,
    read_rows,
    read_table,
    write_case,
    write_rows,
)
from semstab.conformance.formulas import FORMULAS
from semstab.conformance.random_cases import RANDOM, random_frames, seed_of, write_random
from semstab.core.code import absolute, is_code
from semstab.core.files import ScratchFolder
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError, DataError, summarize_error

__all__ = [
    "AT_FACES", "EXPECTED", "LONG", "OF_SCANS", "SECONDS", "TOLERANCE", "Verdict", "as_rows", "case_folder",
    "case_names", "compared", "conform", "differences", "expected_table", "likely_cause", "random_frames", "read_case",
    "read_rows", "read_table", "write_case", "write_rows",
]  # fmt: skip

TOLERANCE = 1e-9
"""Largest difference of a sum or a measure, of sums above 1 relative to the sum; counts are equal."""

ALIKE = 3
"""Cases in which a program fails in one way until it is not started again."""

SECONDS = 120.0
"""Seconds that a program may take for a case, on a busy machine."""

LONG = ("frames_65536",)
"""Cases of very many frames: a backend that takes a millisecond a frame needs a minute."""

AT_FACES = (
    "faces", "decimal_faces", "negative", "ranges", "near", "rays", "quotients", "utm", "utm_faces", "utm_origins",
    "scan_faces", "scan_utm",
)  # fmt: skip
"""Cases whose points lie at faces or far away: arithmetic other than float64 may put them into other voxels."""


OF_SCANS = ("scan", "scan_scores", "scan_faces", "scan_utm", "scans_and_images")
"""Cases that have scans: a program for depth images alone cannot read them."""


@dataclass(frozen=True)
class CaseResult:
    """The result of a case: `problem` is the first difference of the program's table from the expected table, or ''.

    `left_out` names the parts of the case that the program was declared not to take: then the case was not run.
    """

    case: str
    problem: str = ""
    left_out: str = ""


def case_names() -> tuple[str, ...]:
    """Return the names of the cases, in the order in which they are best passed: stored ones, then those by formula."""
    return (*_cases().joinpath("order.txt").read_text(encoding="utf-8").split(), *FORMULAS)


def case_folder(name: str) -> Path:
    """Return the folder of a case; one by formula, or `random:SEED`, is written for the time that this process runs.

    Raises:
        ConfigError: If no case has this name.
    """
    seed = seed_of(name)
    if seed is None and name not in case_names():
        raise ConfigError(f"no case '{name}'; {nearest(name, case_names())}, or {RANDOM}SEED")
    return _cases() / name if seed is None and name not in FORMULAS else _written(name)


@functools.cache
def expected_table(name: str) -> VoxelTable:
    """Return the voxel table that belongs to a case."""
    return FORMULAS[name].table() if name in FORMULAS else read_table(case_folder(name))


@functools.cache
def _written(name: str) -> Path:
    folder = _scratch().path / name.replace(":", "_")
    seed = seed_of(name)
    if seed is None:
        FORMULAS[name].write(folder)
    else:
        write_random(folder, seed)
    return folder


@functools.cache
def _scratch() -> ScratchFolder:
    return ScratchFolder()


def conform(
    command: str,
    only: Sequence[str] = (),
    tolerance: float = TOLERANCE,
    random: int = 0,
    *,
    scans: bool = True,
    scores: bool = True,
) -> Iterator[CaseResult]:
    """Run `command CASE OUT` for each case, or for some, and compare what it wrote to OUT with what is expected.

    The command may be a backend's FILE.py:NAME. A program with the same failure in the first three cases is not started
    again. `random` random cases, with seeds from 0, follow. Without `scans` or `scores`, cases with scans or scores are
    not run, and their verdicts say so.

    Raises:
        ConfigError: For an unknown case, a command that cannot be read or started, or the same failure in the first
            three cases.
    """
    names = [*(only or case_names()), *(f"{RANDOM}{seed}" for seed in range(random))]
    for name in only:
        case_folder(name)
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"{command}: {summarize_error(error)}") from error
    if not words:
        raise ConfigError("name the program that fuses a case: semstab-bench conform 'PROGRAM OPTIONS'")
    if len(words) == 1 and is_code(words[0]):
        words = [sys.executable, "-m", "semstab.conformance.fuse", absolute(words[0])]
    failures = list[str]()
    for name in names:
        folder = case_folder(name)
        if lacking := [word for word in needs(folder) if not {"scans": scans, "scores": scores}[word]]:
            yield CaseResult(name, left_out=" and ".join(lacking))
            continue
        with ScratchFolder() as temporary:
            out = temporary / "table.csv"
            failed = _ran(words, folder, out)
            problem = failed or compared(folder, out, tolerance)
        failures.append(failed)
        if failed and failures == [failed] * ALIKE:
            raise ConfigError(f"{command}: {failed}, in each of the first {ALIKE} cases (PROGRAM CASE OUT)")
        yield CaseResult(name, problem)


def needs(folder: Path) -> list[str]:
    """Return what a case has besides images of labels: 'scans', 'scores'."""
    words = [line.split() for line in (folder / CASE).read_text(encoding="utf-8").splitlines()]
    there = {"scans": any(line[0] == "scan" for line in words), "scores": any("scores" in line[-1] for line in words)}
    return [word for word, has in there.items() if has]


def compared(folder: Path, out: Path, tolerance: float = TOLERANCE) -> str:
    """Return the first difference of a program's table from the expected table, with the likely cause, or ''."""
    try:
        expected, actual = read_rows(folder / EXPECTED), read_rows(out)
    except DataError as error:
        return str(error)
    problem = next(differences(expected, actual, tolerance), "")
    cause = likely_cause(*read_case(folder), expected, actual) if problem else ""
    return f"{problem}; likely: {cause}" if cause else problem


def _ran(words: Sequence[str], folder: Path, out: Path) -> str:
    """Run the program; return what went wrong, or ''."""
    try:
        done = subprocess.run(
            [*words, str(folder), str(out)], capture_output=True, timeout=SECONDS, check=False, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired:
        return f"the program took longer than {SECONDS:g} s"
    except (OSError, ValueError) as error:
        raise ConfigError(f"{words[0]}: cannot be started ({summarize_error(error)})") from error
    if done.returncode:
        errors = done.stderr.decode(errors="replace").strip().splitlines()
        return f"the program ended with code {done.returncode}" + (f" ({errors[-1][:200]})" if errors else "")
    return "" if out.is_file() else "the program wrote no table"


def _cases() -> Path:
    return Path(str(importlib.resources.files("semstab.conformance") / "cases"))
