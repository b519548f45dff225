"""Geometry or semantics: view-independent labels through real fusion, with and without noise."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from semstab import Frame, Intrinsics, backends
from semstab.errors import DataError
from semstab.statistics import ceiling, losses, psa, rendered
from semstab.testing import sight_line

K, SIZE = 3, 0.25


def make(voxel_size=SIZE):
    return lambda: backends.create("numpy", voxel_size=voxel_size, num_classes=K)


def fused(frames, voxel_size=SIZE):
    return ceiling(frames, make(voxel_size))


def flight(flicker=0.0, depth_noise=0.0, seed=0, frames=6):
    """A camera that looks down from 4 m at a floor of stripes 0.6 m wide, and moves 0.1 m a frame."""
    rng = np.random.default_rng(seed)
    H, W, f = 36, 48, 40.0
    down = np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    for index in range(frames):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = down, (0.013 + 0.1 * index, 0.017, 4.0)
        clean = np.full((H, W), 4.0 - 0.113)
        depth = clean * (1 + depth_noise * rng.normal(size=(H, W)))
        x = (np.arange(W) - W / 2) / f * clean + T[0, 3]
        labels = (np.floor(x / 0.6) % K).astype(np.uint8)
        wrong = rng.random((H, W)) < flicker
        labels = np.where(wrong, (labels + 1) % K, labels).astype(np.uint8)
        yield Frame(index, depth.astype(np.float32), Intrinsics(f, f, W / 2, H / 2), T, labels)


def test_labels_are_those_of_the_voxels_that_the_pixels_see():
    world = fused([sight_line(0, [(0.1, 0), (0.3, 2), (0.6, 1)])], 0.25)
    (frame,) = rendered([sight_line(5, [(0.2, 1), (0.4, 1), (0.7, 1), (9.0, 1), (0.0, 1)])], world)
    assert frame.index == 5
    assert frame.labels.tolist() == [[0, 2, 1, 255, 255]]
    world = fused([sight_line(0, [(0.1, 0)])])
    (frame,) = rendered([sight_line(0, [(0.1, (0.2, 0.8, 0.0))], dtype=np.float32)], world)
    assert (frame.scores, frame.labels.tolist()) == (None, [[0]])
    backend = backends.create("numpy", voxel_size=SIZE, num_classes=300)
    backend.integrate(sight_line(0, [(0.1, 299)], dtype=np.uint16))
    (wide,) = rendered([sight_line(0, [(0.1, 7), (0.9, 7)], dtype=np.uint16)], backend.table())
    assert wide.labels.tolist() == [[299, 65535]]


def test_losses_are_of_the_model_or_of_geometry():
    """Geometry loses what it loses of the true labels too: voxels that hold two stripes."""
    frames, truth = list(flight(flicker=0.3)), list(flight())
    found = losses(fused(frames), ceiling(frames, make(), world=fused(truth, SIZE / 8)))
    assert found.geometry.value == pytest.approx(1 - np.nanmean(psa(fused(truth))), abs=0.01)
    assert found.model.low > 0.3
    # Pixels see the floor as it is, and are fused where the noise puts them
    noisy = list(flight(depth_noise=0.05))
    limit = ceiling(noisy, make(), world=fused(flight(), SIZE / 8), views=flight())
    found = losses(fused(noisy), limit)
    assert found.total.value > 0.05
    assert found.share.value == pytest.approx(1, abs=0.1)
    noisy, wrong = list(flight(depth_noise=0.05)), list(flight(flicker=0.2, depth_noise=0.05))
    labelled = [dataclasses.replace(frame, depth=other.depth) for frame, other in zip(wrong, noisy, strict=True)]
    found = losses(fused(labelled), ceiling(noisy, make()))
    assert found.model.low > 0
    assert found.total.value == pytest.approx(found.geometry.value + found.model.value)
    model = fused(flight(flicker=0.3, depth_noise=0.02))
    limit = ceiling(flight(flicker=0.3, depth_noise=0.02), make(), world=model)
    assert np.nanmin(psa(limit)) == 1
    assert losses(model, limit).geometry.value == 0


def test_frames_are_taken_one_at_a_time():
    alive = []

    def one_by_one():
        for frame in flight():
            alive.append(frame.index)
            assert len(alive) == frame.index + 1
            yield frame

    frames = rendered(one_by_one(), fused(flight()))
    next(frames)
    assert alive == [0]


def test_voxels_of_one_map_or_seen_once_do_not_count_and_other_views_are_refused():
    model = fused([sight_line(t, [(0.1, t), (0.4, 0)]) for t in range(2)])
    limit = fused([sight_line(0, [(0.1, 0), (0.4, 0)]), sight_line(1, [(0.1, 0)])])
    found = losses(model, limit)
    assert (found.voxels, found.total.value, found.geometry.value) == (1, 1, 0)
    nothing = losses(model, fused([sight_line(0, [(9.0, 0)])]))
    assert nothing.voxels == 0
    assert math.isnan(nothing.share.value)
    world = fused(flight())
    with pytest.raises(DataError, match="frame 1: it needs a view of its size to see labels from; there is none"):
        list(rendered(flight(), world, views=list(flight())[:1]))
    with pytest.raises(DataError, match="it is 2x1"):
        list(rendered(flight(), world, views=[sight_line(0, [(0.1, 0), (0.2, 0)])]))
    with pytest.raises(DataError, match="has no voxels"):
        list(rendered(flight(), fused([])))
