"""Is alpha that of the same spot, whatever the voxels, the strides and the noise of depth are?

    python simulations/cells.py [--frames 30] [--seed 0]

A camera walks about a furnished room (tests/room_scene.py) whose classes are those of its furniture, or cubes of 17 cm.
Blobs of labels are wrong, anew in each frame. Prints a table in Markdown: alpha of points of the true surface in the
spots; alpha of spots at strides of 1 to 8 pixels; and alpha of voxels of 1 to 8 cm.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from semstab import backends
from semstab.data.frames import Frame, Intrinsics
from semstab.statistics import Sampler, krippendorff_alpha
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import value

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import room_scene

W, H, FOCAL, K = 320, 240, 266.0, 5
CAMERA = Intrinsics(FOCAL, FOCAL, (W - 1) / 2, (H - 1) / 2)
BLOB, CUBE = 12.0, 0.17
"""Pixels of the blur from which blobs come, and metres along the edge of a cube of one class."""

STRIDES, SIZES = (1, 2, 4, 8), (0.01, 0.02, 0.04, 0.08)
"""Pixels of which one is taken along each axis, and voxels in metres."""

CONDITIONS = ((0.0, 0.1), (0.0, 0.25), (0.0, 0.4), (0.005, 0.25))
"""Noise of depth, relative, and the share of the labels that are wrong."""


VISIBLE = 0.02
"""How far depth may differ, relative, where a frame shows a point."""

Seen = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.intp]]


def views(frames: int) -> Iterator[Seen]:
    """Yield each frame's pose, depth and classes: of the furniture, and of cubes."""
    rays = np.stack([*np.meshgrid((np.arange(W) - CAMERA.cx) / FOCAL, (np.arange(H) - CAMERA.cy) / FOCAL), ONES], -1)
    for T in room_scene.walk(frames):
        depth, seen = room_scene.cast(rays @ T[:3, :3].T, T[:3, 3])
        points = (rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3]
        yield T, depth, np.stack([seen, (np.floor(points / CUBE + 1e-6) @ [7, 3, 5] % K).astype(np.intp)])


ONES = np.ones((H, W))


def spots(seen: list[Seen]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """A point (n, 3) of the true surface in each sampled cell, and the frames (n, F) that have a pixel in that cell."""
    sampler, found = Sampler(K), []
    for index, (T, depth, _) in enumerate(seen):
        labels = np.full((H, W), index % K, np.uint8)
        sampler.add(Frame(index, depth.astype(np.float32), CAMERA, T, labels))
        v, u = np.mgrid[:H, :W].reshape(2, -1)
        rays = np.stack([(u - CAMERA.cx) / FOCAL, (v - CAMERA.cy) / FOCAL, np.ones(len(u))], axis=1)
        found.append(rays * depth[v, u, None] @ T[:3, :3].T + T[:3, 3])
    log, points = sampler.sample().observations(), np.concatenate(found)
    cells, first = np.unique(np.floor(points / log.voxel_size).astype(int), axis=0, return_index=True)
    sampled, shown = np.stack([log.ix, log.iy, log.iz], axis=1), np.zeros((len(log.ix), len(seen)), bool)
    shown[log.voxel, log.frame] = True
    _, of = np.unique(np.concatenate([cells, sampled]), axis=0, return_inverse=True)
    _, point, cell = np.intersect1d(of[: len(cells)], of[len(cells) :], return_indices=True)
    return points[first[point]], shown[cell]


def at_the_same_spot(
    points: npt.NDArray[np.float64], shown: npt.NDArray[np.bool_], seen: list[Seen], frames: list[Frame]
) -> float:
    """Krippendorff's alpha with points as units: the label of the pixel that each frame shows a point in."""
    counts = np.zeros((len(points), K))
    for own, (T, depth, _), frame in zip(shown.T, seen, frames, strict=True):
        x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
        z = np.maximum(z, 1e-9)
        u, v = (np.rint(FOCAL * a / z + c).astype(int) for a, c in ((x, CAMERA.cx), (y, CAMERA.cy)))
        inside = np.flatnonzero(own & (u >= 0) & (u < W) & (v >= 0) & (v < H))
        seen_here = inside[np.abs(depth[v[inside], u[inside]] / z[inside] - 1) < VISIBLE]
        counts[seen_here, frame.labels[v[seen_here], u[seen_here]]] += 1
    counts = counts[counts.sum(axis=1) >= 2]
    times, total = counts.sum(axis=1), counts.sum(axis=0)
    agreeing = (((counts**2).sum(axis=1) - times) / (times - 1)).sum() / times.sum()
    chance = (total * (total - 1)).sum() / (total.sum() * (total.sum() - 1))
    return float(1 - (1 - agreeing) / (1 - chance))


def of_cells(frames: list[Frame], stride: int) -> float:
    """Alpha of spots."""
    sampler = Sampler(K)
    for frame in frames:
        sampler.add(frame.every(stride))
    return value(sums_of_spots(sampler.sample()), "alpha")


def of_voxels(frames: list[Frame], size: float) -> float:
    """Krippendorff's alpha of voxels."""
    backend = backends.create("numba", voxel_size=size, num_classes=K)
    for frame in frames:
        backend.integrate(frame)
    return krippendorff_alpha(backend.table())


def made(seen: list[Seen], which: int, noise: float, wrong: float, seed: int) -> list[Frame]:
    """The frames of a model, some of whose labels are wrong."""
    frames = []
    for index, (T, depth, classes) in enumerate(seen):
        rng = np.random.default_rng([seed, index])
        blurred = cv2.GaussianBlur(rng.standard_normal((H, W)), (0, 0), BLOB)
        labels = (classes[which] + (blurred > np.quantile(blurred, 1 - wrong))) % K
        noisy = (depth * (1 + noise * rng.standard_normal(depth.shape))).astype(np.float32)
        frames.append(Frame(index, noisy, CAMERA, T, labels.astype(np.uint8)))
    return frames


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    strides, sizes = (f"alpha, stride {n}" for n in STRIDES), (f"voxel alpha, {100 * size:g} cm" for size in SIZES)
    head = ["classes", "noise of depth, %", "wrong, %", "at the same spot", *strides, *sizes]
    print("|", " | ".join(head), "|\n|" + "---|" * len(head))
    seen = list(views(arguments.frames))
    points, shown = spots(seen)
    for which, name in enumerate(("furniture", "cubes")):
        for noise, wrong in CONDITIONS:
            frames = made(seen, which, noise, wrong, arguments.seed)
            numbers = [at_the_same_spot(points, shown, seen, frames)]
            numbers += [of_cells(frames, stride) for stride in STRIDES]
            numbers += [of_voxels(frames, size) for size in SIZES]
            cells = [name, f"{100 * noise:g}", f"{100 * wrong:g}", *(f"{x:.3f}" for x in numbers)]
            print("|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
