"""The posed_folder reader: layout, incomplete frames, digest, poses and intrinsics, and the real data."""

import logging
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from posed_scene import H, W, fails, first_frame, opened, pose, save_image, say, write_scene

from semstab.config import FrameSelection
from semstab.datasets import open_dataset
from semstab.datasets.formats.disk import natural, read_intrinsics, read_pose
from semstab.datasets.scene import select_frames
from semstab.errors import ConfigError, DataError


@pytest.fixture
def folder(tmp_path) -> Path:
    return write_scene(tmp_path / "scene0")


# --- what a scene is


def test_a_frame_holds_what_the_files_hold(folder):
    scene = opened(folder)
    assert (scene.name, len(scene), scene.models, scene.ground_truth) == ("scene0", 3, ("net", "net-scores"), True)
    assert scene.up.tolist() == [0, 0, 1]
    assert scene.label_space("net").classes == scene.label_space("gt").classes == ("a", "b", "c")
    frame = scene.frame(2, "net")
    raw = np.asarray(Image.open(folder / "depth/frame10.png"))
    np.testing.assert_array_equal(frame.depth, (raw / 1000).astype(np.float32))
    np.testing.assert_array_equal(frame.T_wc, pose(2))
    np.testing.assert_array_equal(frame.color, np.asarray(Image.open(folder / "color/frame10.png")))
    assert (frame.index, frame.intrinsics.fx, frame.intrinsics.fy, frame.labels.max()) == (2, 10, 11, 2)
    assert (frame.intrinsics.cx, frame.intrinsics.cy) == (3.5, 2.5)
    assert frame.files == {
        "depth": f"{folder}/depth/frame10.png",
        "pose": f"{folder}/pose/frame10.txt",
        "labels": f"{folder}/labels/net/frame10.png",
        "color": f"{folder}/color/frame10.png",
    }
    assert scene.frame(2, "gt").labels.max() == 0
    soft = scene.frame(1, "net-scores")
    stored = np.load(folder / "scores/net/frame2.npz")["scores"]
    np.testing.assert_array_equal(soft.scores, stored.transpose(1, 2, 0))
    assert soft.files["scores"] == f"{folder}/scores/net/frame2.npz"


def test_scenes_go_in_natural_order_and_other_folders_do_not_count(tmp_path):
    for name in ("scene10", "scene2", "a (1)"):
        write_scene(tmp_path / name, names=("1",))
    (tmp_path / "notes").mkdir()
    (tmp_path / ".hidden" / "depth").mkdir(parents=True)
    dataset = open_dataset("posed_folder", {"root": tmp_path})
    assert dataset.scenes == ("a (1)", "scene2", "scene10")
    assert dataset.scene("a (1)").name == "a (1)"
    message = r"scene 'scene11' is not there; did you mean 'scene10'\?"
    fails(ConfigError, message, dataset.scene, "scene11")


def test_the_root_can_be_the_scene_and_the_current_folder(folder, monkeypatch):
    monkeypatch.chdir(folder)
    scene = opened(Path())
    assert scene.name == "scene0"
    assert scene.frame(0, "net").files["depth"] == "depth/frame1.png"


def test_a_root_without_a_scene_says_what_was_looked_for(tmp_path):
    fails(
        DataError,
        re.escape(f"{tmp_path}: no scene here, nor 3 folders deep; one holds depth/, pose/ and intrinsics.txt"),
        opened,
        tmp_path,
    )
    fails(DataError, "nowhere: there is no such folder", opened, tmp_path / "nowhere")


def test_names_sort_by_number():
    assert sorted(["f10", "f9", "f09", "g1", "10", "9", "f"], key=natural) == ["9", "10", "f", "f09", "f9", "f10", "g1"]


def test_a_scene_without_labels_still_has_depth_and_poses(folder):
    (folder / "labels").rename(folder / "other labels")
    (folder / "scores").rename(folder / "other scores")
    scene = opened(folder)
    assert (scene.models, scene.ground_truth, len(scene)) == ((), False, 3)
    assert scene.depth(1).shape == (H, W)
    np.testing.assert_array_equal(scene.T_wc(1), pose(1))
    for name in ("net", "gt"):
        message = f"model '{name}' is not there; put its label maps into labels/NAME/"
        fails(ConfigError, message, scene.frame, 0, name)


