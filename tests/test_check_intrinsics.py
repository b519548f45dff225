"""Intrinsics that are not those of the depth: named with those that fit, and not where another thing explains it."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import doctor
import numpy as np
import pytest
from command_line import bench
from posed_writer import write_posed

from semstab.check import quick_check
from semstab.datasets import open_dataset

NAMES = [f"{k:03d}" for k in range(doctor.FRAMES)]
DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[1] / "../shared/data"))


def verdict(seed, mistake=lambda frames: frames):
    made = doctor.FramesInMemory(mistake(doctor.scene(seed)))
    return quick_check(made, range(len(made)))


@pytest.mark.parametrize("seed", [1, 2])
def test_a_focal_length_that_is_too_small_is_named_with_the_one_that_fits(seed) -> None:
    """Data is refused where the error falls to half; else it is a remark."""
    found = verdict(seed, doctor.camera(0.8))
    (text,) = (text for text in (found.text, *found.remarks) if "the focal length is" in text)
    assert "too small" in text
    fx = float(text.split("fx = ")[1].split(",")[0])
    assert fx == pytest.approx(doctor.CAMERA.fx, rel=0.08)
    assert found.state == ("unsound" if text == found.text else "sound")


def test_a_principal_point_that_is_off_is_not_taken_for_another_size_of_the_image() -> None:
    found = verdict(1, doctor.camera(right=doctor.W / 10))
    (text,) = (text for text in (found.text, *found.remarks) if "cx is" in text)
    assert float(text.split("cx = ")[1].split(",")[0]) == pytest.approx(doctor.CAMERA.cx, abs=5)
    assert not found.mend


def test_nothing_is_said_of_intrinsics_that_are_right() -> None:
    found = verdict(1)
    assert found.state == "sound"
    assert not any("focal" in text or "cx is" in text for text in (found.text, *found.remarks))


def test_depth_that_is_a_little_too_long_is_no_matter_of_intrinsics() -> None:
    def longer(frames):
        return [dataclasses.replace(f, depth=f.depth * np.float32(1.05)) for f in frames]

    found = verdict(1, longer)
    assert not any("focal" in text for text in (found.text, *found.remarks))


def test_the_command_refuses_them_and_says_which_fit(tmp_path) -> None:
    frames = doctor.camera(0.8)(doctor.scene(3))
    folder = write_posed(tmp_path / "room", NAMES, {"net": frames}, scale=None, classes=list(doctor.SPACE.classes))
    for name in ("check", "run"):
        done = bench(name, "--data", folder, cwd=tmp_path, code=2)
        text = " ".join((done.stdout + done.stderr).split())
        assert "the focal length is" in text
        assert "correct the intrinsics" in text


@pytest.mark.parametrize("name", ["apc_shelf", "hololens", "livingroom", "brighton"])
def test_real_cameras_are_left_alone(name) -> None:
    if not (DATA / name).is_dir():
        pytest.skip(f"no {DATA / name}; set SEMSTAB_DATA to the folder that holds {name}/")
    dataset = open_dataset("posed_folder", {"root": DATA / name})
    scene = dataset.scene(dataset.scenes[0])
    found = quick_check(scene, range(len(scene)))
    assert not any("focal" in text or "cx is" in text for text in (found.text, *found.remarks))
