"""Moving things are no evidence about a location: pixels of some classes, or under a mask, are left out of fusion."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from semstab.config import Perturbation
from semstab.core.types import Float32, Float64, Mask
from semstab.data.frames import Frame, LeftOut
from semstab.data.labels import flat
from semstab.pixels.kernels import CHUNKS, cut


def leave_out(frame: Frame, classes: Sequence[int] = (), *, masks: bool = True) -> Frame:
    """Return the frame without the pixels of these classes, and without masked ones.

    It is the frame itself if there are none.

    classes are ids in label maps, and positions in soft scores, where a pixel's class is that of its largest score.
    The pixels lose their label; `left_out` marks those of them that had a valid depth and label.
    """
    masked = frame.mask if masks else None
    if not classes and masked is None:
        return frame
    out = np.isin(frame.predicted, np.array(classes, dtype=np.int64))
    if masked is not None:
        out |= masked
    return dataclasses.replace(frame, left_out=out & frame.valid, **_unlabelled(frame, out))


def _unlabelled(frame: Frame, where: Mask) -> dict[str, Any]:
    if frame.labels is not None:
        return {"labels": np.where(where, frame.labels.dtype.type(frame.ignore_id), frame.labels)}
    assert frame.scores is not None
    return {"scores": np.where(where[..., None], frame.scores.dtype.type(0), frame.scores)}


# Noise on depth and poses, to see the effect of geometry alone on the numbers (paper, Sensitivity to Association).

DEPTH, POSE, WALK = range(3)
"""Each has random numbers of its own: the strength of one kind of noise changes no other."""


def perturb(frame: Frame, noise: Perturbation, scene: str) -> Frame:
    """Return the frame with noise on its depth and its pose.

    Every number depends on the seed, the scene's name, the frame's index and the pixel only: all models and backends
    see the same disturbed geometry, in whatever order frames are read and whichever are sampled.

    - depth: d (1 + depth_noise n), with n drawn for each pixel; a depth that falls to 0 or below is invalid; of a
      scan it is the distance from the sensor, along the point's ray
    - position: t + translation_noise n + translation_drift w, world axes
    - rotation: R exp(rotation_drift w) exp(rotation_noise n), rotation vectors in camera axes, about the camera

    n is an independent standard normal number for each frame. w is the sum of one such number for each frame since the
    sequence began: a random walk, 0 at frame 0, whose standard deviation grows with the square root of the index.
    """
    n = _random(noise, scene, POSE, frame.index).standard_normal(6)
    drifts = noise.translation_drift > 0 or noise.rotation_drift > 0
    w = _random(noise, scene, WALK).standard_normal((frame.index if drifts else 0, 6)).sum(axis=0)
    T = frame.T_wc.copy()
    T[:3, 3] += noise.translation_noise * n[:3] + noise.translation_drift * w[:3]
    T[:3, :3] = T[:3, :3] @ _rotation(noise.rotation_drift * w[3:]) @ _rotation(noise.rotation_noise * n[3:])
    depth = _noisy_depth(frame, noise, scene)
    if frame.points is None or not noise.depth_noise:
        return dataclasses.replace(frame, depth=depth, T_wc=T)
    factor = np.divide(depth, frame.depth, out=np.ones_like(depth), where=frame.depth > 0)
    return dataclasses.replace(frame, depth=depth, points=frame.points * factor[..., None], T_wc=T)


def _noisy_depth(frame: Frame, noise: Perturbation, scene: str) -> Float32:
    if not noise.depth_noise:
        return frame.depth
    n = _random(noise, scene, DEPTH, frame.index).standard_normal(frame.shape, dtype=np.float32)
    depth = frame.depth.copy()
    np.multiply(depth, 1 + np.float32(noise.depth_noise) * n, out=depth, where=depth > 0)  # what is invalid stays so
    return depth


def _rotation(degrees: Float64) -> Float64:
    """Return the rotation matrix (3, 3) of a rotation vector."""
    import cv2

    return np.asarray(cv2.Rodrigues(np.deg2rad(degrees))[0], dtype=np.float64)


def _random(noise: Perturbation, scene: str, *what: int) -> Any:
    name = int.from_bytes(hashlib.blake2b(scene.encode(), digest_size=8).digest(), "little")
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([noise.seed, name, *what])))


# Only the largest scores of each pixel, for models of many classes: less memory, and a loss with a bound.
#
# With lambda the share of a pixel's scores that is left out, its normalised scores change by lambda in total variation:
# the k largest grow by a factor of 1 / (1 - lambda), what is left out was lambda. So a voxel's belief, which is a mean
# of means of them, changes by at most the mean lambda of its pixels, weighted as they are, and so does its VSS, the
# largest part of the belief. lambda is at most 1 - k / K, where all scores are equal, and small for a model that is
# sure.

BITS = {2: np.uint16, 4: np.uint32, 8: np.uint64}
AS_DOUBLE = {2: (42, 2.0**1008), 4: (29, 2.0**896), 8: (0, 1.0)}
"""The shift of a number's bits that makes them those of a double, and the unit that it then counts."""


def keep_largest(frame: Frame, k: int) -> Frame:
    """Return the frame with the k largest scores of each pixel, of equal ones those of the lowest classes.

    The rest are 0.

    A pixel without a prediction stays without. `scores_left_out` of the frame is the share of them that was left out.
    """
    assert frame.scores is not None
    scores = frame.scores
    if k >= scores.shape[2]:
        return frame
    supported = scores.dtype in (np.float16, np.float32)
    scores = np.abs(scores if supported else scores.astype(np.float64))  # no -0, whose bits are large
    bits = BITS[scores.dtype.itemsize]
    retained, shares = np.zeros(scores.shape, dtype=bits), np.zeros((CHUNKS, 3))
    infinite = int(np.array(np.inf, dtype=scores.dtype).view(bits))
    shift, unit = AS_DOUBLE[scores.dtype.itemsize]
    cut(flat(scores).view(bits), k, retained.reshape(-1, scores.shape[2]), shift, unit, infinite, shares)
    pixels, total = shares[:, :2].sum(axis=0)
    left_out = LeftOut(float(total / max(pixels, 1)), float(shares[:, 2].max()))
    return dataclasses.replace(frame, scores=retained.view(scores.dtype), scores_left_out=left_out)
