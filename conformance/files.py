"""The files of a case: frames as text and raw arrays, voxel tables as CSV. README.md is the specification."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.files import read_limited, write_text
from semstab.data.frames import Frame, Intrinsics
from semstab.data.measures import measures
from semstab.data.results import Mismatch
from semstab.data.voxels import VoxelTable
from semstab.errors import DataError

CASE, EXPECTED = "case.txt", "expected.csv"
FIRST_LINE, WITH_ROUNDS, WITH_SCANS = "semstab conformance 1", "semstab conformance 2", "semstab conformance 3"
"""The first line of a case, of one whose frames are fused several times, and of one that has scans."""

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
    if first not in (FIRST_LINE, WITH_ROUNDS, WITH_SCANS):
        raise DataError(f"{folder / CASE}: begins with '{first}', not with '{FIRST_LINE}'")
    count = 3 if first == WITH_ROUNDS else 2
    settings = dict(line.split() for line in lines[:count])
    classes, rounds = int(settings["num_classes"]), int(settings.get("rounds", 1))
    frames = [
        _read_frame(folder, classes, *words) if kind == "frame" else _read_scan(folder, classes, *words)
        for kind, *words in map(str.split, lines[count:])
    ]
    every = [dataclasses.replace(f, index=f.index + n * len(frames)) for n in range(1, rounds) for f in frames]
    return float(settings["voxel_size"]), classes, frames + every


def _read_scan(folder: Path, classes: int, index: str, count: str, *words: str) -> Frame:
    *pose, kind = words
    points = np.fromfile(folder / f"{index}.points", "<f4").reshape(int(count), 3)
    T_wc = np.reshape([float(number) for number in pose], (3, 4))
    return Frame(int(index), points=points, T_wc=T_wc, **_evidence(folder, index, kind, classes, (int(count),)))


def _evidence(folder: Path, index: str, kind: str, classes: int, shape: tuple[int, ...]) -> dict[str, Any]:
    """Return the labels or scores of a frame."""
    suffix, dtype = KINDS[kind]
    values = np.fromfile(folder / f"{index}.{suffix}", dtype)
    return {suffix: values.reshape(shape if suffix == "labels" else (*shape, classes))}


def _read_frame(folder: Path, classes: int, index: str, width: str, height: str, *words: str) -> Frame:
    *numbers, kind = words
    fx, fy, cx, cy, *pose = map(float, numbers)
    H, W = int(height), int(width)
    given = _evidence(folder, index, kind, classes, (H, W))
    depth = np.fromfile(folder / f"{index}.depth", "<f4").reshape(H, W)
    T_wc = np.vstack([np.reshape(pose, (3, 4)), [0, 0, 0, 1]])
    return Frame(int(index), depth, Intrinsics(fx, fy, cx, cy), T_wc, **given)


def write_case(folder: Path, voxel_size: float, classes: int, frames: Sequence[Frame], rounds: int = 1) -> None:
    """Write the files of a case but for the expected table."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [FIRST_LINE, f"voxel_size {voxel_size!r}", f"num_classes {classes}"]
    if rounds > 1:
        lines = [WITH_ROUNDS, *lines[1:], f"rounds {rounds}"]
    elif any(frame.is_scan for frame in frames):
        lines[0] = WITH_SCANS
    for frame in frames:
        values = frame.labels if frame.scores is None else frame.scores
        assert values is not None
        (kind,) = (kind for kind, (_, dtype) in KINDS.items() if np.dtype(dtype) == values.dtype)
        (H, W), pose = frame.shape, frame.T_wc[:3].ravel().tolist()
        if frame.points is not None:
            lines.append(" ".join(["scan", str(frame.index), str(H * W), *map(repr, pose), kind]))
            frame.points.astype("<f4").tofile(folder / f"{frame.index}.points")
        else:
            K = frame.intrinsics
            numbers = [K.fx, K.fy, K.cx, K.cy, *pose]
            lines.append(" ".join(["frame", str(frame.index), str(W), str(H), *map(repr, numbers), kind]))
            frame.depth.astype("<f4").tofile(folder / f"{frame.index}.depth")
        values.astype(KINDS[kind][1]).tofile(folder / f"{frame.index}.{KINDS[kind][0]}")
    write_text(folder / CASE, "\n".join([*lines, ""]))


# --- Tables -----------------------------------------------------------------------------------------------------------


def write_rows(path: Path, table: VoxelTable) -> None:
    """Write a voxel table with its measures as CSV, with all digits of a number; an undefined one is empty."""
    columns = _columns(table)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*(column.tolist() for column in columns.values()), strict=True):
        writer.writerow("" if value != value else repr(value) for value in row)  # noqa: PLR0124  NaN
    write_text(path, text.getvalue())


def _columns(table: VoxelTable) -> dict[str, npt.NDArray[Any]]:
    columns: dict[str, npt.NDArray[Any]] = {name: getattr(table, name) for name in (*PLACE, *COUNTS, *SUMS)}
    columns |= {f"evidence_{k}": table.evidence[:, k] for k in range(table.K)}
    return columns | {measure.key: measure.of(table) for measure in measures()}


def as_rows(table: VoxelTable) -> Rows:
    """Return the rows of a table by voxel, as `read_rows` reads what `write_rows` wrote."""
    columns = _columns(table)
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    voxels = zip(table.ix.tolist(), table.iy.tolist(), table.iz.tolist(), strict=True)
    return {q: dict(zip(columns, row, strict=True)) for q, row in zip(voxels, rows, strict=True)}


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


def read_table(folder: Path) -> VoxelTable:
    """Return the expected table of a case."""
    rows = read_rows(folder / EXPECTED)
    voxel_size, classes = (line.split()[1] for line in (folder / CASE).read_text(encoding="utf-8").splitlines()[1:3])
    columns: dict[str, Any] = {name: [rows[q][name] for q in sorted(rows)] for name in (*PLACE, *COUNTS, *SUMS)}
    evidence = [[rows[q][f"evidence_{k}"] for k in range(int(classes))] for q in sorted(rows)]
    return VoxelTable(**columns, evidence=np.array(evidence), voxel_size=float(voxel_size))  # type: ignore[arg-type]


def differences(expected: Rows, actual: Rows, tolerance: float) -> Iterator[str]:
    """Yield in words where a program's rows are not the expected ones: voxels, then column by column.

    Counts are equal; the tolerance of sums above 1 is relative to the sum.
    """
    if lost := sorted(expected.keys() - actual.keys()):
        yield str(Mismatch(lost[0], "op", 0, expected[lost[0]]["op"], len(lost)))
    if extra := sorted(actual.keys() - expected.keys()):
        yield str(Mismatch(extra[0], "op", actual[extra[0]]["op"], 0, len(extra)))
    there = sorted(expected.keys() & actual.keys())
    columns = [name for name in next(iter(expected.values()), {}) if name not in PLACE]
    given = next(iter(actual.values()), {})
    for name in columns:
        if name not in given:
            if name.startswith("evidence_"):
                yield f"the column {name} is missing"
            continue
        most = 0.0 if name in COUNTS else tolerance
        wrong = [q for q in there if not _near(actual[q][name], expected[q][name], most)]
        if wrong:
            yield str(Mismatch(wrong[0], name, actual[wrong[0]][name], expected[wrong[0]][name], len(wrong)))


def _near(value: float, right: float, tolerance: float) -> bool:
    return abs(value - right) <= tolerance * max(1.0, abs(right)) or (math.isnan(value) and math.isnan(right))
