"""Write any dataset as posed folders: plain files of depth, poses and labels that give the same voxels."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml
from rich.progress import TimeRemainingColumn

from semstab.check.conventions import KNOWN_SCALES
from semstab.check.reprojection import reader
from semstab.config import Config
from semstab.core.arrays import evenly
from semstab.core.console import Console
from semstab.core.files import (
    FolderLock,
    atomic_path,
    content_key,
    read_json,
    remove_leftovers,
    write_image,
    write_json,
    write_text,
)
from semstab.core.prefetch import prefetch
from semstab.core.progress import frame_progress
from semstab.core.types import Float32, Float64, UInt16
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import LabelSpace
from semstab.data.results import slug
from semstab.datasets import Scene, open_dataset
from semstab.datasets.files.labels import LABEL_SPACE_FILE
from semstab.datasets.formats.disk import read_intrinsics
from semstab.datasets.formats.images import MILLIMETRES
from semstab.datasets.geometry.cameras import UP_AXES
from semstab.datasets.posed_folder import SETTINGS_FILE
from semstab.errors import ConfigError, DataError
from semstab.task import frame_indices, require_posed, selected

__all__ = ["Converted", "convert", "convert_scene"]

# In a posed folder that is being written each file is whole or missing, and existing files stay.

SCHEMA = 1
"""The version of conversion.json."""

CONVERSION_FILE = "conversion.json"
SCORES_SUFFIX = "-scores"
"""The suffix that posed_folder adds to the name of a folder of scores."""

MAX_UINT16 = 65535
LONGEST_NAME = 200
"""The most bytes of a folder's name."""


@dataclass(frozen=True)
class DepthFormat:
    """A format of depth: 16-bit PNG with `scale` units per metre; .npy files of float32 metres where scale is None."""

    scale: float | None

    @property
    def suffix(self) -> str:
        """Return the suffix of its files."""
        return ".npy" if self.scale is None else ".png"

    def __str__(self) -> str:
        return "float32 .npy" if self.scale is None else f"16-bit PNG, {self.scale:g} units per metre"

    def stored(self, depth: Float32, tolerance: float) -> npt.NDArray[Any] | None:
        """Return the depth as a file stores it; None if a pixel would be off by more than `tolerance` metres."""
        if self.scale is None:
            return depth
        units, error = quantised(depth, self.scale)
        return units if error <= tolerance else None


def quantised(depth: Float32, scale: float) -> tuple[UInt16, float]:
    """Return depth in whole units of 1 / scale metres, with 0 for invalid pixels, and the largest error in metres.

    The error is infinite where depth does not fit into 16 bits, or a valid pixel would become invalid.
    """
    valid = (depth > 0) & (depth < np.inf)
    units = np.rint(depth.astype(np.float64) * scale, where=valid, out=np.zeros(depth.shape))
    if not valid.any():
        return units.astype(np.uint16), 0.0
    if units[valid].min() < 1 or units.max() > MAX_UINT16:
        return np.zeros(depth.shape, dtype=np.uint16), np.inf
    back = np.divide(units.astype(np.uint16), scale, dtype=np.float32, casting="same_kind")  # as a reader computes it
    return units.astype(np.uint16), float(np.abs(back.astype(np.float64) - depth)[valid].max())


def depth_format(depths: Sequence[Float32], tolerance: float) -> DepthFormat:
    """Return the 16-bit format that holds these images best, without error if possible.

    Returns the format of floats if every 16-bit format has a larger error than `tolerance`.
    """
    scales = sorted(KNOWN_SCALES, key=lambda scale: (scale != MILLIMETRES, scale))
    errors = {scale: max(quantised(depth, scale)[1] for depth in depths) for scale in scales}
    best = min(scales, key=lambda scale: errors[scale])
    return DepthFormat(best if errors[best] <= tolerance else None)


class DepthFormatError(Exception):
    """A depth image that the folder's 16-bit format cannot hold."""


