"""A study small enough for a test: two models on a wall, several sweeps, and its numbers without times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import posed_config
import tiny_scene
from posed_config import dataset_of

from semstab.config import Config
from semstab.core.files import read_sealed
from semstab.engine import Observer

FRAMES = 10
TIMES = ("fuse_ms_per_frame", "stages_ms")

SWEEPS = {
    "voxel_size": [0.25, 0.5], "depth_noise": {"values": [0, 0.05], "repeats": 2},
    "frame_count": {"values": [5, 10], "models": ["a"]}, "pixel_stride": [1, 2],
}  # fmt: skip


def write(root: Path, **scene: Any) -> Path:
    """The wall, seen by ten frames."""
    return tiny_scene.write(root, **{"frames": FRAMES, **scene})


def content(root: Path, **settings: Any) -> dict[str, Any]:
    """Settings of a study of the scene, or the scenes, in a folder."""
    return {
        "name": "tiny", "dataset": dataset_of(root), "voxel_size": 0.25, "frames": {"spacing": "even", "count": 5},
        "sweeps": SWEEPS, "backends": ["numpy", "numba"], "check": None, "check_geometry": False, **settings,
    }  # fmt: skip


def configure(root: Path, **settings: Any) -> Config:
    return posed_config.configure(root, **content(root, **settings))


def summary(out: Path) -> dict[str, Any]:
    """The study's summary.json without timings and its digest: what must come out the same."""
    found = read_sealed(out / "summary.json")
    runs = [{key: value for key, value in run.items() if key not in TIMES} for run in found["runs"]]
    return {**found, "runs": runs}


class Counting(Observer):
    """What was wanted, kept and computed."""

    def __init__(self) -> None:
        self.units = self.kept = 0
        self.computed: list[str] = []
        self.failed: list[str] = []

    def run_started(self, plan, finished) -> None:
        self.units, self.kept = len(plan.distinct()), len(finished)

    def unit_finished(self, cell, content, table, error) -> None:
        value = cell.variation.value
        what = f"{cell.name.slug} {cell.variation.sweep} {value if value is None else f'{value:g}'}"
        (self.computed if error is None else self.failed).append(what)


class Interrupting(Counting):
    """Ctrl-C after so many units."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self.after = after

    def unit_finished(self, cell, content, table, error) -> None:
        super().unit_finished(cell, content, table, error)
        if len(self.computed) == self.after:
            raise KeyboardInterrupt
