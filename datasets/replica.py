"""Replica in its two exports: by NICE-SLAM (results/, traj.txt) and by Semantic-NeRF (rgb/, depth/, ...).

Sources: Zhu et al., NICE-SLAM, CVPR 2022; Zhi et al., Semantic-NeRF, ICCV 2021; Straub et al., Replica, 2019.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, FrameSource
from semstab.datasets.files.reader import FileDataset, frames_of, images_named
from semstab.datasets.formats.disk import number, read_object, read_table
from semstab.datasets.geometry.cameras import Camera, camera_of
from semstab.errors import DataError


@dataclass(frozen=True)
class Export:
    """The paths of one of the two exports, and its camera if no file has it."""

    trajectory: str
    depth: str
    color: str
    depth_scale: float
    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]


NICE_SLAM = Export("traj.txt", "results/depth", "results/frame{name}", 6553.5, (600, 600, 599.5, 339.5), (1200, 680))
SEMANTIC_NERF = Export("traj_w_c.txt", "depth/depth_", "rgb/rgb_{name}", 1000, (320, 320, 319.5, 239.5), (640, 480))
EXPORTS = (NICE_SLAM, SEMANTIC_NERF)
CAMERA_FILE = "cam_params.json"


class ReplicaOptions(FileOptions):
    """Options with the defaults of the formats; the depth scale is 6553.5 or 1000, by export."""

    up_axis: opt.UpAxis = "z"
    intrinsics: opt.FourIntrinsics = None
    ground_truth: opt.GroundTruth = "semantic_class/semantic_class_{name}.png"
    void_ids: opt.VoidIds = opt.ZERO_IS_VOID


class Replica(FileDataset[ReplicaOptions]):
    """{name} is the number in the file's name: 000012 of results/frame000012.jpg, 12 of rgb/rgb_12.png."""

    Options: type[BaseModel] = ReplicaOptions
    contents = "results/ and traj.txt (NICE-SLAM's export), or depth/ and traj_w_c.txt (Semantic-NeRF's)"

    def is_scene(self, folder: Path) -> bool:
        """Return whether the trajectory of one of the exports is there."""
        return self._export(folder) is not None

    def frames(self, folder: Path) -> Iterable[FrameSource]:
        """Return a frame for each depth image.

        Raises:
            DataError: If there are not as many poses.
        """
        export = self._export(folder)
        assert export is not None
        poses = read_table(folder / export.trajectory, 16, "a flattened 4x4 matrix").reshape(-1, 4, 4)
        where, _, before = export.depth.rpartition("/")
        images, _, frame = export.color.removesuffix("{name}").rpartition("/")
        instead = images_named(folder / images, frame)
        depth = self.depth_files(folder / where, before, ".png", instead=instead)
        camera, scale = self._camera(folder, export)
        return frames_of(
            folder, depth, camera, pose=export.trajectory, color=export.color, poses=poses, depth_scale=scale
        )

    def _export(self, folder: Path) -> Export | None:
        exports = (
            e for e in EXPORTS if (folder / e.trajectory).is_file() and self.has_depth((folder / e.depth).parent)
        )
        return next(exports, None)

    def _camera(self, folder: Path, export: Export) -> tuple[Camera, float]:
        """Return the camera and the depth scale: of the options, of cam_params.json, or the export's usual ones."""
        numbers, size, scale = export.intrinsics, export.size, export.depth_scale
        path = next((p for p in (folder / CAMERA_FILE, folder.parent / CAMERA_FILE) if p.is_file()), None)
        if path is not None:
            camera: Any = read_object(path).get("camera")
            if not isinstance(camera, Mapping):
                raise DataError(f"{path}: there is no 'camera' in it; download it again, or set intrinsics")
            fx, fy, cx, cy, width, height, scale = (
                number(camera, key, str(path)) for key in ("fx", "fy", "cx", "cy", "w", "h", "scale")
            )
            if not (width >= 1 and height >= 1 and scale > 0):
                raise DataError(f"{path}: w, h and scale must be positive, got {width:g}, {height:g}, {scale:g}")
            numbers, size = (fx, fy, cx, cy), (int(width), int(height))
        return camera_of(self.options.intrinsics, numbers, size), scale
