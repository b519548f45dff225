"""SemanticKITTI's images: LiDAR points at the camera's pixels, what hides them, their classes, and damaged files."""

from __future__ import annotations

import numpy as np
import pytest
from command_line import bench
from dataset_writers import numbers, save, write_lines
from posed_scene import fails
from scan_writers import rigid, save_bytes
from scipy.spatial import cKDTree

from semstab import Intrinsics
from semstab.check import display
from semstab.datasets import open_dataset
from semstab.datasets.geometry.projection import seen_points
from semstab.errors import DataError

W, H, FX, CX, CY = 80, 40, 60.0, 40.5, 19.0
TO_CAMERA = np.array([[0, -1, 0, 0.02], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
"""Tr: the LiDAR has x forward, y left, z up; camera 0 stands 8 cm below and 27 cm before it."""

BASELINE = {"image_2": 0.06, "image_3": -0.47}
"""t of P = K [I | t], metres: image_2 stands 6 cm to the left of camera 0, image_3 47 cm to its right."""

WALL, POST, CAR = 50, 80, 252
"""Stored ids: building, pole, and a car that moves."""


def world() -> tuple[np.ndarray, np.ndarray]:
    """A wall 12 m ahead, dense points; a post 5 m ahead, and a car beside it; with their stored ids."""
    y, z = np.meshgrid(np.linspace(-8, 8, 161), np.linspace(-3, 3, 31))
    wall = np.column_stack([np.full(y.size, 12.0), y.ravel(), z.ravel()])
    post = np.column_stack([np.full(80, 5.0), np.tile([0.0, 0.1], 40), np.linspace(-1.2, 1.2, 80)])
    y, z = np.meshgrid(np.linspace(1.5, 2.5, 11), np.linspace(-1, 0, 11))
    car = np.column_stack([np.full(y.size, 6.0), y.ravel(), z.ravel()])
    return np.concatenate([wall, post, car]), np.repeat([WALL, POST, CAR], [len(wall), len(post), len(car)])


POSES = [rigid((0, 0, 2.0 * k), (0.3 * k, -0.1 * k, 0.0)) for k in range(3)]
"""The LiDAR in the world of the first one."""


@pytest.fixture
def sequence(tmp_path):
    folder = tmp_path / "sequences/08"
    points, ids = world()
    for k, T in enumerate(POSES):
        rows = np.column_stack([(points - T[:3, 3]) @ T[:3, :3], np.full(len(points), 0.5)])
        save_bytes(folder / f"velodyne/{k:06d}.bin", rows.astype("<f4").tobytes())
        save_bytes(folder / f"labels/{k:06d}.label", (ids | 9 << 16).astype("<u4").tobytes())
        for camera in BASELINE:
            save(folder / f"{camera}/{k:06d}.png", np.full((H, W, 3), 40 * k, np.uint8))
        save(folder / f"labels/net/{k:06d}.png", np.full((H, W), k, np.uint8))
    K = np.array([[FX, 0, CX], [0, FX, CY], [0, 0, 1.0]])
    P = {key: np.column_stack([K, K @ [t, 0, 0]]) for key, t in zip(("P2", "P3"), BASELINE.values(), strict=True)}
    write_lines(
        folder / "calib.txt", [f"{key}: {numbers(m)}" for key, m in P.items()] + [f"Tr: {numbers(TO_CAMERA[:3])}"]
    )
    write_lines(folder / "poses.txt", [numbers((TO_CAMERA @ T @ np.linalg.inv(TO_CAMERA))[:3]) for T in POSES])
    write_lines(folder / "times.txt", [f"{0.1 * k}" for k in range(3)])
    return folder


def opened(folder, **options):
    classes = {"classes": ["building", "pole", "car"]}
    dataset = open_dataset("semantickitti_images", {"root": folder.parents[1]} | classes | options)
    assert dataset.scenes == ("sequences-08",)
    return dataset.scene("sequences-08")


@pytest.mark.parametrize("camera", BASELINE)
def test_a_pixel_with_depth_is_a_point_of_the_world(sequence, camera):
    scene, (points, _) = opened(sequence, camera=camera), world()
    for k, T in enumerate(POSES):
        frame = scene.frame(k, "net")
        v, u = np.nonzero(frame.depth)
        assert len(v) > 500
        z = frame.depth[v, u].astype(float)
        in_camera = np.column_stack([(u - CX) / FX * z, (v - CY) / FX * z, z, np.ones(len(z))])
        found = (in_camera @ frame.T_wc.T)[:, :3]
        far, _ = cKDTree(points).query(found)
        assert (far <= z / FX * np.sqrt(0.5) + 1e-4).all()  # a point is up to half a pixel beside its middle
        centre = np.linalg.inv(TO_CAMERA) @ [-BASELINE[camera], 0, 0, 1]
        np.testing.assert_allclose(frame.T_wc[:3, 3], (T @ centre)[:3], atol=1e-9)
    assert scene.timestamps.tolist() == [0.0, 0.1, 0.2]


def test_a_point_behind_a_nearer_surface_is_hidden_also_beside_its_pixels(sequence):
    points, ids = world()
    T_cl, K = TO_CAMERA, opened(sequence).intrinsics(0, (H, W))
    visible = seen_points(points, T_cl, K, (H, W))
    depth = visible.depth_image()
    v, u = visible.v[ids[visible.points] == POST], visible.u[ids[visible.points] == POST]
    assert len(v) > 20
    around = depth[v.min() : v.max() + 1, u.min() - 2 : u.max() + 3]
    assert around[around > 0].max() < 5
    wall_alone = seen_points(points[ids == WALL], T_cl, K, (H, W)).depth_image()
    assert (wall_alone[v.min() : v.max() + 1, u.min() - 2] > 11).any()  # which else is seen there


def test_of_two_points_on_a_pixel_the_nearer_is_seen_and_none_behind_the_camera():
    K = Intrinsics(FX, FX, CX, CY)
    points = np.array([[9, 0, 0], [8, 0, 0], [-8, 0, 0], [np.nan, 0, 0], [np.inf, 1, 1], [0.2, 0, 0]], np.float32)
    axes = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    visible = seen_points(points, axes, K, (H, W))
    assert (visible.points.tolist(), visible.depth.tolist()) == ([1], [8.0])
    assert seen_points(points[2:], axes, K, (H, W)).depth_image().max() == 0


def test_the_truth_is_the_class_of_each_point_and_movers_are_masked(sequence):
    scene = opened(sequence)
    space = scene.label_space("gt")
    assert space.name == "semantickitti"
    frame = scene.frame(1, "gt")
    measured = frame.depth > 0
    assert set(np.unique(frame.labels[measured])) == {10, 50, 80}  # a moving car is a car
    assert (frame.labels[~measured] == 65535).all()
    np.testing.assert_array_equal(frame.labels[measured] == 10, frame.mask[measured])
    assert frame.mask.sum() > 20
    assert scene.frame(1, "net").mask.sum() == frame.mask.sum()  # of every model
    with_movers = opened(sequence, moving="keep")
    assert with_movers.frame(1, "gt").mask is None
    assert (with_movers.frame(1, "gt").labels == frame.labels).all()


def test_masks_of_ones_own_take_the_place_of_the_movers(sequence):
    mask = np.full((H, W), 255, np.uint8)
    mask[:, :7] = 0
    for k in range(3):
        save(sequence / f"masks/{k:06d}.png", mask)
    np.testing.assert_array_equal(opened(sequence, masks="masks/{name}.png").frame(0, "gt").mask, mask == 0)


def test_a_sequence_without_truth_has_none_and_no_mask(sequence):
    for file in sequence.glob("labels/*.label"):
        file.unlink()
    scene = opened(sequence)
    assert not scene.ground_truth
    assert scene.frame(0, "net").mask is None


def test_the_digest_follows_points_and_truth(sequence):
    digest = opened(sequence).digest([0, 1], "net")
    assert opened(sequence).digest([0, 1], "net") == digest
    for file in ("velodyne/000001.bin", "labels/000001.label"):
        data = (sequence / file).read_bytes()
        (sequence / file).write_bytes(data[16:] + data[:16])
        assert opened(sequence).digest([0, 1], "net") != digest
        (sequence / file).write_bytes(data)


def test_hashes_of_a_benchmark_follow_scan_and_pose(sequence):
    before, path = opened(sequence).fingerprints(1), sequence / "velodyne/000001.bin"
    assert len(before) == 2
    path.write_bytes(path.read_bytes()[:-16])
    after = opened(sequence).fingerprints(1)
    assert [name for name in before if before[name] != after[name]] == ["velodyne/000001.bin"]


def rewrite(path, before, after):
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: (f / "calib.txt").unlink(), r"calib\.txt: is missing; it holds Tr"),
        (lambda f: rewrite(f / "calib.txt", "Tr:", "Tx:"), r"calib\.txt: has no line Tr of 12 numbers; copy that"),
        (lambda f: rewrite(f / "calib.txt", "P2:", "P9:"), r"calib\.txt: has no line P2 .* camera of image_2/"),
        (lambda f: rewrite(f / "calib.txt", "60.0", "0.0"), r"calib\.txt: .*focal"),
        (lambda f: (f / "image_2/000000.png").unlink(), r"image_2/000000\.png: is missing; scan 000000\.bin"),
        (lambda f: save_bytes(f / "labels/000000.label", bytes(40)), r"000000\.label: has 10 labels, but .* points"),
        (lambda f: save_bytes(f / "velodyne/000000.bin", bytes(41)), r"000000\.bin: 41 bytes are no rows"),
        (lambda f: write_lines(f / "poses.txt", [numbers(np.eye(4)[:3])]), r"poses\.txt: has 1 poses, and scan 000001"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(sequence, damage, said):
    damage(sequence)
    fails(DataError, said, lambda: opened(sequence).frame(0, "gt"))


def test_check_of_sparse_depth_is_quiet_and_says_whose_labels_agree(sequence, tmp_path):
    for file in sequence.glob("labels/net/*"):
        file.unlink()
    for file, row in (("velodyne/{}.bin", 16), ("labels/{}.label", 4)):
        for k in range(3):
            path = sequence / file.format(f"{k:06d}")
            path.write_bytes(np.frombuffer(path.read_bytes(), f"V{row}")[::11].tobytes())
    result = bench("check", "--dataset", "semantickitti_images", "--data", sequence, cwd=tmp_path)
    assert "Warning" not in result.stderr
    assert "labels   only ground truth: " in result.stdout
    assert display.OF_IMAGES[:20] in result.stdout
    assert "labels of gt" in result.stdout
