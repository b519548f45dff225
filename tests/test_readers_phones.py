"""Recordings of phones: confidence of depth, intrinsics of each frame, poses between stamps, and what is damaged."""

from __future__ import annotations

import functools
import json
import shutil

import cv2
import dataset_writers as ds
import numpy as np
import pytest
from posed_scene import fails

from semstab.errors import DataError

APPS = {name: ds.FORMATS[name] for name in ("stray_scanner", "polycam", "record3d", "arkitscenes")}
CONFIDENCE = {
    "stray_scanner": "confidence/000001.png", "polycam": "keyframes/confidence/9457.png",
    "arkitscenes": "confidence/41069021_305.877.png",
}  # fmt: skip
"""The confidence of the second frame."""


@pytest.fixture
def written(tmp_path):
    def write(name, **how):
        form = APPS[name]
        frames = ds.source(form.scale)
        names = functools.partial(form.write, **how)(tmp_path, frames)
        ds.write_labels(tmp_path, names, frames)
        return form, tmp_path, frames

    return write


# --- Confidence -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CONFIDENCE)
def test_depth_of_low_confidence_is_left_out_unless_all_is_wanted(written, name) -> None:
    form, folder, frames = written(name)
    path = folder / CONFIDENCE[name]
    confidence = np.full(frames[1].depth.shape, 2, np.uint8)
    confidence[5:9, 3:20], confidence[20, 4] = 0, 1
    before = ds.opened(form, folder).digest([1], "net")
    assert cv2.imwrite(str(path), confidence)
    for least in (0, 1, 2):
        scene = ds.opened(form, folder, least_confidence=least)
        expected = np.where(confidence >= least, frames[1].depth, 0)
        np.testing.assert_array_equal(scene.depth(1), expected)
        np.testing.assert_array_equal(
            scene.depth(0)[5:9], frames[0].depth[5:9] if least < 2 or name != "stray_scanner" else 0
        )
    usual = ds.opened(form, folder)
    assert usual.options.least_confidence == 1
    assert usual.digest([1], "net") != before


@pytest.mark.parametrize("name", CONFIDENCE)
def test_confidence_that_is_lost_or_of_another_size_is_named(written, name) -> None:
    form, folder, _ = written(name)
    path = folder / CONFIDENCE[name]
    path.unlink()
    scene = ds.opened(form, folder)
    assert scene.missing(1) == [str(path)]
    fails(DataError, CONFIDENCE[name], scene.depth, 1)
    assert ds.opened(form, folder, least_confidence=0).missing(1) == []
    assert cv2.imwrite(str(path), np.ones((8, 12), np.uint8))
    fails(DataError, rf"{CONFIDENCE[name]}: confidence is 12x8 but depth is 48x32", ds.opened(form, folder).depth, 1)
    assert cv2.imwrite(str(path), np.ones((32, 48, 3), np.uint8))
    fails(DataError, r"a 8-bit RGB PNG is no image of confidence", ds.opened(form, folder).depth, 1)


# --- Intrinsics -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["stray_scanner", "record3d"])
@pytest.mark.parametrize("by_frame", [True, False])
def test_intrinsics_of_a_frame_go_before_those_of_the_recording(written, name, by_frame) -> None:
    form, folder, frames = written(name, own_intrinsics=by_frame)
    scene = ds.opened(form, folder)
    for k in range(3):
        found = scene.geometry(k).intrinsics
        assert ds.four(frames[k]) == pytest.approx([found.fx, found.fy, found.cx, found.cy])


def test_intrinsics_of_a_large_video_are_brought_to_the_depth(written) -> None:
    form, folder, frames = written("stray_scanner")
    K = ds.opened(form, folder, image_size=(4 * ds.W, 4 * ds.H)).geometry(0).intrinsics
    assert K.fx == pytest.approx(frames[0].intrinsics.fx / 4)


@pytest.mark.parametrize("corrected", [True, False])
def test_optimised_keyframes_of_polycam_go_before_others(written, corrected) -> None:
    form, folder, frames = written("polycam", corrected=corrected)
    if corrected:
        ds.write_polycam(folder, ds.source(1000)[::-1], corrected=False)
        for name, frame in zip(sorted((folder / "keyframes/depth").iterdir()), frames, strict=True):
            ds.save(name, ds.stored(frame, 1000))
    scene = ds.opened(form, folder)
    np.testing.assert_allclose(scene.geometry(2).T_wc, frames[2].T_wc, atol=1e-12)
    assert scene.image(2).shape == (ds.H, ds.W, 3)


