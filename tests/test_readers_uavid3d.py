"""UAVid-3D-Scenes: its documented defaults, its three formats of poses, its palette; and transforms.json by itself."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from dataset_writers import (
    COUNT,
    FORMATS,
    H,
    W,
    assert_same_voxels,
    camera_json,
    city,
    opened,
    save,
    source,
    stored,
    with_axes,
    write_colmap,
    write_labels,
    write_lines,
    write_transforms,
)
from posed_scene import fails

from semstab.config import read_yaml
from semstab.datasets import open_dataset
from semstab.datasets.city.mesh import uavid8
from semstab.datasets.uavid3d import Uavid3dOptions
from semstab.errors import ConfigError, DataError
from semstab.settings import load_config, resolve

FRAMES = 3


def uavid(root, **options):
    dataset = open_dataset("uavid3d", {"root": root, **options})
    return [dataset.scene(name) for name in dataset.scenes]


def write_scene(folder, kind="colmap"):
    """The default layout with poses of a kind; depth as .npy, labels of 'net', ground truth in UAVid's colours."""
    palette = np.array(uavid8().colors, np.uint8)
    if kind == "colmap":
        names = write_colmap(folder, source())
    elif kind == "transforms":
        names = write_transforms(folder, source(1000))
        content = json.loads((folder / "transforms.json").read_text())
        content["frames"] = [{k: v for k, v in f.items() if k != "depth_file_path"} for f in content["frames"]]
        (folder / "transforms.json").write_text(json.dumps(content))
    else:
        names = [f"{k:04d}" for k in range(COUNT)]
        for name, frame in zip(names, source(), strict=True):
            write_lines(folder / f"pose/{name}.txt", [" ".join(map(repr, row)) for row in frame.T_wc.tolist()])
        np.savetxt(folder / "intrinsics.txt", source()[0].intrinsics.matrix)
    for name, frame in zip(names, source(), strict=True):
        save(folder / f"depth/{name}.npy", frame.depth * (1000 if kind == "transforms" else 1))
        save(folder / f"images/{name}.png", frame.color)
        save(folder / f"Labels/{name}.png", palette[frame.labels])
    write_labels(folder, names, source())
    return names


@pytest.mark.parametrize("kind", ["colmap", "transforms", "matrix"])
def test_each_format_of_poses_gives_the_voxels_of_the_source(tmp_path, kind):
    write_scene(tmp_path / "scene0", kind)
    write_scene(tmp_path / "scene1", kind)
    scenes = uavid(tmp_path, pose_format=kind)
    assert [scene.name for scene in scenes] == ["scene0", "scene1"]
    scene = scenes[0]
    assert (len(scene), scene.backbones, scene.ground_truth) == (COUNT, ("net",), True)
    found = [scene.frame(k, "net") for k in range(COUNT)]
    np.testing.assert_allclose(found[1].depth, source()[1].depth, rtol=1e-6)
    if kind != "transforms":  # whose depth is rounded to float millimetres
        assert_same_voxels(found, source())
    assert found[0].color.shape == (H, W, 3)
    np.testing.assert_array_equal(scene.frame(2, "gt").labels, source()[2].labels)
    assert scene.label_space("net").classes == uavid8().classes


def test_the_shipped_file_says_the_defaults():
    """configs/datasets/uavid3d.yaml documents every option of it with the value that holds without the file."""
    said = read_yaml("configs/datasets/uavid3d.yaml")["dataset"]["options"]
    defaults = Uavid3dOptions(root=".").model_dump(mode="json")
    assert said == {key: defaults[key] for key in said}
    own = set(Uavid3dOptions.model_fields) - {
        "root",
        "incomplete",
        "scores_layout",
        "classes",
        "taxonomies",
        "void_ids",
    }
    assert set(said) == own - {"frames_per_second"}


def test_a_run_starts_from_the_shipped_file(tmp_path):
    config = load_config(overrides={"dataset": {"name": "uavid3d", "options": {"root": str(tmp_path)}}})
    assert config.taxonomy == "uavid7"
    assert resolve(config).dataset.options["depth"] == "depth/{name}"


def test_what_the_guess_gets_wrong_is_said_by_options(tmp_path):
    """Another layout: colours in rgb/, depth as 16-bit PNG at 256 a metre, world-to-camera matrices in OpenGL axes."""
    frames = source(256)
    for k, frame in enumerate(frames):
        save(tmp_path / f"s/rgb/{k:03d}.jpg", frame.color)
        save(tmp_path / f"s/metric/d_{k:03d}.png", stored(frame, 256))
        write_labels(tmp_path / "s", [f"{k:03d}"], [frame])
        T = np.linalg.inv(with_axes(frame.T_wc, "opengl"))
        write_lines(tmp_path / f"s/cams/{k:03d}_cam.txt", [" ".join(map(repr, row)) for row in T.tolist()])
    K = frames[0].intrinsics
    (scene,) = uavid(
        tmp_path, images="rgb/{name}.jpg", depth="metric/d_{name}.png", depth_scale=256, pose_format="matrix",
        pose="cams/{name}_cam.txt", pose_convention="world_to_camera", camera_axes="opengl",
        intrinsics=[K.fx, K.fy, K.cx, K.cy],
    )  # fmt: skip
    assert_same_voxels([scene.frame(k, "net") for k in range(COUNT)], frames)


