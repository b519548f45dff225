"""Every dataset's files, written from a known scene and read back: the same voxels as from the scene itself."""

from __future__ import annotations

import numpy as np
import pytest
from dataset_writers import CLASSES, COUNT, FORMATS, H, W, assert_same_voxels, opened, save, source, write_labels

from semstab.config import FrameSelection
from semstab.datasets import open_dataset
from semstab.datasets.scene import select_frames


@pytest.fixture(params=FORMATS)
def form(request):
    return FORMATS[request.param]


@pytest.fixture
def written(form, tmp_path):
    """A root with one scene two folders deep, with labels of 'net' in its folder."""
    frames = source(form.scale)
    folder = tmp_path / "room" / "seq 1"
    folder.mkdir(parents=True)
    names = form.write(folder, frames)
    write_labels(folder, names, frames)
    return folder, names, frames


def test_files_give_the_voxels_of_their_source(form, written):
    folder, names, frames = written
    scene = opened(form, folder.parents[1])
    assert (scene.name, len(scene), scene.backbones) == ("room-seq 1", COUNT, ("net",))
    assert scene.label_space("net").classes == tuple(CLASSES)
    found = [scene.frame(index, "net") for index in range(COUNT)]
    for ours, theirs, name in zip(found, frames, names, strict=True):
        np.testing.assert_array_equal(ours.depth, theirs.depth)
        np.testing.assert_allclose(ours.T_wc, theirs.T_wc, rtol=0, atol=1e-12)
        np.testing.assert_allclose(ours.intrinsics.matrix, theirs.intrinsics.matrix, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(ours.labels, theirs.labels)
        assert ours.color.shape == (H, W, 3)
        assert np.abs(ours.color.astype(float) - theirs.color).mean() < 12  # some formats have JPEG
        assert name in ours.files["labels"]
    assert_same_voxels(found, frames)
    assert scene.frame(0, "net", color=False).color is None


def test_the_scenes_folder_can_be_the_root(form, written):
    folder, _, frames = written
    scene = opened(form, folder)
    assert scene.name == "seq 1"
    np.testing.assert_allclose(scene.T_wc(COUNT - 1), frames[-1].T_wc, rtol=0, atol=1e-12)


def test_a_wrong_convention_can_be_said_and_changes_the_pose(form, written):
    """What is only recalled of a format can be overridden: axes, direction, depth scale, the pixel centre."""
    folder, _, frames = written
    scene = opened(form, folder)
    asked, axes = scene.options.pose_convention, scene.options.camera_axes
    other = "world_to_camera" if asked == "camera_to_world" else "camera_to_world"
    T = scene.T_wc(1)
    inverted = opened(form, folder, pose_convention=other, camera_axes="opencv").T_wc(1)
    stored_axes = opened(form, folder, camera_axes="opencv").T_wc(1)
    np.testing.assert_allclose(inverted, np.linalg.inv(stored_axes), rtol=0, atol=1e-12)
    flipped = opened(form, folder, camera_axes="ned" if axes != "ned" else "opencv").T_wc(1)
    assert np.abs(flipped - T).max() > 0.1
    half = opened(form, folder, metres_per_unit=0.5)
    np.testing.assert_allclose(half.T_wc(1)[:3, 3], T[:3, 3] / 2, rtol=0, atol=1e-12)
    tenth = opened(form, folder, depth_scale=10 * (scene.options.depth_scale or form.scale or 1))
    np.testing.assert_allclose(tenth.depth(0), frames[0].depth / 10, rtol=1e-6)
    moved = opened(form, folder, pixel_centre=0.25).intrinsics(0, (H, W))
    assert moved.cx == pytest.approx(scene.intrinsics(0, (H, W)).cx + (scene.options.pixel_centre or 0) - 0.25)


def test_depth_along_the_ray_becomes_planar(form, written):
    folder, _, frames = written
    scene = opened(form, folder, depth_kind="ray")
    K = frames[0].intrinsics.matrix
    v, u = np.mgrid[:H, :W]
    rays = np.linalg.inv(K) @ np.stack([u.ravel(), v.ravel(), np.ones(H * W)])
    expected = frames[0].depth / np.linalg.norm(rays, axis=0).reshape(H, W)
    np.testing.assert_allclose(scene.depth(0), expected, rtol=1e-6)


def test_invalid_values_and_far_depth_are_left_out(form, written):
    folder, _, frames = written
    scale = form.scale or 1
    value = float(np.rint(frames[0].depth[3, 5] * scale)) if form.scale else float(frames[0].depth[3, 5])
    near = opened(form, folder, invalid_depth=[value], max_depth=5.0).depth(0)
    expected = np.where((frames[0].depth >= 5) | (frames[0].depth == frames[0].depth[3, 5]), 0, frames[0].depth)
    np.testing.assert_array_equal(near, expected)
    assert near[3, 5] == 0


def test_intrinsics_for_another_size_are_scaled(form, written):
    folder, _, frames = written
    K = opened(form, folder, intrinsics_size=(2 * W, 2 * H)).intrinsics(0, (H, W))
    assert K.fx == pytest.approx(frames[0].intrinsics.fx / 2)
    assert K.cx == pytest.approx((frames[0].intrinsics.cx + 0.5) / 2 - 0.5)


def test_the_digest_follows_what_counts(form, written):
    folder, names, frames = written
    scene = opened(form, folder)
    digest = scene.digest([0, 1], "net")
    for index in (0, 1):
        scene.frame(index, "net")
    assert scene.digest([0, 1], "net") == digest == opened(form, folder.parents[1]).digest([0, 1], "net")
    assert scene.digest([0], "net") != digest
    assert opened(form, folder, max_depth=7).digest([0, 1], "net") != digest
    assert opened(form, folder, classes=[*CLASSES, "more"]).digest([0, 1], "net") != digest
    save(folder / f"labels/net/{names[1]}.png", frames[0].labels)
    assert opened(form, folder).digest([0], "net") == scene.digest([0], "net")
    assert opened(form, folder).digest([0, 1], "net") != digest


def test_a_frame_that_lacks_a_file_is_an_error_or_left_out(form, written, caplog):
    folder, names, _ = written
    depth = opened(form, folder).frame(1, "net").files["depth"]
    lost = folder / f"labels/net/{names[2]}.png"
    lost.unlink()
    with pytest.raises(ValueError, match=r"1 missing: .*add them, or set incomplete: skip") as caught:
        select_frames(opened(form, folder), FrameSelection(), ["net"])
    assert str(folder) in str(caught.value)
    assert str(lost.relative_to(folder)) in str(caught.value)
    scene = opened(form, folder, incomplete="skip")
    assert select_frames(scene, FrameSelection(), ["net"]).indices == [0, 1, 3]
    assert (len(scene), scene.frame(1, "net").files["depth"]) == (COUNT, depth)
    assert "1 of 4 frames left out" in caplog.text


@pytest.mark.parametrize("above", [False, True])
def test_the_camera_of_7_scenes_is_that_of_its_file(tmp_path, above):
    form, frames = FORMATS["seven_scenes"], source(1000)
    folder = tmp_path / "seq-01"
    form.write(folder, frames)
    usual = open_dataset("seven_scenes", {"root": folder}).scene("seq-01")
    assert usual.intrinsics(0, (480, 640)).fx == 585
    np.savetxt((folder.parent if above else folder) / "camera-intrinsics.txt", frames[0].intrinsics.matrix)
    found = open_dataset("seven_scenes", {"root": folder}).scene("seq-01").intrinsics(0, (H, W))
    np.testing.assert_allclose(found.matrix, frames[0].intrinsics.matrix)
    said = open_dataset("seven_scenes", {"root": folder, "intrinsics": (50, 51, 24, 16)}).scene("seq-01")
    assert said.intrinsics(0, (H, W)).fy == 51
