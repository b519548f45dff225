"""Frames for the benchmarks: a UAV at 45 m over blocks of houses; of its labels 2 % err, anew in each frame."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import semstab

ALTITUDE, PITCH, STEP, WRONG = 45.0, np.radians(50), 1.5, 0.02


def frame(index: int, width: int, height: int, K: int) -> semstab.Frame:
    """Frame `index` of the flight, labels in 0..K-1."""
    f = width / (2 * np.tan(np.radians(30)))
    v, u = np.mgrid[:height, :width]
    R = np.array([[1, 0, 0], [0, -np.sin(PITCH), np.cos(PITCH)], [0, -np.cos(PITCH), -np.sin(PITCH)]])
    ray = np.stack([(u - width / 2) / f, (v - height / 2) / f, np.ones((height, width))], axis=-1) @ R.T
    start = np.array([0.2 * index, STEP * index, ALTITUDE])
    z = ALTITUDE / -ray[..., 2]
    for _ in range(2):  # relief, near enough: where the ray meets the height of where it was before
        x, y = (start[axis] + ray[..., axis] * z for axis in (0, 1))
        house = (np.floor(x / 15) + np.floor(y / 15)) % 2 == 0
        z = (ALTITUDE - 1.5 * np.sin(x / 9) * np.cos(y / 7) - 4 * house) / -ray[..., 2]
    x, y = (start[axis] + ray[..., axis] * z for axis in (0, 1))
    label = (np.floor(x / 15).astype(np.int64) * 3 + np.floor(y / 15).astype(np.int64) * 5) % K
    cell = (np.floor(x / 1.2).astype(np.int64) * 73856093) ^ (np.floor(y / 1.2).astype(np.int64) * 19349663)
    wrong = ((cell ^ (index * 83492791)) * 2654435761 % 1000) < WRONG * 1000
    T_wc = np.eye(4)
    T_wc[:3, :3], T_wc[:3, 3] = R, start
    return semstab.Frame(
        index=index,
        depth=z.astype(np.float32),
        labels=np.where(wrong, (label + 1) % K, label).astype(np.uint8),
        intrinsics=semstab.Intrinsics(f, f, width / 2, height / 2),
        T_wc=T_wc,
    )


def milliseconds(work: Callable[..., Any], *arguments: Any) -> float:
    """Wall-clock time of one call."""
    started = time.perf_counter()
    work(*arguments)
    return 1e3 * (time.perf_counter() - started)


def read_bandwidth(threads: int = 2, megabytes: int = 400) -> float:
    """Bytes a second that `threads` threads read from memory together: the best of several sums of large arrays."""
    from concurrent.futures import ThreadPoolExecutor

    parts = [np.ones(megabytes * 2**20 // 8 // threads) for _ in range(threads)]
    with ThreadPoolExecutor(threads) as pool:
        best = min(milliseconds(lambda: list(pool.map(np.sum, parts))) for _ in range(7))
    return sum(part.nbytes for part in parts) / (best / 1e3)
