"""A map in tiles against the same one at once: peak memory and CPU time of the whole command, and are they the same?

    python benchmarks/bench_tiles.py [--frames 50 150 ...] [--memory-gb 1] [--jobs 1] [--record] [--json FILE]
    python benchmarks/bench_tiles.py --city 0.4 0.2 0.1 --tile-size 128

A flight goes to and fro over a field, in legs 40 m apart, with a frame every 30 m: a frame adds about 30,000 voxels of
0.2 m. It is written as a posed folder and run on one thread, without report, and without recording unless `--record`
asks for it. Peak is resident memory of the command, with `--jobs` of its largest process; CPU time is user and system,
of all processes, and that of the stages of a map in microseconds a voxel. All columns of both maps are compared bit by
bit, their summaries to 1e-12.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import flight
import numpy as np

from semstab.core.files import write_json
from semstab.data.voxels import VoxelTable

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests"))

from compare_summaries import differences  # noqa: E402
from posed_writer import write_posed  # noqa: E402

WIDTH, HEIGHT, K = 640, 480, 7
STAGES = {"fuse": "fuse numba", "table": "table", "statistics": "statistics", "summary": "measure", "Parquet": "write"}
LEG, BESIDE, STEP = 10, 40.0, 30.0
CITY = ["--scene", "scene0", "--model", "sim-flicker", "--frames", ":40"]
COLUMNS = ("ix", "iy", "iz", "op", "drift_sum", "pixels", "first_frame", "last_frame", "self_sum", "frame_entropy_sum",
           "vss", "sbd", "entropy", "margin", "label")  # fmt: skip


def write_flight(root: Path, count: int) -> Path:
    """A scene of so many frames: legs of LEG frames, flown to and fro."""
    frames = []
    for index in range(count):
        leg, along = divmod(index, LEG)
        y = along if leg % 2 == 0 else LEG - 1 - along
        frames.append(flight.frame(index, WIDTH, HEIGHT, K, (BESIDE * leg, STEP * y)))
    classes = [f"class{k}" for k in range(K)]
    names = [f"{index:05d}" for index in range(count)]
    return write_posed(root, names, {"a": frames}, scale=None, classes=classes, up_axis="z")


def run(out: Path, *options: str) -> dict[str, Any]:
    """Run the command; its peak memory in GB, CPU time in seconds, and that of the stages."""
    watched = out.with_suffix(".json")
    command = [sys.executable, str(HERE / "staged.py"), str(watched), "run", "--out", str(out), "--no-geometry-check",
               "--report", "off", "--quiet", *options]  # fmt: skip
    process = subprocess.Popen(command, env={**os.environ, "NUMBA_NUM_THREADS": "1"})
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)}: ended with {os.waitstatus_to_exitcode(status)}")
    found = json.loads(watched.read_text())
    own = {
        name: found.get(stage, {}).get("own_s" if name == "fuse" else "all_s", 0.0) for name, stage in STAGES.items()
    }
    cpu = usage.ru_utime + usage.ru_stime
    return {"peak_gb": found["all"]["peak_gb"], "cpu_s": cpu, **own, "stages": found}


def same(whole: Path, tiles: Path) -> bool:
    """Whether both runs found the same, to the last bit of every column."""
    for file in (whole / "voxels").glob("*.parquet"):
        folder = tiles / "voxels" / file.stem
        folder = folder if folder.is_dir() else folder.with_suffix(".parquet")  # that fitted at once
        for name in COLUMNS:
            a, b = (VoxelTable.columns(path, [name])[name] for path in (file, folder))
            if a.tobytes() != b.tobytes():
                print(f"{file.stem}: column {name} differs")
                return False
        evidence = [VoxelTable.load(path).evidence for path in (file, folder)]
        if any(not np.array_equal(a, b) for a, b in zip(evidence[0].entries, evidence[1].entries, strict=True)):
            print(f"{file.stem}: evidence differs")
            return False
    summaries = [json.loads((run / "summary.json").read_text()) for run in (whole, tiles)]
    for summary in summaries:
        del summary["agreement"]  # each tile has a sample of its own to check
    found = [line for line in differences(*summaries, tolerance=1e-12) if "voxels_file" not in line]
    print(*found, sep="\n", end="\n" if found else "")
    return not found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", nargs="+", type=int, default=[50, 150])
    parser.add_argument(
        "--city", nargs="+", type=float, help="the built-in city instead, at these voxel sizes in metres"
    )
    parser.add_argument("--memory-gb", type=float, default=1.0)
    parser.add_argument("--tile-size", help="forced; else chosen where the map would not fit")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--record", action="store_true", help="with a recording")
    parser.add_argument("--json", help="also write the figures there")
    arguments = parser.parse_args()
    forced = ["--tile-size", arguments.tile_size] if arguments.tile_size else []
    recording = [] if arguments.record else ["--rerun", "off"]
    print(f"{'voxels':>12} {'':>7} {'tiles':>6} {'peak GB':>8} {'CPU s':>7} {'us a voxel':>11}", end="")
    print(*(f"{name:>11}" for name in STAGES))
    rows = []
    for size in arguments.city or arguments.frames:
        with tempfile.TemporaryDirectory() as folder:
            if arguments.city:
                shown = [*CITY, "--voxel-size", str(size), "--rerun", "off"]
            else:
                scene = write_flight(Path(folder) / "field", int(size))
                shown = ["--data", str(scene), "--voxel-size", "0.2", *recording]
            tiled = ["--set", f"memory_gb={arguments.memory_gb}", "--jobs", str(arguments.jobs), *forced]
            limits = {"whole": ["--set", "memory_gb=1000", "--tile-size", "off"], "tiles": tiled}
            for name, options in limits.items():
                out = Path(folder) / name
                found = run(out, *shown, *options)
                voxels = sum(one["voxels"] for one in json.loads((out / "summary.json").read_text())["runs"])
                tiles = len(list((out / "voxels").glob("*/tile=*")))
                rows.append({"run": name, "size": size, "voxels": voxels, "tiles": tiles, **found})
                peak, cpu = found["peak_gb"], found["cpu_s"]
                print(f"{voxels:12,} {name:>7} {tiles:6} {peak:8.2f} {cpu:7.1f} {1e6 * cpu / voxels:11.2f}", end="")
                print(*(f"{1e6 * found.get(stage, 0.0) / voxels:11.3f}" for stage in STAGES), flush=True)
            print("the same" if same(Path(folder) / "whole", Path(folder) / "tiles") else "NOT THE SAME", flush=True)
    if arguments.json:
        write_json(arguments.json, {"memory_gb": arguments.memory_gb, "rows": rows})


if __name__ == "__main__":
    main()
