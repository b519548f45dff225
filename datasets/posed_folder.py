"""Posed images in plain folders: depth/, pose/, labels/MODEL/, scores/MODEL/, intrinsics.txt, scene.yaml."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field

from semstab.config import read_yaml, validated
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, FrameSource, inside
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import files_by_stem, natural, read_camera, read_intrinsics
from semstab.datasets.formats.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from semstab.datasets.geometry.cameras import Camera
from semstab.datasets.trajectories import poses_by_name
from semstab.errors import DataError

SETTINGS_FILE = "scene.yaml"
MASKS = "mask/{name}"


POSE_SUFFIXES = (".txt", ".npy", ".json")
INTRINSICS = ("intrinsics.txt", "intrinsics.json", "intrinsic.json", "camera_intrinsic.json")
"""Files of the camera, the first that is there; those in JSON are as Open3D writes them."""


Trajectory = Annotated[
    str | None,
    Field(description="file of all poses instead of pose/: of TUM or EuRoC by time stamps, of KITTI in order"),
]


class PosedSettings(opt.FileSettings):
    """The settings of scene.yaml."""

    trajectory: Trajectory = None


class PosedOptions(FileOptions):
    """Options that replace scene.yaml; the rest has the defaults of `FileSettings`, and masks are in mask/."""

    trajectory: Trajectory = None
    max_difference: opt.Positive = Field(0.02, description="seconds between a frame's name and a pose of trajectory")

    scores_layout: opt.ScoresLayout = None
    depth_kind: opt.DepthKind = None
    pose_convention: opt.PoseConvention = None
    camera_axes: opt.CameraAxes = None
    metres_per_unit: opt.MetresPerUnit = None
    pixel_centre: opt.PixelCentre = None


class PosedFolder(FileDataset[PosedOptions]):
    """{name} is the name that a frame's files share: of depth/{name}.png, pose/{name}.txt, color/{name}.png, ..."""

    Options: type[BaseModel] = PosedOptions
    contents = "depth/, pose/ and intrinsics.txt"
    labels_like_depth = True
    settings_file = SETTINGS_FILE

    def is_scene(self, folder: Path) -> bool:
        """Return whether depth/ is there, or with a surface pose/."""
        posed = "pose" if self.options.trajectory is None else "color"
        return (folder / ("depth" if self.options.surface is None else posed)).is_dir()

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each name of a depth image or a pose.

        Raises:
            DataError: For two files of one frame, without intrinsics.txt, or for a trajectory that does not fit.
        """
        depth = files_by_stem(folder / "depth", DEPTH_SUFFIXES)
        colors = files_by_stem(folder / "color", COLOR_SUFFIXES)
        trajectory = self._trajectory(folder)
        poses = files_by_stem(folder / "pose", POSE_SUFFIXES) if trajectory is None else {}
        camera = _camera(folder)
        suffix = next((os.path.splitext(file)[1] for file in depth.values()), DEPTH_SUFFIXES[0])  # noqa: PTH122
        names = sorted({*depth, *poses} or {*colors}, key=natural)
        posed, times = None, None
        if trajectory is not None:
            posed, times = poses_by_name(trajectory, names, self.options.max_difference)
        for k, name in enumerate(names):
            yield FrameSource(
                name=name, depth=folder / "depth" / depth.get(name, name + suffix),
                pose=None if posed is None else posed[k],
                pose_file=trajectory or folder / "pose" / poses.get(name, f"{name}.txt"), camera=camera,
                color=folder / "color" / colors.get(name, name + COLOR_SUFFIXES[0]),
                timestamp=None if times is None else float(times[k]),
            )  # fmt: skip

    def _trajectory(self, folder: Path) -> Path | None:
        """Return the file of all poses from the options, else from scene.yaml, or None if each frame has a file."""
        stated = self.options.trajectory or _scene_settings(folder / SETTINGS_FILE).trajectory
        return None if stated is None else inside(self.options.root, folder, stated, "option trajectory")

    def settled(self, folder: Path) -> FileOptions:
        """Return the options on top of scene.yaml, if there is one.

        Raises:
            ConfigError: If that fails, with the file and the setting.
        """
        settings = _scene_settings(folder / SETTINGS_FILE)
        options = {key: getattr(self.options, key) for key in PosedSettings.model_fields}
        stated = {key: value for key, value in options.items() if value not in (None, (), {})}
        if "taxonomy" in stated or "classes" in stated:  # one of the two is enough to replace either
            stated = {"taxonomy": None, "classes": None} | stated
        return self.options.model_copy(update=dict(settings) | stated)


def _camera(folder: Path) -> Camera:
    """Return the camera of a scene.

    Raises:
        DataError: If no file says it.
    """
    file = next((path for name in INTRINSICS if (path := folder / name).exists()), None)
    if file is None:
        raise DataError(
            f"{folder / INTRINSICS[0]}: is missing; write the camera matrix there, fx 0 cx 0 fy cy 0 0 1 (or"
            f" {INTRINSICS[1]}, as Open3D writes it)"
        )
    return Camera(*read_camera(file)) if file.suffix == ".json" else Camera(read_intrinsics(file))


def _scene_settings(path: Path) -> PosedSettings:
    """Return the settings of scene.yaml; taxonomy files in it are relative to its folder."""
    content = read_yaml(path) if path.is_file() else {}
    settings = validated(PosedSettings, {"masks": MASKS} | content, f"{path}: ")
    taxonomies = {key: _resolved(path, value) for key, value in settings.taxonomies.items()}
    taxonomy = settings.taxonomy and _resolved(path, settings.taxonomy)
    return settings.model_copy(update={"taxonomy": taxonomy, "taxonomies": taxonomies})


def _resolved(path: Path, taxonomy: str) -> str:
    return str(path.parent / taxonomy) if Path(taxonomy).suffix in (".yaml", ".yml") else taxonomy