def test_an_unknown_model_or_frame_is_named(folder):
    scene = opened(folder)
    message = r"'net-score' is not there; did you mean 'net-scores'\?$"
    fails(ConfigError, message, scene.label_space, "net-score")
    fails(ConfigError, message, scene.frame, 0, "net-score")
    fails(ConfigError, message, scene.digest, [0], "net-score")
    for index in (-1, 3):
        fails(ConfigError, f"there is no frame {index}; it has 3", scene.frame, index, "net")


def test_two_files_of_one_frame_are_refused(folder):
    np.save(folder / "depth/frame2.npy", np.ones((H, W)))
    fails(DataError, r"depth/frame2\.(png|npy): frame2\.(png|npy) is the same frame", opened, folder)


def test_files_of_the_file_system_do_not_count(folder):
    for name in ("depth/._frame1.png", "depth/Thumbs.db", "labels/net/readme.txt", "labels/loose.png"):
        (folder / name).write_bytes(b"x")
    (folder / "labels/.cache").mkdir()
    assert len(opened(folder)) == 3


@pytest.mark.parametrize("shape", [(H + 1, W), (W, H)])
def test_labels_of_another_size_are_named(folder, shape):
    save_image(folder / "labels/net/frame1.png", np.zeros(shape, np.uint8))
    fails(DataError, r"labels/net/frame1\.png: labels are .* but depth is 8x6", first_frame, folder)


# --- incomplete frames


@pytest.mark.parametrize(
    "missing", ["depth/frame2.png", "pose/frame2.txt", "labels/net/frame2.png", "scores/net/frame2.npz"]
)
def test_an_incomplete_frame_is_an_error_or_left_out(folder, missing, caplog):
    (folder / missing).unlink()
    scene, every = opened(folder), FrameSelection()
    message = f"1 missing: .*{re.escape(missing)}; add them, or set incomplete: skip"
    fails(DataError, message, select_frames, scene, every, scene.models)
    scene = opened(folder, incomplete="skip")
    with caplog.at_level(logging.WARNING, logger="semstab"):
        chosen = select_frames(scene, every, scene.models)
    assert missing in caplog.text
    assert "1 of 3 frames left out" in caplog.text
    assert (len(scene), chosen.indices, chosen.incomplete, chosen.left_out) == (3, [0, 2], (1,), 1)
    for model in scene.models:
        files = [scene.frame(k, model).files["depth"] for k in chosen.indices]
        assert files == [f"{folder}/depth/frame1.png", f"{folder}/depth/frame10.png"]


def test_a_scene_without_a_whole_frame_is_an_error(folder):
    (folder / "pose").rename(folder / "poses")
    scene = opened(folder, incomplete="skip")
    fails(DataError, "no selected frame has depth, pose and labels", select_frames, scene, FrameSelection(), ["net"])
    fails(DataError, "no selected frame has depth and pose", select_frames, scene, FrameSelection())


def test_ground_truth_may_be_sparse(folder):
    (folder / "labels/gt/frame2.png").unlink()
    (folder / "labels/gt/frame99.png").write_bytes(b"")
    scene = opened(folder)
    assert scene.frame(0, "gt").files["labels"].endswith("labels/gt/frame1.png")
    message = r"1 missing: .*labels/gt/frame2\.png; choose frames"
    fails(DataError, message, scene.frame, 1, "gt")
    fails(DataError, message, scene.digest, [1], "gt")


# --- digest


@pytest.mark.parametrize("changed", ["depth/frame2.png", "pose/frame2.txt", "labels/net/frame2.png", "intrinsics.txt"])
def test_the_digest_sees_a_changed_file(folder, changed):
    digest = opened(folder).digest([0, 1], "net")
    content = (folder / changed).read_bytes()
    if changed.endswith(".png"):
        (folder / changed).write_bytes(content + b" ")
    else:  # of text the numbers count
        (folder / changed).write_bytes(content.replace(b"\n", b" \n"))
        assert opened(folder).digest([0, 1], "net") == digest
        (folder / changed).write_bytes(content.replace(b"5", b"6"))
    assert opened(folder).digest([0, 1], "net") != digest