class SceneFolder:
    """The folder of one scene.

    Attributes:
        settings: All that its files depend on; a folder of other settings is not touched.
        tolerance: Metres by which stored depth may be off.

    Raises:
        ConfigError: If the folder holds something else.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], tolerance: float) -> None:
        self.path = path
        self._tolerance = tolerance
        self._settings = dict(settings)
        self._key = content_key(self._settings)
        self.form = self._claim()
        self._intrinsics: Intrinsics | None = None
        self._lock: FolderLock | None = None

    def begin(self, form: DepthFormat, scene_settings: Mapping[str, Any]) -> None:
        """Write into scene.yaml and conversion.json how depth is stored; remove depth of another format."""
        if self.form is not None and self.form != form:
            for file in (self.path / "depth").glob(f"*{self.form.suffix}"):
                file.unlink()
        if self._lock is None:
            self._lock = FolderLock(self.path)
            for folder in self.path.glob("**/"):
                remove_leftovers(folder)
        self.form = form
        settings = dict(scene_settings) | ({} if form.scale is None else {"depth_scale": form.scale})
        write_json(
            self.path / CONVERSION_FILE,
            {"schema": SCHEMA, "key": self._key, "depth_scale": form.scale, "settings": self._settings},
        )
        write_text(self.path / SETTINGS_FILE, yaml.safe_dump(settings, sort_keys=False))

    def close(self) -> None:
        """Release the lock of the folder."""
        if self._lock is not None:
            self._lock.release()

    @property
    def frames(self) -> set[str]:
        """Return the names of the existing frames."""
        return {file.stem for file in (self.path / "depth").glob("[!.]*")}

    def has_geometry(self, name: str) -> bool:
        """Return whether depth, pose, colour and mask of a frame exist: depth is written last."""
        assert self.form is not None
        return (self.path / "depth" / f"{name}{self.form.suffix}").exists()

    def has_labels(self, name: str, model: str) -> bool:
        """Return whether a frame's labels or scores exist."""
        return any(self._label_path(name, model, soft).exists() for soft in (False, True))

    def is_soft(self, model: str) -> bool:
        """Return whether the scores of the model were written instead of labels."""
        labels, scores = (self._label_path("", model, soft).parent for soft in (False, True))
        return scores.is_dir() and not labels.is_dir()

    def write_geometry(self, name: str, frame: Frame) -> None:
        """Write depth, pose, colour and mask of a frame.

        Raises:
            DepthFormatError, DataError: If its intrinsics are not those of the frames before.
        """
        assert self.form is not None
        stored = self.form.stored(frame.depth, self._tolerance)
        if stored is None:
            raise DepthFormatError
        self._require_same_camera(frame)
        if frame.color is not None:
            write_image(self.path / "color" / f"{name}.png", np.ascontiguousarray(frame.color[..., ::-1]))
        if frame.mask is not None:
            write_image(self.path / "mask" / f"{name}.png", np.where(frame.mask, 0, 255).astype(np.uint8))
        write_text(self.path / "pose" / f"{name}.txt", matrix_text(frame.T_wc))
        path = self.path / "depth" / f"{name}{self.form.suffix}"
        if self.form.scale is None:
            with atomic_path(path) as temporary:
                np.save(temporary, stored)
        else:
            write_image(path, stored)

    def write_labels(self, name: str, frame: Frame, model: str) -> None:
        """Write a frame's label ids, or its scores."""
        path = self._label_path(name, model, frame.scores is not None)
        if frame.scores is None:
            assert frame.labels is not None
            write_image(path, frame.labels)
        else:
            with atomic_path(path) as temporary:
                np.savez_compressed(temporary, scores=frame.scores.transpose(2, 0, 1))

    def write_classes(self, model: str, space: LabelSpace) -> None:
        """Write the classes of a model next to its maps."""
        space.save(self._label_path("", model, self.is_soft(model)).parent / LABEL_SPACE_FILE)

    def read_as(self, model: str) -> str:
        """Return the name of the model in posed_folder."""
        return f"{_bare(model)}{SCORES_SUFFIX}" if self.is_soft(model) else folder_name(model)

    def _label_path(self, name: str, model: str, soft: bool) -> Path:
        if soft:
            return self.path / "scores" / _bare(model) / f"{name}.npz"
        return self.path / "labels" / folder_name(model) / f"{name}.png"

    def _require_same_camera(self, frame: Frame) -> None:
        """Raise DataError if a frame has other intrinsics than the frames before."""
        path = self.path / "intrinsics.txt"
        if self._intrinsics is None and not path.exists():
            write_text(path, matrix_text(frame.intrinsics.matrix))
        self._intrinsics = self._intrinsics or read_intrinsics(path)
        if frame.intrinsics != self._intrinsics:
            raise DataError(
                f"{frame.where('depth')}: intrinsics {frame.intrinsics} differ from those of the frames before"
                f" ({self._intrinsics}), and a posed folder has one camera; convert the frames of each separately"
            )

    def _claim(self) -> DepthFormat | None:
        """Return the format of depth of an earlier start; None without one."""
        manifest = self.path / CONVERSION_FILE
        if not manifest.is_file():
            if self.path.exists() and (not self.path.is_dir() or any(self.path.glob("[!.]*"))):
                raise ConfigError(f"{self.path}: the folder exists and holds no conversion; choose another --out")
            return None
        try:
            stored = read_json(manifest)
            key, scale = stored["key"], stored["depth_scale"]
            form = DepthFormat(None if scale is None else float(scale))
            if form.scale is not None and not 0 < form.scale < np.inf:
                raise ValueError(f"depth_scale is {scale}")
        except (DataError, LookupError, TypeError, ValueError, OverflowError) as error:
            raise DataError(f"{manifest}: damaged; delete {self.path}, and the scene is converted again") from error
        if key != self._key:
            raise ConfigError(
                f"{self.path}: it was converted from other data or with other settings; choose another --out"
            )
        return form


