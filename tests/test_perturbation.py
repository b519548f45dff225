"""Noise on depth and poses: the same for every model and in any order, of the size that is asked for, or none."""

from __future__ import annotations

import dataclasses
import functools
import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import tiny_scene
from posed_config import configure

import semstab
from semstab import Frame, Intrinsics
from semstab.config import Perturbation
from semstab.configure import load_config
from semstab.engine.units import make_plan
from semstab.errors import ConfigError
from semstab.pixels.preparation import perturb
from semstab.task import read

H, W = 40, 50


def frame(index: int = 0, depth: float = 2.0) -> Frame:
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    T[:3, 3] = 4e5, 5e6, 30
    labels = np.zeros((H, W), np.uint8)
    return Frame(index, np.full((H, W), depth, np.float32), Intrinsics(50, 50, 24.5, 19.5), T, labels)


def disturbed(index: int = 0, scene: str = "s", **noise) -> Frame:
    return perturb(frame(index), Perturbation(**noise), scene)


def moved(frames: int, **noise) -> np.ndarray:
    """By how much the camera moves in each frame, metres."""
    return np.stack([disturbed(i, **noise).T_wc[:3, 3] - frame().T_wc[:3, 3] for i in range(frames)])


def turned(index: int, **noise) -> np.ndarray:
    """The rotation of a disturbed frame, as camera axes see it."""
    return frame().T_wc[:3, :3].T @ disturbed(index, **noise).T_wc[:3, :3]


def angle(R: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def test_depth_noise_is_relative_normal_and_independent_of_pixel_and_frame() -> None:
    n = np.stack([disturbed(i, depth_noise=0.01).depth / 2.0 - 1 for i in range(200)]) / 0.01
    assert n.mean() == pytest.approx(0, abs=0.01)
    assert n.std() == pytest.approx(1, abs=0.01)
    assert (np.abs(n) < 1).mean() == pytest.approx(0.6827, abs=0.005)
    neighbours = [n[:, :, 1:] * n[:, :, :-1], n[:, 1:] * n[:, :-1], n[1:] * n[:-1]]
    assert [product.mean() for product in neighbours] == pytest.approx([0, 0, 0], abs=0.01)
    np.testing.assert_array_equal(disturbed(depth_noise=0.01).T_wc, frame().T_wc)


def test_noise_of_a_frame_is_drawn_anew_for_each_frame_and_axis() -> None:
    steps = moved(2000, translation_noise=0.05)
    np.testing.assert_allclose(steps.std(axis=0), 0.05, rtol=0.05)
    np.testing.assert_allclose(steps.mean(axis=0), 0, atol=0.005)
    assert np.abs(np.corrcoef(steps.T) - np.eye(3)).max() < 0.06
    assert np.abs((steps[1:] * steps[:-1]).mean(axis=0)).max() < 0.05**2 * 0.1
    angles = np.array([angle(turned(i, rotation_noise=0.3)) for i in range(1000)])
    assert (angles**2).mean() == pytest.approx(3 * 0.3**2, rel=0.1)


def test_rotation_noise_turns_the_camera_about_itself() -> None:
    far = disturbed(3, rotation_noise=1.0)
    np.testing.assert_array_equal(far.T_wc[:3, 3], frame().T_wc[:3, 3])  # though the world's origin is 5000 km away
    assert 0 < angle(turned(3, rotation_noise=1.0)) < 10
    np.testing.assert_array_equal(far.depth, frame().depth)
    noise = {name: 0.1 for name in Perturbation.model_fields if name != "seed"}
    T = disturbed(50, **noise).T_wc
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)


def test_drift_is_a_random_walk_from_the_first_frame_on() -> None:
    assert not moved(1, translation_drift=0.02)[0].any()
    walks = np.stack(
        [[disturbed(i, translation_drift=0.02, seed=seed).T_wc[:3, 3] for i in (0, 25, 100)] for seed in range(300)]
    )
    spread = (walks - walks[:, :1]).std(axis=0)
    np.testing.assert_allclose(spread[1], 0.02 * 5, rtol=0.15)
    np.testing.assert_allclose(spread[2], 0.02 * 10, rtol=0.15)
    steps = np.diff(moved(600, translation_drift=0.02), axis=0)
    np.testing.assert_allclose(steps.std(axis=0), 0.02, rtol=0.1)
    turns = [angle(turned(100, rotation_drift=0.02, seed=seed)) ** 2 for seed in range(300)]
    assert np.mean(turns) == pytest.approx(3 * 0.02**2 * 100, rel=0.15)
    steps = [angle(turned(i, rotation_drift=0.1).T @ turned(i + 1, rotation_drift=0.1)) ** 2 for i in range(500)]
    assert np.mean(steps) == pytest.approx(3 * 0.1**2, rel=0.15)


