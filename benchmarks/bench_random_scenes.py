"""CPU time of a frame of scenes drawn at random, beside Open3D's own VoxelBlockGrid.integrate on the same frames.

    python benchmarks/bench_random_scenes.py [--csv FILE] [--json FILE] [--scenes 20] [--seed 0]
                                             [--noise 0 0.05 0.3 1] [--backends numba open3d] [--rounds 3]

scenes.py draws geometry, height, pitch, field of view, range, resolution, classes, size of the voxels and errors of the
labels; noise is the standard deviation of depth in per cent of it. As in bench_fusion.py, times are those of later
frames, user and system time of all threads, most of whose voxels are known; 'faster' is Open3D's own time over that of
the backend. A backend is left out of a scene where its map is said to take more than --most-gb.

The roofline is about frames that touch many voxels. Floor are the bytes that have to move: the image once, and of each
voxel the lines of the cache with its slot, and with its record, which is also written; the rate is that of a copy of
one thread, and the share is the floor's time over that of the backend.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import logging
import time
from pathlib import Path
from statistics import median
from typing import Any

import bench_fusion  # first, as it configures the process
import numpy as np
import scenes

import semstab
from semstab import backends
from semstab.backends.numba_loops import record_types
from semstab.backends.shared.observations import LINE
from semstab.core.files import write_json

FRAMES = 2
BASELINE = bench_fusion.BASELINE
RECORD, _ = record_types(np.dtype(np.float64))
COPIED = 1 << 28


def copy_rate() -> float:
    """Bytes a second, read and written, of a copy in memory by one thread: the best of several."""
    source, target = np.ones(COPIED, dtype=np.uint8), np.empty(COPIED, dtype=np.uint8)
    times = []
    for _ in range(5):
        started = time.process_time()
        np.copyto(target, source)
        times.append(time.process_time() - started)
    return 2 * COPIED / min(times)


def floor_bytes(frame: semstab.Frame, voxels: int) -> int:
    """Bytes that have to move: the frame's, and whole lines of the cache of the voxels' slots and records."""
    lines = 1 + 2 * -(-RECORD.itemsize // LINE)
    return frame.depth.nbytes + frame.labels.nbytes + voxels * lines * LINE


def measured(
    scene: scenes.Scene, levels: list[float], names: list[str], most_gb: float, rounds: int
) -> list[dict[str, Any]]:
    """A row for each level of noise."""
    views, voxel_size = scenes.views(scene, FRAMES)
    rows = []
    for noise in levels:
        frames = [scenes.spoilt(scene, view, noise / 100) for view in views]
        for frame in frames:
            bench_fusion.prepare(frame)
        counter = backends.create("numba", voxel_size=voxel_size, num_classes=scene.K)
        reports = [counter.integrate(frame) for frame in frames]
        voxels, known = reports[-1].voxels, reports[-1].map_voxels
        del counter
        fit = [name for name in names if backends.expected_bytes(name, known, known, scene.K) < most_gb * 1e9]
        times = bench_fusion.measure(frames, scene.K, voxel_size, (BASELINE, *fit), rounds)
        own = times[BASELINE]["later_ms"]
        rows.append(
            dataclasses.asdict(scene) | {"voxel_size": voxel_size, "noise": noise, "voxels": voxels}
            | {"floor_bytes": floor_bytes(frames[-1], voxels), "integrate_ms": own}
            | {f"{name}_ms": times[name]["later_ms"] if name in fit else None for name in names}
            | {f"{name}_faster": own / times[name]["later_ms"] if name in fit else None for name in names}
        )  # fmt: skip
    return rows


def print_scene(rows: list[dict[str, Any]], names: list[str]) -> None:
    """A line for each level of noise."""
    for row in rows:
        size = f"{row['width']}x{row['height']}"
        print(
            f"{row['seed']:>5} {row['kind']:<6} {size:>9} {row['K']:>3} {row['voxel_size']:>7g} {row['noise']:>5g}"
            f" {row['voxels']:>10,} {row['integrate_ms']:>9.1f}",
            end="",
        )
        for name in names:
            ms, faster = row[f"{name}_ms"], row[f"{name}_faster"]
            print("         -        -" if ms is None else f" {ms:9.1f} {faster:7.2f}x", end="")
        print(flush=True)


def print_ratios(rows: list[dict[str, Any]], levels: list[float], names: list[str]) -> None:
    """Median and worst of each backend by level of noise."""
    print(f"\n{'noise %':>8} {'backend':<8} {'scenes':>7} {'median':>8} {'worst':>8}")
    for noise in levels:
        for name in names:
            ratios = [row[f"{name}_faster"] for row in rows if row["noise"] == noise and row[f"{name}_faster"]]
            if ratios:
                print(f"{noise:>8g} {name:<8} {len(ratios):>7} {median(ratios):>7.2f}x {min(ratios):>7.2f}x")


def print_roofline(rows: list[dict[str, Any]], name: str, many: int) -> None:
    """How near to the rate of memory a backend comes where a frame touches many voxels."""
    large = [row for row in rows if row["voxels"] >= many]
    if not large:
        return
    rate = copy_rate()
    print(f"\nroofline of {name}, a copy moves {rate / 1e9:.1f} GB/s")
    print(f"{'scene':>5} {'noise':>5} {'voxels':>10} {'MB at least':>11} {'ms':>8} {'share':>6}")
    for row in large:
        row["share"] = row["floor_bytes"] / rate / (row[f"{name}_ms"] / 1e3)
        print(
            f"{row['seed']:>5} {row['noise']:>5g} {row['voxels']:>10,} {row['floor_bytes'] / 1e6:>11.0f}"
            f" {row[f'{name}_ms']:>8.1f} {100 * row['share']:>5.0f}%"
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", type=Path, help="also write a row for each scene and noise there")
    parser.add_argument("--json", help="also write the figures there")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="number of the first scene")
    parser.add_argument("--noise", nargs="+", type=float, default=[0.0, 0.05, 0.3, 1.0], help="per cent of the depth")
    parser.add_argument("--sizes", nargs="+", default=[f"{w}x{h}" for w, h in scenes.SIZES])
    parser.add_argument("--backends", nargs="+", default=["numba", "open3d"])
    parser.add_argument("--most-gb", type=float, default=3.0)
    parser.add_argument("--rounds", type=int, default=3, help="maps of each scene; times are medians over their frames")
    parser.add_argument("--many", type=int, default=1_000_000, help="voxels of a frame from which on the floor is told")
    arguments = parser.parse_args()
    logging.getLogger("semstab").setLevel(logging.ERROR)
    sizes = tuple((int(width), int(height)) for width, _, height in (size.partition("x") for size in arguments.sizes))
    names, rows = arguments.backends, []
    print(f"scene kind        size   K   voxel noise     voxels {'integrate':>9}", end="")
    print("".join(f"{f'{name} ms':>10} {'faster':>8}" for name in names))
    for number in range(arguments.seed, arguments.seed + arguments.scenes):
        rows += (
            new := measured(scenes.drawn(number, sizes), arguments.noise, names, arguments.most_gb, arguments.rounds)
        )
        print_scene(new, names)
    print_ratios(rows, arguments.noise, names)
    print_roofline(rows, names[0], arguments.many)
    if arguments.csv:
        columns = list(dict.fromkeys(name for row in rows for name in row))
        with arguments.csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(
                {name: f"{value:.5g}" if isinstance(value, float) else value for name, value in row.items()}
                for row in rows
            )
    if arguments.json:
        write_json(arguments.json, {"rows": rows})


if __name__ == "__main__":
    main()
