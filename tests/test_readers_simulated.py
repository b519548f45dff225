"""Datasets of simulators: their ground truth, where a pixel lies in the world, and what is wrong with their files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from dataset_writers import FORMATS, opened, save, save_hdf5, source, write_hypersim, write_labelled, write_lines
from posed_scene import fails
from scipy.spatial.transform import Rotation

from semstab.data.labels import LabelSpace
from semstab.datasets.hypersim import read_lens
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


# --- Hypersim


HYPERSIM = FORMATS["hypersim"]
FRAME = "images/scene_cam_00_geometry_hdf5/frame.0001"


def write_lens(folder, scene, turn, focal=800.0, size=(1024, 768)):
    """A row of metadata_camera_parameters.csv of a pinhole that looks along another axis than the poses say."""
    W, H = size
    K = np.array([[focal, 0, 500], [0, focal, 400], [0, 0, 1.0]])
    pixels = np.array([[W / 2, 0, W / 2 - 0.5], [0, -H / 2, H / 2 - 0.5], [0, 0, 1]])  # of u, v from -1 to 1, v up
    M = 3 * np.diag([1.0, -1, -1]) @ turn.T @ np.linalg.inv(K) @ pixels
    names = ["scene_name", "settings_output_img_width", "settings_output_img_height"]
    names += [f"M_cam_from_uv_{i}{j}" for i in range(3) for j in range(3)]
    values = [scene, f"{W}.0", f"{H}.0", *map(repr, M.ravel().tolist())]
    return write_lines(folder / "metadata_camera_parameters.csv", [",".join(names), ",".join(values)])


def test_a_tilted_lens_of_hypersim_is_a_pinhole_that_looks_elsewhere(tmp_path):
    turn = Rotation.from_euler("xy", [12, -5], degrees=True).as_matrix()  # from the poses' axes to the lens's, OpenCV
    camera, T = read_lens(write_lens(tmp_path, "ai_001_002", turn), "ai_001_002")
    K = camera.intrinsics
    np.testing.assert_allclose([K.fx, K.fy, K.cx, K.cy], [800, 800, 500, 400], rtol=1e-9)
    flip = np.diag([1.0, -1, -1])
    np.testing.assert_allclose(flip @ T[:3, :3] @ flip, turn.T, atol=1e-12)
    write_labelled(HYPERSIM, tmp_path / "scenes/ai_001_002")
    scene = opened(HYPERSIM, tmp_path / "scenes", intrinsics=None)
    np.testing.assert_allclose(scene.T_wc(0)[:3, :3], source(256)[0].T_wc[:3, :3] @ turn.T, atol=1e-9)
    assert scene.intrinsics(0, (768, 1024)).cx == pytest.approx(500)


def test_a_scene_of_hypersim_without_a_lens_is_told_where_it_is(tmp_path):
    write_labelled(HYPERSIM, tmp_path / "ai_001_003")
    fails(
        DataError,
        r"metadata_camera_parameters\.csv is not there or above; .*886\.81",
        opened,
        HYPERSIM,
        tmp_path,
        intrinsics=None,
    )
    path = write_lens(tmp_path, "ai_001_002", np.eye(3))
    fails(DataError, "has no row of ai_001_003", opened, HYPERSIM, tmp_path, intrinsics=None)
    replace_in(path, "ai_001_002,1024.0", "ai_001_003,0")
    fails(DataError, "the row of ai_001_003 holds no size", opened, HYPERSIM, tmp_path, intrinsics=None)
    write_lens(tmp_path, "ai_001_003", np.array([[1, 0.01, 0], [0, 1, 0], [0, 0, 1]]).T)
    fails(DataError, r"ai_001_003 has a skew of -?8\.0 pixels", opened, HYPERSIM, tmp_path, intrinsics=None)


def test_classes_of_hypersim_are_nyu40_and_depth_is_along_the_ray(tmp_path):
    write_labelled(HYPERSIM, tmp_path)
    save_hdf5(tmp_path / f"{FRAME}.semantic.hdf5", pattern(np.int16, -1))
    scene = opened(HYPERSIM, tmp_path)
    assert scene.label_space("gt").name == "nyu40"
    expected = np.where((ids := pattern(int, 0)) == 0, 65535, ids)
    np.testing.assert_array_equal(scene.frame(0, "gt").labels, expected)
    assert opened(HYPERSIM, tmp_path, depth_kind="ray").options.depth_kind == "ray"
    K = scene.intrinsics(0, (32, 48))
    ray = np.hypot(np.hypot((0 - K.cx) / K.fx, (0 - K.cy) / K.fy), 1)
    planar, along = scene.depth(0)[0, 0], opened(HYPERSIM, tmp_path, depth_kind="ray").depth(0)[0, 0]
    assert along == pytest.approx(planar / ray, rel=1e-6)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (
            lambda f: (f / "_detail/metadata_scene.csv").unlink(),
            r"metadata_scene\.csv: is missing; it holds meters_per_asset",
        ),
        (lambda f: replace_in(f / "_detail/metadata_scene.csv", "1.0", "x"), r"meters_per_asset_unit is 'x'"),
        (
            lambda f: save_hdf5(f / "_detail/cam_00/camera_keyframe_positions.hdf5", np.zeros((2, 3))),
            r"positions\.hdf5: has 2 rows, and 5 rotations, but frame 2 is there",
        ),
        (
            lambda f: save_hdf5(f / "_detail/cam_00/camera_keyframe_positions.hdf5", np.zeros((5, 4))),
            r"positions\.hdf5: dataset is no table of N x 3 numbers",
        ),
        (lambda f: (f / f"{FRAME}.depth_meters.hdf5").write_bytes(b"no"), r"depth_meters\.hdf5: cannot be read"),
    ],
)
def test_what_is_wrong_in_hypersim_is_named(tmp_path, damage, said):
    write_labelled(HYPERSIM, tmp_path)
    damage(tmp_path)
    fails(DataError, said, lambda: opened(HYPERSIM, tmp_path).frame(0, "net"))


def test_poses_of_hypersim_in_inches_become_metres(tmp_path):
    write_hypersim(tmp_path, source(256), unit=0.0254)
    np.testing.assert_allclose(opened(HYPERSIM, tmp_path).T_wc(3), source(256)[3].T_wc, atol=1e-12)