@pytest.mark.parametrize("noise", ["depth_noise", "translation_noise", "rotation_noise", "translation_drift"])
def test_the_strength_scales_the_same_random_numbers(noise) -> None:
    """So that two strengths differ by their strength, not by chance."""
    one, two = disturbed(4, **{noise: 0.001}), disturbed(4, **{noise: 0.002})
    if noise == "depth_noise":
        np.testing.assert_allclose(two.depth - 2, 2 * (one.depth - 2), atol=1e-6)
    elif noise == "rotation_noise":
        assert angle(turned(4, rotation_noise=0.2)) == pytest.approx(2 * angle(turned(4, rotation_noise=0.1)))
    else:
        base = frame().T_wc
        np.testing.assert_allclose(two.T_wc - base, 2 * (one.T_wc - base), atol=1e-8)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, -np.inf])
def test_invalid_depth_stays_invalid(value) -> None:
    """Also where noise this large would turn the sign of a negative depth."""
    depth = np.full((H, W), value, np.float32)
    noisy = perturb(dataclasses.replace(frame(), depth=depth), Perturbation(depth_noise=5.0), "s")
    assert not noisy.valid.any()


def test_noise_of_a_frame_is_drawn_anew_and_depth_below_zero_is_invalid() -> None:
    noisy = disturbed(depth_noise=1.0)  # one number in six lies below -1
    assert (noisy.depth <= 0).mean() == pytest.approx(0.1587, abs=0.02)
    np.testing.assert_array_equal(noisy.valid, noisy.depth > 0)
    alone, together = disturbed(2, depth_noise=0.01), disturbed(2, depth_noise=0.01, translation_drift=0.1)
    np.testing.assert_array_equal(alone.depth, together.depth)
    first = disturbed(1, depth_noise=0.01).depth
    np.testing.assert_array_equal(first, disturbed(1, depth_noise=0.01).depth)
    for other in ({"seed": 1}, {"scene": "t"}, {"index": 2}):
        assert (disturbed(**{"index": 1, "depth_noise": 0.01, **other}).depth != first).mean() > 0.9


@pytest.fixture
def config(tmp_path):
    root = tiny_scene.write(tmp_path / "wall", frames=4)
    return functools.partial(configure, root)


NOISE = {"depth_noise": 0.003, "translation_noise": 0.01, "rotation_drift": 0.5}


def test_every_model_and_any_order_sees_the_same_geometry(config) -> None:
    a, b = make_plan(config(perturbation=NOISE, seed=3)).tasks
    with ThreadPoolExecutor(4) as pool:
        backwards = dict(zip(range(3, -1, -1), pool.map(lambda i: read(b, i), range(3, -1, -1)), strict=True))
    for index in range(4):
        there, back = read(a, index), backwards[index]
        np.testing.assert_array_equal(there.depth, back.depth)
        np.testing.assert_array_equal(there.T_wc, back.T_wc)


def test_noise_is_of_the_pixel_and_none_changes_nothing(config) -> None:
    task = make_plan(config(perturbation=NOISE, seed=3)).tasks[0]
    np.testing.assert_array_equal(read(task, 1, 2).depth, read(task, 1).depth[::2, ::2])
    plain, zero = config(), config(perturbation={"depth_noise": 0}, seed=9)
    assert zero.model_copy(update={"seed": 0}) == plain
    assert zero.perturbation is None
    task = make_plan(plain).tasks[0]
    original = task.scene.frame(1, task.model)
    np.testing.assert_array_equal(read(task, 1).depth, original.depth)
    np.testing.assert_array_equal(read(task, 1).T_wc, original.T_wc)

    def keys(**settings):
        return [unit.identity for unit in make_plan(config(**settings)).units]

    assert keys(seed=4) == keys(seed=5)
    assert keys(perturbation=NOISE, seed=4) == keys(perturbation=NOISE, seed=4) != keys(perturbation=NOISE, seed=5)


def test_a_run_takes_it_as_a_setting_that_cannot_be_negative(config, tmp_path) -> None:
    plain = semstab.run(config(), report=False)
    noisy = semstab.run(config(perturbation=NOISE, seed=3), out=tmp_path / "run", report=False)
    assert noisy.runs[0].map_summary != plain.runs[0].map_summary
    again = semstab.run(load_config(tmp_path / "run" / "config.yaml"), report=False)
    assert [run.map_summary for run in again.runs] == [run.map_summary for run in noisy.runs]
    assert json.loads(json.dumps(config(perturbation=NOISE, seed=3).model_dump(mode="json")))["seed"] == 3
    with pytest.raises(ConfigError, match=r"perturbation\.depth_noise: input should be greater than or equal to 0"):
        config(perturbation={"depth_noise": -0.1})
    with pytest.raises(ConfigError, match=r"unknown setting 'perturbation\.depth'; did you mean 'depth_noise'"):
        config(perturbation={"depth": 0.1})
