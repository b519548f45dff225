"""Scenes of posed LiDAR scans in files, a file of points and one of labels a scan; readers of such formats share it."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import Field

from semstab.config import Settings, nearest
from semstab.core.types import Float32, Float64, Mask, UInt16
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import SEPARATE, LabelSource, SceneEntry
from semstab.datasets.files.options import Folders, Template, matching_folders
from semstab.datasets.files.reader import ScenesBelow
from semstab.datasets.formats.disk import decode_array
from semstab.datasets.formats.images import Read
from semstab.datasets.geometry.cameras import LARGEST_COORDINATE, UP_AXES, to_camera_to_world
from semstab.datasets.geometry.sweeps import Sweep, deskewed, motion_in_sweep
from semstab.datasets.scene import GROUND_TRUTH, Scene, fingerprint, listed
from semstab.errors import ConfigError, DataError

logger = logging.getLogger("semstab")

PLACES = {"root", "labels_root", "incomplete", "taxonomy", "taxonomies", "classes"}
"""Options that do not change the numbers; label spaces count by their content."""

NO_ID = IGNORE_16BIT - 1
"""The mark in a table of ids for one that is not in it."""

LABEL_FIELDS = ("label", "class", "semantic", "sem_class")
"""Names of a column of classes in a cloud; the first one that is there counts."""

CALIBRATED = 0.01
"""How far the rotation of a calibration may be from orthonormal: it has few digits in some files."""


class ScanOptions(Settings):
    """Options that every dataset of scans has."""

    root: Path = Field(description="a scene's folder, or the folder above scenes")
    incomplete: Literal["error", "skip"] = Field("error", description="a selected scan without points, pose or labels")
    labels: str | None = Field(None, description="template of predictions, with {model} and {name}")
    labels_root: Path | None = Field(None, description="folder of predictions, if not the scene's own")
    taxonomy: opt.Taxonomy = None
    classes: tuple[str, ...] | None = Field(None, description="class names in id order, instead of a taxonomy")
    taxonomies: dict[str, str] = Field({}, description="taxonomies of single label sources; gt is the ground truth")
    void_ids: opt.VoidIds = Field({})
    min_range: opt.Positive | None = Field(None, description="metres up to which points are left out: the own vehicle")
    max_range: opt.Positive | None = Field(None, description="metres from which on points are left out")
    up_axis: opt.UpAxis = None
    deskew: Sweep | None = Field(
        None,
        description="take the sensor's motion in a sweep out of the points, by their azimuth: how the sweep turns, and"
        " the degrees from x to y at which it begins; the pose is that of its middle",
    )


@dataclass(frozen=True, eq=False)
class ScanSource:
    """The files and numbers that one scan comes from.

    Attributes:
        name: Name of the scan in path templates.
        points: The file.
        pose: (4, 4) sensor-to-world, metres; NaN for a scan without a pose.
        pose_file: The file that holds it.
        timestamp: Seconds.
        aliases: Other names that its label files may have.
    """

    name: str
    points: Path
    pose: Float64
    pose_file: Path
    timestamp: float | None = None
    aliases: tuple[str, ...] = ()


Options = TypeVar("Options", bound=ScanOptions)


class ScanDataset(ScenesBelow[Options]):
    """Scenes of scans below a root. A reader recognises a scene's folder, lists its scans, and reads points and ids.

    Attributes:
        labels: Templates of predictions; the first template that finds files counts.
        truth: Template of ground truth, or None.
        taxonomy: The classes of the labels, unless options name others.
        in_world: Whether points are in the world already; a pose is then only where the sensor was.

    Raises:
        DataError: If there is no scene.
    """

    labels: tuple[str, ...] = ("predictions/{model}/{name}",)
    truth: str | None = None
    taxonomy: str | None = None
    in_world = False

    def scene(self, name: str) -> ScanScene:
        """Open one.

        Raises:
            ConfigError: For a name that is not there.
            DataError: For one without scans, or damaged poses.
        """
        entry = self.entry(name)
        scans = list(self.scans(entry))
        if not scans:
            raise DataError(f"{entry.folder}: holds no scan; expected {self.contents}")
        return self.opened(entry, scans)

    def opened(self, entry: SceneEntry, scans: Sequence[ScanSource]) -> ScanScene:
        """Return the scene of these scans."""
        return ScanScene(self, entry, scans)

    @abstractmethod
    def scans(self, entry: SceneEntry) -> Iterable[ScanSource]:
        """Return the scans of a scene, in order, of different names; raises DataError with the file."""

    @abstractmethod
    def points(self, path: Path, read: Read) -> npt.NDArray[np.floating[Any]]:
        """Return points (N, 3) in metres of a file, whose bytes `read` gives; raises DataError with the file."""

    def ids(self, path: Path, read: Read) -> npt.NDArray[np.integer[Any]]:
        """Return stored ids (N,) of a file, whose bytes `read` gives; raises DataError with the file."""
        return ids_of(path, read(path))

    def class_ids(self, model: str) -> UInt16 | None:
        """Return a table (65536,) from ids of that source's files to its taxonomy's, where they differ; NO_ID: none."""
        return None

    def moving(self, ids: Callable[[], npt.NDArray[np.integer[Any]]]) -> Mask | None:
        """Return the points (N,) that move by their true ids, which `ids` reads, where the format says so."""
        return None


class ScanScene(Scene):
    """One sequence of scans, each file required when it is read; opening it reads no scan.

    Args:
        dataset: Its reader.
        entry: Its name and its folder.
        scans: Its scans.
        files: The files that it reads.
        own: Folders of labels, {name} a file, by the label source that they are, besides those that templates find.

    Raises:
        ConfigError: For options that cannot be used.
        DataError: For two scans of one name.
    """

    folder: Path
    of_scans = True

    def __init__(
        self,
        dataset: ScanDataset[Any],
        entry: SceneEntry,
        scans: Sequence[ScanSource],
        files: Folders | None = None,
        given: Mapping[str, Path] | None = None,
    ) -> None:
        if len({scan.name for scan in scans}) < len(scans):
            raise DataError(f"{entry.folder}: two scans have one name; scans need names of their own")
        self.name, self.folder, self.options = entry.name, entry.folder, dataset.options
        self.skips_incomplete = self.options.incomplete == "skip"
        self.up = np.array(UP_AXES[self.options.up_axis], np.float64) if self.options.up_axis else None
        self._dataset, self._scans, self._files = dataset, scans, files or Folders()
        base = self.options.labels_root or entry.folder
        self._truth = None
        if dataset.truth is not None:
            truth = LabelSource.with_first_file("points", entry.folder, dataset.truth, scans, self._files)
            self._truth = None if truth.first is None else truth
        templates = dataset.labels if self.options.labels_root is None else (SEPARATE, *dataset.labels)
        templates = templates if self.options.labels is None else (self.options.labels,)
        example = {"scene": entry.below_root, "model": "MODEL", "name": scans[0].name}
        label_templates = [
            Template("labels", text, ("scene", "model", "name"), ("model", "name")) for text in templates
        ]
        self.label_paths = tuple(str(base / template.filled(**example)) for template in label_templates)
        self._sources = dict[str, LabelSource]()
        for template in label_templates:
            sources = {
                model: LabelSource.with_first_file("points", base, filled, scans, self._files)
                for model, filled in matching_folders(base, template, "model", scene=entry.below_root).items()
            }
            self._sources |= {model: source for model, source in sources.items() if source.first is not None}
            if self._sources:
                break
        for name, labels in (given or {}).items():
            if name in self._sources:
                raise ConfigError(f"{entry.folder}: two label sources are called '{name}'; rename one")
            self._sources[name] = LabelSource.with_first_file("points", labels, "{name}", scans, self._files)
        self._truth = self._sources.pop(GROUND_TRUTH, self._truth)
        self.models, self.ground_truth = tuple(self._sources), self._truth is not None

    def __len__(self) -> int:
        """Return the number of scans of the sequence, those without a file or a pose among them."""
        return len(self._scans)

    @cached_property
    def timestamps(self) -> Float64 | None:
        """Return (len,) seconds on the dataset's own clock, or None without a clock."""
        times = [scan.timestamp for scan in self._scans]
        return None if None in times else np.array(times, dtype=np.float64)

    def tracked(self, index: int) -> bool:
        """Return whether the scan has a pose."""
        return bool(np.isfinite(self._scan(index).pose).all())

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return the missing files of the scan, among labels of these sources."""
        scan = self._scan(index)
        lost = [] if self._files.has(scan.points) else [str(scan.points)]
        for name in sources:
            lost += self._source(name).missing(scan)
        return lost

    def frame_name(self, index: int) -> str:
        """Return the name of the scan's files."""
        return self._scan(index).name

    def image_name(self, index: int) -> str:
        """Return the name of the scan's files."""
        return self._scan(index).name

    @property
    def settings(self) -> Mapping[str, Any]:
        """The conventions by which its files are read, by name of option."""
        settings: Mapping[str, Any] = self.options.model_dump()
        return settings

    def label_space(self, model: str) -> LabelSpace:
        """Return the classes of that label source.

        Raises:
            DataError: If they are not known.
            ConfigError: If there is no such source, or it has none.
        """
        self._source(model)
        options = self.options
        name = options.taxonomies.get(model, options.taxonomy or self._dataset.taxonomy)
        if options.classes is not None and model not in options.taxonomies:
            return LabelSpace(name="classes of the scene", classes=options.classes)
        if name is None:
            raise DataError(
                f"{self.folder}: the classes of '{model}' are not known; set classes: [name, ...] in id order, or"
                " taxonomy: NAME (--option taxonomy=FILE.yaml)"
            )
        return LabelSpace.load(name)

    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        """Return scan 0 <= index < len with that source's labels.

        Raises:
            DataError: If that fails; the message names the file.
            ConfigError: If there is no such scan or model.
        """
        scan, source = self._scan(index), self._source(model)
        file = source.file(scan)
        if file is None:
            raise DataError(
                f"{self.folder}: {listed(source.missing(scan), str(self.folder))}; choose scans that have it, or add it"
            )
        stored = None if file.suffix == LABEL else self._ids(file, 0)
        points = self._dataset.points(scan.points, self._files.read)
        if stored is None:
            stored = self._ids(file, len(points))
        truth = None if self._truth is None else self._truth.file(scan)
        moving = None if truth is None else self._dataset.moving(lambda: self._ids(truth, len(points)))
        files = {"labels": str(file), "mask": str(truth)}
        return self._framed(index, points, self._labels(model, stored, file), files, moving)

    def geometry(self, index: int, *, color: bool = False) -> Frame:
        """Return the scan but for its labels: all points are of class 0."""
        points = self._dataset.points(self._scan(index).points, self._files.read)
        return self._framed(index, points, None, {})

    def intrinsics(self, index: int, shape: tuple[int, ...]) -> Intrinsics:
        """Raise DataError: a scan has none."""
        raise DataError(f"{self.folder}: scans have no intrinsics")

    def T_wc(self, index: int) -> Float64:
        """Return pose (4, 4) sensor-to-world in metres; reads no points."""
        return self._scan(index).pose

    def digest(self, indices: Sequence[int], model: str) -> str:
        """Return a hash of the settings, the classes, and the points, poses and labels of those scans."""
        settings = self.options.model_dump(mode="json", exclude=PLACES)
        space, source = self.label_space(model), self._source(model)
        digest = hashlib.blake2b(digest_size=16)
        digest.update(json.dumps([settings, space.to_dict()]).encode())
        if (table := self._dataset.class_ids(model)) is not None:
            digest.update(table.tobytes())
        for index in indices:
            scan = self._scan(index)
            digest.update(scan.name.encode() + b"\0" + scan.pose.tobytes() + self._files.digest(scan.points))
            if self.options.deskew is not None:
                digest.update(self._motion(index).tobytes())
            for label_source in (source, self._truth):
                file = None if label_source is None else label_source.file(scan)
                digest.update(b"" if file is None else self._files.digest(file))
        return digest.hexdigest()

    def fingerprints(self, index: int) -> Mapping[str, str]:
        """Return a short hash of the file of points, and of the pose."""
        scan = self._scan(index)
        pose = " ".join(f"{round(value, 6) + 0.0:.6f}" for value in scan.pose.ravel().tolist())
        return {
            os.path.relpath(scan.points, self.folder): fingerprint(self._files.digest(scan.points)),
            f"pose of {scan.name}": fingerprint(pose.encode()),
        }

    def _labels(self, model: str, stored: npt.NDArray[Any], file: Path) -> UInt16:
        """Return stored ids as ids of the source's taxonomy."""
        if stored.size and (stored.min() < 0 or stored.max() > IGNORE_16BIT):
            raise DataError(f"{file}: ids go from {stored.min()} to {stored.max()}; they must be 0 to 65535")
        labels: UInt16 = stored.astype(np.uint16)
        if void := self.options.void_ids.get(model):
            labels = np.where(np.isin(labels, void), np.uint16(IGNORE_16BIT), labels)
        table = None if model in self.options.taxonomies else self._dataset.class_ids(model)
        if table is None:
            return labels
        ids: UInt16 = table[labels]
        if (unknown := ids == NO_ID).any():
            used = np.unique(labels[labels != IGNORE_16BIT])
            why = "is it another format?"
            if used[-1] < MOST_TRAINED or used[-1] == IGNORE_8BIT:
                why = (
                    f"are ids {used[0]} to {used[used < IGNORE_8BIT][-1]} those that a network is trained with? write"
                    f" them back by learning_map_inv, or name their classes: taxonomies: {{{model}: FILE.yaml}}"
                )
            raise DataError(f"{file}: the id {labels[unknown][0]} is no class of the format; {why}")
        return ids

    def _ids(self, file: Path, points: int) -> npt.NDArray[np.integer[Any]]:
        """Return stored ids (N,) of a scan with `points` points, which tell the width of the ids in a .label file."""
        size = file.stat().st_size if file.suffix == LABEL and file.is_file() else 0
        if points and size in (2 * points, 8 * points):
            return narrow_ids(file, self._files.read(file), points)
        return self._dataset.ids(file, self._files.read)

    def _framed(
        self,
        index: int,
        points: npt.NDArray[np.floating[Any]],
        labels: npt.NDArray[Any] | None,
        files: Mapping[str, str],
        moving: Mask | None = None,
    ) -> Frame:
        scan = self._scan(index)
        near, far = self.options.min_range or 0.0, self.options.max_range or math.inf
        with np.errstate(over="ignore", invalid="ignore"):  # numbers beyond float32 are no valid points
            if self._dataset.in_world:
                points = (points - scan.pose[:3, 3]) @ scan.pose[:3, :3]
            if self.options.deskew is not None:
                points = deskewed(points.astype(np.float64), self._motion(index), self.options.deskew)
            points = points.astype(np.float32, copy=False)
            depth = np.sqrt((points.astype(np.float64) ** 2).sum(axis=1)).astype(np.float32)
        if near > 0 or far < math.inf:
            depth = np.where((depth > near) & (depth < far), depth, np.float32(0))
        if labels is None:
            labels = np.zeros(len(points), np.uint8)
        default_files = {"points": str(scan.points), "depth": str(scan.points), "pose": str(scan.pose_file)}
        return Frame(
            index=int(index), points=points, depth=depth, T_wc=scan.pose, labels=labels, mask=moving,
            timestamp=scan.timestamp, files=default_files | dict(files),
        )  # fmt: skip

    def _motion(self, index: int) -> Float64:
        """Return (6,) the motion in a scan's sweep."""
        before, after = (self._scans[k].pose if 0 <= k < len(self) else None for k in (index - 1, index + 1))
        return motion_in_sweep(before, self._scans[index].pose, after)

    def _source(self, model: str) -> LabelSource:
        """Return the files of a label source; raises ConfigError if no label source has this name."""
        sources = self._sources | ({} if self._truth is None else {GROUND_TRUTH: self._truth})
        if model not in sources:
            hint = nearest(model, [*sources]) if self._sources else f"put its files into {self.label_paths[0]}"
            raise ConfigError(f"{self.folder}: model '{model}' is not there; {hint}")
        return sources[model]

    def _scan(self, index: int) -> ScanSource:
        if not 0 <= index < len(self):
            raise ConfigError(f"{self.folder}: there is no scan {index}; it has {len(self)}, counted from 0")
        return self._scans[index]


