"""The whole command, and the same run without check, recording and report: wall-clock and CPU, cold and warm.

An indoor sequence is made once: a camera walks round a furnished room (room.py) of half its size, 41 classes, PNG depth
and labels, JPEG colour. Each command is a process of its own, bound to two cores, and they take turns. *Cold* is the
first run of all with an empty cache of compiled code; the others are medians. `loop` is what manifest.json says of
reading, flicker, fusion and observers in the run without the three. *again* repeats the finished command, which
computes nothing. CPU counts all threads and child processes.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import measuring
import numpy as np
import room

SCALE, K, SHRINK = 5000, 41, 0.5
"""Units of depth a metre, classes, and the size of the room."""

OFF = ("--check", "none", "--rerun", "off", "--report", "off")
LOOP = ("read", "wait", "flicker", "image space", "fuse numba", "observe")


def write_scene(root: Path, frames: int, size: tuple[int, int]) -> Path:
    """Write the sequence as a posed folder."""
    for part in ("depth", "pose", "labels/net", "color"):
        (root / part).mkdir(parents=True)
    classes = "".join(f"  - class{k}\n" for k in range(K))
    (root / "scene.yaml").write_text(f"depth_scale: {SCALE}\nclasses:\n{classes}", encoding="utf-8")
    with ProcessPoolExecutor() as pool:
        for camera in pool.map(partial(write_frame, root, size), range(frames)):
            np.savetxt(root / "intrinsics.txt", camera)
    return root


def write_frame(root: Path, size: tuple[int, int], index: int) -> np.ndarray:
    """Write one frame of the walk; return the camera matrix."""
    frame = room.smaller(index, *size, K, SHRINK)
    light = np.random.default_rng(index).integers(-9, 9)
    shade = np.random.default_rng(0).integers(40, 220, (K, 3))[frame.labels] + light
    cv2.imwrite(str(root / "depth" / f"{index:05d}.png"), np.round(frame.depth * SCALE).astype(np.uint16))
    cv2.imwrite(str(root / "labels/net" / f"{index:05d}.png"), frame.labels)
    cv2.imwrite(str(root / "color" / f"{index:05d}.jpg"), shade.astype(np.uint8))
    np.savetxt(root / "pose" / f"{index:05d}.txt", frame.T_wc)
    return frame.intrinsics.matrix


def main(frames: int = 200, size: str = "640x480", voxel_size: float = 0.01, runs: int = 3, cores: int = 2) -> Any:
    measuring.use_cores(cores)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = write_scene(folder / "room", frames, measuring.sides(size))

        def run(out: str, *more: str, **variables: str) -> measuring.Process:
            words = ("--data", scene, "--voxel-size", str(voxel_size), "--quiet", "--out", folder / out)
            return measuring.python("-m", "semstab", *words, *more, **variables)

        cold = run("cold", NUMBA_CACHE_DIR=str(folder / "numba"))
        run("off", *OFF)
        taken: dict[str, list[measuring.Process]] = {"default": [], "all three off": [], "again": []}
        loops = []
        for _ in range(runs):
            for out in ("default", "off"):
                shutil.rmtree(folder / out, ignore_errors=True)
            taken["default"].append(run("default"))
            stages = measuring.seconds_of(folder / "default")  # of a run that computes
            taken["again"].append(run("default"))
            taken["all three off"].append(run("off", *OFF))
            off = measuring.seconds_of(folder / "off")
            loops.append(sum(off.get(stage, 0.0) for stage in LOOP))
        voxels = json.loads((folder / "off/summary.json").read_text())["runs"][0]["voxels"]
    print(f"{frames} frames, {voxels:,} voxels, {cores} cores")
    print("stages of the last default run:", {k: round(v, 1) for k, v in stages.items() if v >= 0.05}, end="\n\n")
    rows = {"default, cold": (cold.wall_s, cold.cpu_s)}
    rows |= {
        one: (median(p.wall_s for p in processes), median(p.cpu_s for p in processes))
        for one, processes in taken.items()
    }
    table, base = (
        measuring.MarkdownTable(command="", wall_s=".1f", ratio=".2f", CPU_s=".1f", CPU_ratio=".2f"),
        rows["all three off"],
    )
    for one, (wall, cpu) in rows.items():
        table.add(command=one, wall_s=wall, ratio=wall / base[0], CPU_s=cpu, CPU_ratio=cpu / base[1])
    table.add(command="loop", wall_s=median(loops), ratio=median(loops) / base[0])
    return table.rows
