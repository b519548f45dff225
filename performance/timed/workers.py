"""One map in tiles on one Dask worker and on two: how much faster are two, and what keeps them from twice as fast?

The flight of `tiles`, in a folder that all see; a real scheduler and worker processes of one thread each on 127.0.0.1,
started before the clock, with a fixed amount of memory each. They have done a run of a few frames before, as workers
that stay have, so that nothing is loaded for the first time; with `--cold` they have not. Wall-clock of the whole
command, the least of `--repeat` runs in turn: it says something on a quiet machine with as many free cores as workers.
Beside it the CPU time of the command itself, which is what workers cannot share, and of each worker, whose largest is
the way that is left. That two workers find what one finds is compared bit by bit.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import measuring
from timed.tiles import field

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
UNWATCHED = {"DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False"}
"""Dask looks 100 times a second where each thread is: 2 % of a core for each worker, which one worker has beside it."""

PORT = 8786
LOADED = "semstab.engine.frame_loop"
"""Module that a worker loads for its first job; loading it is not measured."""


@contextlib.contextmanager
def cluster(count: int, folder: Path) -> Iterator[tuple[str, list[int]]]:
    """The address of a scheduler, and the ids of its workers' processes."""
    from distributed import Client

    address = f"tcp://127.0.0.1:{PORT}"
    started = [start("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(PORT), folder=folder)]
    try:
        time.sleep(3)
        options = ("--nthreads", "1", "--no-nanny", "--local-directory", str(folder / "dask"), "--preload", LOADED)
        started += [start("distributed.cli.dask_worker", address, *options, folder=folder) for _ in range(count)]
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=60)
        yield address, [process.pid for process in started[1:]]
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait()


def start(module: str, *words: str, folder: Path) -> subprocess.Popen[bytes]:
    """A process that is quiet, and has one thread for each loop."""
    with (folder / "dask.log").open("a") as log:
        command = [sys.executable, "-m", module, "--no-dashboard", *words]
        return subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | ONE_THREAD | UNWATCHED)


def cpu_seconds(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(
    frames: int = 150, memory_gb: float = 1.0, workers: tuple[int, ...] = (1, 2), repeat: int = 2, cold: bool = False
) -> Any:
    table = measuring.MarkdownTable(
        workers="", wall_s=".1f", command_CPU_s=".1f", workers_CPU_s=".1f", busiest_CPU_s=".1f",
        **dict.fromkeys(("sizing", "assemble", "keep", "all"), ".1f"),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = field(folder, frames)
        for k in range(repeat):
            for count in workers:
                out = folder / f"{count} workers, {k}"
                with cluster(count, folder) as (address, ids):
                    words = (*scene, "--no-geometry-check", "--scheduler", address)
                    if not cold:
                        before = out.with_name(f"{out.name}, before")
                        measuring.command(before, *words, "--frames", ":24", "--tile-size", "128", **ONE_THREAD)
                    begun = [cpu_seconds(pid) for pid in ids]
                    process = measuring.command(out, *words, "--set", f"memory_gb={memory_gb * count}", **ONE_THREAD)
                    busy = [cpu_seconds(pid) - was for pid, was in zip(ids, begun, strict=True)]
                table.add(workers=count, wall_s=process.wall_s, command_CPU_s=process.cpu_s, workers_CPU_s=sum(busy),
                          busiest_CPU_s=max(busy), **measuring.seconds_of(out))  # fmt: skip
        for count in workers[1:]:
            measuring.same(folder / f"{workers[0]} workers, 0", folder / f"{count} workers, 0")
    best = {count: min(row["wall_s"] for row in table.rows if row["workers"] == count) for count in workers}
    for count, seconds in best.items():
        print(f"{count} workers: {seconds:.1f} s, {best[workers[0]] / seconds:.2f} times as fast as the first")
    return table.rows
