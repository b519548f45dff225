"""A posed folder without labels, whose images a camera takes that moves along a painted wall."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pictures import blobs
from PIL import Image

HEIGHT, WIDTH, FOCAL = 48, 80, 40.0


def write(folder: Path, frames: int = 6, depth_scale: int = 1) -> Path:
    """Each frame is 2 pixels (0.1 m) further; `depth_scale` divides the depth's size, not what it shows."""
    for part in ("depth", "pose", "color"):
        (folder / part).mkdir(parents=True)
    f, h, w = FOCAL / depth_scale, HEIGHT // depth_scale, WIDTH // depth_scale
    np.savetxt(folder / "intrinsics.txt", [[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])
    for k in range(frames):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * k
        np.savetxt(folder / "pose" / f"{k:03d}.txt", pose)
        Image.fromarray(np.full((h, w), 2000, dtype=np.uint16)).save(folder / "depth" / f"{k:03d}.png")
        Image.fromarray(image(k)).save(folder / "color" / f"{k:03d}.png")
    return folder


def image(k: int, seed: int = 0) -> np.ndarray:
    """What frame k shows."""
    return blobs(HEIGHT, WIDTH, seed=seed, shift=2 * k)
