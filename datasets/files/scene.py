"""A scene whose frames lie in files, of whatever layout; readers of file formats share it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from semstab.core.arrays import RecentArrays
from semstab.core.prefetch import prefetch
from semstab.core.types import Float32, Float64, UInt8
from semstab.data.features import Features
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import LabelSpace
from semstab.datasets.files.depth import shape_of, stored_depth, stored_scale
from semstab.datasets.files.labels import LabelMaps, SceneEntry, label_paths
from semstab.datasets.files.options import NO_TRUTH, FileOptions, Folders, FrameSource, TruthSource
from semstab.datasets.files.surfaces import CameraView, Surface
from semstab.datasets.formats import disk
from semstab.datasets.formats.disk import read_pose
from semstab.datasets.formats.image_sizes import DENSEST, MAX_PHOTOGRAPH, MAX_PIXELS, FrameSize, Size
from semstab.datasets.formats.images import Read, color_size, depth_size, read_color, read_confidence, read_features
from semstab.datasets.geometry.cameras import UP_AXES, Camera, Poses, to_camera_to_world
from semstab.datasets.geometry.lenses import (
    Labels,
    Pixels,
    Scores,
    at_image,
    fit,
    fitted,
    require_same_view,
    undistorted,
)
from semstab.datasets.scene import Scene, fingerprint, view_fingerprint
from semstab.errors import ConfigError, DataError

PLACES = {
    "root", "labels_root", "incomplete", "taxonomy", "taxonomies", "classes", "class_table", "crs", "offset", "surface",
    "casts", "images", "pose_shift", "time_offset",
}  # fmt: skip
"""Options that are paths and do not change the numbers; label spaces, tables and poses count by their content."""

DEPTH_BYTES = 1 << 27
"""The most bytes of depth images that stay in memory."""

DEPTH, CONFIDENCE, LABELS, FEATURES, MASK = "depth", "confidence", "labels of ", "features of ", "mask"
"""Kinds of a frame's files."""


