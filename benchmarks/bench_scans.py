"""CPU time and memory of one LiDAR scan on each backend, beside the same fusion by np.unique.

    python benchmarks/bench_scans.py [--points 120000] [--classes 20] [--voxel-size 0.2] [--scans 20] [--rounds 5]
                                     [--wrong 0.05] [--data SEMANTICKITTI]

A scanner of 64 beams drives along a street of walls and boxes at 1.2 m a scan; points err by 2 cm, and a share of them,
`--wrong`, has a random label. With `--data` the scans are those of a folder of SemanticKITTI, with their true labels. A
round fuses all scans into a new map; a number is the median over scans of the median over rounds, of user and system
time of all threads. Backend `numpy` fuses by np.unique: it is the baseline of the ratio. 'np.unique alone' finds a
scan's voxels and sums their labels so, without a map.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

from semstab.core.process import configure_process

configure_process()  # as the command line does, before anything starts threads

import numpy as np  # noqa: E402

import semstab  # noqa: E402
from semstab import backends  # noqa: E402
from semstab.backends.shared.association import observe  # noqa: E402
from semstab.configure import as_config, resolve  # noqa: E402
from semstab.core.types import Float64  # noqa: E402
from semstab.task import open_scenes, read, tasks_of  # noqa: E402

ALONE = "np.unique alone"

BEAMS, STEP = 64, 1.2
LOWEST, HIGHEST = -24.8, 2.0
"""Degrees of a Velodyne HDL-64E."""


def street(points: int, K: int, scans: int, wrong: float, seed: int = 0) -> list[semstab.Frame]:
    """Scans of about so many points along a street, a share of them with a random label."""
    rng = np.random.default_rng(seed)
    at = np.linspace(0, 2 * np.pi, int(1.15 * points / BEAMS), endpoint=False)
    up, at = np.meshgrid(np.radians(np.linspace(HIGHEST, LOWEST, BEAMS)), at, indexing="ij")
    rays = np.stack([np.cos(up) * np.cos(at), np.cos(up) * np.sin(at), np.sin(up)], axis=-1).reshape(-1, 3)
    boxes = rng.uniform([-40, -9, -1.8], [80, 9, 0.5], (60, 3))
    frames = []
    for k in range(scans):
        T_wc = np.eye(4)
        T_wc[0, 3] = STEP * k
        distance, label = _seen(T_wc[:3, 3], rays, boxes, K)
        hit = distance < 80
        noisy = distance[hit] + rng.normal(0, 0.02, hit.sum())
        labels = np.where(rng.random(hit.sum()) < wrong, rng.integers(0, K, hit.sum()), label[hit])
        given = (rays[hit] * noisy[:, None]).astype(np.float32)
        frames.append(semstab.Frame(k, points=given, labels=labels.astype(np.uint8), T_wc=T_wc))
    return frames


def _seen(origin: Float64, rays: Float64, boxes: Float64, K: int) -> tuple[Float64, Any]:
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(rays[:, 2] < 0, (-1.8 - origin[2]) / rays[:, 2], np.inf)
        walls = np.abs((np.sign(rays[:, 1]) * 12 - origin[1]) / rays[:, 1])
        distance, label = np.minimum(ground, walls), np.where(ground < walls, 0, 1)
        for k, low in enumerate(boxes):
            a, b = (low - origin) / rays, (low + 2.0 - origin) / rays
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            hit = (near < far) & (near > 0) & (near < distance)
            distance, label = np.where(hit, near, distance), np.where(hit, 2 + k % (K - 2), label)
    return distance, label


def recorded(root: str) -> tuple[list[semstab.Frame], int]:
    """The scans of the first sequence in a folder of SemanticKITTI, with true labels, and the number of classes."""
    config = resolve(as_config({"dataset": {"name": "semantickitti", "options": {"root": root}}, "models": ["gt"]}))
    (task,) = tasks_of(next(iter(open_scenes(config).values())), config)
    return [read(task, index, 1) for index in task.indices], len(task.mapping.target)


def milliseconds(step: Callable[[semstab.Frame], Any], frames: Sequence[semstab.Frame]) -> list[float]:
    """CPU time of a step on each frame."""
    taken = []
    for frame in frames:
        before = time.process_time()
        step(frame)
        taken.append(1e3 * (time.process_time() - before))
    return taken


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=120_000)
    parser.add_argument("--classes", type=int, default=20)
    parser.add_argument("--voxel-size", type=float, default=0.2)
    parser.add_argument("--scans", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--wrong", type=float, default=0.05, help="share of the street's points with a random label")
    parser.add_argument("--data", help="folder of SemanticKITTI, whose scans take the place of the street's")
    parser.add_argument("--backends", nargs="+", default=["numba", "open3d", "torch"])
    arguments = parser.parse_args()
    size, K = arguments.voxel_size, arguments.classes
    if arguments.data:
        frames, K = recorded(arguments.data)
    else:
        frames = street(arguments.points, K, arguments.scans, arguments.wrong)
    taken: dict[str, list[list[float]]] = {name: [] for name in ("numpy", ALONE, *arguments.backends)}
    voxels, reports = 0, []
    for _ in range(arguments.rounds + 1):  # the first one is warm-up
        taken[ALONE].append(milliseconds(lambda frame: observe(frame, size, K), frames))
        for name in ("numpy", *arguments.backends):
            backend = backends.create(name, voxel_size=size, num_classes=K)
            taken[name].append(milliseconds(backend.integrate, frames))
            voxels = len(backend.table())
    reports = [float(np.median(np.median(np.array(rounds[1:]), axis=0))) for rounds in taken.values()]
    counts = [int(np.count_nonzero(frame.valid)) for frame in frames]
    print(f"{len(frames)} scans of {np.median(counts):,.0f} points, K = {K}, {size:g} m, {voxels:,} voxels")
    print("| | CPU ms a scan | times as fast as numpy |\n|---|---:|---:|")
    for name, ms in zip(taken, reports, strict=True):
        print(f"| {name} | {ms:.1f} | {reports[0] / ms:.2f} |")


if __name__ == "__main__":
    main()