def folder_name(name: str) -> str:
    """Return the name itself if it can be the name of a folder, or else its `slug`."""
    fits = name.isprintable() and len(name.encode()) <= LONGEST_NAME and not set(name) & set("/\\")
    return name if fits and name[:1] not in ("", ".", "-") else slug(name)


def matrix_text(matrix: Float64) -> str:
    """Return a matrix as text, one row per line, that reads back to the same numbers."""
    return "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in matrix)


def _bare(model: str) -> str:
    """Return the folder below scores/: posed_folder adds the suffix to its name."""
    return folder_name(model.removesuffix(SCORES_SUFFIX))


PROBED_FRAMES = 3
"""The number of frames whose depth is tried in 16 bits; if a later frame does not fit, all become floats."""

Reporter = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Converted:
    """The result of converting one scene.

    Attributes:
        folder: Folder of the converted scene.
        frames: Number of selected frames, of which `written` were new or not complete.
        depth: The format of its depth, in words.
        renamed: Label sources that have another name in the folder.
        lost: Parts of the scene that a posed folder does not hold.
    """

    scene: str
    folder: Path
    frames: int
    written: int
    depth: str
    renamed: dict[str, str]
    lost: tuple[str, ...]


def convert(
    config: Config, out: str | Path, *, depth_error: float = 0.0, progress: Reporter = lambda what, done, total: None
) -> Iterator[Converted]:
    """Write the scenes, frames and label sources that a resolved configuration selects to OUT/SCENE, one by one.

    By default all label sources are written, the ground truth too. Files that an earlier start finished stay. Depth
    becomes 16-bit PNG if the error of every pixel is at most `depth_error` metres, else float32 .npy; with 0 the folder
    gives the voxels of the source. `progress` is called after each frame: task, frames done, all frames.

    Raises:
        ConfigError: For a folder with other content.
        DataError: For frames that a posed folder cannot hold.
    """
    dataset = open_dataset(config.dataset.name, config.dataset.options)
    for name in selected(config.scenes, dataset.scenes, (), "scene", config.dataset.name):
        yield convert_scene(dataset.scene(name), config, Path(out) / folder_name(name), depth_error, progress)


