"""KITTI-360 seen by its perspective cameras: rectified images, with depth of the LiDAR points that fall on them.

Source: as `kitti360`; github.com/autonomousvision/kitti360Scripts: helpers/project.py (a camera's pose, rectification)
and helpers/labels.py (ids); that data_2d_semantics/train/ has the truth is read in others' readers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.types import Float64
from semstab.data.frames import Intrinsics
from semstab.data.labels import LabelSpace
from semstab.datasets import GROUND_TRUTH
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.options import FileOptions, Folders, FrameSource, TruthSource
from semstab.datasets.files.reader import FileDataset, find_scenes, images_named
from semstab.datasets.files.scans import rigid_inverse
from semstab.datasets.formats.disk import matrix_of, pinhole, records, to_number
from semstab.datasets.formats.images import COLOR_SUFFIXES
from semstab.datasets.geometry.cameras import Camera
from semstab.datasets.kitti360 import camera_in_imu, imu_poses, lidar_in_imu
from semstab.datasets.semantickitti_images import lidar_depth
from semstab.errors import DataError

RAW = "data_2d_raw"

NO_CLASS: dict[str, tuple[int, ...]] = {GROUND_TRUTH: (0, 1, 2, 3)}
"""Unlabeled, the vehicle itself, the border of the rectified image, and what is out of the region of interest."""


class Kitti360ImagesOptions(FileOptions):
    """Options with the defaults of the format."""

    camera: Literal["image_00", "image_01"] = Field("image_00", description="the left or the right perspective camera")
    up_axis: opt.UpAxis = "z"
    void_ids: opt.VoidIds = NO_CLASS


class Kitti360Images(FileDataset[Kitti360ImagesOptions]):
    """{name} is the frame's number: 0000000250. A drive is a scene; of its frames those with a scan and a pose count.

    A scene's folder is that above data_2d_raw/, so that truth and predictions are inside.
    """

    Options: type[BaseModel] = Kitti360ImagesOptions
    depth_is_sparse: ClassVar[bool] = True
    contents = f"image_00/data_rect/ below {RAW}/DRIVE/, and data_poses/, calibration/ and data_3d_raw/ beside {RAW}/"

    def is_scene(self, folder: Path) -> bool:
        """Return whether a drive's folder has rectified images of the camera."""
        return folder.absolute().parent.name == RAW and (folder / self.options.camera / "data_rect").is_dir()

    def find_scenes(self, root: Path) -> Iterable[SceneEntry]:
        """Return the drives at or below the root, each in the folder of the dataset; raises what `find_scenes` does."""
        entries = find_scenes(root, self.is_scene, self.contents)
        drives = [entry.folder.absolute() for entry in entries]
        return [SceneEntry(drive.name, drive.parents[1], drive.name) for drive in drives]

    def settled(self, folder: Path) -> Kitti360ImagesOptions:
        """Return the options with the ground truth and label maps of the drive, and poses that are camera to world."""
        truth = f"data_2d_semantics/train/{{scene}}/{self.options.camera}/semantic/{{name}}.png"
        changes = {"ground_truth": self.options.ground_truth or truth, "pose_convention": "camera_to_world"}
        if self.options.labels is None and self.options.labels_root is None:
            changes["labels"] = f"{RAW}/{{scene}}/labels/{{model}}/{{name}}"
        return self.options.model_copy(update=changes)

    def truth(self, folder: Path) -> TruthSource:
        """Return the classes of the ground truth."""
        return TruthSource(space=LabelSpace.load("kitti360"))

    def frames_of_scene(self, entry: SceneEntry) -> Iterable[FrameSource]:
        """Return the frames of the drive that the scene is called after. Raises what `frames` raises."""
        return self._frames(entry.folder, entry.name)

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield the frames of all drives of a dataset's folder.

        Raises:
            DataError: If poses or calibration are missing or damaged.
        """
        for entry in self.find_scenes(folder):
            yield from self._frames(folder, entry.name)

    def _frames(self, folder: Path, drive: str) -> Iterator[FrameSource]:
        images, scans = folder / RAW / drive / self.options.camera / "data_rect", folder / "data_3d_raw" / drive
        path, calibration = folder / "data_poses" / drive / "poses.txt", folder / "calibration"
        if not self.has_depth(scans / "velodyne_points/data"):
            raise DataError(
                f"{scans / 'velodyne_points/data'}: is missing; get the raw velodyne scans of the drive, or set surface"
            )
        poses = imu_poses(path)
        K, R = _rectified(calibration / "perspective.txt", self.options.camera)
        T_ic = camera_in_imu(calibration, self.options.camera) @ rigid_inverse(R, str(calibration / "perspective.txt"))
        T_cl = rigid_inverse(T_ic, str(calibration)) @ lidar_in_imu(calibration)
        lost, colors = np.full((4, 4), np.nan), Folders()
        point_files = self.depth_files(scans / "velodyne_points/data", "", ".bin", instead=images_named(images))
        for name, points in point_files.items():
            if not name.isdecimal():
                raise DataError(f"{points}: the name is no number of a frame; rename or remove the file")
            color = colors.one_of(images / name, COLOR_SUFFIXES) or images / f"{name}.png"
            yield FrameSource(
                name=name,
                depth=points,
                pose_file=path,
                camera=Camera(K),
                pose=poses.get(int(name), lost) @ T_ic,
                color=color,
                depth_reader=partial(lidar_depth, color=color, K=K, T_cl=T_cl),
            )


def _rectified(path: Path, camera: str) -> tuple[Intrinsics, Float64]:
    """Return intrinsics of a camera's rectified images, and the rotation (4, 4) from the camera to their axes."""
    number, numbers = camera[-2:], dict[str, list[float]]()
    for line, text in records(path):
        key, _, values = text.partition(":")
        if key in (f"P_rect_{number}", f"R_rect_{number}"):
            numbers[key] = [to_number(word, path, line) for word in values.split()]
    P, R = numbers.get(f"P_rect_{number}", []), numbers.get(f"R_rect_{number}", [])
    if len(P) != 12 or len(R) != 9:
        raise DataError(
            f"{path}: needs lines P_rect_{number} and R_rect_{number}, of 12 and 9 numbers; get the calibration again"
        )
    T = matrix_of(np.hstack([np.reshape(R, (3, 3)), np.zeros((3, 1))]))
    return pinhole(path, np.reshape(P, (3, 4))[:, :3]), T
