"""Poses that jump and single frames that do not fit: found, named, and refused or noted; real sequences are silent."""

from __future__ import annotations

import functools
import os
from dataclasses import replace
from pathlib import Path

import doctor
import numpy as np
import pytest
from command_line import bench
from posed_writer import write_posed

from semstab.check import quick_check
from semstab.check.continuity import Neighbours
from semstab.check.conventions import Convention
from semstab.datasets import open_dataset

DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[1] / "../shared/data"))
PLANTED = {mistake.name: mistake for mistake in doctor.MISTAKES}


@functools.cache
def lines(mistake: str) -> list[str]:
    return [*doctor.said(PLANTED[mistake].plant(doctor.scene(0)))]


@pytest.mark.parametrize(
    "mistake",
    ["poses jump by 0.3 m in the middle", "depth of one frame times 5", "pose of one frame off by 0.4 m"],
)
def test_it_is_named_with_its_frame_and_nothing_else_is_said(mistake) -> None:
    (line,) = lines(mistake)
    assert PLANTED[mistake].said in line


def test_depth_in_another_unit_is_told_from_a_wrong_pose() -> None:
    assert "is 5 times too long" in lines("depth of one frame times 5")[0]
    assert "its pose or its depth" in lines("pose of one frame off by 0.4 m")[0]


def test_the_map_of_one_frame_is_named() -> None:
    mistake = "labels of one frame upside down"
    assert any(PLANTED[mistake].said in line for line in lines(mistake))


def test_check_names_the_map_of_another_model_than_the_first(tmp_path) -> None:
    frames = doctor.scene(0)
    upside_down = PLANTED["labels of one frame upside down"].plant(frames)
    models = {name: upside_down if name == "other" else frames for name in ("net", "other")}
    names = [f"{k:03d}" for k in range(len(frames))]
    folder = write_posed(tmp_path / "room", names, models, scale=None, classes=list(doctor.SPACE.classes))
    text = " ".join(bench("check", "--data", folder, cwd=tmp_path).stdout.split())
    assert text.count("is it of another frame?") == 1
    assert "labels of other: the map of frame 011 " in text


@pytest.mark.parametrize(("step", "positions"), [(0.39, set()), (0.41, {9, 10, 11, 12})])
def test_a_step_of_four_times_the_steps_around_it_is_striking(step, positions) -> None:
    """Steps of 0.1 m, but for the one from frame 10 on."""
    along = np.cumsum([0.0, *(step if k == 10 else 0.1 for k in range(19))])
    frames = [replace(f, T_wc=doctor.moved(np.eye(4), (x, 0, 0))) for f, x in zip(doctor.scene(0), along, strict=False)]
    assert Neighbours(doctor.FramesInMemory(frames), range(20), None, Convention()).striking() == positions


def test_poses_that_jump_are_refused_with_the_parts_to_fuse() -> None:
    made = doctor.FramesInMemory(doctor.jump(doctor.scene(0)))
    verdict = quick_check(made, range(len(made)))
    assert verdict.state == "unsound"
    assert "--frames :15 and --frames 15:" in verdict.text


@pytest.mark.parametrize("wrong", [(4, 11, 18), (4, 11, 18, 25)])
def test_frames_that_do_not_fit_are_named_up_to_a_tenth_of_all(wrong) -> None:
    """Of thirty frames three may have a wrong pose, or labels of other classes; four are too many."""
    frames, few = doctor.scene(0), len(wrong) == 3
    off = [replace(f, T_wc=doctor.moved(f.T_wc, (0.3, 0.0, 0.3))) if f.index in wrong else f for f in frames]
    verdict = quick_check(doctor.FramesInMemory(off), range(len(frames)))
    assert verdict.state == ("sound" if few else "unsound")
    assert ("4 of 30 frames do not fit" in verdict.text) is not few
    assert sum("does not fit frames" in line for line in verdict.remarks) == 3 * few
    renamed = [replace(f, labels=doctor.OTHERS[f.labels]) if f.index in wrong else f for f in frames]
    said = [*doctor.said(renamed)]
    assert sum("is it of another frame?" in line for line in said) == 3 * few


@pytest.mark.skipif(not (DATA / "livingroom").is_dir(), reason="the real sequences are not here")
@pytest.mark.parametrize("name", ["livingroom", "apc_shelf", "hololens", "brighton"])
def test_real_sequences_are_sound_and_have_no_misfits(name) -> None:
    dataset = open_dataset("posed_folder", {"root": DATA / name})
    scene = dataset.scene(dataset.scenes[0])
    verdict = quick_check(scene, range(len(scene)))
    assert (verdict.state, verdict.remarks) == ("sound", ())


@pytest.mark.skipif(not (DATA / "livingroom").is_dir(), reason="the real sequences are not here")
def test_a_jump_in_a_real_sequence_is_named(monkeypatch) -> None:
    dataset = open_dataset("posed_folder", {"root": DATA / "livingroom"})
    scene = dataset.scene(dataset.scenes[0])
    right = type(scene).T_wc
    monkeypatch.setattr(
        type(scene), "T_wc", lambda self, k: doctor.moved(right(self, k), np.r_[0.3, 0, 0] * (k >= 106))
    )
    verdict = quick_check(scene, range(len(scene)))
    assert (verdict.state, verdict.text.split(":")[0]) == ("unsound", f"poses jump at frame {scene.frame_name(106)}")
