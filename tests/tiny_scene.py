"""A scene small enough to work out by hand, written as a posed_folder: a wall that three frames see."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from posed_writer import write_posed

from semstab import Frame, Intrinsics

WIDTH, HEIGHT, FRAMES = 8, 6, 3
FOCAL = 8.0


def write(root: Path, models: tuple[str, ...] = ("a", "b"), frames: int = FRAMES, noise: float = 0.25) -> Path:
    """Write a scene: a camera that looks along z at a wall 2 m away, moving 0.25 m (one pixel) to the right a frame."""
    rng = np.random.default_rng(7)
    truth = [np.tile(((np.arange(WIDTH) + i) // 4 % 3).astype(np.uint8), (HEIGHT, 1)) for i in range(frames)]
    sources = {"gt": truth, **{name: [] for name in models}}
    for labels in truth:
        for model in models:
            wrong = rng.random(labels.shape) < noise
            sources[model].append(np.where(wrong, (labels + 1) % 3, labels).astype(np.uint8))
    views = {name: [frame(i, labels) for i, labels in enumerate(maps)] for name, maps in sources.items()}
    names = [f"{i:04d}" for i in range(frames)]
    return write_posed(root, names, views, classes=["wall", "door", "window"], up_axis="-y")


def frame(i: int, labels: np.ndarray) -> Frame:
    T = np.eye(4)
    T[:3, 3] = [0.25 * i + 0.01, 0.01, 0.01]  # off the voxel faces
    camera = Intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    return Frame(i, np.full((HEIGHT, WIDTH), 2, np.float32), camera, T, labels=labels)
