"""COLMAP, UAVid-3D-Scenes and transforms.json: what their own programs write, and what they may not hold."""

from __future__ import annotations

import functools
import json
import math
import struct

import dataset_writers as ds
import numpy as np
import pytest
from posed_scene import fails

from semstab.config import read_yaml
from semstab.configure import load_config, resolve
from semstab.datasets import open_dataset
from semstab.datasets.city.mesh import uavid8
from semstab.datasets.colmap import read_model
from semstab.datasets.files.depth import read_depth_map
from semstab.datasets.uavid3d import Uavid3dOptions
from semstab.errors import ConfigError, DataError

TEXT, BINARY = ds.FORMATS["colmap, text"], ds.FORMATS["colmap, binary"]


@pytest.fixture(params=["text", "binary"])
def scene(request, tmp_path):
    """(folder, names, frames) of a workspace of either kind."""
    names = ds.write_colmap(tmp_path, ds.source(), binary=request.param == "binary")
    ds.write_labels(tmp_path, names, ds.source())
    return tmp_path, names, ds.source()


# --- as COLMAP writes them


def test_models_that_colmap_itself_wrote(tmp_path):
    """Text and binary that pycolmap writes, with rigs, frames and points beside them, are read alike."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap")
    frames = ds.source()
    fx, fy, cx, cy = ds.four(frames[0])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=3, model="PINHOLE", width=ds.W, height=ds.H, params=[fx, fy, cx + 0.5, cy + 0.5])
    )
    for k, frame in enumerate(frames):
        image = pycolmap.Image(name=f"a b/{k}.png", camera_id=3, image_id=9 - k)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(frame.T_wc)[:3]))
        path = tmp_path / f"stereo/depth_maps/a b/{k}.png.geometric.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        depth = pycolmap.DepthMap.from_array(np.ascontiguousarray(frame.depth), 0.1, 100.0)
        depth.write(str(path))
    ds.write_labels(tmp_path, [f"a b/{k}" for k in range(ds.COUNT)], frames)
    for kind in ("text", "binary"):
        (tmp_path / "sparse" / kind).mkdir(parents=True)
        getattr(model, f"write_{kind}")(str(tmp_path / "sparse" / kind))
        scene = ds.opened(TEXT, tmp_path, model=f"sparse/{kind}")
        ds.assert_same_voxels([scene.frame(k, "net") for k in range(ds.COUNT)], frames)


def test_a_depth_map_by_hand(tmp_path):
    """Two rows of three pixels, x fastest."""
    path = tmp_path / "d.bin"
    path.write_bytes(b"3&2&1&" + struct.pack("<6f", 1, 2, 3, 4, 5, 6))
    assert read_depth_map(path).tolist() == [[1, 2, 3], [4, 5, 6]]
    assert read_depth_map(path, 0.5).tolist() == [[2, 4, 6], [8, 10, 12]]


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"3&2&1&" + bytes(20), "3x2 pixels need 30 bytes, it has 26"),
        (b"3&2&3&" + bytes(72), r"has 3 channels \(a normal map\?\)"),
        (b"99999&99999&1&" + bytes(24), "claims 99999x99999 pixels"),
        (b"0&2&1&", "claims 0x2 pixels"),
        (b"\x89PNG\r\n\x1a\n", "not a depth map of COLMAP"),
        (b"3&2&", "not a depth map of COLMAP"),
        (b"", "the file is empty"),
    ],
)
def test_another_depth_map_is_refused(tmp_path, content, match):
    path = tmp_path / "d.bin"
    path.write_bytes(content)
    fails(DataError, rf"d\.bin: .*{match}", read_depth_map, path)


# --- cameras


def set_camera(folder, line):
    ds.write_lines(folder / "sparse/cameras.txt", [line])


@pytest.mark.parametrize(
    ("model", "parameters", "focals"),
    [("SIMPLE_PINHOLE", [40, 24, 16], (40, 40)), ("PINHOLE", [40, 41, 24, 16], (40, 41)),
     ("SIMPLE_RADIAL", [40, 24, 16, 0], (40, 40)), ("OPENCV", [40, 41, 24, 16, 0, 0, 0, 0], (40, 41))],
)  # fmt: skip
def test_cameras_that_do_not_distort(tmp_path, model, parameters, focals):
    ds.write_colmap(tmp_path, ds.city())
    set_camera(tmp_path, f"7 {model} {ds.W} {ds.H} {ds.numbers(parameters)}")
    K = ds.opened(TEXT, tmp_path).intrinsics(0, (ds.H, ds.W))
    assert (K.fx, K.fy, K.cx, K.cy) == (*focals, 23.5, 15.5)


@pytest.mark.parametrize(
    ("model", "parameters"),
    [("SIMPLE_RADIAL", [40, 24, 16, 0.1]), ("OPENCV", [40, 41, 24, 16, 0, 0, 0, 1e-9]),
     ("OPENCV_FISHEYE", [40, 41, 24, 16, 0, 0, 0, 0]), ("FOV", [40, 41, 24, 16, 0])],
)  # fmt: skip
def test_a_camera_that_distorts_is_refused_with_advice(tmp_path, model, parameters):
    ds.write_colmap(tmp_path, ds.city())
    set_camera(tmp_path, f"7 {model} {ds.W} {ds.H} {ds.numbers(parameters)}")
    match = rf"cameras\.txt: camera 7 is {model}, which distorts; undistort .*image_undistorter"
    fails(DataError, match, ds.opened, TEXT, tmp_path)


def test_a_camera_that_no_image_has_may_distort(tmp_path):
    ds.write_colmap(tmp_path, ds.city())
    with (tmp_path / "sparse/cameras.txt").open("a") as file:
        file.write(f"8 FOV {ds.W} {ds.H} 40 40 24 16 0.3\n")
    assert len(ds.opened(TEXT, tmp_path)) == ds.COUNT


@pytest.mark.parametrize(
    ("line", "match"),
    [
        (f"7 PINHOLE {ds.W} {ds.H} 40 40 24", "line 1 is .*expected CAMERA_ID MODEL"),
        (f"7 PINHOL {ds.W} {ds.H} 40 40 24 16", "line 1 is .*expected CAMERA_ID MODEL"),
        (f"7 PINHOLE {ds.W} {ds.H} 40 40 24 x", "line 1: 'x' is not a number"),
        (f"7 PINHOLE {ds.W}.5 {ds.H} 40 40 24 16", r"line 1: '48\.5' is not a whole number"),
        (f"7 PINHOLE 0 {ds.H} 40 40 24 16", "images of 0x32 pixels"),
        (f"7 PINHOLE {ds.W} {ds.H} -40 40 24 16", "camera 7: .*focal lengths must be positive"),
        (f"7 PINHOLE {ds.W} {ds.H} 40 40 nan 16", "camera 7: .*all values finite"),
        (f"6 PINHOLE {ds.W} {ds.H} 40 40 24 16", r"image 'cam 0/0000\.png' has camera 7, which is not in cameras\.txt"),
    ],
)
def test_another_camera_is_refused(tmp_path, line, match):
    ds.write_colmap(tmp_path, ds.city())
    set_camera(tmp_path, line)
    fails(DataError, match, ds.opened, TEXT, tmp_path)


def test_depth_maps_may_be_smaller_than_the_cameras_images(tmp_path):
    """COLMAP bounds the size of its stereo: the intrinsics follow the depth map."""
    names = ds.write_colmap(tmp_path, ds.city())
    for name, frame in zip(names, ds.city(), strict=True):
        ds.save_depth_map(tmp_path / f"stereo/depth_maps/{name}.png.geometric.bin", frame.depth[::2, ::2])
    K = ds.opened(TEXT, tmp_path).intrinsics(0, ds.opened(TEXT, tmp_path).depth(0).shape)
    assert K.fx == pytest.approx(ds.city()[0].intrinsics.fx / 2)
    assert K.cx == pytest.approx((ds.W / 2 - 1) / 2)


# --- images


def test_metres_of_a_model_without_scale(scene):
    """A model in units of 4 m: depth maps and positions grow together, so the voxels are those of the ds.source."""
    folder, names, frames = scene
    small = [frame.T_wc.copy() for frame in frames]
    for name, frame in zip(names, frames, strict=True):
        ds.save_depth_map(folder / f"stereo/depth_maps/{name}.png.geometric.bin", frame.depth / 4)
    found = ds.opened(TEXT, folder, metres_per_unit=4)
    np.testing.assert_allclose(found.depth(0), frames[0].depth, rtol=1e-6)
    np.testing.assert_allclose(found.T_wc(2)[:3, 3], small[2][:3, 3] * 4, rtol=1e-12)


def test_depth_can_come_from_elsewhere(tmp_path):
    frames = ds.source(1000)
    names = ds.write_colmap(tmp_path, frames)
    for name, frame in zip(names, frames, strict=True):
        ds.save(tmp_path / f"my depth/{name}.png", ds.stored(frame, 1000))
    ds.write_labels(tmp_path, names, frames)
    found = ds.opened(TEXT, tmp_path, depth="my depth/{name}")
    ds.assert_same_voxels([found.frame(k, "net") for k in range(ds.COUNT)], frames)


def test_frames_go_by_name_not_by_id(scene):
    folder, names, _ = scene
    found = ds.opened(TEXT, folder)
    assert [found.frame(k, "net").files["labels"] for k in range(ds.COUNT)] == [
        f"{folder}/labels/net/{name}.png" for name in names
    ]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda lines: [line for line in lines if line and not line.startswith("1.5")], "an image has two lines"),
        (lambda lines: [line.replace(" 7 cam", " cam") for line in lines], "expected IMAGE_ID QW|'cam' is not"),
        (lambda lines: [*lines[:2], "100 1 0 0 x 0 0 0 7 a.png", ""], "line 3: 'x' is not a number"),
        (lambda lines: [*lines[:2], "100 2 0 0 0 0 0 0 7 a.png", ""], "quaternion of pose 1 has length 2"),
        (lambda lines: lines[:2], "holds no image"),
        (lambda lines: [*lines[:2], "100 1 0 0 0 0 0 0 7 ../../etc/x.png", ""], "leaves"),
        (lambda lines: [*lines, lines[2], ""], "two frames have one name"),
    ],
)  # fmt: skip
def test_another_list_of_images_is_refused(tmp_path, change, match):
    names = ds.write_colmap(tmp_path, ds.city())
    ds.write_labels(tmp_path, names, ds.city())
    path = tmp_path / "sparse/images.txt"
    ds.write_lines(path, change(path.read_text().splitlines()))
    fails(DataError, match, ds.opened, TEXT, tmp_path)


def test_a_pose_that_is_not_finite_is_lost(tmp_path):
    ds.write_colmap(tmp_path, ds.city())
    path = tmp_path / "sparse/images.txt"
    lines = path.read_text().splitlines()
    lines[2] = "100 nan nan nan nan 0 0 0 7 cam 0/0000.png"
    ds.write_lines(path, lines)
    found = ds.opened(TEXT, tmp_path)
    assert [found.tracked(k) for k in range(ds.COUNT)] == [False, True, True, True]


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_a_binary_file_cut_anywhere_is_refused(tmp_path, name):
    ds.write_colmap(tmp_path, ds.city(), binary=True)
    path = tmp_path / "sparse" / name
    whole = path.read_bytes()
    for length in range(0, len(whole), 3):
        path.write_bytes(whole[:length])
        fails(DataError, f"{name}: ", read_model, tmp_path / "sparse")


def test_counts_that_a_file_cannot_hold_take_no_memory(tmp_path):
    ds.write_colmap(tmp_path, ds.city(), binary=True)
    path = tmp_path / "sparse/images.bin"
    whole = path.read_bytes()
    end = whole.index(b".png\0") + 5
    path.write_bytes(whole[:end] + struct.pack("<Q", 2**61) + whole[end + 8 :])
    fails(DataError, "truncated in the points of image", read_model, tmp_path / "sparse")
    path.write_bytes(struct.pack("<Q", 2**63) + whole[8:])
    fails(DataError, "truncated after", read_model, tmp_path / "sparse")
    path.write_bytes(whole[: whole.index(b"cam 0")] + b"x" * 5000)
    fails(DataError, "does not end within 1000 bytes", read_model, tmp_path / "sparse")


def test_an_unknown_camera_model_is_named(tmp_path):
    ds.write_colmap(tmp_path, ds.city(), binary=True)
    (tmp_path / "sparse/cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 7, 44, ds.W, ds.H, 1, 1, 1, 1))
    fails(DataError, "camera 7 has the model 44, which is not known", read_model, tmp_path / "sparse")


def test_a_missing_half_of_a_model_is_named(tmp_path):
    ds.write_colmap(tmp_path, ds.city())
    (tmp_path / "sparse/images.txt").unlink()
    fails(DataError, r"images\.txt: cannot be read", ds.opened, TEXT, tmp_path)
    write = functools.partial(ds.write_colmap, tmp_path, ds.city())
    write()
    (tmp_path / "sparse/cameras.txt").unlink()
    fails(DataError, r"no scene here, nor 3 folders deep; one holds a sparse model", ds.opened, TEXT, tmp_path)


# --- UAVid-3D-Scenes


FRAMES = 3


def uavid(root, **options):
    dataset = open_dataset("uavid3d", {"root": root, **options})
    return [dataset.scene(name) for name in dataset.scenes]


def write_scene(folder, kind="colmap"):
    """The default layout with poses of a kind; depth as .npy, labels of 'net', ground truth in UAVid's colours."""
    palette = np.array(uavid8().colors, np.uint8)
    if kind == "colmap":
        names = ds.write_colmap(folder, ds.source())
    elif kind == "transforms":
        names = ds.write_transforms(folder, ds.source(1000))
        content = json.loads((folder / "transforms.json").read_text())
        content["frames"] = [{k: v for k, v in f.items() if k != "depth_file_path"} for f in content["frames"]]
        (folder / "transforms.json").write_text(json.dumps(content))
    else:
        names = [f"{k:04d}" for k in range(ds.COUNT)]
        for name, frame in zip(names, ds.source(), strict=True):
            ds.write_lines(folder / f"pose/{name}.txt", [" ".join(map(repr, row)) for row in frame.T_wc.tolist()])
        np.savetxt(folder / "intrinsics.txt", ds.source()[0].intrinsics.matrix)
    for name, frame in zip(names, ds.source(), strict=True):
        ds.save(folder / f"depth/{name}.npy", frame.depth * (1000 if kind == "transforms" else 1))
        ds.save(folder / f"images/{name}.png", frame.color)
        ds.save(folder / f"Labels/{name}.png", palette[frame.labels])
    ds.write_labels(folder, names, ds.source())
    return names


