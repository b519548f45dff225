"""What the recording costs: the command line on a folder of PNGs and colour JPEGs, with it and without.

    python benchmarks/bench_recording.py --size 1920x1080 --frames 40

The folder is made as bench_end_to_end.py makes it (16-bit depth with noise, 8-bit labels), with colour as JPEG of the
quality that cameras use. Runs with and without take turns, bound to the same cores, on files in the page cache; the
figures are medians. One unmeasured start of each compiles what is compiled on first use. `run` is the whole process by
the clock, `CPU` its user and system time, `loop` reading, flicker, fusion and observers, by manifest.json; `ratio` is
with by without. It also says how large the recording is; the unmeasured starts check that with `--rerun off` rerun is
not imported.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_end_to_end import COMMAND, rendered, write_scene
from rich.console import Console
from rich.table import Table

JPEG_QUALITY = 92


def main() -> None:
    arguments = parsed()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.threads])
    width, height = (int(number) for number in arguments.size.split("x"))
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "scene"
        views = rendered(width, height, arguments.frames)
        write_scene(root, views, (width, height), arguments.noise)
        megabytes = write_color(root, views, (width, height)) / 1e6
        runs: dict[str, list[dict[str, float]]] = {"with": [], "without": []}
        for measured in range(arguments.runs + 1):
            for name in ("without", "with") if measured % 2 else ("with", "without"):
                taken = run(root, arguments, recording=name == "with", imports=not measured)
                if measured:
                    runs[name].append(taken)
    report = {
        "command": " ".join(["python", *sys.argv]),
        "size": arguments.size,
        "frames": arguments.frames,
        "color_megabytes_a_frame": megabytes / arguments.frames,
        "runs": runs,
        "median": {
            name: {key: statistics.median(taken[key] for taken in rows) for key in rows[0]}
            for name, rows in runs.items()
        },
    }
    print_report(report)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="numba")
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--noise", type=float, default=10.0, help="of the depth, mm")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2, help="cores, and decoding threads")
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


def write_color(root: Path, views: list[Any], size: tuple[int, int]) -> int:
    """color/NAME.jpg of each view, with grain as cameras have it; returns their bytes."""
    (root / "color").mkdir()
    rng = np.random.default_rng(1)
    for view in views:
        color = cv2.resize(view.color[..., ::-1], size, interpolation=cv2.INTER_LINEAR).astype(np.int16)
        grain = rng.normal(0, 4, (*color.shape[:2], 1)).astype(np.int16)
        file = root / "color" / f"{view.index:04d}.jpg"
        image = np.clip(color + grain, 0, 255).astype(np.uint8)
        cv2.imwrite(str(file), image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return sum(file.stat().st_size for file in (root / "color").iterdir())


def run(root: Path, arguments: argparse.Namespace, *, recording: bool, imports: bool) -> dict[str, float]:
    """Seconds of the whole process, of the loop and of the observers, and the size of the recording in MB.

    With `imports` it checks what is imported, which takes time of its own.
    """
    with tempfile.TemporaryDirectory() as out:
        options = ["--check", "none", "--quiet", "--set", f"threads={arguments.threads}", "--out", out]
        options += [] if recording else ["--rerun", "off"]
        command = [COMMAND, "--backend", arguments.backend, "--data", str(root), *options]
        program = [sys.executable, *(["-X", "importtime"] if imports else []), *command]
        started, spent_before = time.perf_counter(), cpu_of_children()
        done = subprocess.run(program, check=True, capture_output=True, text=True)
        whole, cpu = time.perf_counter() - started, cpu_of_children() - spent_before
        if imports:
            assert ("rerun_bindings" in done.stderr) == recording, "rerun is imported where it is used, and only there"
        spent = json.loads((Path(out) / "manifest.json").read_text())["seconds"]
        file = Path(out) / "recording.rrd"
        size = file.stat().st_size / 1e6 if recording else 0.0
    loop = spent["read"] + spent["flicker"] + spent["observe"] + spent[f"fuse {arguments.backend}"]
    return {"run": whole, "cpu": cpu, "loop": loop, "observe": spent["observe"], "megabytes": size}


def cpu_of_children() -> float:
    """User and system seconds of the processes that ended so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def print_report(report: dict[str, Any]) -> None:
    frames = report["frames"]
    table = Table(
        title=f"{report['size']}, {frames} frames, {report['color_megabytes_a_frame']:.2f} MB of JPEG a frame"
    )
    for name in ("", "run s", "CPU s", "loop ms a frame", "observers ms a frame", "recording MB"):
        table.add_column(name, justify="right")
    for name, row in report["median"].items():
        per_frame = (row[key] * 1e3 / frames for key in ("loop", "observe"))
        table.add_row(
            name,
            f"{row['run']:.2f}",
            f"{row['cpu']:.2f}",
            *(f"{value:.1f}" for value in per_frame),
            f"{row['megabytes']:.1f}",
        )
    both = report["median"]
    ratios = {key: both["with"][key] / both["without"][key] for key in ("run", "cpu", "loop")}
    table.add_row("ratio", *(f"{ratio:.3f}" for ratio in ratios.values()), "", "")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
