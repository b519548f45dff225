"""Images in a row without depth and poses: a folder of images, or a video file that OpenCV reads."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field

from semstab.config import nearest
from semstab.core.arrays import RecentArrays
from semstab.core.files import file_digest
from semstab.core.types import Float64, UInt8
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import LabelSpace
from semstab.datasets import VIDEOS
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import LabelMaps, SceneEntry, label_paths
from semstab.datasets.files.options import Folders, LabelOptions
from semstab.datasets.formats.disk import files_by_stem, natural, subfolders
from semstab.datasets.formats.images import COLOR_SUFFIXES, color_size, read_color
from semstab.datasets.geometry.lenses import Labels, Scores, fitted
from semstab.datasets.scene import GROUND_TRUTH, Dataset, Scene, fingerprint
from semstab.errors import ConfigError, DataError

logger = logging.getLogger("semstab")

IMAGE_FOLDERS = ("images", "color", "rgb", "frames", "JPEGImages", "image_2", "img")
"""Folders of a scene that may hold its images, if they do not lie in the scene's folder itself."""

LEAST = 2
"""Images of a folder that is a scene."""

RECENT_BYTES = 1 << 28
"""The most bytes of decoded frames of a video file that stay in memory."""

NEAR = 64
"""Frames that are passed over to reach a later one; one that is farther away is looked up by the file's index."""

PLACES = {"root", "labels_root", "incomplete", "taxonomy", "taxonomies", "classes", "frames_per_second"}
"""Options that do not change the numbers; label spaces count by their content."""


class VideoOptions(LabelOptions):
    """Options of images without depth and poses."""

    root: Path = Field(description="a video file, a folder of images, or the folder above several of them")
    incomplete: Literal["error", "skip"] = Field("error", description="a selected frame without image or labels")
    frames_per_second: opt.Positive | None = Field(
        None, description="for time stamps from 0 s; a video file has its own"
    )


@dataclass(frozen=True)
class VideoFrame:
    """A frame of a video.

    Attributes:
        name: Name in path templates: the name of its image, or its number from 0 in a video file, 000012.
        image: Its image; None in a video file.
    """

    name: str
    image: Path | None = None
    aliases: tuple[str, ...] = ()


class Video(Dataset):
    """Folders of images, and video files; label maps lie in labels/MODEL/ in a scene's folder.

    The folder of a video file has its name without the suffix: clip/labels/MODEL/000012.png next to clip.mp4.
    """

    Options: type[BaseModel] = VideoOptions
    contents = f"images ({', '.join(COLOR_SUFFIXES)}), or a video file"

    def __init__(self, options: VideoOptions) -> None:
        self.options = options
        self._found = {entry.name: (entry, images) for entry, images in find_videos(options.root)}

    @property
    def scenes(self) -> tuple[str, ...]:
        """Return the names of the scenes, in natural order."""
        return tuple(self._found)

    def scene(self, name: str) -> VideoScene:
        """Open one.

        Raises:
            ConfigError: For a name that is not there.
            DataError: For a file that cannot be decoded.
        """
        if name not in self._found:
            raise ConfigError(f"{self.options.root}: scene '{name}' is not there; {nearest(name, self.scenes)}")
        entry, images = self._found[name]
        if images.is_dir():
            image_files = sorted(files_by_stem(images, COLOR_SUFFIXES).items(), key=lambda item: natural(item[0]))
            return VideoScene(entry, [VideoFrame(stem, images / file) for stem, file in image_files], self.options)
        film = Film(images)
        return VideoScene(entry, [VideoFrame(f"{k:06d}") for k in range(len(film))], self.options, film)


def find_videos(root: Path) -> Iterable[tuple[SceneEntry, Path]]:
    """Return the scenes, each with its folder of images or its video file.

    Raises:
        DataError: If there is none, or two would have one name.
    """
    if not root.exists():
        raise DataError(f"{root}: there is no such file or folder")
    name = root.resolve().name or "scene"
    if root.is_file():
        return [(SceneEntry(root.stem, root.with_suffix(""), root.stem), root)]
    if (images := _images_of(root)) is not None:
        return [(SceneEntry(name, root, ""), images)]
    folders = [(root / folder, _images_of(root / folder)) for folder in subfolders(root)]
    scenes = {folder.name: (folder, images) for folder, images in folders if images is not None}
    for file in sorted(path for path in root.iterdir() if path.suffix.lower() in VIDEOS):
        if file.stem in scenes:
            raise DataError(f"{file}: {scenes[file.stem][1].name} would be a scene of the same name; rename one")
        scenes[file.stem] = (file.with_suffix(""), file)
    if not scenes:
        raise DataError(
            f"{root}: no images here, in {', '.join(IMAGE_FOLDERS[:4])}/ or one folder below, and no video file"
            f" ({', '.join(VIDEOS)})"
        )
    order = sorted(scenes, key=natural)
    return [(SceneEntry(name, scenes[name][0], name), scenes[name][1]) for name in order]