@pytest.mark.parametrize("kind", ["colmap", "transforms", "matrix"])
def test_each_format_of_poses_gives_the_voxels_of_the_source(tmp_path, kind):
    write_scene(tmp_path / "scene0", kind)
    write_scene(tmp_path / "scene1", kind)
    scenes = uavid(tmp_path, pose_format=kind)
    assert [scene.name for scene in scenes] == ["scene0", "scene1"]
    scene = scenes[0]
    assert (len(scene), scene.models, scene.ground_truth) == (ds.COUNT, ("net",), True)
    found = [scene.frame(k, "net") for k in range(ds.COUNT)]
    np.testing.assert_allclose(found[1].depth, ds.source()[1].depth, rtol=1e-6)
    if kind != "transforms":  # whose depth is rounded to float millimetres
        ds.assert_same_voxels(found, ds.source())
    assert found[0].color.shape == (ds.H, ds.W, 3)
    np.testing.assert_array_equal(scene.frame(2, "gt").labels, ds.source()[2].labels)
    assert scene.label_space("net").classes == uavid8().classes


def test_the_shipped_file_says_the_defaults():
    """configs/datasets/uavid3d.yaml documents every option of it with the value that holds without the file."""
    said = read_yaml("configs/datasets/uavid3d.yaml")["dataset"]["options"]
    defaults = Uavid3dOptions(root=".").model_dump(mode="json")
    assert said == {key: defaults[key] for key in said}
    options = set(Uavid3dOptions.model_fields) - {
        "root", "incomplete", "scores_layout", "classes", "taxonomies", "void_ids",
    }  # fmt: skip
    assert set(said) == options - {"frames_per_second"}