def as_poses(T: Float64, convention: str, path: Path) -> Float64:
    """Return poses (n, 4, 4) of a file as sensor-to-world, of rows (n, 3, 4) or (n, 4, 4); NaN stays.

    Raises:
        DataError: For one that cannot be inverted, or is too far away, with the file and its number from 1.
    """
    if T.shape[1:] == (3, 4):
        T = np.concatenate([T, np.tile([0.0, 0.0, 0.0, 1.0], (len(T), 1, 1))], axis=1)
    poses = [to_camera_to_world(pose, convention, "opencv", f"{path}: pose {k}") for k, pose in enumerate(T, start=1)]
    return np.array(poses, np.float64).reshape(-1, 4, 4)


def rigid_inverse(T: Float64, where: str) -> Float64:
    """Return the inverse of a calibration (4, 4).

    Raises:
        DataError: If it is not rigid, with `where` (the file).
    """
    R = T[:3, :3]
    if not (np.isfinite(T).all() and np.abs(T).max() < LARGEST_COORDINATE):
        raise DataError(f"{where}: the matrix holds a number that is not finite, or too large; is the file damaged?")
    if np.abs(R.T @ R - np.eye(3)).max() > CALIBRATED or np.linalg.det(R) < 0:
        raise DataError(f"{where}: the rotation is not orthonormal; is the matrix transposed, or the file damaged?")
    return np.linalg.inv(T).astype(np.float64, copy=False)


