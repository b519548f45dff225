"""Does a run take what the memory estimate says? Measured peak of the whole command against it, at once and in tiles.

    python benchmarks/bench_memory.py [--backends numba open3d] [--classes 7 41] [--kinds labels scores] [--json FILE]

What a run takes is the peak of the whole command less what it has when it is planned (0.22 GB, with Open3D 0.36). The
estimate is of all of that: what is loaded later, frames, and the map with what comes of it, of as many voxels and
observations as there were; in tiles, where `memory_gb` is a third of what the whole map takes, with a tile as large as
the largest one was.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import flight
import numpy as np

import semstab
from semstab.core.files import write_json
from semstab.data.voxels import VoxelTable
from semstab.engine.memory import GB, MapMemory, process_bytes

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests"))

from posed_writer import write_posed  # noqa: E402

VOXEL_SIZE = 0.2
FRAMES = {"labels": 24, "scores": 8}
SIZE, MOST_VOXELS = {"labels": (640, 480), "scores": (320, 240)}, {"labels": 74_000, "scores": 60_000}


def write(root: Path, K: int, kind: str) -> Path:
    """A flight of frames with labels, or with the scores of a softmax."""
    frames = []
    for index in range(FRAMES[kind]):
        frame = flight.frame(index, *SIZE[kind], K, (40.0 * (index // 8), 30.0 * (index % 8)))
        if kind == "scores":
            rng = np.random.default_rng(index)
            logits = rng.standard_normal((*frame.shape, K), dtype=np.float32)
            np.put_along_axis(logits, frame.labels[..., None].astype(np.int64), 6.0, axis=2)
            scores = np.exp(logits)
            scores /= scores.sum(axis=2, keepdims=True)
            frame = dataclasses.replace(frame, labels=None, scores=scores.astype(np.float16))
        frames.append(frame)
    names = [f"{index:05d}" for index in range(len(frames))]
    return write_posed(root, names, {"a": frames}, scale=None, classes=[f"c{k}" for k in range(K)], up_axis="z")


def stages(scene: Path, out: Path, backend: str, voxel_size: float, *options: str) -> dict[str, float]:
    """Peak of each stage of a run, GB."""
    watched = out.with_suffix(".json")
    command = [sys.executable, str(HERE / "staged.py"), str(watched), "run", "--data", str(scene), "--out", str(out),
               "--voxel-size", str(voxel_size), "--backend", backend, "--no-geometry-check", "--report", "off",
               "--quiet", "--rerun", "off", *options]  # fmt: skip
    subprocess.run(command, check=True)
    return {name: stage["peak_gb"] for name, stage in json.loads(watched.read_text()).items()}


def taken(found: dict[str, float]) -> tuple[float, str]:
    """Bytes that the command took once it was planned, and the stage of their peak."""
    stage = max((name for name in found if name not in ("beside", "all")), key=found.__getitem__)
    return (found["all"] - found["digest"]) * GB, stage


def largest_tile(out: Path) -> int:
    """Voxels of the largest tile of a run."""
    return max(map(len, VoxelTable.iter_tiles(next((out / "voxels").iterdir()))))


def measured(scene: Path, out: Path, backend: str, K: int, kind: str, most_gb: float) -> Iterator[dict[str, Any]]:
    """At once, then in tiles."""
    estimate = MapMemory(backend, K, soft=kind == "scores", sampled=backend == "numba")
    process = process_bytes(flight.frame(0, *SIZE[kind], K), K, None, soft=estimate.soft)
    if estimate.whole(most := FRAMES[kind] * MOST_VOXELS[kind], most) > most_gb * GB:
        print(f"{backend:>8} {K:4} {kind:>7} left out: {estimate.whole(most, most) / GB:.2g} GB")
        return
    found, stage = taken(stages(scene, out, backend, VOXEL_SIZE, "--set", "memory_gb=1000", "--tile-size", "off"))
    (summary,) = semstab.load_result(out).runs
    voxels, observations = summary.table.voxels, summary.table.observations
    own = {"backend": backend, "K": K, "kind": kind, "voxels": voxels}
    whole = estimate.whole(voxels, observations)
    yield {**own, "run": "whole", "bytes": found, "estimate": process + whole, "stage": stage}
    limit, out = whole / 3 / GB, out.with_name(f"{backend}-tiles")
    found, stage = taken(stages(scene, out, backend, VOXEL_SIZE, "--set", f"memory_gb={limit}"))
    tiles = estimate.tiles(voxels, observations, largest_tile(out))
    yield {**own, "run": "tiles", "bytes": found, "estimate": process + tiles, "stage": stage}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backends", nargs="+", default=["numba", "open3d", "numpy"])
    parser.add_argument("--classes", nargs="+", type=int, default=[7, 41, 150])
    parser.add_argument("--kinds", nargs="+", default=["labels", "scores"])
    parser.add_argument("--frames", type=int, help="so many; else 24 with labels and 8 with scores")
    parser.add_argument("--most-gb", type=float, default=4.0, help="leave out maps that are said to take more")
    parser.add_argument("--json", help="also write the figures there")
    arguments = parser.parse_args()
    FRAMES.update(dict.fromkeys(FRAMES, arguments.frames) if arguments.frames else {})
    print(f"{'backend':>8} {'K':>4} {'':>7} {'voxels':>10} {'':>6} {'MB':>7} {'estimate':>9} {'ratio':>6} stage")
    rows = []
    for kind in arguments.kinds:
        for K in arguments.classes:
            with tempfile.TemporaryDirectory() as folder:
                scene = write(Path(folder) / "field", K, kind)
                for backend in arguments.backends:
                    for row in measured(scene, Path(folder) / backend, backend, K, kind, arguments.most_gb):
                        rows.append(row)
                        print(f"{backend:>8} {K:4} {kind:>7} {row['voxels']:10,} {row['run']:>6}", end="")
                        print(f" {row['bytes'] / 1e6:7.0f} {row['estimate'] / 1e6:9.0f}", end="")
                        print(f" {row['estimate'] / row['bytes']:6.2f} {row['stage']}", flush=True)
    if arguments.json:
        write_json(arguments.json, {"rows": rows})


if __name__ == "__main__":
    main()