def test_a_run_starts_from_the_shipped_file(tmp_path):
    config = load_config(overrides={"dataset": {"name": "uavid3d", "options": {"root": str(tmp_path)}}})
    assert config.taxonomy == "uavid7"
    assert resolve(config).dataset.options["depth"] == "depth/{name}"


def test_what_the_guess_gets_wrong_is_said_by_options(tmp_path):
    """Another layout: colours in rgb/, depth as 16-bit PNG at 256 a metre, world-to-camera matrices in OpenGL axes."""
    frames = ds.source(256)
    for k, frame in enumerate(frames):
        ds.save(tmp_path / f"s/rgb/{k:03d}.jpg", frame.color)
        ds.save(tmp_path / f"s/metric/d_{k:03d}.png", ds.stored(frame, 256))
        ds.write_labels(tmp_path / "s", [f"{k:03d}"], [frame])
        T = np.linalg.inv(ds.with_axes(frame.T_wc, "opengl"))
        ds.write_lines(tmp_path / f"s/cams/{k:03d}_cam.txt", [" ".join(map(repr, row)) for row in T.tolist()])
    K = frames[0].intrinsics
    (scene,) = uavid(
        tmp_path, images="rgb/{name}.jpg", depth="metric/d_{name}.png", depth_scale=256, pose_format="matrix",
        pose="cams/{name}_cam.txt", pose_convention="world_to_camera", camera_axes="opengl",
        intrinsics=[K.fx, K.fy, K.cx, K.cy],
    )  # fmt: skip
    ds.assert_same_voxels([scene.frame(k, "net") for k in range(ds.COUNT)], frames)


