"""Time that `semstab.TemporalStability` adds to a frame of a validation, on one core, and the time of fusing alone.

A camera walks round a furnished room (room.py) at half its size: 640x480, depth in every pixel, 41 classes. `compute`
at the end is counted in, spread over the frames. Frames are made beforehand; wall-clock, medians of the runs.
"""

from __future__ import annotations

import dataclasses
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import measuring
import room

from semstab.backends import create
from semstab.data.frames import Frame
from semstab.online.metric import TemporalStability

K, SHRINK = 41, 0.5


def made(index: int) -> Frame:
    """A frame of the walk."""
    return room.smaller(index, 640, 480, K, SHRINK)


def main(frames: int = 200, voxel_size: float = 0.02, runs: int = 3) -> Any:
    with ProcessPoolExecutor() as pool:
        walk = list(pool.map(made, range(frames)))
    measuring.use_cores(1)

    def fused() -> dict[str, float]:
        backend = create("numba", voxel_size=voxel_size, num_classes=K)
        update = sum(measuring.wall_ms(lambda one: backend.integrate(dataclasses.replace(one)), one) for one in walk)
        return {"update": update, "compute": 0.0, "all": update}

    def measured(alpha: bool) -> dict[str, float]:
        metric = TemporalStability(K, voxel_size, alpha=alpha)
        update = sum(measuring.wall_ms(metric.update, one.labels, one.depth, one.intrinsics, one.T_wc) for one in walk)
        compute = measuring.wall_ms(metric.compute)
        return {"update": update, "compute": compute, "all": update + compute}

    ways = {"fusion alone": fused, "metric": partial(measured, True), "metric, alpha=False": partial(measured, False)}
    taken = {name: measuring.medians(ms) for name, ms in measuring.in_turns(ways, runs).items()}
    print(f"{frames} frames of 640x480, {voxel_size:g} m, one core\n")
    table = measuring.MarkdownTable(way="", update_ms=".1f", compute_s=".1f", ms_a_frame=".1f", ratio=".2f")
    for name, ms in taken.items():
        table.add(way=name, update_ms=ms["update"] / frames, compute_s=ms["compute"] / 1e3,
                  ms_a_frame=ms["all"] / frames, ratio=ms["all"] / taken["fusion alone"]["all"])  # fmt: skip
    return table.rows
