"""What `semstab.TemporalStability` adds to a validation, a frame, on one core, beside fusing alone.

    python benchmarks/bench_online.py [--frames 200] [--runs 3]

A camera walks round a furnished room (room.py) at half its size: 640x480, depth in every pixel, 41 classes, voxels of
2 cm. `compute` at the end is counted in, spread over the frames. Frames are made beforehand; medians of the runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import statistics
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import room
from rich.console import Console
from rich.table import Table

from semstab.backends import create
from semstab.data.frames import Frame
from semstab.online.metric import TemporalStability

K, SHRINK = 41, 0.5


def made(index: int) -> Frame:
    """Return a frame of the walk."""
    frame = room.frame(index, 640, 480, K)
    pose = frame.T_wc.copy()
    pose[:3, 3] *= SHRINK
    return dataclasses.replace(frame, depth=(frame.depth * SHRINK).astype(np.float32), T_wc=pose)


def fused(frames: list[Frame], voxel_size: float) -> tuple[float, float]:
    """Seconds of fusing alone, and 0."""
    backend = create("numba", voxel_size=voxel_size, num_classes=K)
    began = time.perf_counter()
    for frame in frames:
        backend.integrate(dataclasses.replace(frame))  # its mask of valid pixels is part of the work
    return time.perf_counter() - began, 0.0


def measured(frames: list[Frame], voxel_size: float, *, alpha: bool) -> tuple[float, float]:
    """Seconds of all updates, and of compute."""
    metric = TemporalStability(K, voxel_size, alpha=alpha)
    began = time.perf_counter()
    for frame in frames:
        metric.update(frame.labels, frame.depth, frame.intrinsics, frame.T_wc)
    updated = time.perf_counter()
    metric.compute()
    return updated - began, time.perf_counter() - updated


def main() -> None:
    """Print a row a way of measuring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--voxel-size", type=float, default=0.02, help="metres")
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()
    with ProcessPoolExecutor() as pool:
        frames = list(pool.map(made, range(arguments.frames)))
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
    ways = {
        "fusion alone": lambda: fused(frames, arguments.voxel_size),
        "metric": lambda: measured(frames, arguments.voxel_size, alpha=True),
        "metric, alpha=False": lambda: measured(frames, arguments.voxel_size, alpha=False),
    }
    rows: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    for run in range(arguments.runs + 1):  # the first one compiles
        for name, way in ways.items():
            seconds = way()
            if run:
                rows[name].append(seconds)
    table = Table(title=f"{len(frames)} frames of 640x480, {arguments.voxel_size:g} m, one core")
    for head in ("", "update ms", "compute s", "ms a frame", "ratio"):
        table.add_column(head, justify="right" if head else "left")
    base = statistics.median(sum(one) for one in rows["fusion alone"])
    for name, own in rows.items():
        update, compute = (statistics.median(one[k] for one in own) for k in range(2))
        total = statistics.median(sum(one) for one in own)
        each = 1e3 / len(frames)
        table.add_row(name, f"{each * update:.1f}", f"{compute:.1f}", f"{each * total:.1f}", f"{total / base:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