@pytest.mark.parametrize(
    ("options", "kind", "match"),
    [
        ({"pose": "{name}/pose.txt"}, ConfigError, "must be once, in the name of the file"),
        ({"depth": "../{name}"}, ConfigError, "depth: .*leaves its folder"),
        ({"images": "images/x.png"}, ConfigError, r"images: .*needs \{name\}"),
        ({"model": "../.."}, DataError, r"the options of uavid3d: the path '../..' leaves"),
        ({"pose_format": "matrix", "pose": "no/{name}.txt"}, DataError, "no scene here.*options pose_format, pose"),
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

NERF = ds.FORMATS["transforms_json, nerfstudio"]


@pytest.fixture
def nerf(tmp_path):
    """A folder, and how to change its transforms.json."""
    names = ds.write_transforms(tmp_path, ds.source(1000))
    ds.write_labels(tmp_path, names, ds.source(1000))
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
        ({"fl_x": "-", "fl_y": "-"}, "'fl_x' is missing"), ({"fl_x": "40"}, "'fl_x' is '40'; expected a number"),
        ({"fl_x": 0}, "focal lengths must be positive"), ({"fl_x": True}, "'fl_x' is True"),
        ({"fl_x": 10**400}, "'fl_x' is 1000"), ({"w": 0}, "'w' is 0; expected a number of pixels"),
        ({"w": "-", "cx": "-"}, "'cx' is missing"), ({"frames": []}, "'frames' must be a list"),
        ({"frames": [1]}, "'frames' must be a list"),
        ({"integer_depth_scale": 0}, "'integer_depth_scale' is 0; expected the metres"),
    ],
)  # fmt: skip
def test_values_that_cannot_be_are_named(nerf, change, match):
    fails(DataError, match, ds.opened, NERF, nerf(**change))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"file_path": "../../secret.png"}, r"frame 1: the path '../../secret.png' leaves"),
        ({"depth_file_path": "/etc/passwd"}, "leaves"), ({"file_path": 7}, "file_path is 7; expected a path"),
        ({"file_path": None}, "'file_path' is missing"), ({"file_path": "a\nb"}, "cannot be the path of a file"),
        ({"file_path": "images/frame_00000.png"}, "two frames have one name"),
        ({"depth_file_path": None}, "frame 1: has no depth_file_path; add it, or set depth"),
        ({"transform_matrix": [[1, 2], [3]]}, "frame 1: transform_matrix: expected a"),
        ({"transform_matrix": "x"}, "expected a"), ({"transform_matrix": None}, "expected a"),
        ({"transform_matrix": [[[1]]]}, "expected a 4x4 matrix"),
    ],
)  # fmt: skip
def test_frames_that_cannot_be_are_named(nerf, change, match):
    fails(DataError, match, ds.opened, NERF, nerf(1, **change))


