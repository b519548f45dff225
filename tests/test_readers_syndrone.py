"""Syndrone: CARLA's left-handed angles, against its own definition of them, and what is wrong with its files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from dataset_writers import FORMATS, opened, write_labelled
from posed_scene import fails

from semstab.datasets.syndrone import pose_of
from semstab.errors import DataError


def written(tmp_path, **numbers):
    path = tmp_path / "00000.json"
    path.write_text(json.dumps({"x": 1.0, "y": 2.0, "z": 50.0, "pitch": 0.0, "yaw": 0.0, "roll": 0.0} | numbers))
    return path


def where(T, right=0.0, down=0.0, forward=0.0):
    """The place in the world of a point that a camera sees, less the camera's own."""
    return T[:3, :3] @ [right, down, forward]


def test_a_camera_looks_along_x_with_y_to_its_right_which_is_turned(tmp_path) -> None:
    T = pose_of(written(tmp_path))
    np.testing.assert_allclose(T[:3, 3], [1, -2, 50])
    np.testing.assert_allclose(where(T, forward=1), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(where(T, right=1), [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(where(T, down=1), [0, 0, -1], atol=1e-12)


def test_a_pitch_of_minus_90_degrees_looks_down(tmp_path) -> None:
    T = pose_of(written(tmp_path, pitch=-90.0))
    np.testing.assert_allclose(where(T, forward=1), [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(where(T, down=1), [-1, 0, 0], atol=1e-12)  # the image's lower side is behind


def test_yaw_turns_clockwise_as_seen_from_above(tmp_path) -> None:
    """To CARLA's y, which is to the right, and here the world's -y."""
    T = pose_of(written(tmp_path, yaw=90.0, pitch=-30.0))
    np.testing.assert_allclose(where(T, forward=1), [0, -np.cos(np.pi / 6), -0.5], atol=1e-12)
    np.testing.assert_allclose(where(T, right=1), [-1, 0, 0], atol=1e-12)


def test_a_positive_roll_lowers_the_right_side(tmp_path) -> None:
    """As in CARLA's Transform: the right vector's z is -cos(pitch) sin(roll)."""
    T = pose_of(written(tmp_path, roll=20.0, pitch=10.0))
    assert where(T, right=1)[2] == pytest.approx(-np.cos(np.radians(10)) * np.sin(np.radians(20)))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_the_sky_is_no_depth_and_classes_have_their_ids(tmp_path) -> None:
    form = FORMATS["syndrone"]
    write_labelled(form, tmp_path / "Town01_Opt_120/ClearNoon/height50m")
    scene = opened(form, tmp_path)
    assert scene.name == "Town01_Opt_120-ClearNoon-height50m"
    assert scene.ground_truth
    assert scene.geometry(0).depth[np.isfinite(scene.geometry(0).depth)].max() < 999


def test_a_camera_that_is_missing_or_lacks_an_angle_is_named(tmp_path) -> None:
    form = FORMATS["syndrone"]
    names, _ = write_labelled(form, tmp_path / "scene")
    path = tmp_path / f"scene/camera/{names[1]}.json"
    path.write_text('{"x": 1, "y": 2, "z": 3, "pitch": 0, "yaw": 0}')
    fails(DataError, f"{names[1]}.json.*roll", opened, form, tmp_path)
    path.unlink()
    fails(DataError, f"{names[1]}.json: is missing; it holds x, y, z", opened, form, tmp_path)
