"""Costs of the recording: the command line on a folder of PNGs and colour JPEGs, with a recording and without.

The folder is the folder of `end-to-end` (16-bit depth with noise, 8-bit labels), with colour as JPEG of the quality
that cameras use. Runs with and without take turns, bound to the same cores, on files in the page cache; the figures are
medians. One unmeasured start of each compiles what is compiled on first use. `run` is the whole process by the clock,
`CPU` its user and system time, `loop` reading, flicker, fusion and observers, by manifest.json; `ratio` is with by
without. It also says how large the recording is.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import cv2
import measuring
import numpy as np
from timed.end_to_end import LOOP, rendered, write_scene

JPEG_QUALITY = 92


def write_color(root: Path, views: list[Any], size: tuple[int, int]) -> None:
    """color/NAME.jpg of each view, with grain as cameras have it."""
    (root / "color").mkdir()
    rng = np.random.default_rng(1)
    for view in views:
        color = cv2.resize(view.color[..., ::-1], size, interpolation=cv2.INTER_LINEAR).astype(np.int16)
        grain = rng.normal(0, 4, (*color.shape[:2], 1)).astype(np.int16)
        image = np.clip(color + grain, 0, 255).astype(np.uint8)
        cv2.imwrite(str(root / "color" / f"{view.index:04d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])


def main(
    size: str = "1920x1080",
    frames: int = 40,
    noise: float = 10.0,
    backend: str = "numba",
    runs: int = 3,
    threads: int = 2,
) -> Any:
    measuring.use_cores(threads)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "scene"
        views = rendered(measuring.sides(size), frames)
        write_scene(root, views, measuring.sides(size), noise)
        write_color(root, views, measuring.sides(size))

        def run(recording: bool) -> dict[str, float]:
            with tempfile.TemporaryDirectory() as out:
                words = ("--check", "none", "--backend", backend, "--data", root, "--set", f"threads={threads}")
                process = measuring.command(Path(out), *words, recording=recording)
                spent, file = measuring.seconds_of(Path(out)), Path(out) / "recording.rrd"
                loop = sum(spent.get(f"fuse {backend}" if stage == "fuse" else stage, 0.0) for stage in LOOP)
                megabytes = file.stat().st_size / 1e6 if recording else 0.0
            ms = 1e3 / frames
            return {
                "run_s": process.wall_s, "CPU_s": process.cpu_s, "loop_ms": ms * loop,
                "observers_ms": ms * spent.get("observe", 0.0), "recording_MB": megabytes,
            }  # fmt: skip

        works = {"with": lambda: run(True), "without": lambda: run(False)}
        taken = {name: measuring.medians(rows) for name, rows in measuring.in_turns(works, runs).items()}
    table = measuring.MarkdownTable(
        recording="", run_s=".2f", CPU_s=".2f", loop_ms=".1f", observers_ms=".1f", recording_MB=".1f"
    )
    for name, row in taken.items():
        table.add(recording=name, **row)
    ratios = {name: taken["with"][name] / taken["without"][name] for name in ("run_s", "CPU_s", "loop_ms")}
    table.add(recording="ratio", **ratios)
    return table.rows
