"""Is the ceiling that of the truth, whatever part of the labels is wrong?

    python simulations/ceiling.py [--frames 30] [--seed 0]

A camera walks about a furnished room (tests/room_scene.py) whose classes are those of its furniture, or cubes of 17 cm,
which voxels hold several of. Blobs of labels are wrong, anew in each frame. Prints a table in Markdown: alpha between
frames, the ceiling and the share of it that alpha reaches, and both by fusing the truth of the same frames.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from semstab.model.frames import Frame, Intrinsics
from semstab.statistics import Sampler, alpha_between
from semstab.statistics.accumulate import cluster_sums_of
from semstab.statistics.cluster_sums import value

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import room_scene

W, H, FOCAL, K = 320, 240, 266.0, 5
CAMERA = Intrinsics(FOCAL, FOCAL, (W - 1) / 2, (H - 1) / 2)
BLOB, CUBE = 12.0, 0.17
"""Pixels of the blur from which blobs come, and metres along the edge of a cube of one class."""


def views(frames: int) -> Iterator[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.intp]]]:
    """Yield each frame's pose, depth and piece of furniture."""
    rays = np.stack([*np.meshgrid((np.arange(W) - CAMERA.cx) / FOCAL, (np.arange(H) - CAMERA.cy) / FOCAL), ONES], -1)
    for T in room_scene.walk(frames):
        depth, seen = room_scene.cast(rays @ T[:3, :3].T, T[:3, 3])
        points = (rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3]
        yield T, depth, np.stack([seen, (np.floor(points / CUBE + 1e-6) @ [7, 3, 5] % K).astype(np.intp)])


ONES = np.ones((H, W))


def row(made: list[Frame], true: list[Frame], size: float) -> list[float]:
    """Alpha, its ceiling and share; the same from the truth."""
    own, right = Sampler(size, K), Sampler(size, K)
    for frame, other in zip(made, true, strict=True):
        own.add(frame)
        right.add(other)
    sample = own.sample()
    table = sample.seen.table()
    sums, limit = cluster_sums_of(table, sample=sample), alpha_between(right.sample().seen.table())
    alpha = alpha_between(table)
    return [alpha, value(sums, "ceiling"), limit, value(sums, "reached"), alpha / limit]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    seen = list(views(arguments.frames))
    print("| classes | noise of depth, % | wrong, % | voxel, m | alpha | ceiling | by truth | share | by truth |")
    print("|---|---|---|---|---|---|---|---|---|")
    for which, name in enumerate(("furniture", "cubes")):
        for noise, wrong in ((0.0, 0.1), (0.0, 0.25), (0.0, 0.4), (0.005, 0.25), (0.005, 0.4)):
            made, true = [], []
            for index, (T, depth, classes) in enumerate(seen):
                rng = np.random.default_rng([arguments.seed, index])
                blurred = cv2.GaussianBlur(rng.standard_normal((H, W)), (0, 0), BLOB)
                errs = blurred > np.quantile(blurred, 1 - wrong)
                noisy = (depth * (1 + noise * rng.standard_normal(depth.shape))).astype(np.float32)
                for frames, labels in ((made, (classes[which] + errs) % K), (true, classes[which])):
                    frames.append(Frame(index, noisy, CAMERA, T, labels.astype(np.uint8)))
            for size in (0.005, 0.01, 0.02, 0.05):
                numbers = " | ".join(f"{x:.3f}" for x in row(made, true, size))
                print(f"| {name} | {100 * noise:g} | {100 * wrong:g} | {size:g} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
