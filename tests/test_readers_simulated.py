"""Datasets of simulators: their ground truth, where a pixel lies in the world, and what is wrong with their files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from dataset_writers import (
    FORMATS,
    opened,
    save,
    save_hdf5,
    save_rgba,
    source,
    write_airsim,
    write_hypersim,
    write_labelled,
    write_lines,
)
from posed_scene import fails
from scipy.spatial.transform import Rotation

from semstab import LabelSpace
from semstab.datasets import recognise
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


# --- CARLA


CARLA, KITTI_CARLA = FORMATS["carla"], FORMATS["carla, KITTI-CARLA"]


def rgba(red, green=0, blue=0):
    one = np.broadcast_to(0, np.shape(red))
    return np.stack([one + red, one + green, one + blue, one + 255], axis=2).astype(np.uint8)


def test_a_pixel_of_carla_lies_where_its_left_handed_pose_says(tmp_path):
    """By the matrix of carla.Transform: x forward, y right, z up, in the world and in the camera."""
    write_labelled(CARLA, tmp_path)
    units = np.full((32, 48), 200_000)
    save_rgba(tmp_path / "depth/000000.png", rgba(units & 255, units >> 8 & 255, units >> 16))
    pitch, yaw, roll = np.radians([-20, 70, 5])
    pose = {"x": 12.0, "y": -7.0, "z": 3.0, "pitch": -20.0, "yaw": 70.0, "roll": 5.0}
    (tmp_path / "camera/000000.json").write_text(json.dumps(pose))
    frame = opened(CARLA, tmp_path, intrinsics=None, fov=70).frame(0, "net")
    z = 200_000 / (2**24 - 1) * 1000
    assert frame.depth[3, 40] == pytest.approx(z, rel=1e-6)
    f = 24 / np.tan(np.radians(35))
    local = np.array([1.0, (40 - 23.5) / f, -(3 - 15.5) / f]) * z
    by_yaw = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    by_pitch = np.array([[np.cos(pitch), 0, -np.sin(pitch)], [0, 1, 0], [np.sin(pitch), 0, np.cos(pitch)]])
    by_roll = np.array([[1, 0, 0], [0, np.cos(roll), np.sin(roll)], [0, -np.sin(roll), np.cos(roll)]])
    x, y, up = by_yaw @ by_pitch @ by_roll @ local + [12, -7, 3]
    ours = frame.T_wc @ [(40 - 23.5) / f * z, (3 - 15.5) / f * z, z, 1]
    np.testing.assert_allclose(ours[:3], [x, -y, up], atol=1e-3)


def test_a_pixel_of_kitti_carla_is_seen_over_72_degrees_at_the_time_of_its_image(tmp_path):
    write_labelled(KITTI_CARLA, tmp_path)
    scene = opened(KITTI_CARLA, tmp_path, intrinsics=None)
    assert scene.intrinsics(0, (32, 48)).fx == pytest.approx(24 / np.tan(np.radians(36)))
    assert scene.timestamps.tolist() == pytest.approx([0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(scene.T_wc(2), source(1000)[2].T_wc, atol=1e-9)


@pytest.mark.parametrize(("tags", "name"), [("carla", "road"), ("carla23", "building")])
def test_tags_of_carla_are_the_red_channel_and_mean_what_its_version_says(tmp_path, tags, name):
    write_labelled(CARLA, tmp_path)
    save_rgba(tmp_path / "semantic/000000.png", rgba(pattern(int)))
    save(tmp_path / "semantic/000001.png", pattern(np.uint8))
    scene = opened(CARLA, tmp_path, tags=tags)
    space = scene.label_space("gt")
    assert space.classes[space.ids.index(1)] == name
    for k in (0, 1):
        np.testing.assert_array_equal(scene.frame(k, "gt").labels, np.where(pattern(int) == 0, 255, pattern(int)))


def test_tags_of_kitti_carla_are_colours(tmp_path):
    write_labelled(KITTI_CARLA, tmp_path)
    colours = np.array(LabelSpace.load("carla23").colors)[pattern(int)]
    save_rgba(tmp_path / "images_ss/0000_10.png", rgba(*np.moveaxis(colours, 2, 0)))
    scene = opened(KITTI_CARLA, tmp_path)
    np.testing.assert_array_equal(scene.frame(0, "gt").labels, np.where(pattern(int) == 0, 255, pattern(int)))
    save_rgba(tmp_path / "images_ss/0000_10.png", rgba(pattern(int), 7, 9))
    fails(DataError, r"0000_10\.png: colour \(\d, 7, 9\) at pixel", opened(KITTI_CARLA, tmp_path).frame, 0, "gt")


@pytest.mark.parametrize(
    ("form", "damage", "said"),
    [
        (
            CARLA,
            lambda f: save(f / "depth/000000.png", np.full((32, 48, 3), 90, np.uint8)),
            r"000000\.png: its three channels are equal: a picture of the depth, .* without a ColorConverter",
        ),
        (CARLA, lambda f: (f / "camera/000002.json").unlink(), r"000002\.json: is missing; it holds x, y, z, pitch"),
        (
            KITTI_CARLA,
            lambda f: replace_in(f / "full_ts_camera.txt", "\n2 0.2", ""),
            r"full_ts_camera\.txt: has no row of image 0002",
        ),
        (
            KITTI_CARLA,
            lambda f: replace_in(f / "full_ts_camera.txt", "\n2 0.2", "\n2 0.22"),
            r"full_poses_lidar\.txt: has no pose at 0\.22 s, of image 0002",
        ),
        (KITTI_CARLA, lambda f: (f / "lidar_to_cam0.txt").unlink(), r"lidar_to_cam0\.txt: cannot be read"),
        (
            KITTI_CARLA,
            lambda f: replace_in(f / "lidar_to_cam0.txt", "-1.0", "-0.5"),
            r"lidar_to_cam0\.txt: the rotation is not orthonormal",
        ),
    ],
)
def test_what_is_wrong_in_carla_is_named(tmp_path, form, damage, said):
    write_labelled(form, tmp_path)
    damage(tmp_path)
    fails(DataError, said, lambda: opened(form, tmp_path).frame(0, "net"))


def test_carla_and_syndrone_are_told_apart_by_the_coding_of_depth(tmp_path):
    for name in ("carla", "carla, KITTI-CARLA", "syndrone"):
        write_labelled(FORMATS[name], tmp_path / name)
        assert recognise(tmp_path / name)[0] == FORMATS[name].dataset


# --- AirSim


AIRSIM = FORMATS["airsim"]


def test_a_pixel_of_airsim_lies_where_vehicle_and_mount_say(tmp_path):
    """The vehicle looks to the east, level; its camera half a metre before it looks down by 30 degrees."""
    write_labelled(AIRSIM, tmp_path)
    lines = (tmp_path / "airsim_rec.txt").read_text().splitlines()
    words = lines[1].split("\t")
    east = Rotation.from_euler("z", 90, degrees=True).as_quat()
    words[2:9] = map(repr, map(float, [10, 20, -30, east[3], *east[:3]]))
    write_lines(tmp_path / "airsim_rec.txt", [lines[0], "\t".join(words), *lines[2:]])
    options = {"intrinsics": None, "fov": 60, "mount": [0.5, 0, 0, 0, -30, 0]}
    scene = opened(AIRSIM, tmp_path, **options)
    T, z, f = scene.T_wc(0), 4.0, 24 / np.tan(np.radians(30))
    assert scene.intrinsics(0, (32, 48)).fx == pytest.approx(f)
    u, v = 40, 3
    right, down = (u - 23.5) / f * z, (v - 15.5) / f * z
    c, s = np.cos(np.radians(30)), np.sin(np.radians(30))
    north, east, below = 10 - right, 20 + 0.5 + c * z - s * down, -30 + s * z + c * down
    np.testing.assert_allclose((T @ [right, down, z, 1])[:3], [north, east, below], atol=1e-9)
    assert scene.timestamps.tolist() == [1.0, 1.05, 1.1, 1.15]


def test_depth_of_airsim_begins_with_the_top_row_and_is_along_the_ray_by_its_type(tmp_path):
    write_airsim(tmp_path / "ray", source(), kind=2)
    write_airsim(tmp_path / "planar", source(), kind=1)
    first = source()[0]
    planar, ray = (opened(AIRSIM, tmp_path / name) for name in ("planar", "ray"))
    np.testing.assert_array_equal(planar.depth(0), first.depth)
    assert (planar.options.depth_kind, ray.options.depth_kind) == ("planar", "ray")
    K = first.intrinsics
    length = np.hypot(np.hypot((0 - K.cx) / K.fx, (31 - K.cy) / K.fy), 1)
    assert first.depth[31, 0] > 0
    assert ray.depth(0)[31, 0] == pytest.approx(first.depth[31, 0] / length, rel=1e-6)
    assert opened(AIRSIM, tmp_path / "ray", depth_kind="planar").depth(0)[31, 0] == first.depth[31, 0]


def test_segmentation_of_airsim_is_the_truth_where_its_colours_have_classes(tmp_path):
    names, _ = write_labelled(AIRSIM, tmp_path)
    lines = (tmp_path / "airsim_rec.txt").read_text().splitlines()
    for k, name in enumerate(names):
        other = name.replace("_0_0_", "_0_5_") + "1"
        save(
            tmp_path / f"images/{other}.png", np.full((32, 48, 3), [[[153, 108, 6], [112, 105, 191]][k % 2]], np.uint8)
        )
        lines[1 + k] += f";{other}.png"
    write_lines(tmp_path / "airsim_rec.txt", lines)
    colors = {
        "classes": [
            {"name": "ground", "id": 1, "color": [153, 108, 6]},
            {"name": "wall", "id": 2, "color": [112, 105, 191]},
        ]
    }
    (tmp_path / "colours.yaml").write_text(json.dumps(colors))
    assert not opened(AIRSIM, tmp_path).ground_truth
    scene = opened(AIRSIM, tmp_path, taxonomies={"gt": str(tmp_path / "colours.yaml")})
    assert scene.models == ("net",)  # by the names of the colour images
    assert [scene.frame(k, "gt").labels[9, 9] for k in (0, 1)] == [1, 2]
    write_lines(tmp_path / "airsim_rec.txt", [*lines[:3], lines[3].rpartition(";")[0], lines[4]])
    fails(DataError, r"airsim_rec\.txt: line 4 names no image of type 5 of camera Drone_0", opened, AIRSIM, tmp_path)


def test_a_recording_of_two_vehicles_needs_a_choice(tmp_path):
    write_labelled(AIRSIM, tmp_path)
    path = tmp_path / "airsim_rec.txt"
    head, *rows = path.read_text().splitlines()
    other = [row.replace("Drone", "Car") for row in rows]
    for file in list((tmp_path / "images").iterdir()):
        (tmp_path / "images" / file.name.replace("Drone", "Car")).write_bytes(file.read_bytes())
    write_lines(path, [head, *rows, *other])
    fails(DataError, r"airsim_rec\.txt: holds rows of Drone, Car; set vehicle", opened, AIRSIM, tmp_path)
    assert len(opened(AIRSIM, tmp_path, vehicle="Car")) == 4


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("POS_Z", "POZ", r"airsim_rec\.txt: line 1 has no column POS_Z, apart by tabs"),
        ("1050\t", "1050 ", r"airsim_rec\.txt: line 3 has 9 values; expected 10"),
        ("\t1050\t", "\tnoon\t", r"airsim_rec\.txt: line 3: 'noon' is not a number"),
        ("img_Drone_0_1_", "depth", r"airsim_rec\.txt: line 2: 'depth\d+\.pfm' is no image as img_CAMERA_TYPE_TIME"),
        (
            "img_Drone_0_1_",
            "img_Drone_0_3_",
            r"the first row names no depth image \(type 1 or 2\) of camera any; .*none",
        ),
    ],
)
def test_what_is_wrong_in_a_recording_of_airsim_is_named(tmp_path, before, after, said):
    write_labelled(AIRSIM, tmp_path)
    replace_in(tmp_path / "airsim_rec.txt", before, after)
    fails(DataError, said, opened, AIRSIM, tmp_path)


def test_a_camera_that_is_not_recorded_is_named(tmp_path):
    write_labelled(AIRSIM, tmp_path)
    assert len(opened(AIRSIM, tmp_path, camera="0")) == 4
    fails(DataError, r"of camera 3; with depth: Drone_0; ", opened, AIRSIM, tmp_path, camera="3")
