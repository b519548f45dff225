"""A scene small enough to work out by hand, written as a posed_folder: a wall that three frames see."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FRAMES = 8, 6, 3
FOCAL = 8.0


def write(root: Path, backbones: tuple[str, ...] = ("a", "b"), frames: int = FRAMES, noise: float = 0.25) -> Path:
    """Write a scene: a camera that looks along z at a wall 2 m away, moving 0.25 m (one pixel) to the right a frame."""
    rng = np.random.default_rng(7)
    for folder in ("depth", "pose", "labels/gt", *(f"labels/{name}" for name in backbones)):
        (root / folder).mkdir(parents=True, exist_ok=True)
    np.savetxt(root / "intrinsics.txt", [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    (root / "scene.yaml").write_text("classes: [wall, door, window]\nup_axis: -y\n")
    for i in range(frames):
        name = f"{i:04d}"
        columns = np.arange(WIDTH) + i  # the wall's own coordinate, in pixels
        truth = np.tile((columns // 4 % 3).astype(np.uint8), (HEIGHT, 1))
        cv2.imwrite(str(root / "depth" / f"{name}.png"), np.full((HEIGHT, WIDTH), 2000, np.uint16))
        pose = np.eye(4)
        pose[:3, 3] = [0.25 * i + 0.01, 0.01, 0.01]  # off the voxel faces
        np.savetxt(root / "pose" / f"{name}.txt", pose)
        cv2.imwrite(str(root / "labels/gt" / f"{name}.png"), truth)
        for backbone in backbones:
            wrong = rng.random(truth.shape) < noise
            cv2.imwrite(str(root / f"labels/{backbone}" / f"{name}.png"), np.where(wrong, (truth + 1) % 3, truth))
    return root
