"""The whole command beside the same run without check, recording and report: wall-clock and CPU, cold and warm.

    python benchmarks/bench_command.py [--frames 200] [--runs 3] [--json command.json]

An indoor sequence is made once: a camera walks round a furnished room (room.py) of half its size, 640x480, 41 classes,
PNG depth and labels, JPEG colour, voxels of 1 cm. Each command is a process of its own, bound to two cores, and they
take turns. *Cold* is the first run of all with an empty cache of compiled code; the others are medians. `loop` is what
manifest.json says of reading, flicker, fusion and observers in the run without the three. *again* repeats the finished
command, which computes nothing. CPU counts all threads and child processes. Python may store its bytecode, as an
installed package has it.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import room
from rich.console import Console
from rich.table import Table

COMMAND = str(Path(sys.executable).with_name("semstab-bench"))
SCALE, K, SHRINK = 5000, 41, 0.5
"""Units of depth a metre, classes, and the size of the room."""

OFF = ("--check", "none", "--rerun", "off", "--report", "off")
LOOP = ("read", "wait", "flicker", "image space", "fuse numba", "observe")


def main() -> None:
    """Print a row a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--voxel-size", type=float, default=0.01, help="metres")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.cores])
    with tempfile.TemporaryDirectory() as folder:
        width, height = (int(side) for side in arguments.size.split("x"))
        scene = write_scene(Path(folder) / "room", arguments.frames, width, height)
        rows = measure(scene, Path(folder), arguments)
    print_rows(rows)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


def write_scene(root: Path, frames: int, width: int, height: int) -> Path:
    """Write the sequence as a posed folder."""
    for part in ("depth", "pose", "labels/net", "color"):
        (root / part).mkdir(parents=True)
    classes = "".join(f"  - class{k}\n" for k in range(K))
    (root / "scene.yaml").write_text(f"depth_scale: {SCALE}\nclasses:\n{classes}", encoding="utf-8")
    with ProcessPoolExecutor() as pool:
        for camera in pool.map(partial(write_frame, root, width, height), range(frames)):
            np.savetxt(root / "intrinsics.txt", camera)
    return root


def write_frame(root: Path, width: int, height: int, index: int) -> np.ndarray:
    """Write one frame of the walk; return the camera matrix."""
    frame = room.frame(index, width, height, K)
    pose = frame.T_wc.copy()
    pose[:3, 3] *= SHRINK
    depth = np.round(frame.depth * SHRINK * SCALE).astype(np.uint16)
    shade = np.random.default_rng(0).integers(40, 220, (K, 3))[frame.labels] + np.random.default_rng(index).integers(
        -9, 9
    )
    cv2.imwrite(str(root / "depth" / f"{index:05d}.png"), depth)
    cv2.imwrite(str(root / "labels/net" / f"{index:05d}.png"), frame.labels)
    cv2.imwrite(str(root / "color" / f"{index:05d}.jpg"), shade.astype(np.uint8))
    np.savetxt(root / "pose" / f"{index:05d}.txt", pose)
    return frame.intrinsics.matrix


def measure(scene: Path, folder: Path, arguments: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Wall and CPU seconds of each command."""
    words = ["--data", str(scene), "--voxel-size", str(arguments.voxel_size), "--quiet"]
    cold = timed([*words, "--out", str(folder / "cold")], {"NUMBA_CACHE_DIR": str(folder / "numba")})
    timed([*words, *OFF, "--out", str(folder / "warm")])
    rows: dict[str, list[tuple[float, float]]] = {"default": [], "all three off": [], "again": []}
    loops, stages = [], {}
    for _ in range(arguments.runs):
        for name, more in (("default", ()), ("all three off", OFF)):
            out = folder / "out"
            shutil.rmtree(out, ignore_errors=True)
            rows[name].append(timed([*words, *more, "--out", str(out)]))
            seconds = json.loads((out / "manifest.json").read_text())["seconds"]
            if name == "default":
                rows["again"].append(timed([*words, "--out", str(out)]))
                stages = seconds
            else:
                loops.append(sum(seconds.get(stage, 0.0) for stage in LOOP))
    voxels = json.loads((folder / "warm/summary.json").read_text())["runs"][0]["voxels"]
    found = {"default, cold": {"wall": cold[0], "cpu": cold[1]}}
    for name, own in rows.items():
        found[name] = {part: statistics.median(one[k] for one in own) for k, part in enumerate(("wall", "cpu"))}
    found["loop"] = {"wall": statistics.median(loops), "cpu": float("nan")}
    print(f"{arguments.frames} frames, {voxels:,} voxels, {arguments.cores} cores")
    print("stages of the last default run:", {k: round(v, 1) for k, v in stages.items() if v >= 0.05})
    return found


def timed(words: list[str], variables: dict[str, str] | None = None) -> tuple[float, float]:
    """Wall-clock and CPU seconds of a command."""
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"} | (variables or {})
    subprocess.run([COMMAND, *words], check=True, env=environment)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def print_rows(rows: dict[str, dict[str, float]]) -> None:
    """Print the table, with ratios to the run with all three off."""
    table, base = Table(), rows["all three off"]
    for head in ("command", "wall s", "ratio", "CPU s", "ratio"):
        table.add_column(head, justify="left" if head == "command" else "right")
    for name, own in rows.items():
        ratios = [f"{own[part] / base[part]:.2f}" for part in ("wall", "cpu")]
        table.add_row(name, f"{own['wall']:.1f}", ratios[0], f"{own['cpu']:.1f}", ratios[1])
    Console().print(table)


if __name__ == "__main__":
    main()
