"""COLMAP's models and depth maps: as COLMAP's own library writes them, and what they may not hold."""

from __future__ import annotations

import functools
import struct

import numpy as np
import pytest
from dataset_writers import (
    COUNT,
    FORMATS,
    H,
    W,
    assert_same_voxels,
    city,
    four,
    numbers,
    opened,
    save,
    save_depth_map,
    source,
    stored,
    write_colmap,
    write_labels,
    write_lines,
)
from posed_scene import fails

from semstab.datasets.colmap import read_model
from semstab.datasets.files.depth import read_depth_map
from semstab.errors import DataError

TEXT, BINARY = FORMATS["colmap, text"], FORMATS["colmap, binary"]


@pytest.fixture(params=["text", "binary"])
def scene(request, tmp_path):
    """(folder, names, frames) of a workspace of either kind."""
    names = write_colmap(tmp_path, source(), binary=request.param == "binary")
    write_labels(tmp_path, names, source())
    return tmp_path, names, source()


# --- as COLMAP writes them


def test_models_that_colmap_itself_wrote(tmp_path):
    """pycolmap writes text and binary, with rigs, frames and points beside them; both are read alike."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap")
    frames = source()
    fx, fy, cx, cy = four(frames[0])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=3, model="PINHOLE", width=W, height=H, params=[fx, fy, cx + 0.5, cy + 0.5])
    )
    for k, frame in enumerate(frames):
        image = pycolmap.Image(name=f"a b/{k}.png", camera_id=3, image_id=9 - k)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(frame.T_wc)[:3]))
        path = tmp_path / f"stereo/depth_maps/a b/{k}.png.geometric.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        depth = pycolmap.DepthMap.from_array(np.ascontiguousarray(frame.depth), 0.1, 100.0)
        depth.write(str(path))
    write_labels(tmp_path, [f"a b/{k}" for k in range(COUNT)], frames)
    for kind in ("text", "binary"):
        (tmp_path / "sparse" / kind).mkdir(parents=True)
        getattr(model, f"write_{kind}")(str(tmp_path / "sparse" / kind))
        scene = opened(TEXT, tmp_path, model=f"sparse/{kind}")
        assert_same_voxels([scene.frame(k, "net") for k in range(COUNT)], frames)


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
    write_lines(folder / "sparse/cameras.txt", [line])


@pytest.mark.parametrize(
    ("model", "parameters", "focals"),
    [("SIMPLE_PINHOLE", [40, 24, 16], (40, 40)), ("PINHOLE", [40, 41, 24, 16], (40, 41)),
     ("SIMPLE_RADIAL", [40, 24, 16, 0], (40, 40)), ("OPENCV", [40, 41, 24, 16, 0, 0, 0, 0], (40, 41))],
)  # fmt: skip
def test_cameras_that_do_not_distort(tmp_path, model, parameters, focals):
    write_colmap(tmp_path, city())
    set_camera(tmp_path, f"7 {model} {W} {H} {numbers(parameters)}")
    K = opened(TEXT, tmp_path).intrinsics(0, (H, W))
    assert (K.fx, K.fy, K.cx, K.cy) == (*focals, 23.5, 15.5)


@pytest.mark.parametrize(
    ("model", "parameters"),
    [("SIMPLE_RADIAL", [40, 24, 16, 0.1]), ("OPENCV", [40, 41, 24, 16, 0, 0, 0, 1e-9]),
     ("OPENCV_FISHEYE", [40, 41, 24, 16, 0, 0, 0, 0]), ("FOV", [40, 41, 24, 16, 0])],
)  # fmt: skip
def test_a_camera_that_distorts_is_refused_with_advice(tmp_path, model, parameters):
    write_colmap(tmp_path, city())
    set_camera(tmp_path, f"7 {model} {W} {H} {numbers(parameters)}")
    fails(
        DataError,
        rf"cameras\.txt: camera 7 is {model}, which distorts; undistort .*image_undistorter",
        opened,
        TEXT,
        tmp_path,
    )


def test_a_camera_that_no_image_has_may_distort(tmp_path):
    write_colmap(tmp_path, city())
    with (tmp_path / "sparse/cameras.txt").open("a") as file:
        file.write(f"8 FOV {W} {H} 40 40 24 16 0.3\n")
    assert len(opened(TEXT, tmp_path)) == COUNT


@pytest.mark.parametrize(
    ("line", "match"),
    [
        (f"7 PINHOLE {W} {H} 40 40 24", "line 1 is .*expected CAMERA_ID MODEL"),
        (f"7 PINHOL {W} {H} 40 40 24 16", "line 1 is .*expected CAMERA_ID MODEL"),
        (f"7 PINHOLE {W} {H} 40 40 24 x", "line 1: 'x' is not a number"),
        (f"7 PINHOLE {W}.5 {H} 40 40 24 16", r"line 1: '48\.5' is not a whole number"),
        (f"7 PINHOLE 0 {H} 40 40 24 16", "images of 0x32 pixels"),
        (f"7 PINHOLE {W} {H} -40 40 24 16", "camera 7: .*focal lengths must be positive"),
        (f"7 PINHOLE {W} {H} 40 40 nan 16", "camera 7: .*all values finite"),
        (f"6 PINHOLE {W} {H} 40 40 24 16", r"image 'cam 0/0000\.png' has camera 7, which is not in cameras\.txt"),
    ],
)
def test_another_camera_is_refused(tmp_path, line, match):
    write_colmap(tmp_path, city())
    set_camera(tmp_path, line)
    fails(DataError, match, opened, TEXT, tmp_path)


def test_depth_maps_may_be_smaller_than_the_cameras_images(tmp_path):
    """COLMAP bounds the size of its stereo: the intrinsics follow the depth map."""
    names = write_colmap(tmp_path, city())
    for name, frame in zip(names, city(), strict=True):
        save_depth_map(tmp_path / f"stereo/depth_maps/{name}.png.geometric.bin", frame.depth[::2, ::2])
    K = opened(TEXT, tmp_path).intrinsics(0, opened(TEXT, tmp_path).depth(0).shape)
    assert K.fx == pytest.approx(city()[0].intrinsics.fx / 2)
    assert K.cx == pytest.approx((W / 2 - 1) / 2)


# --- images


def test_metres_of_a_model_without_scale(scene):
    """A model in units of 4 m: depth maps and positions grow together, so the voxels are those of the source."""
    folder, names, frames = scene
    small = [frame.T_wc.copy() for frame in frames]
    for name, frame in zip(names, frames, strict=True):
        save_depth_map(folder / f"stereo/depth_maps/{name}.png.geometric.bin", frame.depth / 4)
    found = opened(TEXT, folder, metres_per_unit=4)
    np.testing.assert_allclose(found.depth(0), frames[0].depth, rtol=1e-6)
    np.testing.assert_allclose(found.T_wc(2)[:3, 3], small[2][:3, 3] * 4, rtol=1e-12)


def test_depth_can_come_from_elsewhere(tmp_path):
    frames = source(1000)
    names = write_colmap(tmp_path, frames)
    for name, frame in zip(names, frames, strict=True):
        save(tmp_path / f"my depth/{name}.png", stored(frame, 1000))
    write_labels(tmp_path, names, frames)
    found = opened(TEXT, tmp_path, depth="my depth/{name}")
    assert_same_voxels([found.frame(k, "net") for k in range(COUNT)], frames)


def test_frames_go_by_name_not_by_id(scene):
    folder, names, _ = scene
    found = opened(TEXT, folder)
    assert [found.frame(k, "net").files["labels"] for k in range(COUNT)] == [
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
    names = write_colmap(tmp_path, city())
    write_labels(tmp_path, names, city())
    path = tmp_path / "sparse/images.txt"
    write_lines(path, change(path.read_text().splitlines()))
    fails(DataError, match, opened, TEXT, tmp_path)


def test_a_pose_that_is_not_finite_is_lost(tmp_path):
    write_colmap(tmp_path, city())
    path = tmp_path / "sparse/images.txt"
    lines = path.read_text().splitlines()
    lines[2] = "100 nan nan nan nan 0 0 0 7 cam 0/0000.png"
    write_lines(path, lines)
    found = opened(TEXT, tmp_path)
    assert [found.tracked(k) for k in range(COUNT)] == [False, True, True, True]


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_a_binary_file_cut_anywhere_is_refused(tmp_path, name):
    write_colmap(tmp_path, city(), binary=True)
    path = tmp_path / "sparse" / name
    whole = path.read_bytes()
    for length in range(0, len(whole), 3):
        path.write_bytes(whole[:length])
        fails(DataError, f"{name}: ", read_model, tmp_path / "sparse")


def test_counts_that_a_file_cannot_hold_take_no_memory(tmp_path):
    write_colmap(tmp_path, city(), binary=True)
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
    write_colmap(tmp_path, city(), binary=True)
    (tmp_path / "sparse/cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 7, 44, W, H, 1, 1, 1, 1))
    fails(DataError, "camera 7 has the model 44, which is not known", read_model, tmp_path / "sparse")


def test_a_missing_half_of_a_model_is_named(tmp_path):
    write_colmap(tmp_path, city())
    (tmp_path / "sparse/images.txt").unlink()
    fails(DataError, r"images\.txt: cannot be read", opened, TEXT, tmp_path)
    write = functools.partial(write_colmap, tmp_path, city())
    write()
    (tmp_path / "sparse/cameras.txt").unlink()
    fails(DataError, r"no scene here, nor 3 folders deep; one holds a sparse model", opened, TEXT, tmp_path)
