"""TUM RGB-D: what belongs together in time, and poses between the trajectory's stamps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from dataset_writers import FORMATS, numbers, opened, source, write_labels, write_lines, write_tum
from hypothesis import given
from hypothesis import strategies as st

from semstab.datasets.geometry.cameras import at_times, from_quaternions, mutual_nearest
from semstab.errors import DataError

TUM = FORMATS["tum"]


@pytest.fixture
def folder(tmp_path):
    names = write_tum(tmp_path, source(5000))
    write_labels(tmp_path, names, source(5000))
    return tmp_path


def turning(times) -> np.ndarray:
    """Poses of a camera that turns about z with 1 rad/s and moves along x with 2 m/s."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for pose, t in zip(poses, times, strict=True):
        pose[:2, :2] = [[math.cos(t), -math.sin(t)], [math.sin(t), math.cos(t)]]
        pose[0, 3] = 2 * t
    return poses


@given(
    at=st.lists(st.floats(0, 3), min_size=1, max_size=5), steps=st.lists(st.floats(0.05, 0.7), min_size=1, max_size=9)
)
def test_between_two_poses_motion_is_steady(at, steps):
    times = np.cumsum([0, *steps])
    wanted = np.array(at).clip(0, times[-1])
    found = at_times(times, turning(times), wanted, max_gap=1, method="interpolate")
    np.testing.assert_allclose(found, turning(wanted), rtol=0, atol=1e-9)


def test_the_nearest_pose_and_none_beyond_the_gap():
    times, wanted = np.array([0.0, 1.0, 2.0]), np.array([-0.05, 0.4, 0.96, 2.2])
    found = at_times(times, turning(times), wanted, max_gap=0.1, method="nearest")
    np.testing.assert_array_equal(found[[0, 2]], turning(times[[0, 1]]))
    assert np.isnan(found[[1, 3]]).all()


def test_lost_poses_are_no_neighbours():
    times = np.array([0.0, 1.0, 2.0])
    poses = turning(times)
    poses[1] = np.nan
    np.testing.assert_allclose(
        at_times(times, poses, np.array([1.0]), max_gap=1, method="interpolate"), turning(np.array([1.0])), atol=1e-9
    )
    assert np.isnan(at_times(times, poses, np.array([1.0]), max_gap=0.5, method="interpolate")).all()
    assert np.isnan(at_times(times, poses * np.nan, np.array([1.0]), max_gap=9, method="nearest")).all()
    one = at_times(times[:1], poses[:1], np.array([0.1]), max_gap=1, method="interpolate")
    np.testing.assert_array_equal(one[0], poses[0])


def test_quaternions_turn_as_they_should(tmp_path):
    """A quaternion x y z w = 0 0 sin(a/2) cos(a/2) turns by a about z."""
    T = from_quaternions(np.array([[2.0, 0, 0]]), np.array([[0, 0, math.sin(0.5), math.cos(0.5)]]), tmp_path)
    np.testing.assert_allclose(T, turning([1.0]), atol=1e-12)
    lost = from_quaternions(np.array([[0.0, 0, 0]]), np.array([[0, 0, math.nan, 1]]), tmp_path)
    assert np.isnan(lost).all()
    with pytest.raises(DataError, match="the quaternion of pose 2 has length 2"):
        from_quaternions(np.zeros((2, 3)), np.array([[0, 0, 0, 1.0], [0, 0, 0, 2]]), tmp_path)


# --- association


def test_each_is_the_others_nearest():
    depth, color = np.array([0.0, 0.1, 0.2, 0.5]), np.array([0.004, 0.108, 0.111, 0.19, 0.45])
    assert mutual_nearest(depth, color, 0.02).tolist() == [0, 1, 3, -1]
    assert mutual_nearest(depth, color, 0.06).tolist() == [0, 1, 3, 4]


@given(
    a=st.lists(st.integers(0, 1000), min_size=1, max_size=30, unique=True).map(sorted),
    b=st.lists(st.integers(0, 1000), min_size=1, max_size=30, unique=True).map(sorted),
    limit=st.integers(1, 50),
)
def test_association_is_one_to_one_and_symmetric(a, b, limit):
    ours, theirs = np.array(a, float), np.array(b, float)
    found = mutual_nearest(ours, theirs, limit)
    matched = found[found >= 0]
    assert len(set(matched.tolist())) == len(matched)
    for k in range(len(ours)):
        distances = np.abs(theirs - ours[k])
        if found[k] >= 0:
            assert distances[found[k]] == distances.min() <= limit
            assert np.abs(ours - theirs[found[k]]).min() == distances.min()