@pytest.mark.parametrize(
    ("options", "kind", "match"),
    [
        ({"pose": "{name}/pose.txt"}, ConfigError, "must be once, in the name of the file"),
        ({"depth": "../{name}"}, ConfigError, "depth: .*leaves its folder"),
        ({"images": "images/x.png"}, ConfigError, r"images: .*needs \{name\}"),
        ({"model": "../.."}, DataError, r"the options of uavid3d: the path '../..' leaves"),
        (
            {"pose_format": "matrix", "pose": "nowhere/{name}.txt"},
            DataError,
            "no scene here.*options pose_format, pose",
        ),
        ({"pose_format": "transforms"}, DataError, "no scene here.*transforms.json"),
    ],
)
def test_options_that_do_not_fit_are_one_line(tmp_path, options, kind, match):
    write_scene(tmp_path)
    fails(kind, match, uavid, tmp_path, **options)


def test_classes_can_replace_the_taxonomy(tmp_path):
    write_scene(tmp_path)
    (scene,) = uavid(tmp_path, classes=[*"abcdefgh"])
    assert scene.label_space("net").classes == tuple("abcdefgh")


# --- transforms.json

NERF = FORMATS["transforms_json, nerfstudio"]


@pytest.fixture
def nerf(tmp_path):
    """A folder, and how to change its transforms.json."""
    names = write_transforms(tmp_path, source(1000))
    write_labels(tmp_path, names, source(1000))
    path = tmp_path / "transforms.json"

    def change(frame=None, **values):
        content = json.loads(path.read_text())
        (content if frame is None else content["frames"][frame]).update(values)
        path.write_text(json.dumps({k: v for k, v in content.items() if v != "-"}))
        return tmp_path

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"k1": 0.1}, r"transforms\.json: frame \d: the camera \(with k1, k2, ...\) distorts; undistort"),
        ({"camera_model": "OPENCV_FISHEYE"}, r"the camera \('OPENCV_FISHEYE'\) distorts"),
        ({"fl_x": "-", "fl_y": "-"}, "'fl_x' is missing"),
        ({"fl_x": "40"}, "'fl_x' is '40'; expected a number"),
        ({"fl_x": 0}, "focal lengths must be positive"),
        ({"fl_x": True}, "'fl_x' is True"),
        ({"fl_x": 10**400}, "'fl_x' is 1000"),
        ({"w": 0}, "'w' is 0; expected a number of pixels"),
        ({"w": "-", "cx": "-"}, "'cx' is missing"),
        ({"frames": []}, "'frames' must be a list"),
        ({"frames": [1]}, "'frames' must be a list"),
        ({"integer_depth_scale": 0}, "'integer_depth_scale' is 0; expected the metres"),
    ],
)
def test_values_that_cannot_be_are_named(nerf, change, match):
    fails(DataError, match, opened, NERF, nerf(**change))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"file_path": "../../secret.png"}, r"frame 1: the path '../../secret.png' leaves"),
        ({"depth_file_path": "/etc/passwd"}, "leaves"),
        ({"file_path": 7}, "file_path is 7; expected a path"),
        ({"file_path": None}, "'file_path' is missing"),
        ({"file_path": "a\nb"}, "cannot be the path of a file"),
        ({"file_path": "images/frame_00000.png"}, "two frames have one name"),
        ({"depth_file_path": None}, "frame 1: has no depth_file_path; add it, or set depth"),
        ({"transform_matrix": [[1, 2], [3]]}, "frame 1: transform_matrix: expected a"),
        ({"transform_matrix": "x"}, "expected a"),
        ({"transform_matrix": None}, "expected a"),
        ({"transform_matrix": [[[1]]]}, "expected a 4x4 matrix"),
    ],
)
def test_frames_that_cannot_be_are_named(nerf, change, match):
    fails(DataError, match, opened, NERF, nerf(1, **change))


@pytest.mark.parametrize("text", ["", "[1]", "{", "[" * 200_000, "\xff", '{"frames": [{"a": 1}]}', "nullx"])
def test_text_that_is_no_transforms_is_refused(tmp_path, text):
    (tmp_path / "transforms.json").write_text(text, encoding="latin-1")
    fails(DataError, r"transforms\.json: ", opened, NERF, tmp_path)


def test_a_pose_that_is_not_finite_is_lost(nerf):
    folder = nerf(0, transform_matrix=[[math.nan] * 4] * 4)  # the last frame: the file has them in reverse
    scene = opened(NERF, folder)
    assert [scene.tracked(k) for k in range(COUNT)] == [True, True, True, False]


def test_focal_lengths_from_angles_and_a_centre_in_the_middle(nerf):
    fx = city()[0].intrinsics.fx
    folder = nerf(fl_x="-", fl_y="-", cx="-", cy="-", camera_angle_x=2 * math.atan(W / 2 / fx))
    K = opened(NERF, folder).intrinsics(0, (H, W))
    assert (K.fx, K.fy, K.cx, K.cy) == (pytest.approx(fx), K.fx, (W - 1) / 2, (H - 1) / 2)


def test_images_in_several_folders_have_names_with_folders(tmp_path):
    frames = source(1000)[:2]
    entries = []
    for k, frame in enumerate(frames):
        save(tmp_path / f"images/cam{k}/1.v2.png", frame.color)
        save(tmp_path / f"depth/cam{k}/1.v2.png", stored(frame, 1000))
        write_labels(tmp_path, [f"cam{k}/1.v2"], [frame])
        T = with_axes(frame.T_wc, "opengl")[:3].tolist()
        entries.append({"file_path": f"images\\cam{k}\\1.v2.png", "transform_matrix": T} | camera_json(frame))
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": entries}))
    scene = opened(NERF, tmp_path, depth="depth/{name}.png")
    found = [scene.frame(k, "net") for k in range(2)]
    assert_same_voxels(found, frames)
    assert found[1].files["labels"] == f"{tmp_path}/labels/net/cam1/1.v2.png"
