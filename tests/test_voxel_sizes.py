"""What a unit comes to at other voxel sizes is what fusing it anew would give."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from striped_floor import K, flight

from semstab import backends
from semstab.statistics import krippendorff_alpha
from semstab.statistics.voxel_sizes import SizeSample


def soft(frame, kind, seed=0):
    scores = np.random.default_rng(seed).dirichlet(np.full(K, 0.4), frame.shape).astype(kind)
    return dataclasses.replace(frame, labels=None, scores=scores)


def alphas(frames, voxel_size):
    maps = SizeSample([frame.index for frame in frames], voxel_size, K)
    for frame in frames:
        maps.add(frame)
    return maps.alphas()


def alpha_of(frames, voxel_size):
    backend = backends.create("numpy", voxel_size=voxel_size, num_classes=K)
    for frame in frames:
        backend.integrate(frame)
    return krippendorff_alpha(backend.table())


def holes(frame):
    """Without labels, without depth, and with depth that is no number, in some places."""
    labels, depth = frame.labels.copy(), frame.depth.copy()
    labels[::7, ::5], depth[3::11, 2::3], depth[4::11, 2::3] = 255, 0, math.nan
    return dataclasses.replace(frame, labels=labels, depth=depth)


def tilted(frame):
    turn = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    T = frame.T_wc.copy()
    T[:3, :3], T[:3, 3] = turn @ T[:3, :3], T[:3, 3] + [-70.3, 21.1, 5]
    return dataclasses.replace(frame, T_wc=T)


KINDS = {
    "labels": lambda frames: [holes(frame) for frame in frames],
    "elsewhere": lambda frames: [tilted(frame) for frame in frames],
    "scores": lambda frames: [soft(frame, np.float32, frame.index) for frame in frames],
    "half": lambda frames: [soft(frame, np.float16, frame.index) for frame in frames],
    "both": lambda frames: [soft(frame, np.float64) if frame.index % 2 else frame for frame in frames],
}


@pytest.mark.parametrize("kind", KINDS)
def test_alpha_at_each_size_is_that_of_a_map_of_its_own(kind):
    frames = KINDS[kind](list(flight(4, flicker=0.3)))
    found = alphas(frames, 0.17)
    assert [(size.voxel_size, size.frames) for size in found] == [(0.085, 4), (0.17, 4), (0.34, 4)]
    assert [size.voxel_alpha_op2 for size in found] == pytest.approx(
        [alpha_of(frames, size.voxel_size) for size in found]
    )


def test_a_scene_larger_than_a_map_and_frames_without_a_pixel_have_none():
    near, far = flight(2)
    far = dataclasses.replace(far, depth=np.full(far.shape, 3e5, np.float32))
    assert alphas([near, far], 0.17) == ()
    frames = [dataclasses.replace(frame, depth=np.zeros_like(frame.depth)) for frame in flight(2)]
    assert [math.isnan(size.voxel_alpha_op2) for size in alphas(frames, 0.17)] == [True] * 3
