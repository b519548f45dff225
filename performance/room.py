"""Frames: a camera that walks round a furnished room, 640x480, and sees each place again and again.

Depth has noise. Labels are wrong in patches, which are different in each frame, and at the edges of things.
"""

from __future__ import annotations

import dataclasses

import numpy as np

import semstab

SIZE = np.array([7.0, 5.0, 2.6])
BOXES = np.array([
    [[1.0, 1.0, 0.0], [2.2, 2.4, 0.8]], [[3.2, 0.4, 0.0], [4.0, 1.0, 1.9]], [[5.0, 3.2, 0.0], [6.4, 4.4, 0.5]],
    [[2.6, 3.4, 0.0], [3.4, 4.2, 1.1]], [[0.3, 3.6, 0.0], [1.1, 4.6, 1.6]], [[4.6, 1.6, 0.0], [5.2, 2.2, 0.7]],
])  # fmt: skip
FRAMES_A_ROUND = 60
NOISE, WRONG, PATCH = 0.003, 0.12, 24


def frame(index: int, width: int = 640, height: int = 480, K: int = 7, step: int = 0) -> semstab.Frame:
    """Frame `index` of the walk, labels in 0..K-1; every `step` frames the camera stands in the next room of a row."""
    rng = np.random.default_rng(index)
    turn = 2 * np.pi * index / FRAMES_A_ROUND
    shift = np.array([SIZE[0] * (index // step if step else 0), 0.0, 0.0])
    eye = np.array([3.5 + 0.9 * np.cos(0.37 * turn), 2.6 + 0.5 * np.sin(0.61 * turn), 1.5])
    yaw, pitch = turn, -0.25 + 0.25 * np.sin(1.7 * turn)
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    f = 0.85 * width
    v, u = np.mgrid[:height, :width]
    ray = np.stack([(u - width / 2) / f, (v - height / 2) / f, np.ones((height, width))], axis=-1) @ R.T
    z, thing = _cast(eye, ray)
    label = (thing * 5 + 3 * (np.floor((eye + ray * z[..., None])[..., :2].sum(axis=-1) / 1.5).astype(int))) % K
    patch = rng.random((height // PATCH + 1, width // PATCH + 1)) < WRONG
    wrong = np.kron(patch, np.ones((PATCH, PATCH), dtype=bool))[:height, :width]
    edge = np.zeros((height, width), dtype=bool)
    edge[:, 2:] = label[:, 2:] != label[:, :-2]
    wrong |= edge & (rng.random((height, width)) < 0.5)
    T_wc = np.eye(4)
    T_wc[:3, :3], T_wc[:3, 3] = R, eye + shift
    return semstab.Frame(
        index=index,
        depth=(z * (1 + NOISE * rng.standard_normal((height, width)))).astype(np.float32),
        labels=np.where(wrong, (label + 1) % K, label).astype(np.uint8),
        intrinsics=semstab.Intrinsics(f, f, width / 2, height / 2),
        T_wc=T_wc,
    )


def smaller(index: int, width: int, height: int, K: int, times: float) -> semstab.Frame:
    """Return frame `index` of a walk round a room that is `times` as large."""
    made = frame(index, width, height, K)
    pose = made.T_wc.copy()
    pose[:3, 3] *= times
    return dataclasses.replace(made, depth=(made.depth * times).astype(np.float32), T_wc=pose)


def _cast(eye: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) along the rays and the number of the surface that they meet."""
    with np.errstate(divide="ignore", invalid="ignore"):
        leave = np.maximum((0 - eye) / ray, (SIZE - eye) / ray)
        z, thing = (
            leave.min(axis=-1),
            leave.argmin(axis=-1) * 2
            + (np.take_along_axis(ray, leave.argmin(axis=-1)[..., None], axis=-1)[..., 0] > 0),
        )
        for number, (low, high) in enumerate(BOXES):
            a, b = (low - eye) / ray, (high - eye) / ray
            enter, exit_ = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
            hit = (enter > 0.1) & (enter < exit_) & (enter < z)
            z, thing = np.where(hit, enter, z), np.where(hit, 6 + number, thing)
    return z, thing