def convert_scene(scene: Scene, config: Config, path: Path, depth_error: float, progress: Reporter) -> Converted:
    """Write one scene; see `convert`."""
    require_posed(scene)
    if scene.of_scans:
        raise DataError(f"{scene.name}: holds scans, and a posed folder holds images; scans are read as they are")
    sources = (*scene.models, *scene.by_name)
    models = selected(config.models, sources, (), "model", scene.name)
    indices = frame_indices(scene, config, models)
    dataset = config.dataset.model_dump(mode="json")
    folder = SceneFolder(path, {"dataset": dataset, "scene": scene.name, "depth_error": depth_error}, depth_error)
    if surplus := folder.frames - set(map(_name, indices)):
        raise ConfigError(
            f"{path}: the folder holds frame {min(surplus)}, which is not selected now; choose another --out"
        )
    folders = [folder_name(name) for name in models]
    if repeated := [name for name in models if folders.count(folder_name(name)) > 1]:
        raise ConfigError(f"{scene.name}: {' and '.join(repeated)} would get the same folder; choose with --model")
    work = _Conversion(scene, indices, models, folder, progress)
    settings: dict[str, Any] = {"pose_convention": "camera_to_world", "camera_axes": "opencv"}
    if up := _up_axis(scene):
        settings["up_axis"] = up
    if scene.georeference is not None:
        settings |= {"crs": scene.georeference.crs, "offset": list(scene.georeference.offset)}
        if scene.georeference.turned:
            settings["linear"] = [list(row) for row in scene.georeference.linear]
    with contextlib.closing(folder):
        folder.begin(folder.form or depth_format(work.probe(), depth_error), settings)
        try:
            written = work.write()
        except DepthFormatError:
            folder.begin(DepthFormat(None), settings)
            written = work.write()
    return Converted(
        scene=scene.name,
        folder=path,
        frames=len(indices),
        written=written,
        depth=str(folder.form),
        renamed={name: folder.read_as(name) for name in models if folder.read_as(name) != name},
        lost=tuple(work.lost()),
    )


@dataclass
class _Conversion:
    """The frames of a scene that go into a folder, by label source."""

    scene: Scene
    indices: Sequence[int]
    models: Sequence[str]
    folder: SceneFolder
    progress: Reporter
    timed: bool = False
    without_classes: tuple[str, ...] = ()

    def probe(self) -> list[Float32]:
        """Return the depth of some frames."""
        read = reader(self.scene, self.models[0] if self.models else None)
        return [read(self.indices[position]).depth for position in evenly(len(self.indices), PROBED_FRAMES)]

    def write(self) -> int:
        """Write the files that are missing, and return how many frames were not complete."""
        written = set()
        for source in self.models or (None,):
            missing = [index for index in self.indices if not self._has(index, source)]
            written.update(missing)
            for done, fetched in enumerate(prefetch(self._reading(source), missing), start=1):
                self._write_frame(fetched.item, source)
                self.progress(f"{self.scene.name} · {source or 'geometry'}", done, len(missing))
            if source is not None:
                try:
                    self.folder.write_classes(source, self.scene.label_space(source))
                except DataError:
                    self.without_classes += (source,)
        return len(written)

    def lost(self) -> Iterator[str]:
        """Yield the names of the parts of the scene that a posed folder does not hold."""
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
            if frame.scores is not None and f"{source}{SCORES_SUFFIX}" in self.models:
                raise ConfigError(
                    f"{source} and {source}{SCORES_SUFFIX} would get the same folder; choose with --model"
                )
            self.folder.write_labels(name, frame, source)


def _name(index: int) -> str:
    """Return the name of a frame's files, which is its number."""
    return f"{index:06d}"


def _up_axis(scene: Scene) -> str | None:
    """Return the name of the world's up axis; None if up is no axis."""
    return next((name for name, axis in UP_AXES.items() if scene.up is not None and (scene.up == axis).all()), None)


# The terminal shows a bar during a conversion, and a line for each scene.


@contextmanager
def frame_bar(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar of the frames of one label source; call it with task, frames done, all frames."""
    with frame_progress(console, TimeRemainingColumn()) as bar:
        work = bar.add_task("starting", total=None)
        yield lambda what, done, total: bar.update(work, description=what, completed=done, total=total)


def print_converted(converted: Converted, console: Console) -> None:
    """Print the scene, its frames and folder, renamed label sources, and things that were not converted."""
    before = converted.frames - converted.written
    earlier = f", {before} of them finished earlier" if before else ""
    console.print(
        f"{converted.scene}: {converted.frames} frames{earlier}, depth as {converted.depth}: {converted.folder}",
        soft_wrap=True,
    )
    for old, new in converted.renamed.items():
        console.print(f"  {old} is called {new} there")
    for lost in converted.lost:
        console.print(f"  not converted: {lost}")
