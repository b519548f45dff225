"""Does a run take what the memory estimate says? Measured peak of the whole command against it, at once and in tiles.

What a run takes is the peak of the whole command less what it has when it is planned (0.22 GB, with Open3D 0.36). The
estimate is of all of that: what is loaded later, frames, and the map with what comes of it, of as many voxels and
observations as there were; in tiles, where `memory_gb` is a third of what the whole map takes, with a tile as large as
the largest one was. Maps that are said to take more than --most-gb are left out.
"""

from __future__ import annotations

import dataclasses
import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import flight
import measuring
import numpy as np

import semstab
from semstab.data.voxels import VoxelTable
from semstab.engine.memory import GB, MapMemory, process_bytes

VOXEL_SIZE = 0.2
FRAMES = {"labels": 24, "scores": 8}
SIZE, MOST_VOXELS = {"labels": (640, 480), "scores": (320, 240)}, {"labels": 74_000, "scores": 60_000}


def flown(count: int, K: int, kind: str) -> Iterator[semstab.Frame]:
    """A flight of frames with labels, or with the scores of a softmax."""
    for index in range(count):
        frame = flight.frame(index, *SIZE[kind], K, (40.0 * (index // 8), 30.0 * (index % 8)))
        if kind == "scores":
            rng = np.random.default_rng(index)
            logits = rng.standard_normal((*frame.shape, K), dtype=np.float32)
            np.put_along_axis(logits, frame.labels[..., None].astype(np.int64), 6.0, axis=2)
            scores = np.exp(logits)
            scores /= scores.sum(axis=2, keepdims=True)
            frame = dataclasses.replace(frame, labels=None, scores=scores.astype(np.float16))
        yield frame


def main(
    backends: tuple[str, ...] = ("numba", "open3d", "numpy"),
    classes: tuple[int, ...] = (7, 41, 150),
    kinds: tuple[Literal["labels", "scores"], ...] = ("labels", "scores"),
    frames: int | None = None,
    most_gb: float = 4.0,
) -> Any:
    table = measuring.MarkdownTable(
        backend="", K="", kind="", voxels=",", run="", MB=".0f", estimate_MB=".0f", ratio=".2f", stage=""
    )
    for kind, K in itertools.product(kinds, classes):
        with tempfile.TemporaryDirectory() as name:
            folder, count = Path(name), frames or FRAMES[kind]
            scene = measuring.posed(folder / "field", count, flown(count, K, kind), K)
            for backend in backends:
                memory = MapMemory(backend, K, soft=kind == "scores", sampled=backend == "numba")
                if memory.whole(most := count * MOST_VOXELS[kind], most) <= most_gb * GB:
                    for row in measured(scene, folder / backend, memory, backend, K, kind):
                        table.add(backend=backend, K=K, kind=kind, **row)
    return table.rows


def measured(scene: Path, out: Path, memory: MapMemory, backend: str, K: int, kind: str) -> Iterator[dict[str, Any]]:
    """At once, then in tiles."""
    process = process_bytes(flight.frame(0, *SIZE[kind], K), K, None, soft=memory.soft)
    words = ("--data", scene, "--voxel-size", str(VOXEL_SIZE), "--backend", backend, "--no-geometry-check")

    def row(run: str, out: Path, *more: str) -> tuple[dict[str, Any], Any]:
        stages = {name: numbers["peak_gb"] for name, numbers in measuring.staged(out, *words, *more)[1].items()}
        stage = max((name for name in stages if name not in ("beside", "all")), key=stages.__getitem__)
        (unit,) = semstab.load_result(out).runs
        taken = (stages["all"] - stages["digest"]) * GB
        return {"run": run, "voxels": unit.map_summary.voxels, "MB": taken / 1e6, "stage": stage}, unit.map_summary

    def said(row: dict[str, Any], estimate: float) -> dict[str, Any]:
        megabytes = (process + estimate) / 1e6
        return row | {"estimate_MB": megabytes, "ratio": megabytes / row["MB"]}

    whole, table = row("whole", out, "--set", "memory_gb=1000", "--tile-size", "off")
    estimate = memory.whole(table.voxels, table.observations)
    yield said(whole, estimate)
    out = out.with_name(f"{backend}-tiles")
    tiles, table = row("tiles", out, "--set", f"memory_gb={estimate / 3 / GB}")
    largest = max(map(len, VoxelTable.iter_tiles(next((out / "voxels").iterdir()))))
    yield said(tiles, memory.tiles(table.voxels, table.observations, largest))
