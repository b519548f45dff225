"""CPU time of a frame of scenes drawn at random, and of Open3D's own VoxelBlockGrid.integrate on the same frames.

scenes.py draws geometry, height, pitch, field of view, range, resolution, classes, size of the voxels and errors of the
labels; noise is the standard deviation of depth, in per cent of it or in voxels at the median depth. As in `fusion`,
times are those of later frames, most of whose voxels are known, user and system time of all threads; 'faster' is
Open3D's own time over that of the backend. A backend is left out of a scene where its map is said to take more than
--most-gb.

The roofline is about frames that touch so --many voxels. Floor are the bytes that have to move: the image once, and of
each voxel the lines of the cache with its slot, and with its record, which is also written; the rate is that of a copy
of one thread, and the share is the floor's time over that of the backend.
"""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from statistics import median
from typing import Any

import measuring
import numpy as np
import scenes
from timed import fusion

import semstab
from semstab.backends import create, expected_bytes
from semstab.backends.numba_loops import record_types
from semstab.backends.shared.observations import LINE

FRAMES = 2
RECORD, _ = record_types(np.dtype(np.float64))
COPIED = 1 << 28


def copy_rate() -> float:
    """Bytes a second, read and written, of a copy in memory by one thread: the best of several."""
    source, target = np.ones(COPIED, dtype=np.uint8), np.empty(COPIED, dtype=np.uint8)
    return 2e3 * COPIED / min(measuring.cpu_ms(np.copyto, target, source) for _ in range(5))


def floor_bytes(frame: semstab.Frame, voxels: int) -> int:
    """Bytes that have to move: the frame's, and whole lines of the cache of the voxels' slots and records."""
    lines = 1 + 2 * -(-RECORD.itemsize // LINE)
    return frame.depth.nbytes + frame.labels.nbytes + voxels * lines * LINE


def measured(
    scene: scenes.SceneSettings,
    views: Any,
    size: float,
    noise: str,
    share: float,
    names: Any,
    most_gb: float,
    rounds: int,
) -> Any:
    """The row of a scene at a level of noise, a share of depth."""
    frames = [scenes.spoilt(scene, view, share) for view in views]
    for frame in frames:
        fusion.prepare(frame)
    counter = create("numba", voxel_size=size, num_classes=scene.K)
    reports = [counter.integrate(frame) for frame in frames]
    voxels, map_voxels = reports[-1].voxels, reports[-1].map_voxels
    del counter
    fit = [name for name in names if expected_bytes(name, map_voxels, map_voxels, scene.K) < most_gb * 1e9]
    times = fusion.measure(frames, scene.K, size, (fusion.BASELINE, *fit), rounds)
    baseline_ms = times[fusion.BASELINE]["later_ms"]
    return (
        dataclasses.asdict(scene) | {"voxel_size": size, "noise": noise, "voxels": voxels}
        | {"floor_bytes": floor_bytes(frames[-1], voxels), "integrate_ms": baseline_ms}
        | {f"{name}_ms": times[name]["later_ms"] if name in fit else None for name in names}
        | {f"{name}_faster": baseline_ms / times[name]["later_ms"] if name in fit else None for name in names}
    )  # fmt: skip


def main(
    scenes_: int = 20,
    seed: int = 0,
    percent: tuple[float, ...] = (0.0, 0.3, 1.0),
    voxels: tuple[float, ...] = (0.25, 0.75, 2.0),
    sizes: tuple[str, ...] = tuple(f"{w}x{h}" for w, h in scenes.SIZES),
    backends: tuple[str, ...] = ("numba", "open3d"),
    most_gb: float = 3.0,
    rounds: int = 3,
    many: int = 1_000_000,
    csv_: Path | None = None,
) -> Any:
    backend_columns = {f"{name}_{what}": spec for name in backends for what, spec in (("ms", ".1f"), ("faster", ".2f"))}
    table = measuring.MarkdownTable(
        seed="",
        kind="",
        width="",
        height="",
        K="",
        voxel_size="g",
        noise="",
        voxels=",",
        integrate_ms=".1f",
        **backend_columns,
    )
    for number in range(seed, seed + scenes_):
        scene = scenes.drawn(number, tuple(map(measuring.sides, sizes)))
        views, size, middle = scenes.views(scene, FRAMES)
        shares = {f"{level:g} %": level / 100 for level in percent}
        shares |= {f"{level:g} voxels": level * size / middle for level in voxels}
        for level, share in shares.items():
            table.add(**measured(scene, views, size, level, share, backends, most_gb, rounds))
    print()
    ratios = measuring.MarkdownTable(noise="", backend="", scenes="", median=".2f", worst=".2f")
    for level in dict.fromkeys(row["noise"] for row in table.rows):
        for name in backends:
            found = [row[f"{name}_faster"] for row in table.rows if row["noise"] == level and row[f"{name}_faster"]]
            if found:
                ratios.add(noise=level, backend=name, scenes=len(found), median=median(found), worst=min(found))
    if large := [row for row in table.rows if row["voxels"] >= many and row[f"{backends[0]}_ms"]]:
        rate = copy_rate()
        print(f"\nroofline of {backends[0]}, a copy moves {rate / 1e9:.1f} GB/s\n")
        roofline = measuring.MarkdownTable(seed="", noise="", voxels=",", MB_at_least=".0f", ms=".1f", share=".0%")
        for row in large:
            ms = row[f"{backends[0]}_ms"]
            row["share"] = row["floor_bytes"] / rate / (ms / 1e3)
            roofline.add(**row, MB_at_least=row["floor_bytes"] / 1e6, ms=ms)
    if csv_:
        with csv_.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(
                file, list(dict.fromkeys(name for row in table.rows for name in row)), lineterminator="\n"
            )
            writer.writeheader()
            for row in table.rows:
                writer.writerow(
                    {name: f"{value:.5g}" if isinstance(value, float) else value for name, value in row.items()}
                )
    return table.rows
