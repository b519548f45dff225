"""What a frame costs beside its pixels: opening and planning a long sequence, and the memory that a run takes a frame.

    python benchmarks/bench_long.py [--frames 100000] [--fused 2000 10000] [--still] [--json FILE]

A posed folder of tiny frames, of which all but 50 are links. CPU seconds and resident memory in MB after each step:
open the scene, select frames (each pose is read: tracking may have been lost), hash the input, pickle what a task is
sent of a stretch of 4096 frames. Then the command fuses so many of its frames: peak memory, and what a frame adds. The
camera goes over new ground, or with --still back and forth over the same: the map does not grow then.
"""

from __future__ import annotations

import argparse
import os
import pickle
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests"))

from posed_writer import write_posed  # noqa: E402

from semstab import Frame, Intrinsics  # noqa: E402
from semstab.config import Config  # noqa: E402
from semstab.core.files import write_json  # noqa: E402
from semstab.core.process import resident_bytes  # noqa: E402
from semstab.datasets import open_dataset  # noqa: E402
from semstab.engine.units import make_plan  # noqa: E402
from semstab.engine.work import Start, UnitTile, Work  # noqa: E402

WIDTH, HEIGHT, OWN, LEG = 16, 12, 50, 500


def write(root: Path, count: int, *, still: bool = False) -> Path:
    """A sequence of so many frames in legs, or over one place; some images are links to others."""
    rng, frames = np.random.default_rng(0), []
    for index in range(OWN):
        depth = (rng.integers(5000, 6000, (HEIGHT, WIDTH)) / 1000).astype(np.float32)
        labels = rng.integers(0, 3, (HEIGHT, WIDTH)).astype(np.uint8)
        camera = Intrinsics(WIDTH, WIDTH, WIDTH / 2, HEIGHT / 2)
        frames.append(Frame(index, depth, camera, np.eye(4), labels=labels))
    write_posed(root, [f"{k:06d}" for k in range(OWN)], {"a": frames}, classes=["x", "y", "z"], up_axis="z")
    for index in range(count):
        leg, along = (0, index % 4) if still else divmod(index, LEG)
        x = along if leg % 2 == 0 else LEG - 1 - along
        (root / f"pose/{index:06d}.txt").write_text(f"1 0 0 {0.5 * x}\n0 1 0 {2.0 * leg}\n0 0 1 0\n0 0 0 1\n")
        for folder in ("depth", "labels/a") if index >= OWN else ():
            os.link(root / folder / f"{index % OWN:06d}.png", root / folder / f"{index:06d}.png")
    return root


def steps(root: Path) -> dict[str, tuple[float, float]]:
    """CPU seconds of each step, and MB after it."""
    found, before = {}, cpu_seconds()

    def end(step: str) -> None:
        nonlocal before
        now = cpu_seconds()
        found[step] = now - before, resident_bytes() / 1e6
        before = now

    open_dataset("posed_folder", {"root": str(root)}).scene(root.name)
    end("open")
    dataset = {"name": "posed_folder", "options": {"root": str(root)}}
    plan = make_plan(Config.model_validate({"dataset": dataset, "voxel_size": 0.5, "backends": ["numba"]}))
    end("open again, select frames")
    (unit,) = plan.units
    _ = unit.task.digest
    end("hash the input")
    sent = pickle.dumps(Work.of(unit, Start("", root)).in_tile(UnitTile("", 64, (0, 0)), unit.task.indices[:4096]))
    end(f"pickle a task of 4096 frames: {len(sent) / 1e3:.0f} kB")
    return found


def cpu_seconds() -> float:
    """Of this process so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def peak_mb(root: Path, out: Path, fused: int) -> float:
    """Peak memory of the command that fuses so many frames."""
    words = [
        "run",
        "--data",
        str(root),
        "--frames",
        f"0:{fused}",
        "--voxel-size",
        "0.5",
        "--no-geometry-check",
        "--quiet",
    ]
    words += ["--rerun", "off", "--report", "off", "--check", "off", "--out", str(out)]
    process = subprocess.Popen(["nice", sys.executable, "-m", "semstab", *words])
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(words)}: ended with {os.waitstatus_to_exitcode(status)}")
    return usage.ru_maxrss / 1e3


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--fused", nargs="*", type=int, default=[2000, 10_000])
    parser.add_argument("--still", action="store_true", help="all frames see the same place")
    parser.add_argument("--json", help="also write the figures there")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = write(Path(folder) / "long", arguments.frames, still=arguments.still)
        found = steps(root)
        for step, (seconds, megabytes) in found.items():
            print(f"{step:45} {seconds:7.2f} s {megabytes:7.0f} MB", flush=True)
        peaks = {fused: peak_mb(root, Path(folder) / f"run{fused}", fused) for fused in arguments.fused}
        for fused, peak in peaks.items():
            print(f"fused {fused:7} frames: peak {peak:.0f} MB", flush=True)
        if len(peaks) > 1:
            (least, low), *_, (most, high) = sorted(peaks.items())
            print(f"a frame: {1e3 * (high - low) / (most - least):.1f} kB, the map and its table among them")
    if arguments.json:
        write_json(arguments.json, {"steps": found, "peak_mb": {str(key): value for key, value in peaks.items()}})


if __name__ == "__main__":
    main()
