"""The command line on a folder of PNGs, against the bare OpenCV decode of the same files on the same cores.

    python benchmarks/bench_end_to_end.py --backend open3d --size 640x480 3840x2160 --json end_to_end.json

A folder is made for each kind of depth and noise level: views of the built-in city, rendered at half the size and
scaled up (depth linearly, labels to the nearest), depth with Gaussian noise of so many mm, as sensors have it, as
16-bit PNGs or as .npy in metres, and 8-bit labels. `jpeg` is 16-bit PNGs beside colour as JPEG, which the loop reads
where the run is `--recorded`, and only there; so does the bare decode. A bare read of .npy looks at each value once.
Noise 0 compresses best, so its bare decode is the fastest: the harder case. Both sides read files that are in the page
cache, and are bound to the same cores. Command and bare decode take turns; the figures are medians. One unmeasured
start compiles what is compiled on first use. Nothing is subtracted: the whole process has a row of its own, and `loop`
is what manifest.json says of reading, flicker, fusion and observers. `CPU ratio` is that of the user and system time of
all threads meanwhile (staged.py) to that of the bare decode: the one to look at on a machine that is not quiet.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from semstab.datasets import open_dataset

COMMAND = (sys.executable, str(Path(__file__).with_name("staged.py")))
DEPTH_SCALE = 500  # units a metre: 16 bits reach 131 m, beyond the city's farthest corner


def main() -> None:
    arguments = parsed()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.threads])
    results: list[dict[str, Any]] = []
    for size in arguments.size:
        width, height = (int(number) for number in size.split("x"))
        with tempfile.TemporaryDirectory() as folder:
            views = rendered(width, height, arguments.frames)
            for depth, noise in itertools.product(arguments.depth, arguments.noise):
                root = Path(folder) / f"{depth}{noise:g}"
                write_scene(root, views, (width, height), noise, depth)
                for backend in arguments.backend:
                    row = measured(root, backend, arguments)
                    results.append({"size": size, "depth": depth, "noise_mm": noise, **row})
                    print(
                        f"{size}, {depth}, {noise:g} mm, {backend}: {row['cpu_ratio']:.2f}", file=sys.stderr, flush=True
                    )
                shutil.rmtree(root)
    report = {
        "command": " ".join(["python", *sys.argv]),
        "machine": f"{platform.processor() or platform.machine()}, {arguments.threads} cores",
        "size": arguments.size,
        "frames": arguments.frames,
        "results": results,
    }
    print_report(report)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", nargs="+", default=["numba"])
    parser.add_argument("--size", nargs="+", default=["3840x2160"])
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 10.0, 50.0], help="of the depth, mm")
    parser.add_argument(
        "--depth", nargs="+", default=["png", "jpeg", "npy"], choices=["png", "jpeg", "npy"],
        help="16-bit PNG, alone or beside colour as JPEG; or float32 metres",
    )  # fmt: skip
    parser.add_argument("--recorded", action="store_true", help="write the recording, which takes colour")
    parser.add_argument("--voxel-size", type=float, help="metres; else what the command chooses")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2, help="cores for both sides, and decoding threads")
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


# --- the folder -------------------------------------------------------------------------------------------------------


def rendered(width: int, height: int, frames: int) -> list[Any]:
    options = {"width": width // 2, "height": height // 2, "frames": frames, "cache_megabytes": 0}
    scene = open_dataset("city", options).scene("scene0")
    return [scene.frame(index, "sim-flicker") for index in range(frames)]


def write_scene(root: Path, views: list[Any], size: tuple[int, int], noise: float, kind: str) -> None:
    for part in ("depth", "pose", "labels/net"):
        (root / part).mkdir(parents=True)
    scale = 1 if kind == "npy" else DEPTH_SCALE
    (root / "scene.yaml").write_text(f"taxonomy: uavid8\ndepth_scale: {scale}\n", encoding="utf-8")
    camera = views[0].intrinsics.resized(views[0].shape[::-1], size).matrix
    np.savetxt(root / "intrinsics.txt", camera)
    rng = np.random.default_rng(0)
    for view in views:
        depth = cv2.resize(view.depth, size, interpolation=cv2.INTER_LINEAR).astype(np.float64)
        depth += (depth > 0) * rng.normal(0, noise / 1000, depth.shape)
        name = f"{view.index:04d}"
        if kind == "npy":
            np.save(root / "depth" / f"{name}.npy", depth.astype(np.float32))
        else:
            units = np.clip(np.round(depth * DEPTH_SCALE), 0, 65535).astype(np.uint16)
            cv2.imwrite(str(root / "depth" / f"{name}.png"), units)
        labels = cv2.resize(view.labels, size, interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(root / "labels/net" / f"{name}.png"), labels)
        np.savetxt(root / "pose" / f"{name}.txt", view.T_wc)
        if kind == "jpeg":
            (root / "color").mkdir(exist_ok=True)
            color = cv2.resize(view.color[..., ::-1], size, interpolation=cv2.INTER_LINEAR)
            cv2.imwrite(str(root / "color" / f"{name}.jpg"), color)


# --- the measurement --------------------------------------------------------------------------------------------------


def measured(root: Path, backend: str, arguments: argparse.Namespace) -> dict[str, Any]:
    colors = root.glob("color/*") if arguments.recorded else ()
    files = sorted([*root.glob("depth/*"), *root.glob("labels/net/*.png"), *colors], key=lambda path: path.stem)
    run_command(root, backend, arguments)
    runs, bare, bare_cpu = [], [], []
    for _ in range(arguments.runs):
        used = time.process_time()
        bare.append(seconds(lambda: decode_all(files, arguments.threads)) * 1e3 / arguments.frames)
        bare_cpu.append(time.process_time() - used)
        runs.append(run_command(root, backend, arguments))
    middle = {key: statistics.median(run[key] for run in runs) for key in runs[0] if key != "stages_ms"}
    stages = {name: [run["stages_ms"][name] for run in runs] for name in runs[0]["stages_ms"]}
    decode = statistics.median(bare)
    return {
        "backend": backend,
        "megabytes_a_frame": sum(path.stat().st_size for path in files) / arguments.frames / 1e6,
        "bare_decode_ms": decode,
        "bare_decode_ms_runs": bare,
        "voxel_size": middle["voxel_size"],
        "loop_ms": middle["loop"] * 1e3 / arguments.frames,
        "loop_ms_runs": [run["loop"] * 1e3 / arguments.frames for run in runs],
        "ratio": middle["loop"] * 1e3 / arguments.frames / decode,
        "cpu_ratio": middle["loop_cpu"] / statistics.median(bare_cpu),
        "seconds": middle,
        "stages_ms": {k: None if None in v else statistics.median(v) for k, v in stages.items()},
    }  # fmt: skip


def decode_all(files: list[Path], threads: int) -> None:
    def decode(path: Path) -> None:
        if path.suffix == ".npy":
            assert np.load(path).max() > 0  # to have read it
        else:
            assert cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED) is not None

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(decode, files))


def run_command(root: Path, backend: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Seconds of the whole process and of its parts, and mean ms by stage, from what the run itself wrote."""
    with tempfile.TemporaryDirectory() as out:
        recording = str(Path(out) / "recording.rrd") if arguments.recorded else "off"
        options = ["--check", "none", "--rerun", recording, "--quiet", "--set", f"threads={arguments.threads}"]
        options += ["--report", "off", "--out", out]
        watched = Path(out) / "stages.json"
        options += [] if arguments.voxel_size is None else ["--voxel-size", str(arguments.voxel_size)]
        command = [*COMMAND, str(watched), "run", "--backend", backend, "--data", str(root), *options]
        whole = seconds(lambda: subprocess.run(command, check=True))
        spent = json.loads((Path(out) / "manifest.json").read_text())["seconds"]
        used = {name: stage["all_s"] for name, stage in json.loads(watched.read_text()).items()}
        (run,) = json.loads((Path(out) / "summary.json").read_text())["runs"]
    stages = ("read", "flicker", "observe", f"fuse {backend}")
    loop, loop_cpu = sum(spent[stage] for stage in stages), sum(used.get(stage, 0) for stage in stages)
    after = spent["measure"] + spent["write"] + spent["digest"]
    parts = {
        "whole": whole,
        "loop": loop,
        "loop_cpu": loop_cpu,
        "voxel_size": run["voxel_size"],
        "results": after,
        "start": whole - loop - after,
    }
    return {**parts, "stages_ms": run["stages_ms"] | {"fusion": run["fuse_ms_per_frame"]}}


def seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


# --- the tables -------------------------------------------------------------------------------------------------------


def print_report(report: dict[str, Any]) -> None:
    console = Console(width=120)
    table = Table(title=f"end to end, {report['frames']} frames, {report['machine']}")
    stages = Table(title="mean ms a frame by stage (decode: in the workers, beside the rest)")
    for name in (
        "size",
        "backend",
        "depth",
        "noise mm",
        "voxel m",
        "MB",
        "bare decode ms",
        "loop ms",
        "ratio",
        "CPU ratio",
        "whole s",
        "start s",
        "results s",
    ):
        table.add_column(name, justify="right")
    for name in ("size", "backend", "depth", "noise mm", *report["results"][0]["stages_ms"]):
        stages.add_column(name, justify="right")
    for row in report["results"]:
        lead = (row["size"], row["backend"], row["depth"], f"{row['noise_mm']:g}")
        spent = row["seconds"]
        table.add_row(
            *lead, f"{row['voxel_size']:.2g}", f"{row['megabytes_a_frame']:.1f}", f"{row['bare_decode_ms']:.1f}",
            f"{row['loop_ms']:.1f}", f"{row['ratio']:.2f}", f"{row['cpu_ratio']:.2f}",
            *(f"{spent[part]:.2f}" for part in ("whole", "start", "results")),
        )  # fmt: skip
        stages.add_row(*lead, *("-" if value is None else f"{value:.1f}" for value in row["stages_ms"].values()))
    console.print(table)
    console.print(stages)


if __name__ == "__main__":
    main()
