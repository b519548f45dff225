"""Frames: a UAV at 45 m over blocks of houses, of whose labels 2 % err; or in a noisy street."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt

import semstab

ALTITUDE, PITCH, STEP, WRONG = 45.0, np.radians(50), 1.5, 0.02


def frame(index: int, width: int, height: int, K: int, at: tuple[float, float] | None = None) -> semstab.Frame:
    """Return frame `index` of the flight, labels in 0..K-1; taken over another place where one is given, metres."""
    f = width / (2 * np.tan(np.radians(30)))
    v, u = np.mgrid[:height, :width]
    R = np.array([[1, 0, 0], [0, -np.sin(PITCH), np.cos(PITCH)], [0, -np.cos(PITCH), -np.sin(PITCH)]])
    ray = np.stack([(u - width / 2) / f, (v - height / 2) / f, np.ones((height, width))], axis=-1) @ R.T
    start = np.array([*(at or (0.2 * index, STEP * index)), ALTITUDE])
    z = ALTITUDE / -ray[..., 2]
    for _ in range(2):  # two fixed-point steps: the ray meets the height of the relief at its last point
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


STREET, EAVES, TREES = 14.0, 12.0, 40
"""Half the width of the street, the height of its houses (metres), and how many trees stand in each of two rows."""


@functools.lru_cache(maxsize=3)
def _street(index: int, width: int, height: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8], Any]:
    """Return depth, 0 in the sky, labels 0 to 5, and the pose of a frame of `street`."""
    f = width / (2 * np.tan(np.radians(35)))
    v, u = np.mgrid[:height, :width].astype(np.float32)
    pitch = np.radians(12)
    R = np.array([[1, 0, 0], [0, -np.sin(pitch), np.cos(pitch)], [0, -np.cos(pitch), -np.sin(pitch)]])
    rays = np.stack([(R[i, 0] * (u - width / 2) + R[i, 1] * (v - height / 2)) / f + R[i, 2] for i in range(3)])
    start = np.array([0.5 * np.sin(index), 1.5 * index, 22.0])
    z = np.full((height, width), np.inf, dtype=np.float32)
    label = np.zeros((height, width), dtype=np.uint8)

    def hit(at: Any, where: Any, name: int, part: Any = np.s_[:]) -> None:
        nearer = where & (at > 0.5) & (at < 150) & (at <= z[part])
        z[part][nearer], label[part][nearer] = at[nearer], name

    with np.errstate(divide="ignore", invalid="ignore"):
        dx, dy, dz = rays.astype(np.float32)
        at = (-start[2] / dz).astype(np.float32)
        hit(at, np.abs(start[0] + dx * at) <= STREET, 0)
        hit(at, np.abs(start[0] + dx * at) <= STREET / 3, 1)
        at = ((EAVES - start[2]) / dz).astype(np.float32)
        hit(at, np.abs(start[0] + dx * at) > STREET, 2)
        for side in (-STREET, STREET):
            at = (side - start[0]) / dx
            up, along = start[2] + dz * at, start[1] + dy * at
            window = (np.mod(along, 3.0) > 1.4) & (np.mod(up, 3.0) > 1.2)
            at = (at + np.where(window, 0.25 / np.abs(dx), 0)).astype(np.float32)
            hit(at, (up > 0) & (up < EAVES), 3)
            hit(at, (up > 0) & (up < EAVES) & window, 4)
        for k in range(2 * TREES):
            center = np.array([(-9.0, 9.0)[k % 2], 8.0 + (k // 2) * 7.0, 5.0]) - start
            x, y, ahead = center @ R
            if ahead > 4:
                reach = 3 * f / (ahead - 3)
                column, row = width / 2 + f * x / ahead, height / 2 + f * y / ahead
                part = tuple(slice(max(0, int(c - reach)), max(0, int(c + reach))) for c in (row, column))
                px, py, pz, v_, u_ = dx[part], dy[part], dz[part], v[part], u[part]
                along = (px * center[0] + py * center[1] + pz * center[2]) / (px * px + py * py + pz * pz)
                miss = (px * along - center[0]) ** 2 + (py * along - center[1]) ** 2 + (pz * along - center[2]) ** 2
                leaf = (np.floor(u_ / 7) * 31 + np.floor(v_ / 5) * 17 + k) % 11 / 11  # leaves before and behind others
                surface = (along - np.sqrt(np.maximum(6.0 - miss, 0)) + 0.8 * leaf).astype(np.float32)
                hit(surface, miss < 6.0 - 2 * leaf, 5, part)
    z[~np.isfinite(z)] = 0
    T_wc = np.eye(4)
    T_wc[:3, :3], T_wc[:3, 3] = R, start
    return z, label, T_wc


def street(
    index: int, width: int, height: int, K: int, *, noise: float = 0.0, salt: float = 0.0, clean: bool = False
) -> semstab.Frame:
    """Return frame `index` of a flight along a street.

    Facades with windows, trees, roofs, ground, and sky without depth.

    - `noise`: standard deviation of depth, as a share of it
    - `salt`: share of single pixels with a random label, in addition to 12 % of the blocks of 24x24 pixels; none if
      clean
    """
    rng = np.random.default_rng(index)
    depth, label, T_wc = _street(index, width, height)
    if noise:
        depth = depth * (1 + noise * rng.standard_normal(depth.shape, dtype=np.float32))
    label = label % K
    if not clean:
        wrong = rng.random((-(-height // 24), -(-width // 24))) < 0.12
        label = np.where(np.kron(wrong, np.ones((24, 24), dtype=bool))[:height, :width], (label + 1) % K, label)
    if salt:
        label = np.where(rng.random(depth.shape) < salt, rng.integers(0, K, depth.shape), label)
    f = width / (2 * np.tan(np.radians(35)))
    camera = semstab.Intrinsics(f, f, width / 2, height / 2)
    return semstab.Frame(index=index, depth=depth, labels=label.astype(np.uint8), intrinsics=camera, T_wc=T_wc)
