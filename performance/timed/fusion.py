"""CPU time of one frame through each fusion backend, and through Open3D's own VoxelBlockGrid.integrate.

The frames fly along a street of facades, trees and sky. 'first' is the first frame of a new map, code already compiled;
'later' the median of all others, most of whose voxels are known; both user and system time of all threads, which other
work on the machine changes little. 'faster' is Open3D's own time over that of the backend, later frames. The
implementations take turns, frame by frame.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any, Literal

import flight
import measuring
import numpy as np
import open3d as o3d
import open3d.core as o3c

import semstab
from semstab import backends

FRAMES = 3
BASELINE = "Open3D integrate"
FINE = 0.05
"""Voxels of which the maps of several implementations do not fit into the memory: they take no turns, metres."""

Condition = Literal[
    "no noise, clean labels", "no noise", "no noise, 5 % salt and pepper", "noise 0.05 %", "noise 0.3 %", "noise 1 %",
    "noise 0.05 %, 0.05 m", "noise 0.3 %, 0.1 m",
]  # fmt: skip
CONDITIONS: dict[Condition, tuple[float, dict[str, Any]]] = {
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


def measure(
    frames: Sequence[semstab.Frame], K: int, voxel_size: float, names: Sequence[str], rounds: int
) -> dict[str, dict[str, float]]:
    """Milliseconds of the first frame and of later ones by implementation."""

    def made(name: str) -> Callable[[semstab.Frame], object]:
        if name == BASELINE:
            return open3d_integrate(voxel_size)
        return backends.create(name, voxel_size=voxel_size, num_classes=K).integrate

    times: dict[str, list[list[float]]] = defaultdict(list)
    for name in names:  # compiles what is compiled on first use
        made(name)(frames[0])
    for _ in range(rounds):
        maps = {name: made(name) for name in names}
        for name in names:
            times[name].append([])
        for frame in (*frames, *frames):  # in turns, so that all maps share any other load of the machine
            for name in names:
                times[name][-1].append(measuring.cpu_ms(maps[name], frame))
        del maps
    return {
        name: {"first_ms": median(ms[0] for ms in rounds_), "later_ms": median(t for ms in rounds_ for t in ms[1:])}
        for name, rounds_ in times.items()
    }


def main(
    sizes: tuple[str, ...] = ("3840x2160",),
    classes: tuple[int, ...] = (7,),
    conditions: tuple[Condition, ...] = tuple(CONDITIONS),
    backends: tuple[str, ...] = ("numba", "open3d"),
    rounds: int = 3,
) -> Any:
    table = measuring.MarkdownTable(
        size="", K="", condition="", implementation="", first_ms=".1f", later_ms=".1f", faster=".2f"
    )
    for size, K, condition in itertools.product(sizes, classes, conditions):
        voxel_size, kind = CONDITIONS[condition]
        frames = [flight.street(i, *measuring.sides(size), K, **kind) for i in range(FRAMES)]
        for frame in frames:
            prepare(frame)
        names = (BASELINE, *backends)
        found = {}
        for group in [names] if voxel_size > FINE else [(name,) for name in names]:
            found |= measure(frames, K, voxel_size, group, rounds)
        for name, times in found.items():
            faster = found[BASELINE]["later_ms"] / times["later_ms"]
            table.add(size=size, K=K, condition=condition, implementation=name, **times, faster=faster)
    return table.rows
