"""KITTI-360's images: LiDAR points at the pixels of a rectified camera, the truth beside, and damaged files."""

from __future__ import annotations

import numpy as np
import pytest
from dataset_writers import numbers, save, write_lines
from posed_scene import fails
from scan_writers import rigid, save_bytes
from scipy.spatial import cKDTree
from test_readers_semantickitti_images import CX, CY, FX, POSES, TO_CAMERA, H, W, rewrite, world

from semstab.datasets import open_dataset
from semstab.errors import DataError

DRIVE = "2013_05_28_drive_0000_sync"
RECTIFY = rigid((2, -3, 1), (0, 0, 0))
"""From the axes of a camera as it was mounted to those of its rectified images."""

CAMERAS = {"image_00": rigid((90, 0, 90), (1.5, -0.3, 0.2)), "image_01": rigid((90, 0, 90), (1.5, 0.3, 0.2))}
"""The mounted cameras in the IMU."""


@pytest.fixture
def drive(tmp_path):
    root = tmp_path / "KITTI-360"
    points, _ = world()
    lidar_in_camera = np.linalg.inv(RECTIFY) @ TO_CAMERA
    lidar_in_imu = CAMERAS["image_00"] @ lidar_in_camera
    poses = []
    for k, T in enumerate(POSES):
        name = f"{7 + k:010d}"
        rows = np.column_stack([(points - T[:3, 3]) @ T[:3, :3], np.full(len(points), 0.5)])
        scan = root / f"data_3d_raw/{DRIVE}/velodyne_points/data/{name}.bin"
        save_bytes(scan, rows.astype("<f4").tobytes())
        for camera in CAMERAS:
            save(root / f"data_2d_raw/{DRIVE}/{camera}/data_rect/{name}.png", np.full((H, W, 3), 40 * k, np.uint8))
            truth = np.tile(np.arange(W, dtype=np.uint8) % 45, (H, 1)) + (camera == "image_01")
            save(root / f"data_2d_semantics/train/{DRIVE}/{camera}/semantic/{name}.png", truth.astype(np.uint8))
        save(root / f"data_2d_raw/{DRIVE}/labels/net/{name}.png", np.full((H, W), k, np.uint8))
        poses.append(f"{7 + k} {numbers((T @ np.linalg.inv(lidar_in_imu))[:3])}")
    save_bytes(root / f"data_3d_raw/{DRIVE}/velodyne_points/data/{10:010d}.bin", bytes(16))  # where it has no pose
    write_lines(root / f"data_poses/{DRIVE}/poses.txt", poses)
    calibration = root / "calibration"
    write_lines(calibration / "calib_cam_to_pose.txt", [f"{key}: {numbers(T[:3])}" for key, T in CAMERAS.items()])
    write_lines(calibration / "calib_cam_to_velo.txt", [numbers(np.linalg.inv(lidar_in_camera)[:3])])
    P = [FX, 0, CX, 0, 0, FX, CY, 0, 0, 0, 1, 0]
    lines = ["calib_time: 01-Jan-2013"]
    for k in (0, 1):
        lines += [f"S_rect_0{k}: {W} {H}", f"R_rect_0{k}: {numbers(RECTIFY[:3, :3])}", f"P_rect_0{k}: {numbers(P)}"]
    write_lines(calibration / "perspective.txt", lines)
    return root


def opened(root, **options):
    dataset = open_dataset("kitti360_images", {"root": root, "classes": ["building", "pole", "car"]} | options)
    assert dataset.scenes == (DRIVE,)
    return dataset.scene(DRIVE)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_pixel_with_depth_is_a_point_of_the_world(drive, camera):
    scene, (points, _) = opened(drive, camera=camera), world()
    assert scene.models == ("net",)
    imu_in_lidar = np.linalg.inv(CAMERAS["image_00"] @ np.linalg.inv(RECTIFY) @ TO_CAMERA)
    for k, T in enumerate(POSES):
        frame = scene.frame(k, "net")
        v, u = np.nonzero(frame.depth)
        assert len(v) > 300
        z = frame.depth[v, u].astype(float)
        in_camera = np.column_stack([(u - CX) / FX * z, (v - CY) / FX * z, z, np.ones(len(z))])
        far, _ = cKDTree(points).query((in_camera @ frame.T_wc.T)[:, :3])
        assert (far <= z / FX * np.sqrt(0.5) + 1e-4).all()  # a point is up to half a pixel beside its middle
        centre = T @ imu_in_lidar @ CAMERAS[camera][:, 3]
        np.testing.assert_allclose(frame.T_wc[:3, 3], centre[:3], atol=1e-9)
    assert not scene.tracked(3)


@pytest.mark.parametrize("below", ["", "data_2d_raw", f"data_2d_raw/{DRIVE}"])
def test_the_truth_of_the_camera_is_found_from_any_folder(drive, below):
    for camera in CAMERAS:
        scene = opened(drive / below, camera=camera)
        assert scene.label_space("gt").name == "kitti360"
        labels = scene.frame(0, "gt").labels[0]
        first = 4 if camera == "image_00" else 3
        assert (labels[:first] == 255).all()
        assert labels[first] == 4


def test_predictions_may_lie_elsewhere(drive, tmp_path):
    save(tmp_path / f"p/{DRIVE}/other/{7:010d}.png", np.full((H, W), 2, np.uint8))
    assert opened(drive, labels_root=tmp_path / "p").frame(0, "other").labels[0, 0] == 2


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (
            lambda f: (f / "calibration/perspective.txt").unlink(),
            r"perspective\.txt: cannot be read \(No such file",
        ),
        (
            lambda f: rewrite(f / "calibration/perspective.txt", "R_rect_00", "R_rect_09"),
            r"perspective\.txt: needs lines P_rect_00 and R_rect_00, of 12 and 9 numbers",
        ),
        (
            lambda f: rewrite(
                f / "calibration/perspective.txt", f"R_rect_00: {numbers(RECTIFY[0, :1])}", "R_rect_00: 3"
            ),
            r"perspective\.txt: the rotation is not orthonormal",
        ),
        (
            lambda f: rewrite(f / "calibration/calib_cam_to_pose.txt", "image_00", "x"),
            r"pose\.txt: has no line image_00",
        ),
        (
            lambda f: (f / f"data_2d_raw/{DRIVE}/image_00/data_rect/0000000007.png").unlink(),
            r"7\.png: is missing; scan",
        ),
        (
            lambda f: save_bytes(f / f"data_3d_raw/{DRIVE}/velodyne_points/data/x.bin", bytes(16)),
            r"x\.bin: the name is no number of a frame",
        ),
        (
            lambda f: (f / f"data_3d_raw/{DRIVE}").rename(f / "gone"),
            r"velodyne_points/data: is missing; get the raw velodyne scans of the drive, or set surface",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_line(drive, damage, said):
    damage(drive)
    fails(DataError, said, lambda: opened(drive).frame(0, "net"))


def test_a_folder_without_a_drive_says_what_one_holds(tmp_path):
    fails(
        DataError, "image_00/data_rect/ below data_2d_raw/DRIVE/", open_dataset, "kitti360_images", {"root": tmp_path}
    )
