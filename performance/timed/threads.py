"""Wall-clock time of one frame by the number of threads, up to the number of cores.

The frames are those of `fusion`, with 0.3 % noise of depth; the time is the median of later frames, most of whose
voxels are known. Each number of threads is a process of its own, and 'faster' is the time with one thread over it.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from statistics import median
from typing import Any

import measuring

NOISE, FRAMES = 0.003, 3
VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")


def later_ms(name: str, size: str, K: int, rounds: int) -> float:
    """Milliseconds of a later frame through a backend, in this process."""
    import flight

    from semstab import backends
    from semstab.core.process import configure_process

    configure_process()
    frames = [flight.street(i, *measuring.sides(size), K, noise=NOISE) for i in range(FRAMES)]
    backend = backends.create(name, voxel_size=0.2, num_classes=K)
    for frame in frames:
        backend.integrate(frame)
    return median(measuring.wall_ms(backend.integrate, frame) for _ in range(rounds) for frame in frames)


def main(
    sizes: tuple[str, ...] = ("640x480", "3840x2160"),
    K: int = 7,
    backends: tuple[str, ...] = ("numba", "open3d"),
    threads: tuple[int, ...] = (1, 2, 4, 8),
    rounds: int = 5,
) -> Any:
    cores = len(os.sched_getaffinity(0))
    counts = [count for count in threads if count <= cores]
    print(f"{cores} cores\n")
    table = measuring.MarkdownTable(size="", backend="", threads="", ms=".1f", faster=".2f")
    for size, name in itertools.product(sizes, backends):
        found: dict[int, float] = {}
        for count in counts:
            os.environ |= dict.fromkeys(VARIABLES, str(count))
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
                found[count] = process.submit(later_ms, name, size, K, rounds).result()
            table.add(
                size=size, backend=name, threads=str(count), ms=found[count], faster=found[counts[0]] / found[count]
            )
    return table.rows