def test_the_digest_sees_a_changed_setting(folder):
    options = ({}, {"depth_scale": 2}, {"classes": ["a", "x"]})
    digests = {opened(folder, **option).digest([0], "net") for option in options}
    (folder / "scene.yaml").write_text("taxonomy: mine.yaml\n")
    for classes in ("[p, q]", "[p, r]"):
        (folder / "mine.yaml").write_text(f"classes: {classes}\n")
        digests.add(opened(folder).digest([0], "net"))
    assert len(digests) == 5


# --- real data

DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[1] / "../shared/data"))


def real(name):
    if not (DATA / name).is_dir():
        pytest.skip(f"no {DATA / name}; set SEMSTAB_DATA to the folder that holds {name}/")
    return opened(DATA / name)


def reprojection_errors(scene, a, b):
    """Relative depth differences of frame a's valid pixels seen from frame b, where b has depth too."""
    depth_a, depth_b = scene.depth(a).astype(np.float64), scene.depth(b)
    K_a, K_b = scene.intrinsics(a, depth_a.shape).matrix, scene.intrinsics(b, depth_b.shape).matrix
    v, u = np.nonzero(depth_a > 0)
    rays = np.linalg.inv(K_a) @ np.stack([u, v, np.ones_like(u)])
    T_ba = np.linalg.inv(scene.T_wc(b)) @ scene.T_wc(a)
    points = T_ba[:3, :3] @ (rays * depth_a[v, u]) + T_ba[:3, 3:]
    points = points[:, points[2] > 0]
    u_b, v_b, _ = np.rint(K_b @ (points / points[2])).astype(int)
    inside = (u_b >= 0) & (v_b >= 0) & (u_b < depth_b.shape[1]) & (v_b < depth_b.shape[0])
    found, expected = depth_b[v_b[inside], u_b[inside]], points[2, inside]
    return np.abs(found / expected - 1)[found > 0]


def test_apc_shelf():
    scene = real("apc_shelf")
    assert (scene.name, len(scene), scene.ground_truth) == ("apc_shelf", 15, True)
    assert scene.models == ("fcn", "fcn-scores")
    assert scene.label_space("fcn").classes[1] == "chenille_stems"
    assert np.mean([(scene.depth(k) > 0).mean() for k in range(15)]) == pytest.approx(0.27, abs=0.02)
    hard, soft, truth = (scene.frame(4, model) for model in ("fcn", "fcn-scores", "gt"))
    assert hard.shape == soft.shape == (480, 640)
    assert soft.scores.shape == (480, 640, 5)
    assert set(np.unique(truth.labels)) <= set(range(5))
    assert (hard.labels == truth.labels).mean() > 0.7
    errors = [np.median(reprojection_errors(scene, k, k + 1)) for k in range(14)]
    assert np.median(errors) == pytest.approx(0.007, abs=0.003)


def test_hololens():
    scene = real("hololens")
    assert (len(scene), scene.models, scene.ground_truth) == (96, (), False)
    pairs = [(k, k + 5) for k in range(0, 90, 10)]
    errors = [np.median(reprojection_errors(scene, *pair)) for pair in pairs]
    assert 0.002 < np.median(errors) < 0.006
    mirrored = opened(DATA / "hololens", camera_axes="opengl")
    assert np.median(reprojection_errors(mirrored, *pairs[0])) > 3 * errors[0]


# --- poses and intrinsics


POINT_CV = np.array([0.2, -0.3, 2.0])
"""A point right of, above and before the camera: OpenCV axes."""


