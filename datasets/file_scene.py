"""A scene whose frames lie in files, of whatever layout: what readers of file formats share."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.datasets import GROUND_TRUTH, disk
from semstab.datasets.cameras import Camera
from semstab.datasets.colmap_depth import read_depth_map
from semstab.datasets.file_options import FileOptions
from semstab.datasets.images import Labels, read_color, read_depth, read_labels, read_mask, read_scores
from semstab.datasets.label_source import LabelSource, ScenePlace, find_masks, find_regions, find_sources, label_spaces
from semstab.datasets.poses import Poses, to_camera_to_world
from semstab.datasets.ray_depth import planar
from semstab.datasets.resampling import fit_labels, fit_scores
from semstab.datasets.same_view import Scores
from semstab.datasets.scene_files import listed, nearest
from semstab.datasets.scene_settings import UP_AXES
from semstab.datasets.templates import Folders
from semstab.datasets.text_files import read_pose
from semstab.errors import ConfigError, DataError
from semstab.frames import Frame, Intrinsics
from semstab.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace

logger = logging.getLogger("semstab")

NO_ID = IGNORE_16BIT - 1
"""In a table of class ids: an id that is not in it."""

PLACES = {"root", "labels_root", "incomplete", "taxonomy", "taxonomies", "classes", "class_table"}
"""Options that say where things are, not what the numbers mean; label spaces and tables count by their content."""


@dataclass(frozen=True, eq=False)
class FrameSource:
    """Where one frame comes from.

    name          what path templates call it
    depth         the file
    pose          (4, 4) in the dataset's convention, or the file that holds it
    pose_file     what errors of the pose name
    camera        of the depth image
    label_camera  of the images that label maps belong to, where that is another one
    depth_scale   units in a metre, where the dataset's own files say so
    timestamp     seconds
    """

    name: str
    depth: Path
    pose: Poses | Path
    pose_file: Path
    camera: Camera
    label_camera: Camera | None = None
    color: Path | None = None
    depth_scale: float | None = None
    timestamp: float | None = None


class FileScene:
    """One sequence of files; opening it reads no image.

    Raises ConfigError for options that cannot be used, DataError for missing files.
    """

    labels_like_depth = False
    """Its label maps may have the pixels of the colour images."""

    def __init__(
        self,
        place: ScenePlace,
        frames: Sequence[FrameSource],
        options: FileOptions,
        class_ids: Mapping[str, npt.NDArray[np.uint16]] | None = None,
    ) -> None:
        self.name = place.name
        self.folder = place.folder
        self.options = options
        self._class_ids = class_ids or {}
        self._labels = find_sources(options, place, [frame.name for frame in frames])
        self._regions = find_regions(options, place, [frame.name for frame in frames])
        self.backbones: tuple[str, ...] = tuple(name for name in self._labels if name != GROUND_TRUTH)
        self.regions: tuple[str, ...] = tuple(name for name in self._regions if name not in self._labels)
        self.ground_truth: bool = GROUND_TRUTH in self._labels
        self.up: npt.NDArray[np.float64] | None = None
        if options.up_axis:
            self.up = np.array(UP_AXES[options.up_axis], dtype=np.float64)
        self._masks = find_masks(options, place, [frame.name for frame in frames])
        self._frames = self._complete(frames)
        self._digests: dict[Path, bytes] = {}

    def __len__(self) -> int:
        """Number of frames, those with a lost pose among them."""
        return len(self._frames)

    @cached_property
    def timestamps(self) -> npt.NDArray[np.float64] | None:
        """(len,) seconds on the dataset's own clock; None where it has none."""
        if self.options.frames_per_second is not None:
            return np.arange(len(self)) / self.options.frames_per_second
        times = [frame.timestamp for frame in self._frames]
        return None if None in times else np.array(times, dtype=np.float64)

    def tracked(self, index: int) -> bool:
        """Whether the frame has a pose: one that is not finite says that tracking was lost."""
        return bool(np.isfinite(self._stored_pose(self._frame(index))).all())

    def label_space(self, backbone: str) -> LabelSpace:
        """The classes of that label source.

        Raises DataError where neither classes nor taxonomy is set, ConfigError where there is no such source, or it
        has none.
        """
        self._source(backbone)
        if backbone in self.regions:
            raise ConfigError(f"{self.folder}: '{backbone}' holds regions without classes, which cannot be fused")
        space = self._spaces[backbone]
        if space is None:
            raise DataError(
                f"{self.folder}: the classes of '{backbone}' are not known; set the dataset's option taxonomy,"
                f" classes, or taxonomies: {{{backbone}: NAME}}"
            )
        return space

    def frame(self, index: int, backbone: str, *, color: bool = True) -> Frame:
        """Frame 0 <= index < len with that source's labels or scores, and colour where there is any and it is wanted.

        Labels of another size than the depth are brought to its pixels. Raises DataError that names the file,
        ConfigError where there is no such frame or backbone.
        """
        source = self._frame(index)
        depth = self.depth(index)
        labelled = self._label_file(source, backbone)
        kind = self._source(backbone).kind
        files = {"depth": source.depth, "pose": source.pose_file, kind: labelled}
        if source.color is not None and color:
            files["color"] = source.color
        timestamps = self.timestamps
        return Frame(
            index=int(index),
            depth=depth,
            intrinsics=self.intrinsics(index, depth.shape),
            T_wc=self.T_wc(index),
            labels=self._read_labels(index, backbone, labelled, depth.shape) if kind == "labels" else None,
            scores=self._read_scores(index, labelled, depth.shape) if kind == "scores" else None,
            color=read_color(files["color"]) if "color" in files else None,
            mask=self._mask(index, depth.shape),
            timestamp=None if timestamps is None else float(timestamps[index]),
            files={what: str(path) for what, path in files.items()},
        )

    def depth(self, index: int) -> npt.NDArray[np.float32]:
        """Depth (H, W) float32 in metres along the optical axis; needs no labels. Raises DataError with the file."""
        source = self._frame(index)
        scale = self.options.depth_scale or source.depth_scale
        read = read_depth_map if source.depth.suffix.lower() == ".bin" else read_depth
        depth = read(source.depth, scale, self._read)
        for value in self.options.invalid_depth:
            with np.errstate(over="ignore"):
                depth[depth == np.float32(value) / np.float32(scale or 1)] = 0
        if self.options.max_depth is not None:
            depth[depth >= self.options.max_depth] = 0
        if self.options.depth_kind == "ray":
            return planar(depth, self.intrinsics(index, depth.shape))
        return depth

    def color(self, index: int) -> npt.NDArray[np.uint8] | None:
        """Colour (H, W, 3) uint8 RGB, None where the frame has none; needs no labels. Raises DataError."""
        path = self._frame(index).color
        return None if path is None else read_color(path)

    def image_name(self, index: int) -> str:
        """What path templates call the frame."""
        return self._frame(index).name

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """The frame with labels (H, W) or scores (H, W, K) that were predicted on its colour image; no colour.

        They are brought to the depth's pixels. Raises DataError that names the file.
        """
        source, depth, timestamps = self._frame(index), self.depth(index), self.timestamps
        shape = (depth.shape[0], depth.shape[1])
        if labels is not None and (cameras := self._cameras(index, labels.shape, shape)):
            labels = fit_labels(labels, *cameras, shape)
        if scores is not None and (cameras := self._cameras(index, scores.shape, shape)):
            scores = fit_scores(scores, *cameras, shape)
        return Frame(
            index=int(index),
            depth=depth,
            intrinsics=self.intrinsics(index, shape),
            T_wc=self.T_wc(index),
            labels=labels,
            scores=scores,
            mask=self._mask(index, shape),
            timestamp=None if timestamps is None else float(timestamps[index]),
            files={"depth": str(source.depth), "pose": str(source.pose_file)},
        )

    def intrinsics(self, index: int, shape: tuple[int, ...]) -> Intrinsics:
        """Intrinsics of the frame's depth image, of shape (H, W); pixels."""
        camera, options = self._frame(index).camera, self.options
        return Camera(camera.intrinsics, options.intrinsics_size or camera.size).at(shape, options.pixel_centre or 0.0)

    def T_wc(self, index: int) -> Poses:
        """Pose (4, 4) camera-to-world in metres, OpenCV camera axes; needs no labels.

        Raises DataError that names the file. That the pose is rigid is checked by `Frame`.
        """
        source, options = self._frame(index), self.options
        stored = self._stored_pose(source).copy()
        with np.errstate(over="ignore"):
            stored[:3, 3] *= options.metres_per_unit
        convention, axes = options.pose_convention or "camera_to_world", options.camera_axes or "opencv"
        return to_camera_to_world(stored, convention, axes, str(source.pose_file))

    def digest(self, indices: list[int], backbone: str) -> str:
        """A hash of the settings, the classes, and the depth, poses and labels of those frames; colour does not count.

        Of the images it is the content that `frame` read, where it did; others are read for it.
        """
        space = self._spaces.get(backbone)
        settings = self.options.model_dump(mode="json", exclude=PLACES)
        digest = hashlib.blake2b(digest_size=16)
        digest.update(json.dumps([settings, space.to_dict() if space else None]).encode())
        if backbone in self._class_ids:
            digest.update(self._class_ids[backbone].tobytes())
        for index in indices:
            source = self._frame(index)
            digest.update(source.name.encode() + b"\0" + self._geometry(source))
            mask = [self._masks[source.name]] if source.name in self._masks else []
            for path in (source.depth, self._label_file(source, backbone), *mask):
                digest.update(self._digests.get(path) or disk.file_digest(path))
        return digest.hexdigest()

    def _geometry(self, source: FrameSource) -> bytes:
        """The pose and the cameras of a frame, as bytes that are equal where they are."""
        cameras = (source.camera, source.label_camera, source.depth_scale)
        return self._stored_pose(source).tobytes() + repr(cameras).encode()

    def _read(self, path: Path) -> bytes:
        """The content of an image file; its digest is kept, so that `digest` need not read the file again."""
        data = disk.read_bytes(path)
        self._digests[path] = disk.digest(data)
        return data

    def _read_labels(self, index: int, backbone: str, path: Path, shape: tuple[int, ...]) -> Labels:
        labels = read_labels(path, self._spaces.get(backbone), self._read)
        if backbone in self._class_ids:
            labels = _translated(labels, self._class_ids[backbone], path)
        if void := self.options.void_ids.get(backbone):
            ignore = IGNORE_8BIT if labels.dtype == np.uint8 else IGNORE_16BIT
            labels = np.where(np.isin(labels, void), labels.dtype.type(ignore), labels)
        cameras = self._cameras(index, labels.shape, shape)
        return labels if cameras is None else fit_labels(labels, *cameras, (shape[0], shape[1]))

    def _mask(self, index: int, shape: tuple[int, ...]) -> npt.NDArray[np.bool_] | None:
        """What is masked in a frame, brought to the depth's pixels; what the mask does not see is not."""
        path = self._masks.get(self._frame(index).name)
        if path is None:
            return None
        mask = read_mask(path, self._read)
        cameras = self._cameras(index, mask.shape, shape)
        return mask if cameras is None else fit_labels(mask.astype(np.uint8), *cameras, (shape[0], shape[1])) == 1

    def _read_scores(self, index: int, path: Path, shape: tuple[int, ...]) -> npt.NDArray[np.floating[Any]]:
        scores = read_scores(path, self.options.scores_layout, (shape[0], shape[1]), self._read)
        cameras = self._cameras(index, scores.shape, shape)
        return scores if cameras is None else fit_scores(scores, *cameras, (shape[0], shape[1]))

    def _cameras(
        self, index: int, shape: tuple[int, ...], depth_shape: tuple[int, ...]
    ) -> tuple[Intrinsics, Intrinsics] | None:
        """Intrinsics of the label map of a shape and of the depth; None where their pixels are the same."""
        ours = self.intrinsics(index, depth_shape)
        other = self._frame(index).label_camera
        if other is not None:
            return other.at(shape, self.options.pixel_centre or 0.0), ours
        if shape[:2] == depth_shape[:2]:
            return None
        return Camera(ours, (depth_shape[1], depth_shape[0])).at(shape), ours

    def _stored_pose(self, source: FrameSource) -> Poses:
        return read_pose(source.pose) if isinstance(source.pose, Path) else source.pose

    @cached_property
    def _spaces(self) -> dict[str, LabelSpace | None]:
        return label_spaces(self.options, self._labels)

    def _source(self, backbone: str) -> LabelSource:
        known = {**self._regions, **self._labels}
        if backbone not in known:
            hint = nearest(backbone, known) if known else "say where its label maps are: option labels"
            raise ConfigError(f"{self.folder}: backbone '{backbone}' is not there; {hint}")
        return known[backbone]

    def _label_file(self, source: FrameSource, backbone: str) -> Path:
        labels = self._source(backbone)
        if source.name not in labels.files:  # only of the ground truth and of regions: the others are complete
            lost = [path for frame in self._frames for path in labels.missing(frame.name)]
            raise DataError(f"{self.folder}: {listed(lost)}; choose frames that have them, or add them")
        return labels.files[source.name]

    def _frame(self, index: int) -> FrameSource:
        if not 0 <= index < len(self):
            raise ConfigError(f"{self.folder}: there is no frame {index}; it has {len(self)}, counted from 0")
        return self._frames[index]

    def _complete(self, frames: Sequence[FrameSource]) -> list[FrameSource]:
        """The frames whose files are there; raises DataError that lists missing ones, unless they are to be skipped."""
        folders = Folders()
        missing = {frame.name: self._missing(frame, folders) for frame in frames}
        if len(missing) < len(frames):
            raise DataError(f"{self.folder}: two frames have one name; frames need names of their own")
        complete = [frame for frame in frames if not missing[frame.name]]
        lost = [path for paths in missing.values() for path in paths]
        if lost and self.options.incomplete == "error":
            raise DataError(
                f"{self.folder}: {listed(lost)}; add them, or set incomplete: skip to leave such frames out"
            )
        if not complete:
            raise DataError(f"{self.folder}: no frame has depth, pose and labels ({listed(lost)})")
        if lost:
            count = len(frames) - len(complete)
            logger.warning("%s: %d of %d frames left out: %s", self.folder, count, len(frames), listed(lost))
        return complete

    def _missing(self, frame: FrameSource, folders: Folders) -> list[str]:
        files = [frame.depth, frame.pose] if isinstance(frame.pose, Path) else [frame.depth]
        missing = [str(path) for path in files if not folders.has(path)]
        return missing + [path for name in self.backbones for path in self._labels[name].missing(frame.name)]


def _translated(labels: Labels, table: npt.NDArray[np.uint16], path: Path) -> Labels:
    """table[labels]. Raises DataError for an id that the table does not have."""
    translated: Labels = table[labels]
    if (unknown := translated == NO_ID).any():
        raise DataError(f"{path}: the id {labels[unknown][0]} is not in the table of classes; is it the right table?")
    return translated
