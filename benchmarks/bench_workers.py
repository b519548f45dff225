"""One map in tiles on one Dask worker and on two: how much faster are two, and what keeps them from twice as fast?

    python benchmarks/bench_workers.py [--frames 150] [--memory-gb 1] [--workers 1 2] [--repeat 2] [--cold]

The flight of bench_tiles.py, in a folder that all see; a real scheduler and worker processes of one thread each on
127.0.0.1, started before the clock, with so much memory each. They have done a run of a few frames before, as workers
that stay have, so that nothing is loaded for the first time; with `--cold` they have not. Wall-clock of the whole
command, the least of `--repeat` runs in turn: it says something on a quiet machine with as many free cores as workers.
Beside it the CPU time of the command itself, which is what workers cannot share, and of each worker, whose largest is
the way that is left. That two workers find what one finds is compared bit by bit.
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
import numpy as np

from semstab.core.files import write_json
from semstab.data.voxels import VoxelTable

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
UNWATCHED = {"DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False"}
"""Dask looks 100 times a second where each thread is: 2 % of a core for each worker, which one worker has beside it."""

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
        return subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | ONE_THREAD | UNWATCHED)


def _import() -> None:
    """What a worker loads for its first job, which is no part of what is measured."""
    import semstab.engine.frame_loop  # noqa: F401


def cpu_seconds(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(scene: Path, out: Path, workers: int, memory_gb: float, *, cold: bool = False) -> dict[str, float]:
    """Wall-clock of the command, CPU time of it and of the workers, seconds."""
    with cluster(workers, out.parent) as (address, ids):
        if not cold:
            run(scene, out.with_name(f"{out.name}, before"), address, "--frames", ":24", "--tile-size", "128")
        before, started = [cpu_seconds(pid) for pid in ids], time.perf_counter()
        usage = run(scene, out, address, "--set", f"memory_gb={memory_gb * workers}")
        wall = time.perf_counter() - started
        busy = [cpu_seconds(pid) - was for pid, was in zip(ids, before, strict=True)]
    own = {"command_cpu_s": usage.ru_utime + usage.ru_stime, "workers_cpu_s": sum(busy), "busiest_cpu_s": max(busy)}
    return {"wall_s": wall, **own, **stages(out)}


def run(scene: Path, out: Path, address: str, *options: str) -> resource.struct_rusage:
    """What the command takes itself."""
    command = [sys.executable, "-m", "semstab", "run", "--data", str(scene), "--out", str(out), "--voxel-size", "0.2",
               "--no-geometry-check", "--report", "off", "--rerun", "off", "--quiet", "--scheduler", address,
               *options]  # fmt: skip
    process = subprocess.Popen(command, env=os.environ | ONE_THREAD)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)}: ended with {os.waitstatus_to_exitcode(status)}")
    return usage


def stages(out: Path) -> dict[str, float]:
    """What of the command's time went into what."""
    seconds = json.loads((out / "manifest.json").read_text())["seconds"]
    return {f"{name}_s": seconds.get(name, 0.0) for name in ("sizing", "assemble", "keep", "all")}


def same(one: Path, other: Path) -> bool:
    """Whether two runs found the same, to the last bit of every column of their tables."""
    a, b = (VoxelTable.load(next((run / "voxels").iterdir())) for run in (one, other))
    names = ("ix", "iy", "iz", "op", "drift_sum", "pixels", "first_frame", "last_frame", "self_sum")
    columns = [(getattr(a, name), getattr(b, name)) for name in names]
    columns += zip(a.evidence.entries, b.evidence.entries, strict=True)
    summaries = [json.loads((run / "summary.json").read_text()) for run in (one, other)]
    found = bench_tiles.differences(*summaries, tolerance=1e-12)
    print(*found, sep="\n", end="\n" if found else "")
    return all(np.array_equal(x, y) for x, y in columns) and not found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--memory-gb", type=float, default=1.0)
    parser.add_argument("--workers", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--cold", action="store_true", help="workers that have just been started")
    parser.add_argument("--json", help="also write the figures there")
    arguments = parser.parse_args()
    rows: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        scene = bench_tiles.write_flight(Path(folder) / "field", arguments.frames)
        for k in range(arguments.repeat):
            for workers in arguments.workers:
                out = Path(folder) / f"{workers} workers, {k}"
                rows.append(
                    {"workers": workers, **measure(scene, out, workers, arguments.memory_gb, cold=arguments.cold)}
                )
                print(*(f"{name} {value:.4g}" for name, value in rows[-1].items()), sep=", ", flush=True)
        first, *others = (Path(folder) / f"{workers} workers, 0" for workers in arguments.workers)
        equal = all(same(first, other) for other in others)
    print("the same" if equal else "NOT THE SAME")
    best = {n: min(row["wall_s"] for row in rows if row["workers"] == n) for n in arguments.workers}
    for n, seconds in best.items():
        print(f"{n} workers: {seconds:.1f} s, {best[arguments.workers[0]] / seconds:.2f} times as fast as the first")
    if arguments.json:
        write_json(arguments.json, {"frames": arguments.frames, "memory_gb": arguments.memory_gb, "rows": rows})


if __name__ == "__main__":
    main()
