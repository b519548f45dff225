"""Any dataset as posed folders: plain files of depth, poses and labels, from which the same voxels come."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.check.views import evenly, reader
from semstab.config import Config
from semstab.convert.folder import (
    SCORES_SUFFIX,
    DepthFormat,
    DepthFormatError,
    SceneFolder,
    depth_format,
    folder_name,
)
from semstab.datasets import GROUND_TRUTH, Scene, open_dataset
from semstab.datasets.files.label_source import LABEL_SPACE_FILE
from semstab.datasets.views.poses import UP_AXES
from semstab.errors import ConfigError, DataError
from semstab.model.frames import Frame
from semstab.runtime.prefetch import prefetch
from semstab.task import frame_indices, selected

__all__ = ["Converted", "convert", "convert_scene"]

PROBED_FRAMES = 3
"""Frames that are looked at to see whether depth fits into 16 bits; where a later one does not, all are floats."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Converted:
    """What came of a scene.

    folder   where it is
    frames   how many were selected, of which `written` were not there before
    depth    how its depth is stored, in words
    renamed  label sources that have another name in the folder
    lost     what a posed folder does not hold
    """

    scene: str
    folder: Path
    frames: int
    written: int
    depth: str
    renamed: dict[str, str]
    lost: tuple[str, ...]


def convert(
    config: Config, out: str | Path, *, depth_error: float = 0.0, progress: Progress = lambda what, done, total: None
) -> Iterator[Converted]:
    """Write the scenes, frames and label sources that a resolved configuration selects to OUT/SCENE, one by one.

    Where no label source is named, all are written, the ground truth too. Files that an earlier start finished are
    kept. Depth becomes 16-bit PNG where no pixel is off by more than `depth_error` metres, else float32 .npy; with 0
    the folder gives the voxels of the source. `progress` is told of each frame: what, how many are done, of how many.

    Raises ConfigError for a folder that holds something else, DataError for frames that a posed folder cannot hold.
    """
    dataset = open_dataset(config.dataset.name, config.dataset.options)
    for name in selected(config.scenes, dataset.scenes, (), "scene", config.dataset.name):
        yield convert_scene(dataset.scene(name), config, Path(out) / folder_name(name), depth_error, progress)


def convert_scene(scene: Scene, config: Config, path: Path, depth_error: float, progress: Progress) -> Converted:
    """Write one scene; see `convert`."""
    known = (*scene.backbones, *((GROUND_TRUTH,) if scene.ground_truth else ()))
    backbones = selected(config.backbones, known, (), "backbone", scene.name)
    indices = frame_indices(scene, config, backbones)
    settings = {
        "dataset": config.dataset.model_dump(mode="json"),
        "scene": scene.name,
        "depth_error": depth_error,
    }
    folder = SceneFolder(path, settings, depth_error)
    if others := folder.frames - set(map(_name, indices)):
        raise ConfigError(f"{path}: holds frame {min(others)}, which is not selected now; choose another --out")
    _require_places(scene, backbones)
    work = _Work(scene, indices, backbones, folder, progress)
    up = _up_axis(scene)
    said: dict[str, Any] = {"pose_convention": "camera_to_world", "camera_axes": "opencv"}
    said |= ({"up_axis": up} if up else {}) | _georeference(scene)
    with contextlib.closing(folder):
        folder.begin(folder.form or depth_format(work.probe(), depth_error), said)
        try:
            written = work.write()
        except DepthFormatError:
            folder.begin(DepthFormat(None), said)
            written = work.write()
    return Converted(
        scene=scene.name,
        folder=path,
        frames=len(indices),
        written=written,
        depth=str(folder.form),
        renamed={name: folder.read_as(name) for name in backbones if folder.read_as(name) != name},
        lost=tuple(work.lost()),
    )


@dataclass
class _Work:
    """The frames of a scene that go into a folder, by label source."""

    scene: Scene
    indices: Sequence[int]
    backbones: Sequence[str]
    folder: SceneFolder
    progress: Progress
    timed: bool = False
    without_classes: tuple[str, ...] = ()

    @property
    def sources(self) -> Sequence[str | None]:
        """The label sources; one, None, where there are no labels."""
        return self.backbones or (None,)

    def probe(self) -> list[npt.NDArray[np.float32]]:
        """Depth of some frames."""
        read = reader(self.scene, self.sources[0])
        return [read(self.indices[position]).depth for position in evenly(len(self.indices), PROBED_FRAMES)]

    def write(self) -> int:
        """Write what is not there, and say how many frames were not complete."""
        written = set()
        for source in self.sources:
            missing = [index for index in self.indices if not self._has(index, source)]
            written.update(missing)
            for done, fetched in enumerate(prefetch(self._reading(source), missing), start=1):
                self._write_frame(fetched.item, source)
                self.progress(f"{self.scene.name} · {source or 'geometry'}", done, len(missing))
            if source is not None:
                self._write_classes(source)
        return len(written)

    def lost(self) -> Iterator[str]:
        """What a posed folder does not hold."""
        if self.timed:
            yield "time stamps"
        if self.scene.up is not None and _up_axis(self.scene) is None:
            yield "the up direction, which is no axis"
        for name in self.without_classes:
            yield f"the classes of {name}, which are not known; write a {LABEL_SPACE_FILE} for them"

    def _has(self, index: int, source: str | None) -> bool:
        name = _name(index)
        return self.folder.has_geometry(name) and (source is None or self.folder.has_labels(name, source))

    def _reading(self, source: str | None) -> Callable[[int], Frame]:
        if source is None:
            return reader(self.scene, None, color=True)
        return lambda index: self.scene.frame(index, source, color=not self.folder.has_geometry(_name(index)))

    def _write_frame(self, frame: Frame, source: str | None) -> None:
        name = _name(frame.index)
        self.timed = self.timed or frame.timestamp is not None
        if not self.folder.has_geometry(name):
            self.folder.write_geometry(name, frame)
        if source is not None and not self.folder.has_labels(name, source):
            if frame.scores is not None and f"{source}{SCORES_SUFFIX}" in self.backbones:
                raise ConfigError(f"{source} and {source}{SCORES_SUFFIX} would get one folder; choose with --backbone")
            self.folder.write_labels(name, frame, source)

    def _write_classes(self, source: str) -> None:
        try:
            space = self.scene.label_space(source)
        except DataError:
            self.without_classes += (source,)
        else:
            self.folder.write_classes(source, space)


def _require_places(scene: Scene, backbones: Sequence[str]) -> None:
    """Each label source needs a folder of its own."""
    folders = [folder_name(name) for name in backbones]
    if repeated := [name for name in backbones if folders.count(folder_name(name)) > 1]:
        raise ConfigError(f"{scene.name}: {' and '.join(repeated)} would get one folder; choose with --backbone")


def _name(index: int) -> str:
    """The name of a frame's files: frames keep their order, and their number where all are converted."""
    return f"{index:06d}"


def _georeference(scene: Scene) -> dict[str, Any]:
    """The settings that say where the scene lies on Earth, where that is known."""
    known = scene.georeference
    return {} if known is None else {"crs": known.crs, "offset": list(known.offset)}


def _up_axis(scene: Scene) -> str | None:
    """The name of the world's up axis, where it is one."""
    return next((name for name, axis in UP_AXES.items() if scene.up is not None and (scene.up == axis).all()), None)