def test_a_depth_image_without_a_colour_image_is_left_out_and_said(folder, caplog):
    lines = (folder / "rgb.txt").read_text().splitlines()
    write_lines(folder / "rgb.txt", [lines[0], lines[1], *lines[3:]])
    scene = opened(TUM, folder)
    assert len(scene) == 3
    assert "1 depth images have no colour image; left out" in caplog.text
    assert scene.frame(1, "net").timestamp == pytest.approx(1305031102.2)


def test_without_colour_images_labels_go_by_the_depth_images_name(tmp_path):
    write_tum(tmp_path, source(5000))
    (tmp_path / "rgb.txt").unlink()
    write_labels(tmp_path, [f"{1305031102 + 0.1 * k:.6f}" for k in range(4)], source(5000))
    scene = opened(TUM, tmp_path)
    assert (len(scene), scene.frame(0, "net").color) == (4, None)


@pytest.mark.parametrize(("unit", "name"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
@pytest.mark.parametrize("file", ["groundtruth.txt", "depth.txt"])
def test_stamps_in_other_units_are_told(unit, name, file, folder):
    (folder / "rgb.txt").unlink()
    lines = [line.split(maxsplit=1) for line in (folder / file).read_text().splitlines() if line[0] != "#"]
    write_lines(folder / file, [f"{float(stamp) * unit:.0f} {rest}" for stamp, rest in lines])
    where = "groundtruth.txt" if file == "groundtruth.txt" else "the lists of images"
    with pytest.raises(DataError, match=f"time stamps of {where} look like {name}; write seconds"):
        opened(TUM, folder).T_wc(0)


def test_poses_are_taken_between_stamps_or_the_nearest(folder):
    """Of a trajectory that only knows 0.01 s before and 0.01 s after each depth image."""
    start = 1305031102.0
    times = [start + 0.1 * k + offset for k in range(4) for offset in (-0.01, 0.01)]
    lines = []
    for t, pose in zip(times, turning([t - start for t in times]), strict=True):
        half = math.atan2(pose[1, 0], pose[0, 0]) / 2
        lines.append(f"{t:.6f} {numbers([*pose[:3, 3], 0, 0, math.sin(half), math.cos(half)])}")
    write_lines(folder / "groundtruth.txt", lines)
    between = opened(TUM, folder).T_wc(2)
    np.testing.assert_allclose(between, turning([0.2])[0], atol=1e-6)  # stamps have microseconds
    nearest = opened(TUM, folder, poses="nearest").T_wc(2)
    assert nearest[0, 3] in (pytest.approx(2 * 0.19), pytest.approx(2 * 0.21))
    narrow = opened(TUM, folder, max_difference=0.009)
    assert not any(narrow.tracked(k) for k in range(4))


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth.txt"])
def test_stamps_out_of_order_are_named(folder, name):
    lines = (folder / name).read_text().splitlines()
    write_lines(folder / name, [lines[0], lines[2], lines[1], *lines[3:]])
    with pytest.raises(
        DataError, match=r"time stamps must ascend, but record 2 \(1305031102\.\d+\) is not after record 1"
    ) as e:
        opened(TUM, folder)
    assert str(folder / name) in str(e.value)


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth.txt"])
def test_two_records_of_one_stamp_are_out_of_order(folder, name):
    lines = (folder / name).read_text().splitlines()
    write_lines(folder / name, [*lines[:2], *lines[1:]])
    stamp = lines[1].split()[0].replace(".", r"\.")
    with pytest.raises(DataError, match=rf"record 2 \({stamp}\d*\) is not after record 1 \({stamp}"):
        opened(TUM, folder)


def test_calibrations_go_by_the_sequences_name(tmp_path):
    for name in ("rgbd_dataset_freiburg2_desk", "my_kinect"):
        write_labels(tmp_path / name, write_tum(tmp_path / name, source(5000)), source(5000))
    scene = opened(TUM, tmp_path / "rgbd_dataset_freiburg2_desk", intrinsics=None)
    assert scene.intrinsics(0, (480, 640)).fx == 520.908620
    assert scene.intrinsics(0, (240, 320)).fx == 520.908620 / 2
    with pytest.raises(DataError, match=r"my_kinect: the intrinsics are not known.*set intrinsics: \[fx, fy, cx, cy\]"):
        opened(TUM, tmp_path / "my_kinect", intrinsics=None)
