"""Posed images in plain folders: depth/, pose/, labels/MODEL/, scores/MODEL/, intrinsics.txt, scene.yaml."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel

from semstab.config import read_yaml, validated
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, FrameSource
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import files_by_stem, natural, read_intrinsics
from semstab.datasets.formats.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from semstab.datasets.geometry.cameras import Camera
from semstab.errors import DataError

SETTINGS_FILE = "scene.yaml"
MASKS = "mask/{name}"


class PosedOptions(FileOptions):
    """Options that replace scene.yaml; the rest has the defaults of `FileSettings`, and masks are in mask/."""

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
        return (folder / ("depth" if self.options.surface is None else "pose")).is_dir()

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each name of a depth image or a pose.

        Raises:
            DataError: For two files of one frame, or without intrinsics.txt.
        """
        depth = files_by_stem(folder / "depth", DEPTH_SUFFIXES)
        poses = files_by_stem(folder / "pose", (".txt",))
        colors = files_by_stem(folder / "color", COLOR_SUFFIXES)
        matrix = folder / "intrinsics.txt"
        if not matrix.exists():
            raise DataError(f"{matrix}: is missing; write the camera matrix there, fx 0 cx 0 fy cy 0 0 1")
        camera = Camera(read_intrinsics(matrix))
        suffix = next((os.path.splitext(file)[1] for file in depth.values()), DEPTH_SUFFIXES[0])  # noqa: PTH122
        for name in sorted({*depth, *poses}, key=natural):
            yield FrameSource(
                name=name, depth=folder / "depth" / depth.get(name, name + suffix),
                pose_file=folder / "pose" / poses.get(name, f"{name}.txt"), camera=camera,
                color=folder / "color" / colors.get(name, name + COLOR_SUFFIXES[0]),
            )  # fmt: skip

    def settled(self, folder: Path) -> FileOptions:
        """Return scene.yaml, where there is one, with the options on top.

        Raises:
            ConfigError: If that fails, with the file and the setting.
        """
        settings = _scene_settings(folder / SETTINGS_FILE)
        options = {key: getattr(self.options, key) for key in opt.FileSettings.model_fields}
        given = {key: value for key, value in options.items() if value not in (None, (), {})}
        if "taxonomy" in given or "classes" in given:  # one of the two is enough to replace either
            given = {"taxonomy": None, "classes": None} | given
        return self.options.model_copy(update=dict(settings) | given)


def _scene_settings(path: Path) -> opt.FileSettings:
    """Return the settings of scene.yaml; taxonomy files in it are relative to its folder."""
    content = read_yaml(path) if path.is_file() else {}
    settings = validated(opt.FileSettings, {"masks": MASKS} | content, f"{path}: ")
    taxonomies = {key: _resolved(path, value) for key, value in settings.taxonomies.items()}
    taxonomy = settings.taxonomy and _resolved(path, settings.taxonomy)
    return settings.model_copy(update={"taxonomy": taxonomy, "taxonomies": taxonomies})


def _resolved(path: Path, taxonomy: str) -> str:
    return str(path.parent / taxonomy) if Path(taxonomy).suffix in (".yaml", ".yml") else taxonomy