@pytest.mark.parametrize("text", ["", "[1]", "{", "[" * 200_000, "\xff", '{"frames": [{"a": 1}]}', "nullx"])
def test_text_that_is_no_transforms_is_refused(tmp_path, text):
    (tmp_path / "transforms.json").write_text(text, encoding="latin-1")
    fails(DataError, r"transforms\.json: ", ds.opened, NERF, tmp_path)


def test_a_matrix_that_is_not_finite_is_lost(nerf):
    folder = nerf(0, transform_matrix=[[math.nan] * 4] * 4)  # the last frame: the file has them in reverse
    scene = ds.opened(NERF, folder)
    assert [scene.tracked(k) for k in range(ds.COUNT)] == [True, True, True, False]


def test_focal_lengths_from_angles_and_a_centre_in_the_middle(nerf):
    fx = ds.city()[0].intrinsics.fx
    folder = nerf(fl_x="-", fl_y="-", cx="-", cy="-", camera_angle_x=2 * math.atan(ds.W / 2 / fx))
    K = ds.opened(NERF, folder).intrinsics(0, (ds.H, ds.W))
    assert (K.fx, K.fy, K.cx, K.cy) == (pytest.approx(fx), K.fx, (ds.W - 1) / 2, (ds.H - 1) / 2)


