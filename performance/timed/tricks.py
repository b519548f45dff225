"""Settings of the process by what they are worth: CPU time of whole commands without one, over their time with all.

Each command is a process of its own; the ways to start it take turns, and ratios are of medians. The runs, of six
frames of 640x480 and of 3840x2160, by `numba` and by `open3d`, are without check, recording and report.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import measuring
from timed.command import OFF, write_scene

COMMAND = """
import gc, os
from semstab.core import process
configure = process.configure_process
{change}
from semstab.__main__ import main
main()
"""
WITHOUT_VARIABLE = """
def without():
    configure()
    os.environ.pop("{name}")
process.configure_process = without
"""
WAYS = {
    "all": "",
    "gc.freeze before a run": "gc.freeze = lambda: None",
    "OMP_WAIT_POLICY": WITHOUT_VARIABLE.format(name="OMP_WAIT_POLICY"),
    "OPENBLAS_NUM_THREADS": WITHOUT_VARIABLE.format(name="OPENBLAS_NUM_THREADS"),
    "imports where they are used": "import semstab.api, semstab.recording",
}
"""Changes to the process before the command starts, by what they take away."""


@contextlib.contextmanager
def computing(processes: int) -> Iterator[None]:
    """Keep this number of processes computing."""
    others = [multiprocessing.Process(target=compute, daemon=True) for _ in range(processes)]
    for other in others:
        other.start()
    try:
        yield
    finally:
        for other in others:
            other.kill()


def compute() -> None:
    while True:
        pass


def main(
    rounds: int = 7,
    commands: tuple[str, ...] = ("help", "list", "six frames", "busy", "large frames", "large frames open3d"),
    ways: tuple[str, ...] = tuple(WAYS),
) -> Any:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words: dict[str, tuple[str | Path, ...]] = {"help": ("--help",), "list": ("list",)}
        if {"six frames", "busy"} & set(commands):
            six = write_scene(folder / "six", 6, (640, 480))
            words["six frames"] = words["busy"] = ("--data", six, "--voxel-size", "0.02", *OFF)
        if any(command.startswith("large") for command in commands):
            large = write_scene(folder / "large", 6, (3840, 2160))
            words["large frames"] = ("--data", large, "--voxel-size", "0.05", *OFF)
            words["large frames open3d"] = (*words["large frames"], "--backend", "open3d")
        table = measuring.MarkdownTable(without="", **dict.fromkeys((c.replace(" ", "_") for c in commands), ".2f"))
        ratios: dict[str, dict[str, float]] = {way: {} for way in ways}
        for command in commands:

            def seconds(change: str, command: str = command) -> float:
                with tempfile.TemporaryDirectory() as out:
                    more = ("--quiet", "--out", Path(out) / "run") if words[command][0] == "--data" else ()
                    script = COMMAND.format(change=change)
                    return measuring.python("-c", script, *words[command], *more, quiet=True).cpu_s

            works = {way: (lambda change=change: seconds(change)) for way, change in WAYS.items() if way in ways}
            with computing(multiprocessing.cpu_count() if command == "busy" else 0):
                found = {way: median(times) for way, times in measuring.in_turns(works, rounds).items()}
            print(f"{command}: {found['all']:.2f} s of CPU time")
            for way, took in found.items():
                ratios[way][command.replace(" ", "_")] = took / found["all"]
        for way, row in ratios.items():
            table.add(without=way, **row)
    return table.rows