def _images_of(folder: Path) -> Path | None:
    """Return the folder with a scene's images: the folder itself, or one of `IMAGE_FOLDERS`; None without images."""
    subfolder_names = {*subfolders(folder)}
    for images in (folder, *(folder / name for name in IMAGE_FOLDERS if name in subfolder_names)):
        if len(files_by_stem(images, COLOR_SUFFIXES)) >= LEAST:
            return images
    return None


class Film:
    """The frames of a video file, decoded in order; threads may share it.

    Attributes:
        path: The file.
        size: (width, height) of its frames.
        rate: Frames a second; NaN if unknown.

    Raises:
        DataError: If OpenCV cannot decode it.
    """

    def __init__(self, path: Path) -> None:
        import cv2

        self.path = path
        self._lock, self._recent = threading.Lock(), RecentArrays(RECENT_BYTES)
        self._capture, self._next = cv2.VideoCapture(str(path)), 0
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)) if self._capture.isOpened() else 0
        if count < LEAST:
            raise DataError(
                f"{path}: {'no video that OpenCV can decode' if count < 1 else 'holds a single frame'}; convert it"
                " (ffmpeg -i FILE out.mp4), or give a folder of its frames (ffmpeg -i FILE images/%06d.png)"
            )
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self._count, self.rate = count, rate if 0 < rate < math.inf else math.nan
        width, height = (self._capture.get(side) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        self.size = int(width), int(height)

    def __len__(self) -> int:
        """Return the number of frames that the file says it has."""
        return self._count

    def image(self, index: int) -> UInt8:
        """Return (H, W, 3) uint8 RGB.

        Raises:
            DataError: If the frame cannot be decoded.
        """
        return self._recent.get(index, lambda: self._decoded(index))

    def _decoded(self, index: int) -> UInt8:
        import cv2

        with self._lock:
            if not self._next <= index < self._next + NEAR:
                self._capture.set(cv2.CAP_PROP_POS_FRAMES, index)
                self._next = index
            reached = all(self._capture.grab() for _ in range(index - self._next))
            done, image = self._capture.read() if reached else (False, None)
            self._next = index + 1 if done else -NEAR  # the next read seeks again
        if not done or image is None:
            raise DataError(
                f"{self.path}: frame {index} cannot be decoded; leave it and what follows out (--frames :{index}), or"
                " convert the file (ffmpeg -i FILE out.mp4)"
            )
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


class VideoScene(Scene):
    """Images in a row. A frame has no depth and no pose: those that `Frame` needs are 1 m and the identity."""

    folder: Path
    posed = False
    labels_like_depth = False

    def __init__(
        self, entry: SceneEntry, frames: Sequence[VideoFrame], options: VideoOptions, film: Film | None = None
    ) -> None:
        self.name, self.folder, self.options = entry.name, entry.folder, options
        self.skips_incomplete = options.incomplete == "skip"
        self._frames, self._film, self._files = frames, film, Folders()
        self._maps = LabelMaps(options, entry, frames, self._files, {})
        self.models, self.ground_truth = self._maps.models, self._maps.ground_truth
        if self.ground_truth and self._maps.space(GROUND_TRUTH) is None:
            logger.warning("%s: the classes of %s are not known, so it is not read", self.name, GROUND_TRUTH)
            self.ground_truth = False
        self.regions = self._maps.regions
        self.label_paths = tuple(label_paths(options, entry, frames))

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

    @cached_property
    def timestamps(self) -> Float64 | None:
        """Return (len,) seconds from the first frame, or None if the number of frames a second is unknown."""
        rate = self.options.frames_per_second or (math.nan if self._film is None else self._film.rate)
        return None if math.isnan(rate) else np.arange(len(self), dtype=np.float64) / rate

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return the missing label maps of the frame; its image is there."""
        frame = self._frame(index)
        return [path for model in sources for path in self._maps.source(model).missing(frame)]

    def frame_name(self, index: int) -> str:
        """Return the name of the frame's image, or its number in a video file."""
        return self._frame(index).name

    def image_name(self, index: int) -> str:
        """Return the same."""
        return self._frame(index).name

    @property
    def settings(self) -> Mapping[str, Any]:
        """The options by which its files are read."""
        settings: Mapping[str, Any] = self.options.model_dump()
        return settings

    def label_space(self, model: str) -> LabelSpace:
        """Return the classes of that label source.

        Raises:
            DataError: If they are not known.
            ConfigError: If there is no such source, or it has none.
        """
        return self._maps.label_space(model, self.folder / "label_space.yaml")

    def color(self, index: int) -> UInt8:
        """Return the image (H, W, 3) uint8 RGB.

        Raises:
            DataError: If it cannot be decoded; the message names the file.
        """
        frame = self._frame(index)
        if frame.image is not None:
            return read_color(frame.image, self._files.read)
        assert self._film is not None
        return self._film.image(index)

    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        """Return frame 0 <= index < len with that source's labels or scores, brought to the image's pixels.

        Raises:
            DataError: If that fails; the message names the file.
            ConfigError: If there is no such frame or model.
        """
        source, shape = self._maps.source(model), self._shape(index)
        path = self._maps.file(self._frame(index), model)
        if source.kind == "scores":
            return self._framed(index, path, color, scores=self._maps.scores(model, path, shape, self._files.read))
        return self._framed(index, path, color, labels=self._maps.labels(model, path, self._files.read))

    def geometry(self, index: int, *, color: bool = False) -> Frame:
        """Return the frame but for its labels: all pixels are of class 0."""
        return self._framed(index, None, color, labels=np.zeros(self._shape(index), np.uint8))

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """Return the frame with labels (H, W) or scores (H, W, K) that were predicted on its image; no colour."""
        return self._framed(index, None, False, labels, scores)

    def view(self, index: int, shape: tuple[int, int]) -> Frame:
        """Raise ConfigError: a video has no depth and no poses."""
        raise ConfigError(
            f"{self.name}: the model, or a filter, looks at depth and pose, which a video does not have; use one that"
            " looks at the image alone"
        )

    def digest(self, indices: Sequence[int], model: str) -> str:
        """Return a hash of the settings, the classes, and the images and labels of those frames."""
        space, settings = self._maps.space(model), self.options.model_dump(mode="json", exclude=PLACES)
        digest = hashlib.blake2b(digest_size=16)
        digest.update(json.dumps([settings, space.to_dict() if space else None]).encode())
        if self._film is not None:
            digest.update(file_digest(self._film.path))
        for index in indices:
            frame = self._frame(index)
            digest.update(frame.name.encode() + b"\0")
            for file in (frame.image, self._maps.file(frame, model)):
                digest.update(b"" if file is None else self._files.digest(file))
        return digest.hexdigest()

    def fingerprints(self, index: int) -> Mapping[str, str]:
        """Return a short hash of the frame's image."""
        return {f"image of {self.frame_name(index)}": fingerprint(self.color(index).tobytes())}

    def _shape(self, index: int) -> tuple[int, int]:
        image = self._frame(index).image
        if image is not None:
            width, height = color_size(image)
        else:
            assert self._film is not None
            width, height = self._film.size
        return height, width

    def _framed(
        self, index: int, path: Path | None, color: bool, labels: Labels | None = None, scores: Scores | None = None
    ) -> Frame:
        shape, where = self._shape(index), f"{self.name}, {self.frame_name(index)}"
        frame, times = self._frame(index), self.timestamps
        height, width = shape
        film = None if self._film is None else self._film.path
        return Frame(
            index=int(index),
            depth=np.ones(shape, np.float32),
            intrinsics=Intrinsics(width, width, (width - 1) / 2, (height - 1) / 2),
            T_wc=np.eye(4),
            labels=None if labels is None else fitted(labels, shape, where if path is None else str(path)),
            scores=None if scores is None else fitted(scores, shape, where if path is None else str(path)),
            color=self.color(index) if color else None,
            timestamp=None if times is None else float(times[index]),
            files={"color": str(frame.image or film)} | ({} if path is None else {"labels": str(path)}),
        )

    def _frame(self, index: int) -> VideoFrame:
        if not 0 <= index < len(self):
            raise ConfigError(f"{self.folder}: there is no frame {index}; it has {len(self)}, counted from 0")
        return self._frames[index]
