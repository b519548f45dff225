"""Wall-clock of the stages of a run beside that of its fusion: what all that is said of a map costs.

    python benchmarks/bench_run.py [--frames 200] [--runs 5] [--voxel-size 0.05]
    python benchmarks/bench_run.py --data SCENE --voxel-size 0.01     # of a sequence of your own

A camera walks round a furnished room (room.py). The same run by the numba backend several times in one process, without
--statistics and with it, with one thread: the first one, which loads compiled code and libraries, apart; of the others
the median. The frames are read by a thread beside it, so that *read* is what the loop waits. Wall-clock says something
on a quiet machine only.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
from pathlib import Path
from typing import Any

os.environ |= dict.fromkeys(("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

from bench_statistics import walked, written

import semstab

FUSION = "fuse numba"
SAID = ("sample", "voxel sizes", "statistics")
"""What is measured of a map beside its fusion: a sample of cells, other voxel sizes, and what the statistics say."""


def stages(settings: dict[str, Any]) -> dict[str, float]:
    """Seconds of each stage of one run."""
    with tempfile.TemporaryDirectory() as out:
        return dict(semstab.run(settings, out=out, report=False).manifest["seconds"])


def measure(settings: dict[str, Any], runs: int) -> tuple[dict[str, float], dict[str, float]]:
    """Of the first run, and the median of the others.

    Between them other maps are made, so that nothing of this one is at hand from the run before.
    """
    first, *others = [_afresh(settings) for _ in range(runs + 1)]
    return first, {name: statistics.median(one[name] for one in others) for name in first}


def _afresh(settings: dict[str, Any]) -> dict[str, float]:
    found = stages(settings)
    for stop in (8, 10, 12):
        stages(settings | {"frames": {"stop": stop}})
    return found


def main() -> None:
    """Print a table each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--voxel-size", type=float, default=0.05, help="metres")
    parser.add_argument("--data", help="a posed folder, instead of the room")
    parser.add_argument("--model", help="of that folder")
    parser.add_argument("--runs", type=int, default=5)
    arguments = parser.parse_args()
    width, height = (int(side) for side in arguments.size.split("x"))
    with tempfile.TemporaryDirectory() as there:
        frames = walked(arguments.frames, (width, height), 7, 1)
        root = arguments.data or str(written(Path(there), arguments.frames, frames, 7))
        settings = {"dataset": {"name": "posed_folder", "options": {"root": root}}, "voxel_size": arguments.voxel_size}
        settings |= {"check": None, "backends": ["numba"]}
        if arguments.model:
            settings["models"] = [arguments.model]
        for options in ({}, {"statistics": True}):
            first, found = measure(settings | options, arguments.runs)
            print("with --statistics" if options else "as it is", f"median of {arguments.runs} runs", sep=", ")
            print(f"{'stage':<16}{'s':>8}{'of fusion':>11}{'first run s':>13}")
            for name, seconds in [*found.items(), ("said, together", sum(found[name] for name in SAID))]:
                once = first.get(name, sum(first[name] for name in SAID))
                print(f"{name:<16}{seconds:8.3f}{seconds / found[FUSION]:11.2f}{once:13.3f}")


if __name__ == "__main__":
    main()
