"""A posed folder without labels, whose images a camera takes that moves along a painted wall."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pictures import blobs
from posed_writer import write_posed

from semstab import Frame, Intrinsics

HEIGHT, WIDTH, FOCAL = 48, 80, 40.0


def write(folder: Path, frames: int = 6, depth_scale: int = 1) -> Path:
    """Each frame is 2 pixels (0.1 m) further; `depth_scale` divides the depth's size, not what it shows."""
    return write_posed(
        folder, [f"{k:03d}" for k in range(frames)], {"": [frame(k, depth_scale) for k in range(frames)]}
    )


def frame(k: int, depth_scale: int) -> Frame:
    f, h, w = FOCAL / depth_scale, HEIGHT // depth_scale, WIDTH // depth_scale
    T = np.eye(4)
    T[0, 3] = 0.1 * k
    nothing = np.zeros((h, w), np.uint8)
    camera = Intrinsics(f, f, (w - 1) / 2, (h - 1) / 2)
    return Frame(k, np.full((h, w), 2, np.float32), camera, T, labels=nothing, color=image(k))


def image(k: int, seed: int = 0) -> np.ndarray:
    """What frame k shows."""
    return blobs(HEIGHT, WIDTH, seed=seed, shift=2 * k)
