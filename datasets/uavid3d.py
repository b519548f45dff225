"""UAVid-3D-Scenes, whose layout is not published: every path and format is an option, with a guess as default.

Source: Florea and Nedevschi, TanDepth, J-STARS 2025 (github.com/hrflr/uavid-3d-scenes): undistorted frames of UAVid
by scene, with metric depth maps from scaled COLMAP reconstructions.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field

from semstab.data.frames import Intrinsics
from semstab.datasets.colmap import has_model, read_model
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, Folders, FrameSource, Template, inside
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import files_named, read_intrinsics
from semstab.datasets.formats.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from semstab.datasets.geometry.cameras import Camera, Poses
from semstab.datasets.transforms_json import read_transforms
from semstab.errors import ConfigError

TAXONOMY = "uavid8"
"""Taxonomy of the label maps, unless the options say otherwise: the colours of UAVid's ground truth."""

PoseFormat = Literal["colmap", "transforms", "matrix"]

FORMATS: Mapping[PoseFormat, dict[str, Any]] = {
    "colmap": {"pose_convention": "world_to_camera", "camera_axes": "opencv", "pixel_centre": 0.5},
    "transforms": {"pose_convention": "camera_to_world", "camera_axes": "opengl", "pixel_centre": 0.5},
    "matrix": {"pose_convention": "camera_to_world", "camera_axes": "opencv", "pixel_centre": 0.0},
}
"""Conventions of each format of poses, unless the options say otherwise."""


class Uavid3dOptions(FileOptions):
    """Paths are templates relative to the scene's folder; {name} is the frame's name.

    pose_convention, camera_axes and pixel_centre are those of the pose format unless they are given; the taxonomy is
    uavid8.
    """

    images: str = Field("images/{name}", description="template of the colour images")
    depth: str = Field("depth/{name}", description="template of the depth maps")
    pose_format: PoseFormat = Field("colmap", description="COLMAP model, transforms.json, or 4x4 matrices as text")
    model: str = Field("sparse", description="folder of the COLMAP model, text or binary")
    transforms: str = Field("transforms.json", description="file of the cameras")
    pose: str = Field("pose/{name}.txt", description="template of the matrices")
    intrinsics: opt.FourIntrinsics = None
    intrinsics_file: str = Field("intrinsics.txt", description="3x3 matrix, where poses are matrices")
    ground_truth: opt.GroundTruth = "Labels/{name}.png"
    pose_convention: opt.PoseConvention = None
    camera_axes: opt.CameraAxes = None
    pixel_centre: opt.PixelCentre = None


class Uavid3d(FileDataset[Uavid3dOptions]):
    """{name} is the image's name without suffix as the COLMAP model or transforms.json has it, or the matrix file's."""

    Options: type[BaseModel] = Uavid3dOptions

    def __init__(self, options: Uavid3dOptions) -> None:
        means = {key: value for key, value in FORMATS[options.pose_format].items() if getattr(options, key) is None}
        if options.classes is None and options.taxonomy is None:
            means["taxonomy"] = TAXONOMY
        self._depth, self._images, self._pose = (
            Template(key, getattr(options, key), ("name",), ("name",)) for key in ("depth", "images", "pose")
        )
        if "{" in self._pose.text.rpartition("/")[0] or self._pose.text.count("{name}") > 1:
            raise ConfigError(f"pose: {self._pose.text!r}: {{name}} must be once, in the name of the file")
        self.contents = {
            "colmap": f"a COLMAP model in {options.model}/ (options pose_format, model)",
            "transforms": f"{options.transforms} (options pose_format, transforms)",
            "matrix": f"{options.pose} (options pose_format, pose)",
        }[options.pose_format]
        super().__init__(options.model_copy(update=means))

    def is_scene(self, folder: Path) -> bool:
        """Return whether the poses are there, in the format that the options say."""
        if self.options.pose_format == "colmap":
            return has_model(self._inside(folder, self.options.model))
        if self.options.pose_format == "transforms":
            return self._inside(folder, self.options.transforms).is_file()
        return self._inside(folder, self._pose.text).parent.is_dir()

    def frames(self, folder: Path) -> list[FrameSource]:
        """Return a frame for each pose. Raises what `read_model` or `read_transforms` raises."""
        options, folders = self.options, Folders()
        if options.pose_format == "transforms":
            path = self._inside(folder, options.transforms)
            return read_transforms(path, options.root, folder, self._depth)
        posed: list[tuple[str, Poses | None, Path, Camera]]  # name, pose, file of it, camera
        if options.pose_format == "colmap":
            path, images = read_model(self._inside(folder, options.model))
            posed = [(image.frame, image.T_cw, path, image.camera) for image in images]
        else:
            before, _, after = self._pose.text.partition("{name}")
            where, _, before = before.rpartition("/")
            file = self._inside(folder, options.intrinsics_file)
            camera = Camera(Intrinsics(*options.intrinsics) if options.intrinsics else read_intrinsics(file))
            posed = [(name, None, path, camera) for name, path in files_named(folder / where, before, after).items()]
        frames = []
        for name, pose, pose_file, camera in posed:
            depth = self._inside(folder, self._depth.filled(name=name))
            color = folders.one_of(self._inside(folder, self._images.filled(name=name)), COLOR_SUFFIXES)
            depth = folders.one_of(depth, (*DEPTH_SUFFIXES, ".bin")) or depth
            frames.append(FrameSource(name, depth, pose_file, camera, pose, color=color))
        return frames

    def _inside(self, folder: Path, relative: str) -> Path:
        return inside(self.options.root, folder, relative, "the options of uavid3d")
