"""Poses of another time than the frames: the offset is measured, named with the option, and mended by it."""

from __future__ import annotations

import doctor
import numpy as np
import pytest
from command_line import bench
from dataset_writers import numbers, quaternion, save, stored, write_labels, write_lines
from posed_writer import write_posed

from semstab.check import quick_check
from semstab.datasets import open_dataset

NAMES = [f"{k:03d}" for k in range(doctor.FRAMES)]
PERIOD, START = 0.1, 1305031102.0


@pytest.fixture(scope="module")
def frames():
    return doctor.scene(3)


def words(result) -> str:
    return " ".join((result.stdout + result.stderr).split())


@pytest.mark.parametrize(("by", "side", "mend"), [(1, "early", -1), (-1, "late", 1)])
def test_whole_frames_are_named_with_what_mends_them(by, side, mend, frames):
    verdict = quick_check(doctor.FramesInMemory(doctor.poses_of(by)(frames)), range(len(frames)))
    assert verdict.state == "unsound"
    assert f"poses are one frame {side}" in verdict.text
    assert f"pose_shift: {mend}" in verdict.text


def test_they_are_refused_by_check_and_run_and_mended(frames, tmp_path):
    poses = doctor.poses_of(-1)(frames)
    folder = write_posed(tmp_path / "room", NAMES, {"net": poses}, scale=None, classes=list(doctor.SPACE.classes))
    for name in ("check", "run"):
        result = bench(name, "--data", folder, cwd=tmp_path, code=2)
        assert "poses are one frame late" in words(result)
        assert "pose_shift: 1" in words(result)
    mended = bench("check", "--data", folder, "--option", "pose_shift=1", cwd=tmp_path)
    assert "poses are" not in words(mended)


def test_a_shift_moves_poses_and_leaves_the_last_frame_without_one(frames, tmp_path):
    folder = write_posed(tmp_path / "room", NAMES, {"net": frames}, scale=None, classes=list(doctor.SPACE.classes))
    scene = open_dataset("posed_folder", {"root": folder, "pose_shift": 1}).scene("room")
    np.testing.assert_allclose(scene.T_wc(0), frames[1].T_wc, atol=1e-6)
    assert [scene.tracked(k) for k in (0, len(frames) - 2, len(frames) - 1)] == [True, True, False]


def write_tum(folder, frames, late: float):
    """A trajectory with ten poses a frame, whose stamps are late by so many seconds."""
    from scipy.spatial.transform import Rotation, Slerp

    times = PERIOD * np.arange(len(frames))
    dense = np.arange(0, times[-1] + 1e-9, PERIOD / 10)
    at = Slerp(times, Rotation.from_matrix([f.T_wc[:3, :3] for f in frames]))(dense.clip(0, times[-1])).as_matrix()
    xyz = np.stack([np.interp(dense, times, [f.T_wc[axis, 3] for f in frames]) for axis in range(3)], axis=1)
    poses = [f"{START + t + late:.6f} {numbers([*p, *quaternion(R)])}" for t, p, R in zip(dense, xyz, at, strict=True)]
    names = [f"{START + t:.6f}" for t in times]
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"depth/{name}.png", stored(frame, 5000))
        save(folder / f"rgb/{name}.png", np.zeros((doctor.H, doctor.W, 3), np.uint8))
    for kind in ("depth", "rgb"):
        write_lines(folder / f"{kind}.txt", [f"{name} {kind}/{name}.png" for name in names])
    write_lines(folder / "groundtruth.txt", poses)
    write_labels(folder, names, frames)
    K = doctor.CAMERA
    return {"root": folder, "intrinsics": [K.fx, K.fy, K.cx, K.cy], "classes": list(doctor.SPACE.classes)}


@pytest.mark.parametrize("late", [0.07, -0.04])
def test_a_part_of_a_frame_is_measured_to_a_tenth(late, frames, tmp_path):
    options = write_tum(tmp_path / "room", frames, late)

    def checked(**more):
        scene = open_dataset("tum", options | more).scene("room")
        indices = [k for k in range(len(scene)) if scene.tracked(k)]
        return quick_check(scene, indices, options | more)

    said = checked()
    lines = (*said.remarks, said.text)
    (line,) = [line for line in lines if line.startswith("poses are")]
    measured = float(line.partition("time_offset: ")[2].partition(" ")[0])
    assert measured == pytest.approx(late, abs=0.1 * PERIOD + 1e-9)
    mended = checked(time_offset=late)
    assert not any(text.startswith("poses are") for text in (*mended.remarks, mended.text))


def test_clean_poses_are_silent(frames):
    """Those of two more scenes are so in test_check_mistakes.py."""
    verdict = quick_check(doctor.FramesInMemory(frames), range(len(frames)))
    assert (verdict.state, verdict.remarks) == ("sound", ())


@pytest.mark.parametrize(
    ("factor", "late", "said"), [(1e9, 0, "look like nanoseconds"), (1, 300, "set time_offset (about 300)")]
)
def test_clocks_that_differ_are_named(factor, late, said, frames, tmp_path):
    options = write_tum(tmp_path / "room", frames, late)
    path = tmp_path / "room/groundtruth.txt"
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    write_lines(path, [" ".join([f"{float(row[0]) * factor:.6f}", *row[1:]]) for row in rows])
    with pytest.raises(Exception, match=said.replace("(", r"\(").replace(")", r"\)")):
        open_dataset("tum", options).scene("room")
