"""KITTI-360: velodyne scans of its raw data, with the poses of its IMU and calibration.

Source: Liao et al., KITTI-360, PAMI 2022; github.com/autonomousvision/kitti360Scripts: devkits/accumuLaser (poses and
calibration), devkits/convertOxtsPose (axes), devkits/commons/loadCalibration.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from semstab.core.types import Float32, Float64
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.scans import ScanDataset, ScanOptions, ScanSource, as_poses, floats_of, rigid_inverse
from semstab.datasets.formats.disk import files_named, matrix_of, read_matrices, read_table
from semstab.datasets.formats.images import Read
from semstab.errors import DataError

CAMERA = "image_00"
"""The camera that the LiDAR is calibrated with."""


class Kitti360Options(ScanOptions):
    """Options with the defaults of the format."""

    up_axis: opt.UpAxis = "z"


class Kitti360(ScanDataset[Kitti360Options]):
    """{name} is the scan's number: 0000000250. Scans without a pose, as where the vehicle stands, are left out.

    The classes of predictions are not known by the format, whose ground truth is of fused clouds.
    """

    Options: type[BaseModel] = Kitti360Options
    contents = "velodyne_points/data/ below data_3d_raw/, and data_poses/ and calibration/ beside that"

    def is_scene(self, folder: Path) -> bool:
        """Return whether scans are there."""
        return (folder / "velodyne_points/data").is_dir()

    def scans(self, entry: SceneEntry) -> Iterator[ScanSource]:
        """Yield a scan for each file of points; the pose of a scan without a pose is NaN.

        Raises:
            DataError: If poses or calibration are missing or damaged.
        """
        folder = entry.folder.absolute()
        root, path = folder.parents[1], folder.parents[1] / "data_poses" / folder.name / "poses.txt"
        by_frame, T = imu_poses(path), lidar_in_imu(root / "calibration")
        lost = np.full((4, 4), np.nan)
        for name, points in files_named(folder / "velodyne_points/data", "", ".bin").items():
            if not name.isdecimal():
                raise DataError(f"{points}: the name is no number of a frame; rename or remove the file")
            yield ScanSource(name, points, by_frame.get(int(name), lost) @ T, path)

    def points(self, path: Path, read: Read) -> Float32:
        """Return the points of x, y, z and reflectance."""
        return floats_of(path, read(path), 4)[:, :3]


def imu_poses(path: Path) -> dict[float, Float64]:
    """Return the poses (4, 4) of the IMU in the world, z up, by the frame's number; raises DataError if damaged."""
    rows = read_table(path, 13, "frame r11 r12 r13 t1 ...")
    poses = as_poses(rows[:, 1:].reshape(-1, 3, 4), "camera_to_world", path)
    return dict(zip(rows[:, 0].tolist(), poses, strict=True))


def camera_in_imu(folder: Path, camera: str) -> Float64:
    """Return the pose (4, 4) of a camera, as image_00, in the IMU, by the folder of calibrations; raises DataError."""
    path = folder / "calib_cam_to_pose.txt"
    cameras = read_matrices(path)
    if camera not in cameras:
        raise DataError(f"{path}: has no line {camera}; get KITTI-360's calibration again")
    rigid_inverse(cameras[camera], str(path))
    return cameras[camera]


def lidar_in_imu(folder: Path) -> Float64:
    """Return the pose (4, 4) of the LiDAR in the IMU: of camera 0 in the IMU, after that of the LiDAR in camera 0."""
    T_ic, path = camera_in_imu(folder, CAMERA), folder / "calib_cam_to_velo.txt"
    T_lc = matrix_of(read_table(path, 12, "r11 r12 r13 t1 ...")[0])
    return T_ic @ rigid_inverse(T_lc, str(path))