def floats_of(path: Path, data: bytes, columns: int) -> Float32:
    """Return the rows (N, columns) of float32 that a file holds, little-endian.

    Raises:
        DataError: If its size is no multiple of a row's, with the file.
    """
    if len(data) % (4 * columns) or not data:
        raise DataError(
            f"{path}: {len(data)} bytes are no rows of {columns} float32 (x, y, z, ...); is it cut off, or another"
            " format?"
        )
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def classes_in(values: npt.NDArray[Any], name: str, where: str) -> npt.NDArray[np.int64]:
    """Return the classes (N,) that a column of a cloud holds; NaN is no class.

    Raises:
        DataError: If they are no whole numbers, with the column's name and `where`.
    """
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    values = np.where(np.isnan(values), IGNORE_16BIT, values)
    bad = ~((np.abs(values) <= IGNORE_16BIT) & (values == np.rint(values)))
    if bad.any():
        raise DataError(
            f"{where}: the field '{name}' holds {values[bad][0]:g}, which is no class from 0 to {IGNORE_16BIT}; set"
            " label_field to one of classes, not of scores"
        )
    return values.astype(np.int64)


LABEL = ".label"
"""The suffix of ids of points, which are uint32 in the formats that have it."""

MOST_TRAINED = 34
"""More than the ids that a network is trained with: 20 of SemanticKITTI, 17 of nuScenes, 34 of Cityscapes."""


