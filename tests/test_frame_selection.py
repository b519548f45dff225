"""Which frames a selection picks: by number, evenly, from a list, by time; and those without a pose, left out."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest
import tiny_scene
from dataset_writers import FORMATS, matrix_text, opened, write_labelled, write_lines
from hypothesis import given
from hypothesis import strategies as st
from posed_config import configure, dataset_of

from semstab.api import run
from semstab.config import Config, FrameSelection, as_range
from semstab.datasets import open_dataset
from semstab.datasets.scene import select_frames
from semstab.engine.units import make_plan
from semstab.errors import ConfigError, DataError

# --- by number


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"spacing": "even", "count": 5}, [0, 5, 10, 14, 19]),
        ({"spacing": "even", "count": 3, "start": 4, "stop": 9}, [4, 6, 8]),
        ({"spacing": "even", "count": 4, "stride": 3}, [0, 6, 12, 18]),
        ({"spacing": "even", "count": 1}, [0]),
        ({"spacing": "even", "count": 50, "start": 17}, [17, 18, 19]),
        ({"spacing": "even", "count": 2, "start": 20}, []),
        ({"count": 3, "stride": 2, "start": 5}, [5, 7, 9]),
        ({"list": [0, 7, 19]}, [0, 7, 19]),
    ],
)
def test_frames_of_twenty(settings, expected):
    assert FrameSelection(**settings).indices(20) == expected


@given(
    length=st.integers(0, 300), count=st.integers(1, 40), start=st.integers(0, 320), stop=st.integers(1, 320),
    stride=st.integers(1, 9),
)  # fmt: skip
def test_evenly_spaced_frames_hold_both_ends_at_equal_distances(length, count, start, stop, stride):
    all_of_them = FrameSelection(start=start, stop=stop, stride=stride).indices(length)
    even = FrameSelection(start=start, stop=stop, stride=stride, count=count, spacing="even").indices(length)
    assert set(even) <= set(all_of_them)
    assert len(even) == min(count, len(all_of_them))
    if len(even) > 1:
        assert (even[0], even[-1]) == (all_of_them[0], all_of_them[-1])
        steps = np.diff([all_of_them.index(frame) for frame in even])
        assert steps.min() >= 1
        assert steps.max() - steps.min() <= 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"spacing": "even"}, "frames: spacing: even needs count"),
        ({"list": [3, 3]}, "frames: the frames of a list must ascend"),
        ({"list": []}, r"frames\.list: "),
        ({"list": [-1]}, r"frames\.list\.0: "),
        ({"list": [1], "stride": 2, "count": 1}, "frames: list says which frames; leave out stride, count"),
        ({"from_time": 2, "to_time": 1}, "frames: from_time lies after to_time"),
        ({"from_time": math.nan}, r"frames\.from_time: "),
        ({"lists": [1]}, r"unknown setting 'frames\.lists'; did you mean 'list'"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_line(settings, message):
    with pytest.raises(ConfigError, match=message) as caught:
        Config.build({"frames": settings})
    assert "\n" not in str(caught.value)


def test_a_list_survives_its_own_yaml(tmp_path):
    config = Config(frames=FrameSelection(list=(1, 4)))
    (tmp_path / "c.yaml").write_text(config.to_yaml())
    assert Config.build(config.model_dump(mode="json")).frames.indices(9) == [1, 4]


def test_a_listed_frame_that_is_not_there_is_named():
    with pytest.raises(ConfigError, match=r"frames\.list: there is no frame 9; the sequence has 9, from 0"):
        FrameSelection(list=(1, 9)).indices(9)


# --- by time


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"from_time": 0.3}, [3, 4]),
        ({"to_time": 0.2}, [0, 2]),
        ({"from_time": 0.1, "to_time": 0.3, "stride": 2}, [2]),
        ({"from_time": 9}, []),
    ],
)
def test_a_range_of_time_includes_both_ends_and_no_frame_of_unknown_time(settings, expected):
    assert FrameSelection(**settings).indices(5, [0.0, math.nan, 0.2, 0.3, 0.4]) == expected


def test_a_range_of_time_needs_time_stamps():
    with pytest.raises(ConfigError, match="need time stamps; this sequence has none"):
        FrameSelection(from_time=0).indices(5)


# --- of scenes


def test_times_are_those_of_the_scene(tmp_path):
    write_labelled(FORMATS["tum"], tmp_path)
    scene = opened(FORMATS["tum"], tmp_path)
    np.testing.assert_allclose(scene.timestamps - 1305031102, [0, 0.1, 0.2, 0.3], atol=1e-6)
    assert scene.frame(2, "net").timestamp == pytest.approx(1305031102.2)
    assert select_frames(scene, FrameSelection(from_time=1305031102.1, to_time=1305031102.25)).indices == [1, 2]


def test_a_frame_rate_gives_times(tmp_path):
    write_labelled(FORMATS["hololens"], tmp_path)
    scene = opened(FORMATS["hololens"], tmp_path)
    assert scene.timestamps is None
    with pytest.raises(ConfigError, match="need time stamps"):
        select_frames(scene, FrameSelection(from_time=0))
    timed = opened(FORMATS["hololens"], tmp_path, frames_per_second=2)
    assert select_frames(timed, FrameSelection(from_time=0.5, to_time=1)).indices == [1, 2]
    assert timed.frame(3, "net").timestamp == 1.5


@pytest.mark.parametrize("lost", ["-inf", "nan"])
def test_lost_poses_are_left_out_and_said(tmp_path, caplog, lost):
    write_labelled(FORMATS["scannet"], tmp_path)
    for k in (1, 3):
        write_lines(tmp_path / f"pose/{k}.txt", [f"{lost} {lost} {lost} {lost}"] * 4)
    scene = opened(FORMATS["scannet"], tmp_path)
    assert len(scene) == 4
    with caplog.at_level(logging.WARNING, logger="semstab"):
        assert select_frames(scene, FrameSelection()).indices == [0, 2]
    assert (
        f"{tmp_path.name}: 2 of 4 selected frames have no pose (tracking was lost) and are left out: 1, 3"
        in caplog.text
    )
    assert select_frames(scene, FrameSelection(list=(0, 3))).indices == [0]
    with pytest.raises(ValueError, match=r"pose/1\.txt: the pose is not finite"):
        scene.frame(1, "net")


def test_a_damaged_pose_is_no_lost_one(tmp_path):
    write_labelled(FORMATS["scannet"], tmp_path)
    write_lines(tmp_path / "pose/2.txt", matrix_text(np.eye(3)))
    with pytest.raises(ValueError, match=r"pose/2\.txt: expected a 4x4 or 3x4 matrix, got 9 numbers"):
        select_frames(opened(FORMATS["scannet"], tmp_path), FrameSelection())


def test_the_city_s_frames_can_be_chosen_by_time() -> None:
    scene = open_dataset("city", {"frames": 9}).scene("scene0")
    first, last = scene.timestamps[2], scene.timestamps[5]
    assert select_frames(scene, FrameSelection(from_time=first, to_time=last)).indices == [2, 3, 4, 5]


# --- what was not asked for


def test_label_maps_that_were_not_asked_for_neither_break_nor_change_a_run(tmp_path):
    """A second model predicted every other frame only, and its classes cannot be read."""
    root = tiny_scene.write(tmp_path / "wall", models=("a",), frames=6)
    settings = {"voxel_size": 0.25, "backends": ["numpy"], "check": None, "models": ["a"]}
    before = run_of(root, settings)
    partial = root / "labels/partial"
    partial.mkdir()
    for k in (0, 2, 4):
        (partial / f"{k:04d}.png").write_bytes((root / f"labels/a/{k:04d}.png").read_bytes())
    (partial / "label_space.yaml").write_text("classes: 3")
    for incomplete in ("error", "skip"):
        (found,) = run_of(root, settings, incomplete=incomplete)
        assert (found.map_summary, found.frames) == (before[0].map_summary, 6)


def test_frames_are_selected_on_the_sequence_and_what_lacks_a_file_is_counted(tmp_path):
    root = tiny_scene.write(tmp_path / "wall", models=("a", "partial"), frames=12)
    for k in set(range(12)) - {0, 3, 6, 9}:
        (root / f"labels/partial/{k:04d}.png").unlink()
    every_third = {"models": ["partial"], "frames": {"stride": 3}}
    assert [*plan_of(root, every_third).tasks[0].indices] == [0, 3, 6, 9]
    (task,) = plan_of(root, every_third, incomplete="skip").tasks  # the stride is not applied to what is left
    assert ([*task.indices], task.left_out) == ([0, 3, 6, 9], 0)
    with pytest.raises(DataError, match=r"4 missing: .*labels/partial/0002\.png"):
        plan_of(root, {"models": ["partial"], "frames": {"stride": 2}})
    (task,) = plan_of(root, {"models": ["partial"], "frames": {"stride": 2}}, incomplete="skip").tasks
    assert ([*task.indices], task.left_out) == ([0, 6], 4)


def plan_of(root, settings, **options):
    return make_plan(configure(root, dataset=dataset_of(root, **options), **settings))


def run_of(root, settings, **options):
    return run(configure(root, dataset=dataset_of(root, **options), **settings), report=False).runs


@given(st.sets(st.integers(0, 40), min_size=1))
def test_frames_of_a_range_are_a_range_and_others_stay_as_they_are(chosen):
    listed = sorted(chosen)
    short = as_range(listed)
    assert [*short] == listed == FrameSelection.from_indices(short).indices(41)
    assert isinstance(as_range(listed[:1] + [k + listed[0] for k in (3, 6)]), range)