class FileScene(Scene):
    """One sequence of files, each required when it is read; opening it reads no image.

    Args:
        entry: Its name and its folder.
        frames: The files of its frames.
        options: The settings by which they are read.
        truth: What the format says of its ground truth.
        surface: What depth is cast at, if that is not stored.
        folders: Where files are looked up and read.
        label_folders: Folders of label maps, one file a frame, by the label source that they are.

    Raises:
        ConfigError: For options that cannot be used.
        DataError: For two frames of one name.
    """

    folder: Path

    def __init__(
        self,
        entry: SceneEntry,
        frames: Sequence[FrameSource],
        options: FileOptions,
        truth: TruthSource = NO_TRUTH,
        surface: Surface | None = None,
        folders: Folders | None = None,
        label_folders: Mapping[str, Path] | None = None,
    ) -> None:
        if len({frame.name for frame in frames}) < len(frames):
            raise DataError(f"{entry.folder}: two frames have one name; frames need names of their own")
        self.name = entry.name
        self.folder = entry.folder
        self.options = options
        self.skips_incomplete = options.incomplete == "skip"
        self.images_elsewhere = getattr(options, "images", "") is None
        self.up = np.array(UP_AXES[options.up_axis], dtype=np.float64) if options.up_axis else None
        self._frames = frames
        self._folders = folders or Folders()
        self._maps = LabelMaps(options, entry, frames, self._folders, label_folders or {}, truth)
        self.models = self._maps.models
        self.with_features = self._maps.with_features
        self.ground_truth = self._maps.ground_truth
        self.regions = self._maps.regions
        self.unread = self._maps.unread
        self.label_paths = tuple(label_paths(options, entry, frames))
        self._digests: dict[tuple[int, str], bytes] = {}
        self._depths = RecentArrays(DEPTH_BYTES)
        self._shapes: dict[Camera, tuple[int, ...]] = {}
        self._tracked: dict[int, bool] = {}
        self._surface = surface
        self._surface_seen = False
        self.surface = None if surface is None else surface.path
        self.depth_from = None if surface is None else f"rays cast at {surface.path}"
        self.on_photographs = any(frame.label_lens is not None for frame in frames)

    def __len__(self) -> int:
        """Return the number of frames of the sequence, those without a file or a pose among them."""
        return len(self._frames)

    @cached_property
    def timestamps(self) -> Float64 | None:
        """Return (len,) seconds on the dataset's own clock, or None without a clock."""
        if self.options.frames_per_second is not None:
            return np.arange(len(self)) / self.options.frames_per_second
        times = [frame.timestamp for frame in self._frames]
        return None if None in times else np.array(times, dtype=np.float64)

    def tracked(self, index: int) -> bool:
        """Return whether the frame has a pose; one that is not finite means that tracking was lost. Read once."""
        source = self._frame(index)
        if index not in self._tracked:
            self._tracked[index] = bool(np.isfinite(self._stored_pose(source)).all())
        return self._tracked[index]

    def frame_name(self, index: int) -> str:
        """Return the name that the frame's files have in common."""
        return self._frame(index).name

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return the paths of the missing files of the frame: depth, pose, the labels of these sources, colour."""
        frame = self._frame(index)
        files = [self.surface or frame.depth, *([frame.pose_file] if frame.pose is None else [])]
        files += [frame.confidence] if frame.confidence is not None and self.surface is None else []
        lost = [str(path) for path in files if not self._folders.has(path)]
        lost += [path for name in sources for path in self._maps.missing(frame, name)]
        if color and self._color_file(frame) is None:
            lost.append(f"{self.folder}: the colour of {frame.name}" if frame.color is None else str(frame.color))
        if color and frame.label_lens is not None and not self._folders.has(frame.photograph or Path()):
            lost.append(f"{self.folder}: the photograph of {frame.name}")
        return lost

    @property
    def settings(self) -> Mapping[str, Any]:
        """The conventions by which its files are read, by name of option."""
        return self.options.model_dump()

    @property
    def depth_scale(self) -> float | None:
        """Return units of its stored depth in a metre: the option, else the usual scale of its kind of file."""
        return stored_scale(self._frames[0], self.options) if self._surface is None else None

    def label_space(self, model: str) -> LabelSpace:
        """Return the classes of that label source.

        Raises:
            DataError: If they are not known.
            ConfigError: If there is no such source, or it has none.
        """
        return self._maps.label_space(model, self.settings_file or self.folder)

    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        """Return frame 0 <= index < len with the labels or scores of a source, and colour, if any.

        Labels of another size than the depth are brought to its pixels.

        Raises:
            DataError: If that fails; the message names the file.
            ConfigError: If there is no such frame or model.
        """
        file, kind = self._maps.file(self._frame(index), model), self._maps.source(model).kind
        read = self._reader(index, LABELS + model)
        depth, labels, scores = self.depth(index), None, None
        features = self._features(index, model, (depth.shape[0], depth.shape[1]))
        if kind == "features":
            return self._framed(index, depth, None, None, color=color, features=features, files={"features": file})
        if kind != "scores":
            sizes = self._sizes(index, depth.shape, file, "labels are")
            ids = self._maps.labels(model, file, read, sizes, self._frame(index))
            labels = self._stored(index, ids, depth.shape, file, "labels are")
        else:
            sizes = self._sizes(index, depth.shape, file, "scores are")
            stored = self._maps.scores(model, file, (depth.shape[0], depth.shape[1]), read, sizes)
            scores = self._stored(index, stored, depth.shape, file, "scores are")
        what = "labels" if scores is None else "scores"
        return self._framed(index, depth, labels, scores, color=color, features=features, files={what: file})

    def _features(self, index: int, model: str, shape: Size) -> Features | None:
        """Return the features of a frame, at the pixels of its depth image of shape (H, W); None without any."""
        source = self._frame(index)
        if (path := self._maps.features_file(source, model)) is None:
            return None
        if source.label_lens is not None or source.label_camera is not None:
            raise DataError(f"{path}: is of a photograph with another camera than the depth; features need the depth's")
        return read_features(path, shape, self._reader(index, FEATURES + model))

    def geometry(self, index: int, *, color: bool = False) -> Frame:
        """Return the frame but for its labels: all pixels are of class 0.

        Raises:
            DataError: If that fails; the message names the file.
        """
        depth = self.depth(index)
        return self._framed(index, depth, np.zeros(depth.shape, dtype=np.uint8), None, color=color)

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """Return the frame with labels (H, W) or scores (H, W, K) that were predicted on its colour image; no colour.

        They are brought to the depth's pixels.

        Raises:
            DataError: If that fails; the message names the file.
        """
        depth = self.depth(index)
        where = str(self._frame(index).color or self.image_name(index))
        labels = None if labels is None else self._fitted(index, labels, depth.shape, where)
        scores = None if scores is None else self._fitted(index, scores, depth.shape, where)
        return self._framed(index, depth, labels, scores, color=False)

    def view(self, index: int, shape: tuple[int, int]) -> Frame:
        """Return depth and pose of the frame at the pixels of its colour image, of shape (H, W); all labels are 0."""
        source = self._frame(index)
        if source.label_lens is not None:
            raise DataError(
                f"{self.folder}: no pinhole has the depth of distorted photographs, which a model wants; set labels_on:"
                " undistorted"
            )
        camera = source.label_camera
        K = None if camera is None else camera.intrinsics_at(shape, self.options.pixel_centre or 0.0)
        return at_image(self.geometry(index), shape, str(source.color or source.name), K)

    def depth(self, index: int) -> Float32:
        """Return depth (H, W) float32 in metres along the optical axis, read-only.

        The last images stay in memory: check, fusion, ground truth and pictures want the same ones.

        Raises:
            DataError: If that fails, with the file.
        """
        return self._depths.get(index, lambda: self._read_depth(index))

    def _read_depth(self, index: int) -> Float32:
        if self._surface is None:
            source, read = self._frame(index), self._reader(index, DEPTH)
            sizes = FrameSize(lambda: self._image_pixels(index, of_depth=True))
            depth = stored_depth(source, self.options, read, lambda shape: self.intrinsics(index, shape), sizes)
            self._require_one_size(source, depth)
            return depth if source.confidence is None else self._confident(index, depth, source.confidence)
        depth = self._surface.depth(self._view(index))
        if not self._surface_seen and not depth.any():
            self._surface.require_seen(self._view(k) for k in range(len(self)) if self.tracked(k))
        self._surface_seen = True
        if self.options.max_depth is not None:
            depth[depth >= self.options.max_depth] = 0
        return depth

    def require_one_size(self, indices: Sequence[int]) -> None:
        """Raise DataError where depth images of one camera have several sizes, and the intrinsics say for none.

        Images that need no more than their beginning to tell their size are looked at.
        """
        for camera in dict.fromkeys(self._frames[index].camera for index in indices if self._surface is None):
            self._require_usual(camera, [self._frames[index] for index in indices])

    def _require_one_size(self, source: FrameSource, depth: Float32) -> None:
        """Raise the same where depth that was read has another size than the first that was."""
        if depth.shape != self._shapes.setdefault(source.camera, depth.shape):
            self._require_usual(source.camera, self._frames, source, depth.shape)

    def _require_usual(
        self,
        camera: Camera,
        frames: Sequence[FrameSource],
        other: FrameSource | None = None,
        shape: tuple[int, ...] = (),
    ) -> None:
        """Raise DataError with the first of a camera's frames whose size is not the usual one, or with that other."""
        if camera.size is not None or self.options.intrinsics_size is not None:
            return
        of_camera = [frame for frame in frames if frame.camera is camera or frame.camera == camera]
        sizes = [(frame, size) for frame in of_camera if (size := depth_size(frame.depth)) is not None]
        measured = [size for _, size in sizes]
        usual = max(dict.fromkeys(measured), key=measured.count, default=None)
        if other is not None and usual is None:
            H, W = self._shapes[camera]
            usual, sizes = (W, H), [(other, (shape[1], shape[0]))]
        odd = [(frame, size) for frame, size in sizes if size != usual]
        if not odd or usual is None:
            return
        frame, (width, height) = odd[0]
        more = f", and {len(odd) - 1} more," if len(odd) > 1 else ""
        raise DataError(
            f"{frame.depth}: depth{more} is {width}x{height} where that of the others is {usual[0]}x{usual[1]}, but the"
            f" intrinsics are for one size; take these frames out, or, where all show the same view, set"
            f" intrinsics_size: [{usual[0]}, {usual[1]}]"
        )

    def _confident(self, index: int, depth: Float32, file: Path) -> Float32:
        """Return depth without that of pixels whose confidence is too low."""

        def require(size: Size) -> None:
            if size != depth.shape:
                (h, w), (H, W) = size, depth.shape
                raise DataError(f"{file}: confidence is {w}x{h} but depth is {W}x{H}; export them again")

        confidence = read_confidence(file, self._reader(index, CONFIDENCE), FrameSize(require=require))
        return np.where(confidence >= self._frame(index).least_confidence, depth, np.float32(0))

    def color(self, index: int) -> UInt8 | None:
        """Return the colour (H, W, 3) uint8 RGB, or None without colour; needs no labels. Raises DataError."""
        source = self._frame(index)
        path = self._color_file(source)
        if path is None or source.color_lens is None:
            return None if path is None else read_color(path, self._folders.read)
        size = source.camera.size or source.color_lens.camera.size
        assert size is not None
        shape = (size[1], size[0])
        image, K = read_color(path, self._folders.read), self.intrinsics(index, shape)
        return undistorted(image, source.color_lens, K, shape, str(path))

    def image(self, index: int) -> UInt8:
        """Return the image that models predict on: in colour, or the distorted photograph of the label maps."""
        source = self._frame(index)
        if source.label_lens is None:
            return super().image(index)
        if source.photograph is None or not self._folders.has(source.photograph):
            raise DataError(
                f"{self.folder}: the photograph of {source.name} is not there, on which labels are predicted; add it"
                " to images/, or set labels_on: undistorted"
            )
        return read_color(source.photograph, self._folders.read)

    def image_name(self, index: int) -> str:
        """Return the frame's name in path templates."""
        return self._frame(index).name

    def intrinsics(self, index: int, shape: tuple[int, ...]) -> Intrinsics:
        """Return the intrinsics of the frame's depth image, of shape (H, W); pixels."""
        camera, options = self._frame(index).camera, self.options
        return Camera(camera.intrinsics, options.intrinsics_size or camera.size).intrinsics_at(
            shape, options.pixel_centre or 0.0
        )

    def T_wc(self, index: int) -> Poses:
        """Return pose (4, 4) camera-to-world in metres, OpenCV camera axes; needs no labels.

        `Frame` checks that the pose is rigid.

        Raises:
            DataError: If that fails; the message names the file.
        """
        source, options = self._frame(index), self.options
        stored = self._stored_pose(source).copy()
        with np.errstate(over="ignore"):
            stored[:3, 3] *= options.metres_per_unit or 1.0
        convention, axes = options.pose_convention or "camera_to_world", options.camera_axes or "opencv"
        return to_camera_to_world(stored, convention, axes, str(source.pose_file))

    def digest(self, indices: Sequence[int], model: str) -> str:
        """Return a hash of the settings, the classes, and the depth, poses and labels of those frames.

        Images that `frame` has read count by that content; others are read for the hash.
        """
        space = self._maps.space(model)
        settings = self.options.model_dump(mode="json", exclude=PLACES)
        digest = hashlib.blake2b(digest_size=16)
        digest.update(json.dumps([settings, space.to_dict() if space else None]).encode())
        if (table := self._maps.class_ids(model)) is not None:
            digest.update(table.tobytes())
        files = [self._images(index, model) for index in indices]
        unread = [k for k, paths in enumerate(files) if paths.keys() - self._digests.keys()]
        for fetched in prefetch(lambda k: {key: self._folders.digest(path) for key, path in files[k].items()}, unread):
            self._digests = fetched.item | self._digests
        for index, paths in zip(indices, files, strict=True):
            source = self._frame(index)
            cameras = (source.camera, source.label_camera, source.depth_scale, source.label_lens, source.depth_lens)
            digest.update(source.name.encode() + b"\0" + self._stored_pose(source).tobytes() + repr(cameras).encode())
            digest.update(b"" if self._surface is None else self._surface.digest)
            for key in paths:
                digest.update(self._digests[key])
        return digest.hexdigest()

    def fingerprints(self, index: int) -> Mapping[str, str]:
        """Return a short hash of the file of depth and how it is read, and of the pose and camera, by their files."""
        source, options = self._frame(index), self.options
        if self._surface is None:
            name, content = source.depth, self._folders.digest(source.depth)
            if source.confidence is not None:
                content += self._folders.digest(source.confidence)
            least = source.least_confidence
            content += repr((self.depth_scale, options.depth_kind, options.invalid_depth, least)).encode()
        else:
            name, content = self._surface.path, self._surface.digest
        content += repr(options.max_depth).encode()
        view = self._view(index)
        pose = source.pose_file if source.pose is None else f"pose of {source.name}"
        return {
            self._named(name): fingerprint(content),
            self._named(pose): view_fingerprint(view.T_wc, view.intrinsics, view.shape),
        }

    def _named(self, path: Path | str | None) -> str:
        """Return a path as it is called in the scene's folder."""
        return str(path).removeprefix(f"{self.folder}{os.sep}")

    def _images(self, index: int, model: str) -> dict[tuple[int, str], Path]:
        """Return the files of a frame, without its pose: stored depth, labels, a mask."""
        source = self._frame(index)
        depth = source.depth if self._surface is None else None
        labels, mask = self._maps.file(source, model), self._maps.mask_file(source)
        confidence = None if depth is None else source.confidence
        files = {DEPTH: depth, CONFIDENCE: confidence, LABELS + model: labels, MASK: mask}
        files |= {FEATURES + model: self._maps.features_file(source, model)}
        return {(index, what): path for what, path in files.items() if path is not None}

    def _view(self, index: int) -> CameraView:
        shape = shape_of(self._frame(index), self.options)
        return CameraView(self.intrinsics(index, shape), self.T_wc(index), shape)

    def _framed(
        self,
        index: int,
        depth: Float32,
        labels: Labels | None,
        scores: Scores | None,
        *,
        color: bool,
        features: Features | None = None,
        files: Mapping[str, Path] | None = None,
    ) -> Frame:
        source, timestamps = self._frame(index), self.timestamps
        image = self._color_file(source)  # named also if it is not read: a recording takes the file as it is
        mask, masked = self._maps.mask_file(source), None
        if mask is not None:  # outside of the mask's view nothing is masked
            sizes = self._sizes(index, depth.shape, mask, "the mask is")
            values = self._maps.mask(source, mask, self._reader(index, MASK), sizes).astype(np.uint8)
            masked = self._stored(index, values, depth.shape, mask, "the mask is") == 1
        color_file = image if source.color_lens is None else None  # a distorted one shows another view than the depth
        paths = {"depth": self.surface or source.depth, "pose": source.pose_file, "color": color_file, "mask": mask}
        paths |= dict(files or {})
        return Frame(
            index=int(index), depth=depth, intrinsics=self.intrinsics(index, depth.shape), T_wc=self.T_wc(index),
            labels=labels, scores=scores, features=features, color=self.color(index) if color else None, mask=masked,
            timestamp=None if timestamps is None else float(timestamps[index]),
            files={what: str(path) for what, path in paths.items() if path is not None},
        )  # fmt: skip

    def _stored(self, index: int, values: Pixels, shape: tuple[int, ...], path: Path, what: str) -> Pixels:
        """Return the content of a file at the depth's pixels."""
        return self._fitted(index, values, shape, str(path), what)

    def _fitted(
        self, index: int, values: Pixels, shape: tuple[int, ...], where: str, what: str = "the image is"
    ) -> Pixels:
        """Return labels (H', W') or scores (H', W', K) as the depth's camera sees them."""
        source = self._frame(index)
        if source.label_lens is not None:
            K = self.intrinsics(index, shape)
            return undistorted(values, source.label_lens, K, (shape[0], shape[1]), where, what)
        camera = source.label_camera
        if camera is None:
            return fitted(values, shape, where, what)
        K = camera.intrinsics_at(values.shape, self.options.pixel_centre or 0.0)
        return fit(values, K, self.intrinsics(index, shape), (shape[0], shape[1]))

    def _sizes(self, index: int, shape: tuple[int, ...], path: Path, what: str) -> FrameSize:
        """Return the sizes that a map of a frame may have, whose depth has that shape, by its file's header."""
        source = self._frame(index)
        elsewhere = source.label_lens is not None or source.label_camera is not None

        def require(size: Size) -> None:
            if not elsewhere:
                require_same_view(size, shape, str(path), f"{what} {{}} but depth is {{}}")

        return FrameSize(lambda: self._image_pixels(index), require, (shape[0], shape[1]))

    def _image_pixels(self, index: int, *, of_depth: bool = False) -> int:
        """Return the pixels of a frame's image, of depth also of its camera; 0 where neither is known.

        What an image's header claims counts as far as its file has bytes for it.
        """
        source = self._frame(index)
        lenses = (lens.camera for lens in (source.label_lens, source.color_lens) if lens is not None)
        cameras = [*lenses, *([] if source.label_camera is None else [source.label_camera])]
        sizes = [camera.size for camera in [*cameras, *([source.camera] if of_depth else [])]]
        sizes += [self.options.intrinsics_size] if of_depth else []
        areas = [min(size[0] * size[1], MAX_PHOTOGRAPH) for size in sizes if size is not None]
        for file in (self._color_file(source), source.photograph):
            if file is not None and self._folders.has(file):
                with contextlib.suppress(DataError, OSError):
                    width, height = color_size(file)
                    likely = max(MAX_PIXELS, DENSEST * file.stat().st_size)
                    areas.append(min(width * height, likely, MAX_PHOTOGRAPH))
        return max(areas, default=0)

    def _reader(self, index: int, what: str) -> Read:
        """Give the content of a frame's file; its digest is remembered, so that `digest` need not read it again."""

        def read(path: Path) -> bytes:
            data = self._folders.read(path)
            self._digests[index, what] = disk.digest(data)
            return data

        return read

    def _stored_pose(self, source: FrameSource) -> Poses:
        """Return the pose (4, 4) as it is stored, or NaN if its rotation is zeros: tracking was lost."""
        stored = read_pose(source.pose_file) if source.pose is None else source.pose
        return stored if stored[:3, :3].any() else np.full((4, 4), np.nan)

    def _color_file(self, source: FrameSource) -> Path | None:
        return source.color if source.color is not None and self._folders.has(source.color) else None

    def _frame(self, index: int) -> FrameSource:
        if not 0 <= index < len(self):
            raise ConfigError(f"{self.folder}: there is no frame {index}; it has {len(self)}, counted from 0")
        return self._frames[index]