def narrow_ids(path: Path, data: bytes, points: int) -> npt.NDArray[np.integer[Any]]:
    """Return ids (N,) of a .label of uint16 or int64; the number of points N tells the width.

    Raises:
        DataError: If some of the 64-bit numbers do not fit in 16 bits.
    """
    if len(data) == 2 * points:
        return np.frombuffer(data, "<u2")
    ids = np.frombuffer(data, "<i8")
    if (ids < 0).any() or (ids > IGNORE_16BIT).any():
        raise DataError(
            f"{path}: {len(data)} bytes for {points} points are int64, but ids go from {ids.min()} to {ids.max()};"
            " write uint32"
        )
    return ids


def ids_of(path: Path, data: bytes) -> npt.NDArray[np.integer[Any]]:
    """Return ids (N,): of .label the lower 16 bits of each uint32 (the upper ones are an instance); of .npy integers.

    Raises:
        DataError: If the file is another one.
    """
    if path.suffix == ".npy":
        ids = decode_array(path, data, "labels")
        if not np.issubdtype(ids.dtype, np.integer):
            raise DataError(f"{path}: holds {ids.dtype}, not integers; write the class of each point, not its scores")
        return ids.reshape(-1)
    if path.suffix != ".label":
        raise DataError(f"{path}: is neither .label (uint32) nor .npy; write one of these")
    if len(data) % 4:
        raise DataError(f"{path}: {len(data)} bytes are no uint32; is it cut off, or another format?")
    return np.frombuffer(data, "<u4") & 0xFFFF
