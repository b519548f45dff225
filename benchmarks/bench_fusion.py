"""CPU time of one frame through each fusion backend, beside Open3D's own VoxelBlockGrid.integrate on the same frames.

    python benchmarks/bench_fusion.py [--json FILE] [--sizes 1280x720 3840x2160] [--classes 7] [--rounds 3]
                                      [--conditions "noise 0.3 %" ...] [--backends numba open3d]

The frames fly along a street of facades, trees and sky. 'first' is the first frame of a new map, code already compiled;
'later' the median of all others, most of whose voxels are known; both user and system time of all threads, which other
work on the machine changes little. 'faster' is Open3D's own time over that of the backend, later frames. The
implementations take turns, frame by frame.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

from semstab.core.process import configure_process

configure_process()  # as the command line does, before anything starts threads

import flight  # noqa: E402
import numpy as np  # noqa: E402
import open3d as o3d  # noqa: E402
import open3d.core as o3c  # noqa: E402

import semstab  # noqa: E402
from semstab import backends  # noqa: E402
from semstab.core.files import write_json  # noqa: E402

FRAMES = 3
BASELINE = "Open3D integrate"
FINE = 0.05
"""Voxels of which the maps of several implementations do not fit into the memory: they take no turns, metres."""

CONDITIONS: dict[str, tuple[float, dict[str, Any]]] = {
    "no noise, clean labels": (0.2, {"clean": True}),
    "no noise": (0.2, {}),
    "no noise, 5 % salt and pepper": (0.2, {"salt": 0.05}),
    "noise 0.05 %": (0.2, {"noise": 0.0005}),
    "noise 0.3 %": (0.2, {"noise": 0.003}),
    "noise 1 %": (0.2, {"noise": 0.01}),
    "noise 0.05 %, 0.05 m": (0.05, {"noise": 0.0005}),
    "noise 0.3 %, 0.1 m": (0.1, {"noise": 0.003}),
}
"""Voxel size in metres and what `flight.street` is asked for; labels are wrong in 12 % of the blocks unless clean."""


def open3d_integrate(voxel_size: float) -> Callable[[semstab.Frame], None]:
    """A new TSDF map with colour, block resolution 16, by its documented calls; inputs are made outside the clock."""
    attributes = ("tsdf", "weight", "color"), (o3c.float32,) * 3, ((1), (1), (3))
    grid = o3d.t.geometry.VoxelBlockGrid(*attributes, voxel_size, 16, 4096, o3c.Device("CPU:0"))

    def integrate(frame: semstab.Frame) -> None:
        depth, color, K, T_cw = o3d_inputs[frame.index]
        blocks = grid.compute_unique_block_coordinates(depth, K, T_cw, 1.0, 1000.0)
        grid.integrate(blocks, depth, color, K, T_cw, 1.0, 1000.0)

    return integrate


o3d_inputs: dict[int, tuple[object, ...]] = {}


def prepare(frame: semstab.Frame) -> None:
    """The frame as Open3D wants it."""
    image = o3d.t.geometry.Image
    gray = np.repeat((frame.labels / 255).astype(np.float32)[..., None], 3, axis=2)
    o3d_inputs[frame.index] = (
        image(o3c.Tensor(np.array(frame.depth))),
        image(o3c.Tensor(gray)),
        o3c.Tensor(frame.intrinsics.matrix),
        o3c.Tensor(np.linalg.inv(frame.T_wc)),
    )


def cpu_milliseconds(work: Callable[[semstab.Frame], object], frame: semstab.Frame) -> float:
    """User and system time of one call, all threads."""
    started = time.process_time()
    work(frame)
    return 1e3 * (time.process_time() - started)


def measure(
    frames: Sequence[semstab.Frame], K: int, voxel_size: float, names: Sequence[str], rounds: int
) -> dict[str, dict[str, float]]:
    """Milliseconds of the first frame and of later ones by implementation."""

    def maker(name: str) -> Callable[[], Callable[[semstab.Frame], object]]:
        if name == BASELINE:
            return lambda: open3d_integrate(voxel_size)
        return lambda: backends.create(name, voxel_size=voxel_size, num_classes=K).integrate

    times: dict[str, list[list[float]]] = defaultdict(list)
    for name in names:  # compiles what is compiled on first use
        maker(name)()(frames[0])
    for _ in range(rounds):
        maps = {name: maker(name)() for name in names}
        for name in names:
            times[name].append([])
        for frame in (*frames, *frames):  # in turns: what else the machine does meets all of them alike
            for name in names:
                times[name][-1].append(cpu_milliseconds(maps[name], frame))
        del maps
    first = {name: [a_round[0] for a_round in times[name]] for name in names}
    later = {name: [each for a_round in times[name] for each in a_round[1:]] for name in names}
    return {name: {"first_ms": median(first[name]), "later_ms": median(later[name])} for name in names}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="also write the figures there")
    parser.add_argument("--sizes", nargs="+", default=["3840x2160"])
    parser.add_argument("--classes", nargs="+", type=int, default=[7])
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), choices=list(CONDITIONS))
    parser.add_argument("--backends", nargs="+", default=["numba", "open3d"])
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    logging.getLogger("semstab").setLevel(logging.ERROR)
    rows = []
    print(
        f"{'size':>9} {'K':>3}  {'condition':<30} {'implementation':<17} {'first ms':>9} {'later ms':>9} {'faster':>7}"
    )
    for size in arguments.sizes:
        width, height = map(int, size.split("x"))
        for K in arguments.classes:
            for condition in arguments.conditions:
                voxel_size, kind = CONDITIONS[condition]
                frames = [flight.street(i, width, height, K, **kind) for i in range(FRAMES)]
                for frame in frames:
                    prepare(frame)
                names = (BASELINE, *arguments.backends)
                groups = [names] if voxel_size > FINE else [(name,) for name in names]
                measured = {}
                for group in groups:
                    measured |= measure(frames, K, voxel_size, group, arguments.rounds)
                for name, times in measured.items():
                    faster = measured[BASELINE]["later_ms"] / times["later_ms"]
                    rows.append({"size": size, "K": K, "condition": condition, "name": name, **times, "faster": faster})
                    print(
                        f"{size:>9} {K:>3}  {condition:<30} {name:<17} {times['first_ms']:9.1f}"
                        f" {times['later_ms']:9.1f} {faster:6.2f}x",
                        flush=True,
                    )
    if arguments.json:
        write_json(arguments.json, {"rows": rows})


if __name__ == "__main__":
    main()
