"""A camera over a floor of stripes, and what a sampler takes of its frames."""

from __future__ import annotations

import dataclasses

import numpy as np

from semstab import Frame, Intrinsics, backends
from semstab.statistics import Sampler

K = 3


def flight(frames=8, flicker=0.0, coin=False, seed=0, step=0.11, patch=None, height=4.0):
    """A camera that looks down at a floor of stripes 0.9 m wide; labels err by pixel or patch."""
    rng = np.random.default_rng(seed)
    H, W, f = 60, 80, 50.0
    down = np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    for index in range(frames):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = down, (0.013 + step * index, 0.017, height)
        depth = np.full((H, W), height - 0.113, dtype=np.float32)
        x = (np.arange(W) - W / 2) / f * depth + T[0, 3]
        labels = (np.floor(x / 0.9) % K).astype(np.uint8)
        size = patch or 1
        wrong = np.kron(rng.random((H // size, W // size)) < (1.0 if coin else flicker), np.ones((size, size), bool))
        drawn = np.kron(rng.integers(0, K, (H // size, W // size)), np.ones((size, size), int))
        yield Frame(index, depth, Intrinsics(f, f, W / 2, H / 2), T, np.where(wrong, drawn, labels).astype(np.uint8))


def numbered(frames):
    """The frames, numbered from 0 on."""
    return [dataclasses.replace(frame, index=index) for index, frame in enumerate(frames)]


def sampled(frames, budget=1 << 19):
    """The spots that a sampler took from the frames."""
    sampler = Sampler(K, budget)
    for frame in frames:
        sampler.add(frame)
    return sampler.sample()


def fused(frames, voxel_size):
    """The frames' map, still in its backend."""
    backend = backends.create("numpy", voxel_size=voxel_size, num_classes=K)
    for frame in frames:
        backend.integrate(frame)
    return backend
