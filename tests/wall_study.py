"""A study small enough for tests, run for real: two label sources on a wall seen often and on one seen rarely."""

from __future__ import annotations

import dataclasses
import fcntl
import functools
import os
from pathlib import Path

import numpy as np
from posed_config import configure
from posed_writer import write_posed

from semstab import Frame, Intrinsics, Result
from semstab.api import run_study
from semstab.engine import load_result
from semstab.report.figures import write_figures

WIDTH, HEIGHT, FOCAL, FRAMES = 96, 64, 64.0, 9
STEPS = {"often": 0.25, "rarely": 1.0}
"""How far the camera moves from frame to frame, metres, along a wall of which it sees 3 m."""
MODELS = {"calm": 0.05, "nervous": 0.25}
"""How much of the wall each of them gets wrong, anew in every frame."""
CLASSES = ["wall", "door_1", "window & <sill>", "ghost"]


def write_wall(folder: Path, step: float) -> None:
    """A camera that looks along z at a wall 2.03 m away and moves to the right; blocks of 4 x 4 pixels err together."""
    views: dict[str, list[Frame]] = {"gt": [], **{model: [] for model in MODELS}}
    camera = Intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    depth = np.full((HEIGHT, WIDTH), 2.03, np.float32)
    for i in range(FRAMES):
        columns = (np.arange(WIDTH) + i * step * FOCAL / 2.03).astype(int)
        truth = np.tile((columns // 24 % 3).astype(np.uint8), (HEIGHT, 1))
        pose = np.eye(4)
        pose[:3, 3] = [step * i + 0.003, 0.003, 0.0]
        color = np.repeat(truth[..., None] * 80, 3, axis=2).astype(np.uint8)
        views["gt"].append(Frame(i, depth, camera, pose, labels=truth, color=color))
        for k, (model, share) in enumerate(MODELS.items()):
            wrong = np.random.default_rng([k, i]).random((HEIGHT // 4, WIDTH // 4)) < share
            labels = np.where(np.kron(wrong, np.ones((4, 4), bool)), (truth + 1) % 3, truth).astype(np.uint8)
            views[model].append(Frame(i, depth, camera, pose, labels=labels, color=color))
    write_posed(folder, [f"{i:04d}" for i in range(FRAMES)], views, classes=CLASSES, up_axis="-y")


@functools.cache
def wall_study(base: Path) -> tuple[Result, Path]:
    """What the study found, and its folder, made once for all processes of the session; 12.5 ms a frame."""
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = base / "wall study"
    with (base / "wall study.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        result = load_result(folder) if (folder / "summary.json").exists() else made(base, folder)
    records = tuple(dataclasses.replace(record, fuse_ms_per_frame=12.5) for record in result.records)
    return dataclasses.replace(result, records=records), folder


def made(base: Path, folder: Path) -> Result:
    for scene, step in STEPS.items():
        write_wall(base / "walls" / scene, step)
    config = configure(
        base / "walls",
        name="wall & <door>",
        voxel_size=0.0625,
        sweeps={
            "voxel_size": [0.0625, 0.125],
            "depth_noise": {"values": [0, 0.01], "repeats": 2},
            "frame_count": {"values": [5, 9], "scenes": ["often"]},
        },
        backends=["numpy", {"name": "numba", "scenes": ["often"]}],
        check=None,
    )
    result = run_study(config, folder, report=False)
    assert not result.failures
    return result


@functools.cache
def drawn_walls(base: Path) -> tuple[Result, Path, list[Path]]:
    """The part of one model, with a saved frame of one scene; a folder with its figures, and their paths."""
    result, _ = wall_study(base)
    calm = dataclasses.replace(result, records=tuple(r for r in result.records if r.unit.model == "calm"))
    folder = base / "drawn walls"
    (folder / "overview").mkdir(parents=True)
    frame = {"frame": 3, "labels": np.zeros((6, 8), np.uint8), "palette": np.zeros((len(CLASSES), 3), np.uint8)}
    np.savez(folder / "overview" / "often__calm.npz", **frame)
    return calm, folder, write_figures(calm, folder, svg=True)
