"""Datasets of simulators: their ground truth, where a pixel lies in the world, and what is wrong with their files."""

from __future__ import annotations

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
