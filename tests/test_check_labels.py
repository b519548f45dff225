"""Label maps that do not belong to their frames, or are no ids: planted mistakes are named, whole scenes are silent."""

from __future__ import annotations

import json
from dataclasses import replace

import doctor
import numpy as np
import pytest
from command_line import bench
from corners import combination
from PIL import Image
from posed_writer import write_posed

from semstab import LabelSpace
from semstab.check.label_ids import id_remarks
from semstab.check.label_maps import MAPS, LabelledFrame, LabelRun
from semstab.check.labels import check_labels
from semstab.check.reprojection import View

NAMES = [f"{k:03d}" for k in range(doctor.FRAMES)]
OF_ALL = [
    hypothesis for hypothesis in doctor.MISTAKES if "of one frame" not in hypothesis.name
]  # found in 7 of 10 scenes: docs/check.md
LABELS = [hypothesis for hypothesis in OF_ALL if hypothesis.name.startswith(("labels", "ids", "one class"))]


def write(folder, frames):
    return write_posed(folder, NAMES, {"net": frames}, scale=None, classes=list(doctor.SPACE.classes))


@pytest.fixture(scope="module")
def frames():
    return doctor.scene(3)


def words(result) -> str:
    return " ".join((result.stdout + result.stderr).split())


@pytest.mark.parametrize("mistake", LABELS, ids=lambda mistake: mistake.name)
def test_what_is_wrong_with_labels_is_named(mistake, frames):
    found = check_labels(doctor.FramesInMemory(mistake.plant(frames)), range(len(frames)), "net", doctor.SPACE, 6)
    wrong = mistake.said.startswith("are ") or "same map" in mistake.said
    assert any(mistake.said in line for line in (found.wrong if wrong else found.remarks))
    assert bool(found.wrong) == wrong


def test_check_says_it_and_ends_with_exit_2(frames, tmp_path):
    mistake = next(hypothesis for hypothesis in LABELS if "one map" in hypothesis.name)
    folder = write(tmp_path / "room", mistake.plant(frames))
    assert mistake.said in words(bench("check", "--data", folder, cwd=tmp_path, code=2))


def test_a_run_says_the_same_and_goes_on(frames, tmp_path):
    mirrored = next(hypothesis for hypothesis in LABELS if "mirrored" in hypothesis.name)
    folder = write(tmp_path / "room", mirrored.plant(frames))
    result = bench("run", "--data", folder, "--voxel-size", "0.2", "--check", "none", cwd=tmp_path)
    note, verdict = (words(result).index(text) for text in ("note: labels of net are mirrored left to right", "alpha"))
    assert note < verdict
    (notes,) = json.loads(next(tmp_path.glob("runs/*/summary.json")).read_text())["notes"].values()
    assert any("mirrored" in text for text in notes)


def test_labels_of_another_frame_fail_a_check_and_are_noted_by_a_run(frames, tmp_path):
    """docs/check.md says why: a run measures the labels as they are."""
    early = next(hypothesis for hypothesis in LABELS if hypothesis.name == "labels of the next frame")
    folder = write(tmp_path / "room", early.plant(frames))
    refused = bench("check", "--quiet", "--data", folder, cwd=tmp_path, code=2)
    assert "error: room: labels of net are one frame early" in words(refused)
    noted = bench("run", "--data", folder, "--voxel-size", "0.2", "--check", "none", cwd=tmp_path)
    assert "note: labels of net are one frame early" in words(noted)


def test_a_scene_without_mistakes_is_silent(frames):
    assert [*doctor.said(frames)] == []


def test_what_frames_cannot_tell_is_said(frames, tmp_path):
    """Labels that have nothing to do with the scene fit no better as they are."""
    rng = np.random.default_rng(0)
    noise = doctor.relabelled(lambda L: rng.integers(0, 7, L.shape).astype(np.uint8))(frames)
    result = bench("check", "-v", "--data", write(tmp_path / "room", noise), cwd=tmp_path)
    assert "their edges lie on those of depth and colour no better than mirrored" in words(result)


def test_jpegs_in_the_place_of_label_maps_are_named(frames, tmp_path):
    folder = write(tmp_path / "room", frames)
    for path in (folder / "labels/net").glob("*.png"):
        Image.open(path).convert("L").save(path.with_suffix(".jpg"))
        path.unlink()
    result = bench("run", "--data", folder, cwd=tmp_path, code=2)
    assert "labels/net/000.jpg is a JPEG, which changes class ids; write label maps as PNG" in words(result)


def test_a_first_class_that_may_be_missing_is_no_remark():
    maps = [np.arange(1, 4, dtype=np.uint8).repeat(4).reshape(3, 4)] * 4
    road, void = (LabelSpace("s", (name, "a", "b", "c")) for name in ("road", "void"))
    assert any("never have the first id" in line for line in id_remarks(maps, 255, road, maps))
    assert not [*id_remarks(maps, 255, void, maps)]


@pytest.mark.parametrize(
    ("seed", "renamed", "said"),
    [
        (0, range(8, 30), "8 on: 0 becomes 3, 1 becomes 5"),
        (0, range(9, 20), "9 on, and once more: 0 becomes 3, 1 becomes 5"),
        pytest.param(1, range(13, 30), "13 on: 0 becomes 3, 3 becomes 2", marks=combination),
    ],
)
def test_it_is_said_from_which_frame_on_and_how_often_ids_change(seed, renamed, said):
    frames = [replace(f, labels=doctor.OTHERS[f.labels]) if f.index in renamed else f for f in doctor.scene(seed)]
    (line,) = (line for line in doctor.said(frames) if "have other ids" in line)
    assert f"have other ids from frame {said}" in line


BANDS, SHARP = [0, 0, 1, 2, 2, 255, 5, 5, 6, 7, 7], [0, 0, 2, 2, 2, 255, 5, 5, 7, 7, 7]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([BANDS] * 50, True),
        ([BANDS] * 49, False),
        ([BANDS[:5]] * 50, False),
        ([BANDS] * 40 + [SHARP] * 20, True),
        ([BANDS] * 40 + [SHARP] * 21, False),
    ],
)
def test_bands_at_borders_of_two_pairs_of_classes_are_half_of_fifty_pixels_or_more(rows, said):
    """A border without a band has two pixels with the id of one side between ids of both."""
    maps = [np.array([row]) for row in rows]
    assert any("thin bands of ids" in line for line in id_remarks(maps, 255, None, maps)) is said


def test_every_hypothesis_has_maps_of_the_shape_of_the_given_ones(frames):
    views = [View.from_frame(frame, 500) for frame in frames[:5]]
    run = LabelRun([LabelledFrame(view, (), view.labels) for view in views])
    assert all(hypothesis.applies(run) for hypothesis in MAPS)
    others = [(hypothesis, hypothesis.change(run).maps) for hypothesis in MAPS]
    assert {len(maps) for hypothesis, maps in others if "frame" not in hypothesis.name} == {5}
    assert {len(maps) for hypothesis, maps in others if "frame" in hypothesis.name} == {3, 4}
    assert all(labels.shape == views[0].labels.shape for _, maps in others for labels, _ in maps.values())
