"""Situations that people met: lost tracking, poses and labels that change from a frame on; a row a situation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import doctor
import numpy as np
import pytest
from posed_writer import write_posed
from scipy.spatial.transform import Rotation

from semstab.check import quick_check
from semstab.check.scene_check import CLUSTERS, POINTS, Inspection, clusters, label_findings
from semstab.datasets import open_dataset

HALF = doctor.FRAMES // 2
ONE = np.eye(4)
ELSEWHERE = np.eye(4)
ELSEWHERE[:3, :3] = Rotation.from_euler("xyz", [20, 70, 10], degrees=True).as_matrix()
ELSEWHERE[:3, 3] = (20, -3, 8)
TURN = np.eye(4)
TURN[:3, :3] = Rotation.from_euler("y", 3, degrees=True).as_matrix()
Frames = doctor.Frames


def posed(which, pose) -> Callable[[Frames], Frames]:
    return lambda fs: [replace(f, T_wc=pose(fs, f)) if f.index in which else f for f in fs]


SECOND = range(HALF, doctor.FRAMES)
GEOMETRY = {
    "identity, spread": (posed({3, 9, 14, 22, 27}, lambda fs, f: ONE), "tracking was lost: 5 frames"),
    "identity, one": (posed({17}, lambda fs, f: ONE), "frame 17 has the identity"),
    "identity, in a row": (posed(range(12, 20), lambda fs, f: ONE), "tracking was lost: 8 frames"),
    "the last known pose": (posed(range(12, 20), lambda fs, f: fs[11].T_wc), "the pose of a frame before once more"),
    "another frame of reference": (posed(SECOND, lambda fs, f: ELSEWHERE @ f.T_wc), f"poses jump at frame {HALF}: by"),
    "turned": (posed(SECOND, lambda fs, f: TURN @ f.T_wc), f"poses jump at frame {HALF}"),
}


def labelled(change) -> Callable[[Frames], Frames]:
    return lambda fs: [replace(f, labels=np.ascontiguousarray(change(fs, f))) for f in fs]


def half(change) -> Callable[[Frames], Frames]:
    return labelled(lambda fs, f: change(f.labels) if f.index >= HALF else f.labels)


def some(which, change) -> Callable[[Frames], Frames]:
    return labelled(lambda fs, f: change(f.labels) if f.index in which else f.labels)


OTHERS = np.r_[3, 5, 4, 2, 0, 6, 1, np.arange(7, 256)].astype(np.uint8)
ORDER = np.random.default_rng(1).permutation(doctor.FRAMES)
LABELS = {
    "other ids": (half(lambda L: OTHERS[L]), f"have other ids from frame {HALF} on"),
    "ids that roll": (labelled(lambda fs, f: (f.labels + f.index) % 7), "have other ids from frame to frame"),
    "mirrored": (half(lambda L: L[:, ::-1]), f"are mirrored left to right from frame {HALF} on"),
    "reversed": (labelled(lambda fs, f: fs[-1 - f.index].labels), "are in reversed order"),
    "shuffled": (labelled(lambda fs, f: fs[ORDER[f.index]].labels), "are in another order than the frames"),
    "empty": (some({7, 8}, lambda L: L * 0 + 255), "have no label at all in 2 of 30 frames: 7, 8"),
    "one class": (some({4, 5, 9}, lambda L: L * 0), "have one class, id 0, in 3 of 30 frames (4, 5, 9)"),
    "two side by side": (some({20, 21}, lambda L: L[::-1]), "the map of frame 21 "),
}


@pytest.fixture(scope="module")
def frames():
    return doctor.scene(1)


@pytest.mark.parametrize("situation", GEOMETRY)
def test_check_and_a_run_name_poses_in_the_same_words(situation, frames) -> None:
    plant, said = GEOMETRY[situation]
    made = doctor.Made(plant(frames))
    inspection = Inspection(made, range(len(frames)), "net", clusters(len(frames), CLUSTERS), POINTS)
    found = [inspection.verdict({}, thorough=True), quick_check(made, range(len(frames)))]
    assert all(any(said in line for line in (each.text, *each.remarks)) for each in found)
    assert situation == "turned" or all(each.state == "unsound" for each in found)


@pytest.mark.parametrize("situation", LABELS)
def test_check_and_a_run_name_labels_in_the_same_words(situation, frames) -> None:
    plant, said = LABELS[situation]
    made = doctor.Made(plant(frames))
    for thorough in (True, False):
        (found,) = label_findings(made, range(len(frames)), ["net"], thorough=thorough)
        assert any(said in line for line in (*found.wrong, *found.remarks))


def test_poses_of_zeros_are_left_out_as_those_of_nan(frames, tmp_path) -> None:
    folder = write_posed(tmp_path / "room", [f"{k:03d}" for k in range(5)], {"net": frames[:5]}, scale=None)
    np.savetxt(folder / "pose/002.txt", np.zeros((4, 4)))
    dataset = open_dataset("posed_folder", {"root": folder, "classes": list(doctor.SPACE.classes)})
    scene = dataset.scene(dataset.scenes[0])
    assert [scene.tracked(k) for k in range(5)] == [True, True, False, True, True]
