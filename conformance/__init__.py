"""Conformance as data: small frames with the voxel tables that belong to them, for fusion programs in any language.

README.md is the specification. `semstab-bench conform CMD` runs a program over the cases; the backends that ship pass
through the same door: `python -m semstab.conformance.fuse BACKEND CASE OUT`.
"""

from __future__ import annotations

import csv
import importlib.resources
import io
import math
import shlex
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.config import nearest
from semstab.core.files import read_limited, write_text
from semstab.data.frames import Frame, Intrinsics
from semstab.data.measures import measures
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError, DataError, summarize_error

TOLERANCE = 1e-9
"""Largest difference of a sum or a measure; counts are equal."""

SECONDS = 60.0
"""Seconds that a program may take for a case."""


@dataclass(frozen=True)
class Verdict:
    """The result of a case: no problem where the program's table is the expected one, else where it differs."""

    case: str
    problem: str = ""


def case_names() -> tuple[str, ...]:
    """Return the names of the cases, in the order in which they are best passed."""
    return tuple(_cases().joinpath("order.txt").read_text(encoding="utf-8").split())


def case_folder(name: str) -> Path:
    """Return the folder of a case.

    Raises:
        ConfigError: If there is none of that name.
    """
    if name not in case_names():
        raise ConfigError(f"no case '{name}'; {nearest(name, case_names())}")
    return _cases() / name


def conform(command: str, only: Sequence[str] = (), tolerance: float = TOLERANCE) -> Iterator[Verdict]:
    """Run `command CASE OUT` for each case, or for some, and compare what it wrote to OUT with what is expected.

    Raises:
        ConfigError: For a case that there is not, or a command that cannot be read or started.
    """
    folders = [case_folder(name) for name in only or case_names()]
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"{command}: {summarize_error(error)}") from error
    if not words:
        raise ConfigError("name the program that fuses a case: semstab-bench conform 'PROGRAM OPTIONS'")
    for folder in folders:
        with tempfile.TemporaryDirectory() as temporary:
            out = Path(temporary) / "table.csv"
            problem = _ran(words, folder, out) or compared(folder, out, tolerance)
        yield Verdict(folder.name, problem)


def compared(folder: Path, out: Path, tolerance: float = TOLERANCE) -> str:
    """Return where a program's table differs from the expected one; empty where it does not."""
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
        raise ConfigError(f"{words[0]}: cannot be started ({summarize_error(error)})") from error
    if done.returncode:
        errors = done.stderr.decode(errors="replace").strip().splitlines()
        return f"the program ended with code {done.returncode}" + (f" ({errors[-1][:200]})" if errors else "")
    return "" if out.is_file() else "the program wrote no table"


def _cases() -> Path:
    return Path(str(importlib.resources.files("semstab.conformance") / "cases"))


# The files of a case: frames as text and raw arrays, voxel tables as CSV.

CASE, EXPECTED = "case.txt", "expected.csv"
FIRST_LINE = "semstab conformance 1"

KINDS: Mapping[str, tuple[str, str]] = {
    "labels8": ("labels", "<u1"), "labels16": ("labels", "<u2"), "scores16": ("scores", "<f2"),
    "scores32": ("scores", "<f4"),
}  # fmt: skip
"""The suffix of the file and the type of its numbers, by the word of a frame's line."""

PLACE = ("ix", "iy", "iz")
COUNTS = ("op", "pixels", "first_frame", "last_frame")
SUMS = ("drift_sum", "self_sum", "frame_entropy_sum")
REQUIRED = (*PLACE, "op", "drift_sum")
MAX_TABLE_BYTES = 2**26

Voxel = tuple[int, int, int]
Rows = dict[Voxel, dict[str, float]]


# --- Frames -----------------------------------------------------------------------------------------------------------


def read_case(folder: Path) -> tuple[float, int, list[Frame]]:
    """Return voxel size (metres), number of classes, and frames in the order in which they are fused."""
    first, *lines = (folder / CASE).read_text(encoding="utf-8").splitlines()
    if first != FIRST_LINE:
        raise DataError(f"{folder / CASE}: begins with '{first}', not with '{FIRST_LINE}'")
    settings = dict(line.split() for line in lines[:2])
    classes = int(settings["num_classes"])
    frames = [_read_frame(folder, classes, *line.split()[1:]) for line in lines[2:]]
    return float(settings["voxel_size"]), classes, frames


def _read_frame(folder: Path, classes: int, index: str, width: str, height: str, *words: str) -> Frame:
    *numbers, kind = words
    fx, fy, cx, cy, *pose = map(float, numbers)
    H, W = int(height), int(width)
    suffix, dtype = KINDS[kind]
    values = np.fromfile(folder / f"{index}.{suffix}", dtype)
    given: dict[str, Any] = {suffix: values.reshape((H, W) if suffix == "labels" else (H, W, classes))}
    depth = np.fromfile(folder / f"{index}.depth", "<f4").reshape(H, W)
    T_wc = np.vstack([np.reshape(pose, (3, 4)), [0, 0, 0, 1]])
    return Frame(int(index), depth, Intrinsics(fx, fy, cx, cy), T_wc, **given)


