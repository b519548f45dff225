"""Situations that people met: lost tracking, poses and labels that change from a frame on; a row a situation."""

from __future__ import annotations

from dataclasses import replace

import doctor
import numpy as np
import pytest
from corners import corners
from dataset_writers import write_labels, write_tum
from posed_writer import write_posed
from typer.testing import CliRunner

from semstab.cli import app
from semstab.datasets import open_dataset

SEED = 1
HARD = ("fy 5 %", "extrinsic of", "two classes exchanged", "labels one frame late from", "labels two frames late from")
"""Situations that are found in some scenes, or in none: docs/check.md has their table."""

LIKE_OTHERS = ("poses turned by 2", "labels upside down from")
"""Situations that are found as other ones are: poses that jump, labels that are mirrored from a frame on."""

FOUND = [situation for situation in doctor.SITUATIONS if not situation.name.startswith(HARD + LIKE_OTHERS)]

AS_ANOTHER = ("identity as pose in 5 frames", "poses in another frame of reference", "labels three frames late")
"""Situations that are said in the words of another one here."""

CORNERS = [situation for situation in FOUND if not situation.name.startswith(AS_ANOTHER)]


@pytest.fixture(scope="module")
def frames():
    return doctor.scene(SEED)


@pytest.mark.parametrize("situation", corners(FOUND, always=CORNERS), ids=lambda situation: situation.name)
def test_check_and_a_run_name_it_in_the_same_words(situation, frames, monkeypatch) -> None:
    planted = situation.plant(frames)
    if all(np.array_equal(after.T_wc, f.T_wc) for after, f in zip(planted, frames, strict=True)):  # mistakes of labels
        for trial in ("with_mistakes", "with_lateness", "with_mounting", "with_intrinsics"):
            monkeypatch.setattr(f"semstab.check.inspection.{trial}", lambda verdict, *_: verdict)  # as without mistakes
    checked, in_run = [*doctor.said(planted)], [*doctor.said(planted, run=True)]
    for lines in (checked, in_run):
        assert any(situation.said in line for line in lines)
        assert not situation.frames or situation.is_placed(lines)
    assert all(situation.said in line for line in checked)


def test_nothing_is_said_of_a_scene_without_mistakes(frames) -> None:
    assert not [*doctor.said(frames), *doctor.said(frames, run=True)]


def test_a_map_with_little_beside_one_class_is_not_of_one_class(frames) -> None:
    plant = doctor.labelled(lambda fs, f: np.where(np.arange(f.labels.size).reshape(f.labels.shape) < 9, 1, 0), (4,))
    assert not any("have one class" in line for line in doctor.said(plant(frames)))


def test_poses_of_zeros_are_left_out_as_those_of_nan(frames, tmp_path) -> None:
    folder = write_posed(tmp_path / "room", [f"{k:03d}" for k in range(5)], {"net": frames[:5]}, scale=None)
    np.savetxt(folder / "pose/002.txt", np.zeros((4, 4)))
    dataset = open_dataset("posed_folder", {"root": folder, "classes": list(doctor.SPACE.classes)})
    scene = dataset.scene(dataset.scenes[0])
    assert [scene.tracked(k) for k in range(5)] == [True, True, False, True, True]


def test_check_names_frames_of_a_tum_file_whose_poses_are_zeros(frames, tmp_path, caplog) -> None:
    coloured = [replace(f, color=np.repeat(f.labels[..., None] * np.uint8(30), 3, axis=2)) for f in frames]
    names = write_tum(tmp_path, coloured)
    write_labels(tmp_path, names, frames)
    head, *lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    lost = {4, 5, 20}
    zeros = [f"{line.split()[0]} 0 0 0 0 0 0 0" if k // 2 in lost else line for k, line in enumerate(lines)]
    (tmp_path / "groundtruth.txt").write_text("\n".join([head, *zeros]) + "\n")
    options = ("intrinsics=[80,80,47.5,35.5]", "classes=[a,b,c,d,e,f,g]")
    words = ["check", "--data", str(tmp_path), *(word for situation in options for word in ("--option", situation))]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0
    said = "3 of 30 selected frames have no pose (tracking was lost) and are left out: 4, 5, 20"
    assert said in caplog.text
