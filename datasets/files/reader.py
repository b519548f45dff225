"""The scenes below a folder, and the dataset of files that opens them."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import numpy as np
from pydantic import BaseModel

from semstab.config import nearest
from semstab.core.files import cache_folder
from semstab.data.georeference import Georeference
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.options import NO_TRUTH, FileOptions, Folders, FrameSource, TruthSource, inside
from semstab.datasets.files.scene import FileScene
from semstab.datasets.files.surfaces import SEEN_FROM_ABOVE, Surface
from semstab.datasets.formats.disk import files_named, natural, subfolders
from semstab.datasets.formats.images import COLOR_SUFFIXES
from semstab.datasets.geometry.cameras import Camera, Poses
from semstab.datasets.scene import Dataset
from semstab.errors import ConfigError, DataError

DEEPEST = 3
"""Levels of folders below root that are searched for scenes."""

OwnOptions = TypeVar("OwnOptions", bound=FileOptions)


class WithRoot(Protocol):
    """Options that name a root."""

    @property
    def root(self) -> Path:
        """Return a scene, or what holds scenes."""


AnyOptions = TypeVar("AnyOptions", bound=WithRoot)


class ScenesBelow(Dataset, Generic[AnyOptions]):
    """Scenes below a root, each in a folder that a reader recognises.

    Attributes:
        contents: The files of a scene's folder, for error messages.

    Raises:
        DataError: If there is no scene.
    """

    contents: str

    def __init__(self, options: AnyOptions) -> None:
        self.options = options
        self._entries = {entry.name: entry for entry in self.find_scenes(options.root)}

    @property
    def scenes(self) -> tuple[str, ...]:
        """Return the names of the scenes, in natural order: their paths below root, with - between folders."""
        return tuple(self._entries)

    @property
    def folders(self) -> list[Path]:
        """The folders of its scenes."""
        return [entry.folder for entry in self._entries.values()]

    def entry(self, name: str) -> SceneEntry:
        """Return the scene of that name; raises ConfigError if it is not there."""
        if name not in self._entries:
            raise ConfigError(f"{self.options.root}: scene '{name}' is not there; {nearest(name, self.scenes)}")
        return self._entries[name]

    def find_scenes(self, root: Path) -> Iterable[SceneEntry]:
        """Return the scenes below the root, in natural order; raises what `find_scenes` raises."""
        return find_scenes(root, self.is_scene, self.contents)

    @abstractmethod
    def is_scene(self, folder: Path) -> bool:
        """Return whether a folder is a scene of this format."""


class FileDataset(ScenesBelow[OwnOptions]):
    """Scenes of files below a root. A reader recognises a scene's folder, and lists its frames.

    Attributes:
        labels_like_depth: Whether label maps that are made for it have the depth's pixels, not those of the images.
        settings_file: Name of a file in a scene's folder with further settings, which `settled` reads.

    Raises:
        DataError: If there is no scene.
    """

    Options: type[BaseModel] = FileOptions
    contents = "depth, poses and a camera"
    labels_like_depth = False
    settings_file: str | None = None

    def scene(self, name: str) -> FileScene:
        """Open one.

        Raises:
            ConfigError: For a name that is not there, and what `FileScene` raises.
        """
        entry = self.entry(name)
        options = self.settled(entry.folder)
        frames = with_poses_of(tuple(self.frames_of_scene(entry)), options.pose_shift or 0)
        for frame in frames:
            inside(entry.folder, entry.folder, frame.name, str(frame.pose_file))  # files of predictions have its name
        if not frames:
            raise DataError(f"{entry.folder}: holds no frame; expected {self.contents}")
        georeference = self.georeference(entry.folder, options)
        surface = None
        if options.surface is not None:
            if options.surface.suffix.lower() in SEEN_FROM_ABOVE and options.up_axis not in (None, "z"):
                raise ConfigError(
                    f"{options.surface}: holds heights over x and y, but up_axis is {options.up_axis}; turn it, or take"
                    " a mesh"
                )
            casts = None if options.casts is False else options.casts or cache_folder() / "casts"
            origin = self.mesh_origin(entry.folder, options.surface)
            surface = Surface(options.surface, options.surface_cell, georeference, casts, origin)
        scene = self.opened(entry, frames, options, surface)
        scene.georeference = georeference
        scene.labels_like_depth = self.labels_like_depth
        scene.settings_file = None if self.settings_file is None else entry.folder / self.settings_file
        return scene

    def opened(
        self, entry: SceneEntry, frames: Sequence[FrameSource], options: FileOptions, surface: Surface | None
    ) -> FileScene:
        """Return the scene of these frames."""
        return FileScene(entry, frames, options, self.truth(entry.folder), surface)

    def settled(self, folder: Path) -> FileOptions:
        """Return the options with which a scene's folder is read."""
        return self.options

    def georeference(self, folder: Path, options: FileOptions) -> Georeference | None:
        """Return the georeference that the options give, else None; it raises what `Georeference.from_crs` raises."""
        if options.crs is None:
            return None
        return Georeference.from_crs(options.crs, options.offset or (0.0, 0.0, 0.0), f"{folder}: crs", options.linear)

    def mesh_origin(self, folder: Path, surface: Path) -> tuple[float, float, float] | None:
        """Return the origin of a mesh's coordinates in the projection, or None if they are the scene's coordinates."""
        return None

    def depth_files(self, folder: Path, before: str, after: str, *, instead: Iterable[str]) -> dict[str, Path]:
        """Return the depth images of a folder by name, as `files_named` finds them.

        Args:
            folder: The folder of the depth images.
            before: Part of the file's name before the name of the frame.
            after: Part of the file's name after the name of the frame.
            instead: Names of frames with a pose or an image, which get depth from a surface without a depth image.
        """
        files = files_named(folder, before, after)
        if self.options.surface is None:
            return files
        return {name: folder / f"{before}{name}{after}" for name in sorted({*files, *instead}, key=natural)}

    def has_depth(self, folder: Path) -> bool:
        """Return whether a folder of depth images is there, or is not needed, as a surface gives the depth."""
        return self.options.surface is not None or folder.is_dir()

    def truth(self, folder: Path) -> TruthSource:
        """Return what the format says of the ground truth of a scene's folder; raises DataError with the file."""
        return NO_TRUTH

    def frames_of_scene(self, entry: SceneEntry) -> Iterable[FrameSource]:
        """Return the frames of a scene, by default all of its folder. Raises what `frames` raises."""
        return self.frames(entry.folder)

    @abstractmethod
    def frames(self, folder: Path) -> Iterable[FrameSource]:
        """Return the frames of a scene's folder, in order, of different names.

        Raises:
            DataError: If that fails, with the file.
        """


