"""Datasets of simulators: their ground truth, where a pixel lies in the world, and what is wrong with their files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from dataset_writers import FORMATS, opened, save, source, write_labelled
from posed_scene import fails

from semstab.data.labels import LabelSpace
from semstab.errors import DataError

VIRTUAL_KITTI = FORMATS["virtual_kitti"]


def replace_in(path, before, after):
    text = path.read_text()
    assert before in text, path
    path.write_text(text.replace(before, after, 1))


def test_the_colours_of_virtual_kitti_are_classes_and_undefined_is_none(tmp_path):
    write_labelled(VIRTUAL_KITTI, tmp_path / "Scene01/clone")
    ids = source(100)[0].labels + 1  # terrain to guard rail
    ids[:2] = 0
    space = LabelSpace.load("virtual_kitti")
    colours = np.array(space.colors, np.uint8)[ids]
    save(tmp_path / "Scene01/clone/frames/classsegmentation/Camera_0/classgt_00000.png", colours)
    scene = opened(VIRTUAL_KITTI, tmp_path)
    assert (scene.name, scene.ground_truth) == ("Scene01-clone", True)
    assert scene.label_space("gt") == space
    np.testing.assert_array_equal(scene.frame(0, "gt").labels, np.where(ids == 0, 255, ids))


@pytest.mark.parametrize(
    ("file", "before", "after", "said"),
    [
        ("extrinsic.txt", "\n2 0 ", "\n7 0 ", r"extrinsic\.txt: has no row of frame 2 and camera 0"),
        ("intrinsic.txt", "\n3 0 ", "\n3 1 ", r"intrinsic\.txt: has no row of frame 3 and camera 0"),
        ("intrinsic.txt", "\n1 0 ", "\n1 0 -", r"intrinsic\.txt: frame 00001: .*focal"),
        ("extrinsic.txt", "\n1 0 ", "\n1 0 0 ", r"extrinsic\.txt: line 4 has 19 values; expected 18 \(frame cameraID"),
    ],
)
def test_a_row_of_virtual_kitti_that_is_wrong_is_named(tmp_path, file, before, after, said):
    write_labelled(VIRTUAL_KITTI, tmp_path)
    replace_in(tmp_path / file, before, after)
    fails(DataError, said, opened, VIRTUAL_KITTI, tmp_path)


def test_a_depth_of_virtual_kitti_that_is_no_number_is_named(tmp_path):
    write_labelled(VIRTUAL_KITTI, tmp_path)
    (tmp_path / "frames/depth/Camera_0/depth_00001.png").rename(tmp_path / "frames/depth/Camera_0/depth_a.png")
    fails(DataError, r"'a' is no number of a frame", opened, VIRTUAL_KITTI, tmp_path)


# --- Habitat


HABITAT = FORMATS["habitat"]
INFO = {"classes": [{"id": 3, "name": "chair"}, {"id": 7, "name": "floor"}], "id_to_label": [-1, 7, 3, 3, 0]}


def habitat(folder, instances, info=INFO):
    """A room with the same instances in each frame."""
    write_labelled(HABITAT, folder)
    for k in range(4):
        save(folder / f"semantic/{k}.png", instances)
    if info is not None:
        (folder / "info_semantic.json").write_text(json.dumps(info))
    return folder


def pattern(dtype, last=4):
    ids = np.arange(32 * 48, dtype=int).reshape(32, 48) % 5
    ids[0, 0] = last
    return ids.astype(dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_instances_of_habitat_become_their_classes(tmp_path, dtype):
    scene = opened(HABITAT, habitat(tmp_path / "room_0", pattern(dtype)))
    space = scene.label_space("gt")
    assert (space.classes, space.ids) == (("chair", "floor"), (3, 7))
    labels = scene.frame(0, "gt").labels
    np.testing.assert_array_equal(labels, np.array([65535, 7, 3, 3, 65535])[pattern(int)])
    assert scene.label_space("net").classes[0] == "clutter"  # the models' classes are their own


def test_instances_that_overflowed_in_8_bits_are_found(tmp_path):
    many = INFO | {"id_to_label": [7] * 300}
    scene = opened(HABITAT, habitat(tmp_path, pattern(np.uint8), many))
    said = r"0\.png: has 8 bits, but info_semantic\.json has instances up to 299: .* 16 bits"
    fails(DataError, said, scene.frame, 0, "gt")
    save(tmp_path / "semantic/0.png", pattern(np.uint16, 299))
    assert opened(HABITAT, tmp_path).frame(0, "gt").labels[0, 0] == 7


def test_a_table_of_instances_is_found_above_or_named_and_missed(tmp_path):
    habitat(tmp_path / "walk", pattern(np.uint8), None)
    said = r"0\.png: holds ids of instances, and no info_semantic\.json"
    fails(DataError, said, opened(HABITAT, tmp_path).frame, 0, "gt")
    (tmp_path / "habitat").mkdir()
    (tmp_path / "habitat/info_semantic.json").write_text(json.dumps(INFO))
    assert opened(HABITAT, tmp_path).frame(0, "gt").labels[0, 1] == 7
    (tmp_path / "habitat/info_semantic.json").rename(tmp_path / "mine.json")
    assert opened(HABITAT, tmp_path, semantic_info=tmp_path / "mine.json").frame(0, "gt").labels[0, 1] == 7


@pytest.mark.parametrize(
    ("info", "said"),
    [
        ({}, "has no lists 'classes' and 'id_to_label'"),
        (INFO | {"id_to_label": [5]}, "instance 0 of 'id_to_label' has class 5, which 'classes' lacks"),
        (INFO | {"classes": [{"id": "x", "name": "a"}]}, "'x' is no id of a class"),
        (INFO | {"classes": [{"id": 3, "name": "a"}, {"id": 7, "name": "a"}]}, "info_semantic.json: .*a"),
        (INFO | {"id_to_label": [7] * 70_000}, "has 70000 instances; at most"),
    ],
)
def test_a_damaged_table_of_instances_is_named(tmp_path, info, said):
    habitat(tmp_path, pattern(np.uint8), info)
    fails(DataError, said, opened, HABITAT, tmp_path)


def test_an_instance_that_the_table_lacks_is_named(tmp_path):
    scene = opened(HABITAT, habitat(tmp_path, pattern(np.uint16, 9)))
    fails(DataError, r"0\.png: the id 9 is not in the table of classes", scene.frame, 0, "gt")


def test_the_camera_of_habitat_sees_90_degrees_and_quaternions_have_an_order(tmp_path):
    folder = habitat(tmp_path, pattern(np.uint8))
    K = opened(HABITAT, folder, intrinsics=None).intrinsics(0, (32, 48))
    assert (K.fx, K.fy, K.cx, K.cy) == (24, 24, 23.5, 15.5)
    rows = [line.split() for line in (folder / "GT_Pose.txt").read_text().splitlines()]
    (folder / "GT_Pose.txt").write_text("".join(f"{' '.join([*r[:3], *r[4:], r[3]])}\n" for r in rows))
    T = opened(HABITAT, folder, quaternion="xyzw").T_wc(2)
    np.testing.assert_allclose(T, source(1000)[2].T_wc, atol=1e-12)
