"""One map in tiles on one Dask worker and on two: how much faster are two, and what keeps them from being twice as fast?

    python tests/perf/bench_workers.py [--frames 100] [--memory-gb 1] [--workers 1 2] [--repeat 2] [--json FILE]

The flight of bench_tiles.py, in a folder that all see; a real scheduler and worker processes of one thread each on
127.0.0.1, started before the clock. Wall-clock of the whole command, the least of `--repeat` runs in turn: it says
something on a quiet machine with as many free cores as workers. Beside it the CPU time of the command itself and of the
workers, and the share of the command's time in which no worker was at work: start, tiling, assembly. That two workers
find what one finds is compared bit by bit.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import bench_tiles

from semstab.runtime.files import write_json

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
PORT = 8786


@contextlib.contextmanager
def cluster(count: int, folder: Path) -> Iterator[tuple[str, list[int]]]:
    """The address of a scheduler, and the ids of its workers' processes."""
    from distributed import Client

    address = f"tcp://127.0.0.1:{PORT}"
    started = [start("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(PORT), folder=folder)]
    try:
        time.sleep(3)
        own = ("--nthreads", "1", "--no-nanny", "--local-directory", str(folder / "dask"))
        started += [start("distributed.cli.dask_worker", address, *own, folder=folder) for _ in range(count)]
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=60)
            client.run(_import)
        yield address, [process.pid for process in started[1:]]
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait()


def start(module: str, *words: str, folder: Path) -> subprocess.Popen[bytes]:
    """A process that is quiet, and has one thread for each loop."""
    with (folder / "dask.log").open("a") as log:
        command = [sys.executable, "-m", module, "--no-dashboard", *words]
        return subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | ONE_THREAD)


def _import() -> None:
    """What a worker loads for its first job, which is no part of what is measured."""
    import semstab.engine.work.passes  # noqa: F401


def cpu_seconds(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(scene: Path, out: Path, workers: int, memory_gb: float) -> dict[str, float]:
    """Wall-clock of the command, CPU time of it and of the workers, seconds."""
    with cluster(workers, out.parent) as (address, ids):
        before, own = sum(map(cpu_seconds, ids)), resource.getrusage(resource.RUSAGE_CHILDREN)
        started = time.perf_counter()
        options = ["--scheduler", address, "--set", f"memory_gb={memory_gb}"]
        bench_tiles.run(scene, out, *options)
        wall = time.perf_counter() - started
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        busy = sum(map(cpu_seconds, ids)) - before
    command = after.ru_utime + after.ru_stime - own.ru_utime - own.ru_stime
    return {"wall_s": wall, "command_cpu_s": command, "workers_cpu_s": busy, **stages(out)}


def stages(out: Path) -> dict[str, float]:
    """What of the command's time went into what."""
    seconds = json.loads((out / "manifest.json").read_text())["seconds"]
    return {name: seconds.get(name, 0.0) for name in ("sizing", "assemble", "keep", "all")}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--memory-gb", type=float, default=1.0)
    parser.add_argument("--workers", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--json", help="also write the figures there")
    arguments = parser.parse_args()
    rows: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        scene = bench_tiles.write_flight(Path(folder) / "field", arguments.frames)
        for k in range(arguments.repeat):
            for workers in arguments.workers:
                out = Path(folder) / f"{workers} workers, {k}"
                rows.append({"workers": workers, **measure(scene, out, workers, arguments.memory_gb)})
                print(*(f"{name} {value:.4g}" for name, value in rows[-1].items()), sep=", ", flush=True)
        first, *others = (Path(folder) / f"{workers} workers, 0" for workers in arguments.workers)
        same = all(bench_tiles.same(first, other) for other in others)
    print("the same" if same else "NOT THE SAME")
    best = {n: min(row["wall_s"] for row in rows if row["workers"] == n) for n in arguments.workers}
    for n, seconds in best.items():
        print(f"{n} workers: {seconds:.1f} s, {best[arguments.workers[0]] / seconds:.2f} times as fast as the first")
    if arguments.json:
        write_json(arguments.json, {"frames": arguments.frames, "memory_gb": arguments.memory_gb, "rows": rows})


if __name__ == "__main__":
    main()
