"""A map in tiles against the same one at once: peak memory and CPU time of the whole command, and are they the same?

A flight goes to and fro over a field, in legs 40 m apart, with a frame every 30 m: a frame adds about 30,000 voxels of
0.2 m; or --city, the built-in city at these voxel sizes in metres. It is run on one thread, without report, and without
recording unless `--record` asks for it. Tiles are those that --memory-gb asks for, or of --tile-size. Peak is resident
memory of the command, with `--jobs` of its largest process; CPU time is user and system, of all processes, and that of
the stages of a map in microseconds a voxel. All columns of both maps are compared bit by bit, their summaries to 1e-12.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import measuring

K, SIZE = 7, (640, 480)
STAGES = {"fuse": "fuse numba", "table": "table", "statistics": "statistics", "summary": "measure", "write": "write"}


def field(folder: Path, frames: int) -> list[str]:
    """Write a flight; the words that name it."""
    scene = measuring.posed(folder / "field", frames, measuring.to_and_fro(frames, SIZE, K), K)
    return ["--data", str(scene), "--voxel-size", "0.2"]


def main(
    frames: tuple[int, ...] = (50, 150),
    city: tuple[float, ...] = (),
    memory_gb: float = 1.0,
    tile_size: str | None = None,
    jobs: int = 1,
    record: bool = False,
) -> Any:
    table = measuring.MarkdownTable(
        voxels=",", run="", tiles="", peak_GB=".2f", CPU_s=".1f", us_a_voxel=".2f", **dict.fromkeys(STAGES, ".3f")
    )
    forced = ["--tile-size", tile_size] if tile_size else []
    runs = {
        "whole": ["--set", "memory_gb=1000", "--tile-size", "off"],
        "tiles": ["--set", f"memory_gb={memory_gb}", "--jobs", str(jobs), *forced],
    }
    for size in city or frames:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            if city:
                words = ["--scene", "scene0", "--model", "sim-flicker", "--frames", ":40", "--voxel-size", str(size)]
            else:
                words = field(folder, int(size))
            for run, more in runs.items():
                out = folder / run
                words_of_run = (*words, "--no-geometry-check", *more)
                process, stages = measuring.staged(out, *words_of_run, recording=record, NUMBA_NUM_THREADS="1")
                voxels = sum(one["voxels"] for one in json.loads((out / "summary.json").read_text())["runs"])
                seconds = {
                    stage: stages.get(part, {}).get("own_s" if stage == "fuse" else "all_s", 0.0)
                    for stage, part in STAGES.items()
                }
                table.add(
                    voxels=voxels, run=run, size=size, tiles=len(list((out / "voxels").glob("*/tile=*"))),
                    peak_GB=stages["all"]["peak_gb"], CPU_s=process.cpu_s, us_a_voxel=1e6 * process.cpu_s / voxels,
                    **{stage: 1e6 * taken / voxels for stage, taken in seconds.items()},
                )  # fmt: skip
            measuring.same(folder / "whole", folder / "tiles")
    return table.rows
