"""SemanticKITTI seen by a camera: KITTI's images, with depth and the class of the LiDAR points that fall on them.

Source: as `semantickitti`; of the cameras Geiger et al., KITTI, and the odometry devkit's readme: x = P2 X in camera 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.types import Float32, Float64
from semstab.data.frames import Intrinsics
from semstab.data.labels import IGNORE_16BIT, LabelSpace
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, Folders, FrameSource, TruthSource
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.files.scans import floats_of, ids_of, rigid_inverse
from semstab.datasets.formats.disk import pinhole, read_matrices
from semstab.datasets.formats.images import COLOR_SUFFIXES, Read, color_size
from semstab.datasets.geometry.cameras import Camera
from semstab.datasets.geometry.lenses import Labels
from semstab.datasets.geometry.projection import SeenPoints, seen_points
from semstab.datasets.semantickitti import MOVING, benchmark_ids, lidar_to_camera, scans_of
from semstab.errors import DataError


class SemanticKittiImagesOptions(FileOptions):
    """Options with the defaults of the format."""

    up_axis: opt.UpAxis = "z"
    ground_truth: opt.GroundTruth = "labels/{name}.label"
    camera: Literal["image_2", "image_3"] = Field("image_2", description="the left or the right colour camera")
    moving: Literal["mask", "keep"] = Field(
        "mask", description="pixels whose true class moves (ids 252 to 259): masked, or kept as their class"
    )


class SemanticKittiImages(FileDataset[SemanticKittiImagesOptions]):
    """{name} is the frame's number: 000012. A pixel has depth and a true class where a LiDAR point is seen."""

    Options: type[BaseModel] = SemanticKittiImagesOptions
    depth_is_sparse: ClassVar[bool] = True
    contents = "image_2/, velodyne/, poses.txt and calib.txt"

    def is_scene(self, folder: Path) -> bool:
        """Return whether the camera's images are there, scans, and their poses."""
        return all((folder / name).exists() for name in (self.options.camera, "velodyne", "poses.txt"))

    def settled(self, folder: Path) -> SemanticKittiImagesOptions:
        """Return the options for the poses of the camera, which are camera to world whatever those of the file are."""
        return self.options.model_copy(update={"pose_convention": "camera_to_world"})

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each scan.

        Raises:
            DataError: If there are fewer poses, or the calibration is missing or damaged.
        """
        K, T_cl = _camera(folder, self.options.camera)
        T_lc, images = rigid_inverse(T_cl, str(folder / "calib.txt")), Folders()
        for scan in scans_of(folder, "poses.txt", self.options.pose_convention or "camera_to_world", "camera"):
            path = folder / self.options.camera / scan.name
            color = images.one_of(path, COLOR_SUFFIXES) or path.with_name(f"{scan.name}.png")
            yield FrameSource(
                name=scan.name,
                depth=scan.points,
                pose_file=scan.pose_file,
                camera=Camera(K),
                pose=scan.pose @ T_lc,
                color=color,
                depth_reader=partial(lidar_depth, color=color, K=K, T_cl=T_cl),
                timestamp=scan.timestamp,
            )

    def truth(self, folder: Path) -> TruthSource:
        """Return how the classes of points become those of pixels; raises DataError for a damaged calibration."""
        K, T_cl = _camera(folder, self.options.camera)
        moving = MOVING if self.options.moving == "mask" else ()
        read = partial(_classes, K=K, T_cl=T_cl)
        return TruthSource(read, benchmark_ids(), LabelSpace.load("semantickitti"), moving)


def _camera(folder: Path, name: str) -> tuple[Intrinsics, Float64]:
    """Return intrinsics and the pose (4, 4) of the LiDAR in a camera, whose P = K [I | t] has t from camera 0 to it."""
    path, key = folder / "calib.txt", f"P{name[-1]}"
    Tr = lidar_to_camera(path)
    if (P := read_matrices(path).get(key)) is None:
        raise DataError(f"{path}: has no line {key} of 12 numbers, of the camera of {name}/; get calib.txt again")
    K = pinhole(path, P[:3, :3])
    T = np.eye(4)
    T[:3, 3] = np.linalg.solve(K.matrix, P[:3, 3])
    return K, T @ Tr


def _seen(path: Path, color: Path, read: Read, K: Intrinsics, T_cl: Float64) -> SeenPoints:
    if not color.is_file():
        raise DataError(f"{color}: is missing; scan {path.name} is projected onto this image")
    W, H = color_size(color)
    return seen_points(floats_of(path, read(path), 4)[:, :3], T_cl, K, (H, W))


def lidar_depth(path: Path, scale: float | None, read: Read, *, color: Path, K: Intrinsics, T_cl: Float64) -> Float32:
    """Return depth (H, W), metres, of a scan (float32 x y z and another) in an image; T_cl (4, 4) is LiDAR to camera.

    Raises:
        DataError: For a damaged scan, or an image that is missing.
    """
    return _seen(path, color, read, K, T_cl).depth_image() / np.float32(scale or 1)


def _classes(frame: FrameSource, path: Path, read: Read, *, K: Intrinsics, T_cl: Float64) -> Labels:
    """Return the stored ids (H, W) of the points that are seen, IGNORE_16BIT elsewhere."""
    assert frame.color is not None
    data = frame.depth.read_bytes()
    stored, count = ids_of(path, read(path)), len(floats_of(frame.depth, data, 4))
    if len(stored) != count:
        raise DataError(f"{path}: has {len(stored)} labels, but {frame.depth.name} has {count} points; get both again")
    visible = _seen(frame.depth, frame.color, lambda _: data, K, T_cl)
    ids = np.full(visible.shape, IGNORE_16BIT, np.uint16)
    ids[visible.v, visible.u] = stored[visible.points]
    return ids
