"""Files that no setting mends are named as what they are: mirrored depth, transposed rotations, quaternions, ..."""

from __future__ import annotations

import dataclasses

import doctor
import numpy as np
import pytest
from posed_writer import write_posed

from semstab.check import geometry, quick_check
from semstab.check.conventions import Convention
from semstab.check.geometry import with_mistakes
from semstab.check.hypotheses import CAMERAS, angles, camera_poses, mistake
from semstab.check.reprojection import Sample, View
from semstab.datasets import open_dataset

NAMES = [
    "depth mirrored left to right", "depth upside down", "depth turned by 180 degrees", "rotations transposed",
    "quaternions w x y z read as x y z w", "quaternions x y z w read as w x y z", "cx and cy exchanged",
    "intrinsics divided by the size",
]  # fmt: skip
PLANTED = {mistake.name: mistake for mistake in doctor.MISTAKES}


def verdict(frames):
    return quick_check(doctor.FramesInMemory(frames), range(len(frames)))


@pytest.mark.parametrize("name", NAMES)
def test_a_mistake_of_files_is_named_with_what_to_do(name) -> None:
    planted = PLANTED[name]
    found = verdict(planted.plant(doctor.scene(1)))
    assert found.state == "unsound"
    assert planted.said in found.text
    (mend,) = (mistake.mend for mistake in CAMERAS if planted.said in mistake.name)
    assert found.text.endswith(mend)
    assert found.fits[1][1].error < found.fits[0][1].error or not found.fits[0][1].has_evidence


def test_rotations_are_transposed_as_the_file_has_them(tmp_path) -> None:
    """Where poses map the world to the camera, it is the rotation of that matrix, beside its own translation."""
    frames = doctor.scene(1)
    names = [f"{k:03d}" for k in range(len(frames))]
    settings = {"classes": [*doctor.SPACE.classes], "pose_convention": "world_to_camera", "camera_axes": "opengl"}
    folder = write_posed(tmp_path / "room", names, {"net": frames}, scale=None, **settings)
    for path, frame in zip(sorted((folder / "pose").iterdir()), frames, strict=True):
        T = np.linalg.inv(frame.T_wc @ np.diag([1.0, -1, -1, 1]))
        T[:3, :3] = T[:3, :3].T
        np.savetxt(path, T)
    scene = open_dataset("posed_folder", {"root": folder}).scene("room")
    assert "poses with transposed rotations, as it seems" in quick_check(scene, range(len(scene))).text


@pytest.mark.parametrize("axes", [(0,), (1,), (0, 1)])
def test_a_thinned_image_is_mirrored_to_the_pixel(axes) -> None:
    """641 columns and 480 rows, every third pixel: the first pixel of the mirrored image is not that of the file."""
    frame = dataclasses.replace(doctor.scene(0)[0], depth=np.arange(480 * 641, dtype=np.float32).reshape(480, 641) + 1,
                                labels=np.zeros((480, 641), np.uint8))  # fmt: skip
    (mistake,) = (m for m in CAMERAS if m.name.endswith({(0,): "down", (1,): "right", (0, 1): "degrees"}[axes]))
    view = View.from_frame(frame, 500)
    mended = mistake.change(Sample({0: view}, [], Convention())).views[0]
    K, k = mended.camera.every(view.stride), frame.intrinsics
    for v, u in zip(mended.v[:50], mended.u[:50], strict=True):
        row, column = np.divmod(int(mended.depth[v, u]) - 1, 641)
        ray = (479 - row if 0 in axes else row) - k.cy, (640 - column if 1 in axes else column) - k.cx
        assert (v - K.cy) * view.stride == pytest.approx(ray[0], abs=0.5 * view.stride)
        assert (u - K.cx) * view.stride == pytest.approx(ray[1], abs=0.5 * view.stride)


@pytest.mark.parametrize("seed", range(2))
def test_nothing_is_said_of_files_that_are_right(seed) -> None:
    frames = doctor.scene(seed)
    found = verdict(frames)
    views = {k: View.from_frame(frame, 500) for k, frame in enumerate(frames[:6])}
    sample = Sample(views, [(0, 3), (1, 4), (2, 5), (5, 0)], found.fits[0][1].convention)
    assert (found.state, found.remarks) == ("sound", ())
    assert with_mistakes(found, sample) is found


def test_a_new_hypothesis_is_one_entry(monkeypatch) -> None:
    """Angles twice as large: they are named once an entry says what it changes."""
    frames = [dataclasses.replace(f, T_wc=angles(2.0)(f.T_wc)) for f in doctor.scene(1)]
    entry = mistake("angles twice as large", camera_poses(angles(0.5)), "halve them")
    monkeypatch.setattr(geometry, "CAMERAS", (*CAMERAS, entry))
    found = verdict(frames)
    assert found.state == "unsound"
    assert found.text.startswith("angles twice as large, as it seems")
    assert found.text.endswith("; halve them")
