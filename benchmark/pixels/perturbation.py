"""Noise on depth and poses, to see what geometry alone does to the numbers (paper, Sensitivity to Association)."""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.config import Perturbation
from semstab.model.frames import Frame

Float64 = npt.NDArray[np.float64]
DEPTH, POSE, WALK = range(3)
"""Each has random numbers of its own: the strength of one kind of noise changes no other."""


def perturb(frame: Frame, noise: Perturbation, scene: str) -> Frame:
    """The frame with noise on its depth and its pose.

    Every number depends on the seed, the scene's name, the frame's index and the pixel only: all backbones and backends
    see the same disturbed geometry, in whatever order frames are read and whichever are sampled.

    depth     d (1 + depth_noise n), with n drawn for each pixel; a depth that falls to 0 or below is invalid
    position  t + translation_noise n + translation_drift w, world axes
    rotation  R exp(rotation_drift w) exp(rotation_noise n), rotation vectors in camera axes, about the camera

    n is a standard normal number drawn anew in each frame, w the sum of one for each frame since the sequence began: a
    random walk, 0 at frame 0, whose standard deviation grows with the square root of the index.
    """
    n = _random(noise, scene, POSE, frame.index).standard_normal(6)
    drifts = noise.translation_drift > 0 or noise.rotation_drift > 0
    w = _random(noise, scene, WALK).standard_normal((frame.index if drifts else 0, 6)).sum(axis=0)
    T = frame.T_wc.copy()
    T[:3, 3] += noise.translation_noise * n[:3] + noise.translation_drift * w[:3]
    T[:3, :3] = T[:3, :3] @ _rotation(noise.rotation_drift * w[3:]) @ _rotation(noise.rotation_noise * n[3:])
    return dataclasses.replace(frame, depth=_noisy_depth(frame, noise, scene), T_wc=T)


def _noisy_depth(frame: Frame, noise: Perturbation, scene: str) -> npt.NDArray[np.float32]:
    if not noise.depth_noise:
        return frame.depth
    n = _random(noise, scene, DEPTH, frame.index).standard_normal(frame.shape, dtype=np.float32)
    depth = frame.depth.copy()
    np.multiply(depth, 1 + np.float32(noise.depth_noise) * n, out=depth, where=depth > 0)  # what is invalid stays so
    return depth


def _rotation(degrees: Float64) -> Float64:
    """The rotation matrix (3, 3) of a rotation vector."""
    import cv2

    return np.asarray(cv2.Rodrigues(np.deg2rad(degrees))[0], dtype=np.float64)


def _random(noise: Perturbation, scene: str, *what: int) -> Any:
    name = int.from_bytes(hashlib.blake2b(scene.encode(), digest_size=8).digest(), "little")
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([noise.seed, name, *what])))
