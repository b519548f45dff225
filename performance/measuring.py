"""Shared parts of the cases: clocks, memory, processes, tables, and sequences in a folder."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import flight
import numpy as np

import semstab
from semstab.core.process import resident_bytes
from semstab.data.voxels import VoxelTable

STAGED = Path(__file__).with_name("staged.py")
LEG, BESIDE, STEP = 10, 40.0, 30.0
"""Frames of a leg of a flight to and fro, and metres from leg to leg and from frame to frame."""


def sides(size: str) -> tuple[int, int]:
    """Width and height of '640x480'."""
    width, height = map(int, size.split("x"))
    return width, height


# --- clocks and memory ------------------------------------------------------------------------------------------------


def cpu_ms(work: Callable[..., object], *arguments: Any) -> float:
    """User and system time of a call, all threads: other work on the machine changes it little."""
    started = time.process_time()
    work(*arguments)
    return 1e3 * (time.process_time() - started)


def wall_ms(work: Callable[..., object], *arguments: Any) -> float:
    """Wall-clock time of a call."""
    started = time.perf_counter()
    work(*arguments)
    return 1e3 * (time.perf_counter() - started)


def in_turns(works: Mapping[str, Callable[[], Any]], rounds: int, *, warm: int = 1) -> dict[str, list[Any]]:
    """Return the results of each work in each round, after `warm` rounds; works take turns, to share any other load."""
    found: dict[str, list[Any]] = {name: [] for name in works}
    for _ in range(rounds + warm):
        for name, work in works.items():
            found[name].append(work())
    return {name: values[warm:] for name, values in found.items()}


def medians(rows: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """The median of each number."""
    rows = list(rows)
    return {name: median(row[name] for row in rows) for name in rows[0]}


def use_cores(count: int) -> None:
    """Bind this process and its children to `count` cores."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


class Watch:
    """CPU time of steps, and the most memory that each sees resident above what there was before."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.peak: dict[str, int] = {}
        self.before = resident_bytes()

    def __call__(self, name: str, call: Callable[[], Any]) -> Any:
        highest, over = resident_bytes(), threading.Event()

        def look() -> None:
            nonlocal highest
            while not over.wait(0.005):
                highest = max(highest, resident_bytes())

        thread = threading.Thread(target=look)
        thread.start()
        started = time.process_time()
        found = call()
        self.seconds[name] = self.seconds.get(name, 0.0) + time.process_time() - started
        over.set()
        thread.join()
        self.peak[name] = max(self.peak.get(name, 0), highest - self.before, resident_bytes() - self.before)
        return found


# --- processes --------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Process:
    """Time and memory of a process and of the children that it waited for.

    Attributes:
        wall_s, cpu_s: Seconds by the clock; user and system time.
        peak_gb: Resident memory of the largest process.
    """

    wall_s: float
    cpu_s: float
    peak_gb: float


def python(*words: str | Path, quiet: bool = False, **variables: str) -> Process:
    """Run Python with these words, as an installed package does: it may store its bytecode."""
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"} | variables
    command = [sys.executable, *map(str, words)]
    started = time.perf_counter()
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL if quiet else None)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if status:
        raise SystemExit(f"{' '.join(command)}: ended with {process.returncode}")
    wall = time.perf_counter() - started
    return Process(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e9)


def command(out: Path, *words: str | Path, recording: bool = False, **variables: str) -> Process:
    """Run the command over a scene, without a report."""
    return python("-m", "semstab", *_run(out, recording), *words, **variables)


def staged(
    out: Path, *words: str | Path, recording: bool = False, **variables: str
) -> tuple[Process, dict[str, dict[str, float]]]:
    """Run the command so, and say what each stage took (staged.py)."""
    file = out.with_suffix(".json")
    process = python(STAGED, file, *_run(out, recording), *words, **variables)
    return process, json.loads(file.read_text())


def _run(out: Path, recording: bool) -> list[str]:
    words = ["run", "--out", str(out), "--report", "off", "--quiet"]
    return words if recording else [*words, "--rerun", "off"]


def seconds_of(out: Path) -> dict[str, float]:
    """Seconds of the stages of a run by the clock, as its manifest has them."""
    seconds: dict[str, float] = json.loads((out / "manifest.json").read_text())["seconds"]
    return seconds


# --- sequences --------------------------------------------------------------------------------------------------------


def to_and_fro(frames: int, size: tuple[int, int], K: int) -> Iterator[semstab.Frame]:
    """A flight over a field (flight.py), in legs: a frame adds about 30,000 voxels of 0.2 m."""
    for index in range(frames):
        leg, along = divmod(index, LEG)
        yield flight.frame(index, *size, K, (BESIDE * leg, STEP * (LEG - 1 - along if leg % 2 else along)))


def posed(root: Path, count: int, frames: Iterable[semstab.Frame], K: int, scale: float | None = None) -> Path:
    """Write the `count` frames as a posed folder."""
    from posed_writer import write_posed

    names, classes = [f"{index:05d}" for index in range(count)], [f"class{k}" for k in range(K)]
    return write_posed(root, names, {"a": frames}, scale=scale, classes=classes, up_axis="z")


def same(one: Path, other: Path) -> bool:
    """Return whether two runs agree: each column of their maps to the last bit, their summaries to 1e-12."""
    from compare_summaries import differences

    found = []
    for path in (one / "voxels").iterdir():
        beside = other / "voxels" / path.stem
        beside = beside if beside.is_dir() else beside.with_suffix(".parquet")  # a map at once is a file
        a, b = VoxelTable.load(path), VoxelTable.load(beside)
        columns = {field.name: (getattr(a, field.name), getattr(b, field.name)) for field in dataclasses.fields(a)}
        columns |= {
            f"evidence {k}": pair for k, pair in enumerate(zip(a.evidence.entries, b.evidence.entries, strict=True))
        }
        arrays = {name: pair for name, pair in columns.items() if isinstance(pair[0], np.ndarray)}
        found += [f"{path.stem}: {name} differs" for name, (x, y) in arrays.items() if x.tobytes() != y.tobytes()]
    summaries = [json.loads((run / "summary.json").read_text()) for run in (one, other)]
    for summary in summaries:
        summary.pop("agreement", None)  # each tile has a sample of its own to check
    found += [line for line in differences(*summaries, tolerance=1e-12) if "voxels_file" not in line]
    print(*found, "NOT THE SAME" if found else "the same", sep="\n", flush=True)
    return not found


# --- tables -----------------------------------------------------------------------------------------------------------


class MarkdownTable:
    """A table in Markdown, printed a row at a time; `rows` has all that was added, for --json."""

    def __init__(self, **formats: str) -> None:
        """`formats` has the columns; a number's `_` is a space in its head."""
        self.formats, self.rows = formats, []
        print(f"| {' | '.join(name.replace('_', ' ') for name in formats)} |")
        print(f"|{'|'.join('---:' if spec else '---' for spec in formats.values())}|", flush=True)

    def add(self, **row: Any) -> dict[str, Any]:
        """Print a row: the columns of it that the table has."""
        self.rows.append(row)
        cells = ("" if row.get(name) is None else format(row[name], spec) for name, spec in self.formats.items())
        print(f"| {' | '.join(cells)} |", flush=True)
        return row
