"""Does a run take what the memory estimate says? Measured peak of the whole command against it, at once and in tiles.

    python tests/perf/bench_memory.py [--backends numba open3d] [--classes 7 41] [--kinds labels scores] [--json FILE]

What a map takes is the peak of a stage less that of the same stage where the same frames are fused into a few voxels
of 8 m: the program, what it imports and frames that are read ahead are in both. Estimates are of the voxels and
observations that there were; in tiles, of the largest part, where `memory_gb` is a third of what the whole map takes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import flight
import numpy as np

import semstab
from semstab.engine.sizing import SHARE
from semstab.engine.tiling.partition import tiled
from semstab.engine.tiling.sights import Sights
from semstab.engine.work.memory import GB, Kind
from semstab.runtime.files import write_json

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from posed_writer import write_posed  # noqa: E402

VOXEL_SIZE, FEW = 0.2, 8.0
FRAMES = {"labels": 24, "scores": 8}
SIZE = {"labels": (640, 480), "scores": (320, 240)}


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
               "--voxel-size", str(voxel_size), "--backend", backend, "--trust-geometry", "--report", "off", "--quiet",
               "--rerun", "off", *options]  # fmt: skip
    subprocess.run(command, check=True)
    return {name: stage["peak_gb"] for name, stage in json.loads(watched.read_text()).items()}


def above(found: dict[str, float], program: dict[str, float]) -> tuple[float, str]:
    """Bytes that the map took, and in which stage."""
    more = {name: peak - program.get(name, peak) for name, peak in found.items() if name not in ("beside", "all")}
    stage = max(more, key=more.__getitem__)
    return more[stage] * GB, stage


def largest_part(out: Path, kind: Kind, memory_gb: float, observed: float) -> float:
    """Bytes of the largest part of a run in tiles, as estimated; `observed` is how often a voxel is seen."""
    (file,) = (out / "sights").iterdir()
    sights = Sights.load(file)
    assert sights is not None
    parts = tiled(sights, kind.bytes, SHARE * memory_gb * GB).parts
    return max(kind.bytes(part.voxels, observed * part.voxels) for part in parts)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backends", nargs="+", default=["numba", "open3d", "numpy"])
    parser.add_argument("--classes", nargs="+", type=int, default=[7, 41, 150])
    parser.add_argument("--kinds", nargs="+", default=["labels", "scores"])
    parser.add_argument("--json", help="also write the figures there")
    arguments = parser.parse_args()
    print(f"{'backend':>8} {'K':>4} {'':>7} {'voxels':>10} {'':>6} {'MB':>7} {'estimate':>9} {'ratio':>6} stage")
    rows = []
    for kind in arguments.kinds:
        for K in arguments.classes:
            with tempfile.TemporaryDirectory() as folder:
                scene = write(Path(folder) / "field", K, kind)
                for backend in arguments.backends:
                    out, whole = Path(folder) / backend, ["--set", "memory_gb=1000", "--tile-size", "off"]
                    program = stages(scene, out.with_name(f"{backend}-few"), backend, FEW, *whole)
                    found, stage = above(stages(scene, out, backend, VOXEL_SIZE, *whole), program)
                    (summary,) = semstab.load_result(out).runs
                    voxels, looks = summary.table.voxels, summary.table.observations
                    of = Kind(backend, K, soft=kind == "scores", sampled=backend == "numba")
                    expected = of.bytes(voxels, looks)
                    limit, out = expected / 3 / GB, out.with_name(f"{backend}-tiles")
                    small = stages(scene, out, backend, VOXEL_SIZE, "--set", f"memory_gb={limit}")
                    parts, inside = above(small, program)
                    largest = largest_part(out, of, limit, looks / voxels)
                    for name, took, said, where in (
                        ("whole", found, expected, stage),
                        ("tiles", parts, largest, inside),
                    ):
                        rows.append({"backend": backend, "K": K, "kind": kind, "voxels": voxels, "run": name,
                                     "bytes": took, "estimate": said, "stage": where})  # fmt: skip
                        print(f"{backend:>8} {K:4} {kind:>7} {voxels:10,} {name:>6} {took / 1e6:7.0f}", end="")
                        print(f" {said / 1e6:9.0f} {said / took:6.2f} {where}", flush=True)
    if arguments.json:
        write_json(arguments.json, {"rows": rows})


if __name__ == "__main__":
    main()