@pytest.mark.parametrize(
    ("axes", "point"), [("opencv", POINT_CV), ("opengl", [0.2, 0.3, -2.0]), ("ned", [2.0, 0.2, -0.3])]
)
@pytest.mark.parametrize("convention", ["camera_to_world", "world_to_camera"])
def test_poses_of_any_convention_see_the_same_point(folder, axes, point, convention):
    T = pose(5)
    expected = T[:3, :3] @ point + T[:3, 3]
    np.savetxt(folder / "pose/frame1.txt", T if convention == "camera_to_world" else np.linalg.inv(T))
    say(folder, camera_axes=axes, pose_convention=convention)
    T_wc = first_frame(folder).T_wc
    np.testing.assert_allclose(T_wc[:3, :3] @ POINT_CV + T_wc[:3, 3], expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    "text",
    [
        "1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n",
        "1 0 0 5\n0 1 0 6\n0 0 1 7\n",
        "1,0,0,5,0,1,0,6,0,0,1,7,0,0,0,1",
        "\ufeff1.0, 0, 0, 5e0\r\n0\t1 0 6\r\n0 0 1 7\r\n",
    ],
)
def test_a_pose_is_16_or_12_numbers(tmp_path, text):
    (tmp_path / "p.txt").write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(
        read_pose(tmp_path / "p.txt"), [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
    )


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "the file is empty"),
        ("\n", "got 0 numbers"),
        ("1 2 3 0 0 0 1", r"got 7 numbers \(position and quaternion\?\)"),
        ("1 0 0 0 1 0 0 0 1", "got 9 numbers"),
        ("1 0 0 x 0 1 0 0 0 0 1 0", "expected numbers .*'x'"),
        pytest.param("1 " * 40000, "too many for such a file", id="long"),
    ],
)
def test_a_pose_of_another_form_is_refused(folder, text, match):
    (folder / "pose/frame1.txt").write_text(text)
    fails(DataError, rf"pose/frame1\.txt: .*{match}", first_frame, folder)


@pytest.mark.parametrize(
    ("T", "convention", "match"),
    [
        (np.full((4, 4), -np.inf), "camera_to_world", "not finite"),
        (np.full((4, 4), np.nan), "world_to_camera", "not finite"),
        (np.zeros((4, 4)), "world_to_camera", "not finite"),
        (np.diag([1.0, 1, -1, 1]), "camera_to_world", "mirrors"),
        (np.diag([2.0, 2, 2, 1]), "world_to_camera", "not orthonormal"),
        (pose(1).T, "camera_to_world", "transposed"),
    ],
)
def test_a_pose_that_is_not_rigid_names_its_file(folder, T, convention, match):
    np.savetxt(folder / "pose/frame1.txt", T)
    fails(DataError, rf"pose/frame1\.txt: .*{match}", first_frame, folder, pose_convention=convention)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("10 11 3 2", "got 4 numbers"), ("10 0 0 0 11 0 3 2 1", "is no camera matrix"),
        ("10 0 3 0 nan 2 0 0 1", "is no camera matrix"), ("10 1 3 0 11 2 0 0 1", "skew"),
        ("-10 0 3 0 11 2 0 0 1", "focal lengths must be positive"), ("ten", "expected numbers"),
    ],
)  # fmt: skip
def test_intrinsics_that_are_none_are_refused(folder, text, match):
    (folder / "intrinsics.txt").write_text(text)
    fails(DataError, rf"intrinsics\.txt: .*{match}", opened, folder)


def test_missing_intrinsics_are_named(folder):
    (folder / "intrinsics.txt").unlink()
    fails(DataError, r"intrinsics\.txt: is missing; write the camera matrix", opened, folder)


NUMBERISH = st.text(alphabet="0123456789.eE+-_, \n\tnaif", max_size=120)


@given(content=st.one_of(st.binary(max_size=120), NUMBERISH.map(str.encode)))
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_text_is_a_matrix_or_a_data_error(tmp_path, content):
    path = tmp_path / "matrix.txt"
    path.write_bytes(content)
    for read in (read_pose, read_intrinsics):
        message = path.name
        try:
            read(path)
        except DataError as error:
            message = str(error)
        assert path.name in message
        assert "\n" not in message