def test_images_in_several_folders_have_names_with_folders(tmp_path):
    frames = ds.source(1000)[:2]
    entries = []
    for k, frame in enumerate(frames):
        ds.save(tmp_path / f"images/cam{k}/1.v2.png", frame.color)
        ds.save(tmp_path / f"depth/cam{k}/1.v2.png", ds.stored(frame, 1000))
        ds.write_labels(tmp_path, [f"cam{k}/1.v2"], [frame])
        T = ds.with_axes(frame.T_wc, "opengl")[:3].tolist()
        entries.append({"file_path": f"images\\cam{k}\\1.v2.png", "transform_matrix": T} | ds.camera_json(frame))
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": entries}))
    scene = ds.opened(NERF, tmp_path, depth="depth/{name}.png")
    read = [scene.frame(k, "net") for k in range(2)]
    ds.assert_same_voxels(read, frames)
    assert read[1].files["labels"] == f"{tmp_path}/labels/net/cam1/1.v2.png"


def test_an_image_of_another_size_than_the_model_says_is_named(tmp_path, caplog):
    form = ds.FORMATS["colmap, text"]
    ds.write_labelled(form, tmp_path)
    ds.opened(form, tmp_path)
    assert not caplog.records
    cameras = tmp_path / "sparse/cameras.txt"
    cameras.write_text(cameras.read_text().replace(f" {ds.W} {ds.H} ", f" {2 * ds.W} {2 * ds.H} "))
    ds.opened(form, tmp_path)
    assert f"0000.png has {2 * ds.W}x{2 * ds.H} pixels, but the file has {ds.W}x{ds.H}" in caplog.text
