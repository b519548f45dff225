"""CPU time and memory of one LiDAR scan on each backend, and of the same fusion by np.unique.

A scanner of 64 beams drives along a street of walls and boxes at 1.2 m a scan; points err by 2 cm, and a share of them,
`--wrong`, has a random label. With `--data` the scans are those of a folder of SemanticKITTI, with their true labels. A
round fuses all scans into a new map; a number is the median over scans of the median over rounds, of user and system
time of all threads. Backend `numpy` fuses by np.unique: it is the baseline of the ratio. 'np.unique alone' finds a
scan's voxels and sums their labels so, without a map.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import measuring
import numpy as np

import semstab
from semstab.backends import create
from semstab.backends.shared.association import observe
from semstab.configure import as_config, resolve
from semstab.core.types import Float64
from semstab.task import open_scenes, read, tasks_of

BEAMS, STEP = 64, 1.2
LOWEST, HIGHEST = -24.8, 2.0
"""Degrees of a Velodyne HDL-64E."""


def street(points: int, K: int, scans: int, wrong: float, seed: int = 0) -> list[semstab.Frame]:
    """Return scans of about `points` points along a street, with a random label for the share `wrong` of them."""
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


def main(
    points: int = 120_000,
    classes: int = 20,
    voxel_size: float = 0.2,
    scans: int = 20,
    rounds: int = 5,
    wrong: float = 0.05,
    data: str | None = None,
    backends: tuple[str, ...] = ("numba", "open3d", "torch"),
) -> Any:
    frames, K = recorded(data) if data else (street(points, classes, scans, wrong), classes)
    voxels = 0

    def alone() -> list[float]:
        return [measuring.cpu_ms(observe, frame, voxel_size, K) for frame in frames]

    def fused(name: str) -> list[float]:
        nonlocal voxels
        backend = create(name, voxel_size=voxel_size, num_classes=K)
        taken = [measuring.cpu_ms(backend.integrate, frame) for frame in frames]
        voxels = len(backend.table())
        return taken

    works = {"numpy": partial(fused, "numpy"), "np.unique alone": alone} | {
        name: partial(fused, name) for name in backends
    }
    taken = measuring.in_turns(works, rounds)
    counts = [np.count_nonzero(frame.valid) for frame in frames]
    print(f"{len(frames)} scans of {np.median(counts):,.0f} points, K = {K}, {voxel_size:g} m, {voxels:,} voxels\n")
    table = measuring.MarkdownTable(implementation="", CPU_ms=".1f", faster=".2f")
    ms = {name: float(np.median(np.median(np.array(seconds_taken), axis=0))) for name, seconds_taken in taken.items()}
    for name in works:
        table.add(implementation=name, CPU_ms=ms[name], faster=ms["numpy"] / max(ms[name], 1e-6))
    return table.rows