def write_case(folder: Path, voxel_size: float, classes: int, frames: Sequence[Frame]) -> None:
    """Write the files of a case but for the expected table."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [FIRST_LINE, f"voxel_size {voxel_size!r}", f"num_classes {classes}"]
    for frame in frames:
        values = frame.labels if frame.scores is None else frame.scores
        assert values is not None
        (kind,) = (kind for kind, (_, dtype) in KINDS.items() if np.dtype(dtype) == values.dtype)
        K, (H, W) = frame.intrinsics, frame.shape
        numbers = [K.fx, K.fy, K.cx, K.cy, *frame.T_wc[:3].ravel().tolist()]
        lines.append(" ".join(["frame", str(frame.index), str(W), str(H), *map(repr, numbers), kind]))
        values.astype(KINDS[kind][1]).tofile(folder / f"{frame.index}.{KINDS[kind][0]}")
        frame.depth.astype("<f4").tofile(folder / f"{frame.index}.depth")
    write_text(folder / CASE, "\n".join([*lines, ""]))


# --- Tables -----------------------------------------------------------------------------------------------------------


def write_rows(path: Path, table: VoxelTable) -> None:
    """Write a voxel table with its measures as CSV, with all digits of a number; an undefined one is empty."""
    columns: dict[str, npt.NDArray[Any]] = {name: getattr(table, name) for name in (*PLACE, *COUNTS, *SUMS)}
    columns |= {f"evidence_{k}": table.evidence[:, k] for k in range(table.K)}
    columns |= {measure.key: measure.of(table) for measure in measures()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*(column.tolist() for column in columns.values()), strict=True):
        writer.writerow("" if value != value else repr(value) for value in row)  # noqa: PLR0124  NaN
    write_text(path, text.getvalue())


def read_rows(path: Path) -> Rows:
    """Return the rows of a table by voxel; an empty field is NaN.

    Raises:
        DataError: If that fails; the message names file and line.
    """
    try:
        reader = csv.reader(io.StringIO(read_limited(path, MAX_TABLE_BYTES).decode("utf-8")))
        header = [name.strip() for name in next(reader, [])]
        if missing := [name for name in REQUIRED if name not in header]:
            raise DataError(f"{path.name}: the column {missing[0]} is missing; the first line names the columns")
        rows: Rows = {}
        for cells in reader:
            if len(cells) != len(header):
                raise DataError(f"{path.name}, line {reader.line_num}: {len(cells)} fields, not {len(header)}")
            row = {name: float(cell) if cell.strip() else math.nan for name, cell in zip(header, cells, strict=True)}
            voxel = (int(row["ix"]), int(row["iy"]), int(row["iz"]))
            if voxel in rows:
                raise DataError(f"{path.name}, line {reader.line_num}: the voxel {voxel} is there twice")
            rows[voxel] = row
    except (OSError, ValueError, OverflowError, csv.Error) as error:
        raise error if isinstance(error, DataError) else DataError(f"{path.name}: cannot be read ({error})") from error
    return rows


def differences(expected: Rows, actual: Rows, tolerance: float) -> Iterator[str]:
    """Yield in words where a program's rows are not the expected ones: voxels, then column by column."""
    if lost := sorted(expected.keys() - actual.keys()):
        yield f"the voxel {lost[0]} is missing{_more(lost)}"
    if extra := sorted(actual.keys() - expected.keys()):
        yield f"the voxel {extra[0]} should not be there{_more(extra)}"
    there = sorted(expected.keys() & actual.keys())
    columns = [name for name in next(iter(expected.values()), {}) if name not in PLACE]
    given = next(iter(actual.values()), {})
    for name in columns:
        if name not in given:
            if name.startswith("evidence_"):
                yield f"the column {name} is missing"
            continue
        most = 0.0 if name in COUNTS else tolerance
        wrong = [voxel for voxel in there if not _near(expected[voxel][name], actual[voxel][name], most)]
        if wrong:
            value, right = actual[wrong[0]][name], expected[wrong[0]][name]
            yield f"{name} of the voxel {wrong[0]} is {value!r}, expected {right!r}{_more(wrong)}"


def _near(a: float, b: float, tolerance: float) -> bool:
    return abs(a - b) <= tolerance or (math.isnan(a) and math.isnan(b))


def _more(voxels: Sequence[Voxel]) -> str:
    return f" (and {len(voxels) - 1} more)" if len(voxels) > 1 else ""