def with_poses_of(frames: tuple[FrameSource, ...], shift: int) -> tuple[FrameSource, ...]:
    """Return the frames, each with the pose of the frame `shift` further on, or NaN without such a frame."""
    if shift == 0:
        return frames
    lost = np.full((4, 4), np.nan)
    shifted = []
    for k, frame in enumerate(frames):
        exists = 0 <= k + shift < len(frames)
        other = frames[k + shift] if exists else frame
        shifted.append(replace(frame, pose=other.pose if exists else lost, pose_file=other.pose_file))
    return tuple(shifted)


def find_scenes(root: Path, is_scene: Callable[[Path], bool], contents: str) -> list[SceneEntry]:
    """Return the root if it is a scene itself, else the scenes below it in natural order; no scene holds another.

    Raises:
        DataError: If there is none, or two would have one name.
    """
    if not os.path.isdir(root):  # noqa: PTH112  Path.is_dir raises where the name is too long
        raise DataError(f"{root}: there is no such folder; set root to a scene or to the folder above scenes")
    if is_scene(root):
        name = root.resolve().name or "scene"
        return [SceneEntry(name, root, name)]

    def below(folder: Path, levels: int) -> Iterator[Path]:
        for name in subfolders(folder) if levels else ():
            inner = folder / name
            yield from [inner] if is_scene(inner) else below(inner, levels - 1)

    relative = [path.relative_to(root).parts for path in below(root, DEEPEST)]
    if not relative:
        raise DataError(f"{root}: no scene here, nor {DEEPEST} folders deep; one holds {contents}")
    entries = [SceneEntry("-".join(parts), root.joinpath(*parts), "/".join(parts)) for parts in relative]
    names = [entry.name for entry in entries]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise DataError(f"{root}: two scenes would be called '{repeated[0]}'; rename one, or set root deeper")
    return entries


def images_named(folder: Path, before: str = "", after: str = "") -> list[str]:
    """Return the names of a folder's colour images 'BEFORE name AFTER.png', or of another kind."""
    return [name for suffix in COLOR_SUFFIXES for name in files_named(folder, before, f"{after}{suffix}")]


def frames_of(
    folder: Path,
    depth: Mapping[str, Path],
    camera: Camera,
    *,
    pose: str,
    color: str,
    poses: Poses | None = None,
    label_camera: Camera | None = None,
    depth_scale: float | None = None,
    what: str = "depth images",
) -> Iterator[FrameSource]:
    """Yield a frame for each depth image, with its colour if any; `pose` and `color` are templates with {name}.

    Args:
        folder: The folder of the scene.
        depth: Depth images by the names of their frames.
        camera: Intrinsics of the depth images.
        pose: File of a pose, a template with {name}, or of all poses.
        color: File of a colour image, a template with {name}.
        poses: (n, 4, 4) in the same order, where `pose` is the file of them all.
        label_camera: Intrinsics of the label maps, where they are others.
        depth_scale: Stored units in a metre, where the files say it.
        what: Name of the depth images in messages.

    Raises:
        DataError: If that file has another number of poses than there are depth images, or of files that go with each.
    """
    if poses is not None and len(poses) != len(depth):
        raise DataError(
            f"{folder / pose}: has {len(poses)} poses, but there are {len(depth)} {what}; they must be as many"
        )
    folders = Folders()
    return (
        FrameSource(
            name=name,
            depth=path,
            pose_file=folder / pose.replace("{name}", name),
            camera=camera,
            pose=None if poses is None else poses[k],
            label_camera=label_camera,
            color=folders.one_of(folder / color.replace("{name}", name), COLOR_SUFFIXES),
            depth_scale=depth_scale,
        )
        for k, (name, path) in enumerate(depth.items())
    )