# --- Poses of ARKitScenes ---------------------------------------------------------------------------------------------


def test_poses_lie_between_their_neighbours_and_are_never_extrapolated(written) -> None:
    form, folder, frames = written("arkitscenes")
    path = folder / "lowres_wide.traj"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:1:-1], lines[2]]))  # none before the second image; reversed, one twice
    scene = ds.opened(form, folder)
    assert [scene.tracked(k) for k in range(4)] == [False, True, True, True]
    np.testing.assert_allclose(scene.geometry(1).T_wc, frames[1].T_wc, atol=1e-9)
    late = ds.opened(form, folder, time_offset=0.25, max_pose_gap=1.0)
    middle = (frames[1].T_wc[:3, 3] + frames[2].T_wc[:3, 3]) / 2
    np.testing.assert_allclose(late.geometry(1).T_wc[:3, 3], middle, atol=1e-6)
    assert not ds.opened(form, folder, time_offset=0.25, max_pose_gap=0.2).tracked(1)


def test_depth_without_intrinsics_is_no_frame(written) -> None:
    form, folder, _ = written("arkitscenes")
    (folder / "lowres_wide_intrinsics/41069021_305.377.pincam").unlink()
    assert len(ds.opened(form, folder)) == 3
    shutil.rmtree(folder / "lowres_depth")
    fails(DataError, "no depth image has intrinsics of its name", ds.opened, form, folder)


# --- Damaged files ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "file", "old", "new", "said"),
    [
        ("stray_scanner", "odometry.csv", "000001, ", "", r"odometry.csv: line 3 does not have 9 or 13 values"),
        ("stray_scanner", "odometry.csv", "000001, ", "000001, x", r"odometry.csv: line 3: 'x.*' is not a number"),
        ("stray_scanner", "odometry.csv", None, "timestamp, frame", r"odometry.csv: holds no pose; record again"),
        ("polycam", "keyframes/corrected_cameras/9457.json", '"t_12"', '"t_x"', r"9457.json: 't_12'"),
        ("polycam", "keyframes/corrected_cameras/9457.json", '"width": 48', '"width": -1', r"9457.json: 'width'"),
        ("record3d", "metadata.json", '"poses": [[', '"poses": [[1, ', r"'poses' must be a list of rows of 7 numbers"),
        ("record3d", "metadata.json", '"K": [', '"K": [1, ', r"metadata.json: 'K' must be nine numbers"),
        ("record3d", "metadata.json", '"w"', '"x"', r"metadata.json: 'w'"),
        ("arkitscenes", "lowres_wide.traj", "305.3270 ", "305.3270 1 ", r"lowres_wide.traj: line 1 has 8 values"),
        ("arkitscenes", "lowres_wide_intrinsics/41069021_305.877.pincam", "48 ", "0 ", "expected one line of width"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_named_with_what_it_lacks(written, name, file, old, new, said) -> None:
    form, folder, _ = written(name)
    content = (folder / file).read_text()
    assert old is None or old in content
    (folder / file).write_text(new if old is None else content.replace(old, new, 1))
    fails(DataError, said, ds.opened, form, folder)


def test_as_many_intrinsics_as_poses(written) -> None:
    form, folder, _ = written("record3d", own_intrinsics=True)
    content = json.loads((folder / "metadata.json").read_text())
    content["perFrameIntrinsicCoeffs"].pop()
    (folder / "metadata.json").write_text(json.dumps(content))
    fails(DataError, "metadata.json: 3 intrinsics for 4 poses", ds.opened, form, folder)


def test_a_name_without_seconds_is_named(written) -> None:
    form, folder, _ = written("arkitscenes")
    for kind, suffix in (("lowres_depth", "png"), ("lowres_wide_intrinsics", "pincam")):
        (folder / kind / f"41069021_305.377.{suffix}").rename(folder / kind / f"first.{suffix}")
    fails(DataError, r"'first' does not end in seconds, as in 41069021_305.377", ds.opened, form, folder)
