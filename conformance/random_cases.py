"""Random cases: the sequences on which the pytest class compares a backend with the reference, as files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from semstab.backends import create
from semstab.conformance.files import EXPECTED, write_case, write_rows
from semstab.data.frames import Frame, Intrinsics

RANDOM = "random:"
"""The name of a random case is this and its seed."""

VOXEL_SIZE, CLASSES = 0.4, 4


def seed_of(name: str) -> int | None:
    """Return the seed of a random case by its name; None for the name of another one."""
    return int(name[len(RANDOM) :]) if re.fullmatch(rf"{RANDOM}\d{{1,9}}", name, re.ASCII) else None


def random_frames(seed: int, count: int = 3, K: int = 4) -> list[Frame]:
    """Return a camera that wanders and turns before a scattered scene.

    Depth has gaps, every other frame has soft scores.
    """
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    frames = []
    for index in range(count):
        T_wc = np.eye(4)
        T_wc[:3, :3] = Rotation.from_euler("xyz", rng.normal(0, 0.2, 3)).as_matrix()
        T_wc[:3, 3] = rng.normal(0, 0.5, 3)
        depth = rng.uniform(0.5, 6, (18, 24)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.1] = rng.choice([0, -1, np.nan, np.inf])
        labels = rng.choice([*range(K), 255], size=depth.shape).astype(np.uint8)
        scores = rng.random((*depth.shape, K), dtype=np.float32)
        soft = index % 2 == 1
        camera = Intrinsics(fx=20, fy=21, cx=11.3, cy=8.8)
        frames.append(Frame(index, depth, camera, T_wc, None if soft else labels, scores if soft else None))
    return frames


def write_random(folder: Path, seed: int) -> None:
    """Write the random case of a seed, with the table of the reference."""
    frames, reference = random_frames(seed, K=CLASSES), create("numpy", voxel_size=VOXEL_SIZE, num_classes=CLASSES)
    for frame in frames:
        reference.integrate(frame)
    write_case(folder, VOXEL_SIZE, CLASSES, frames)
    write_rows(folder / EXPECTED, reference.table())
