"""Costs of a frame without its pixels: opening and planning a long sequence, and the memory that a run takes a frame.

A posed folder of tiny frames, of which all but 50 are links. CPU seconds and resident memory in MB after each step:
open the scene, select frames (each pose is read: tracking may have been lost), hash the input, pickle what a task is
sent of a stretch of 4096 frames. Then the command fuses a growing number of its frames: peak memory, and the memory
that a frame adds. The camera goes over new ground, or with --still back and forth over the same ground, and then the
map does not grow.
"""

from __future__ import annotations

import os
import pickle
import tempfile
from pathlib import Path
from typing import Any

import measuring
import numpy as np

from semstab import Frame, Intrinsics
from semstab.config import Config
from semstab.datasets import open_dataset
from semstab.engine.units import make_plan
from semstab.engine.work import Start, UnitTile, Work

WIDTH, HEIGHT, OWN, LEG = 16, 12, 50, 500


def write(root: Path, count: int, *, still: bool) -> Path:
    """Write a sequence of `count` frames in legs, or over one place; some images are links to others."""
    rng, frames = np.random.default_rng(0), []
    for index in range(OWN):
        depth = (rng.integers(5000, 6000, (HEIGHT, WIDTH)) / 1000).astype(np.float32)
        labels = rng.integers(0, 3, (HEIGHT, WIDTH)).astype(np.uint8)
        camera = Intrinsics(WIDTH, WIDTH, WIDTH / 2, HEIGHT / 2)
        frames.append(Frame(index, depth, camera, np.eye(4), labels=labels))
    measuring.posed(root, OWN, frames, 3, scale=1000)
    for index in range(count):
        leg, along = (0, index % 4) if still else divmod(index, LEG)
        x = along if leg % 2 == 0 else LEG - 1 - along
        (root / f"pose/{index:05d}.txt").write_text(f"1 0 0 {0.5 * x}\n0 1 0 {2.0 * leg}\n0 0 1 0\n0 0 0 1\n")
        for folder in ("depth", "labels/a") if index >= OWN else ():
            os.link(root / folder / f"{index % OWN:05d}.png", root / folder / f"{index:05d}.png")
    return root


def main(frames: int = 100_000, fused: tuple[int, ...] = (2000, 10_000), still: bool = False) -> Any:
    table, dataset = measuring.MarkdownTable(step="", CPU_s=".2f", MB=".0f"), "posed_folder"

    def step(name: str, work: Any) -> Any:
        found: list[Any] = []
        ms = measuring.cpu_ms(lambda: found.append(work()))
        table.add(step=name, CPU_s=ms / 1e3, MB=measuring.resident_bytes() / 1e6)
        return found[0]

    with tempfile.TemporaryDirectory() as folder:
        root = write(Path(folder) / "long", frames, still=still)
        options = {"root": str(root)}
        settings = {"dataset": {"name": dataset, "options": options}, "voxel_size": 0.5, "backends": ["numba"]}
        step("open", lambda: open_dataset(dataset, options).scene(root.name))
        (unit,) = step("open again, select frames", lambda: make_plan(Config.model_validate(settings))).units
        step("hash the input", lambda: unit.task.digest)
        tile = UnitTile("", 64, (0, 0))
        work = Work.from_unit(unit, Start("", root)).in_tile(tile, unit.task.indices[:4096])
        sent = step("pickle a task of 4096 frames", lambda: pickle.dumps(work))
        print(f"\nthe pickled task has {len(sent) / 1e3:.0f} kB\n")
        peaks = measuring.MarkdownTable(fused_frames=",", peak_MB=".0f", kB_a_further_frame=".1f")
        for count in fused:
            words = ("--data", root, "--frames", f"0:{count}", "--voxel-size", "0.5", "--check", "none")
            peak = 1e3 * measuring.command(Path(folder) / f"run{count}", *words, "--no-geometry-check").peak_gb
            first = peaks.rows[0] if peaks.rows else None
            more = 1e3 * (peak - first["peak_MB"]) / (count - first["fused_frames"]) if first else None
            peaks.add(fused_frames=count, peak_MB=peak, kB_a_further_frame=more)
    return {"steps": table.rows, "peaks": peaks.rows}
