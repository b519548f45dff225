"""COLMAP reconstructions with depth maps: a dense workspace (images/, sparse/, stereo/depth_maps/), or one like it.

Sources: Schönberger and Frahm, Structure-from-Motion Revisited, CVPR 2016; colmap.github.io/format.html.
"""

from __future__ import annotations

import logging
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.files import open_file
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.options import FileOptions, Folders, FrameSource, Template, inside
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import AGAIN, natural, numbered_lines, subfolders, to_number
from semstab.datasets.formats.images import DEPTH_SUFFIXES, color_size
from semstab.datasets.geometry.cameras import Camera, Poses, from_quaternions
from semstab.errors import DataError

logger = logging.getLogger("semstab")

MODELS_FOLDER = "sparse"
"""The folder of the sparse model, or of one model a subfolder: 0, 1, ..."""

ALL = "all"


class ColmapOptions(FileOptions):
    """Options with the defaults of the format."""

    pose_convention: opt.PoseConvention = "world_to_camera"
    pixel_centre: opt.PixelCentre = 0.5
    model: int | str | None = Field(
        None,
        description="folder of the sparse model, its number in sparse/, or all: a scene each; by default the only one",
    )
    images: str = Field("images", description="folder of the (undistorted) images in the scene's")
    depth: str = Field("stereo/depth_maps/{image}.geometric.bin", description="template: {image}, {name} (no suffix)")


class Colmap(FileDataset[ColmapOptions]):
    """{name} is the image's name in the model without suffix: 0012, or cam0/0012.

    Depth maps in .bin files are in the model's unit, others in metres, unless depth_scale says so; with
    metres_per_unit both become metric. Models that the mapper left next to each other, sparse/0, sparse/1, share no
    coordinates: one is read, or with `model: all` each is a scene, NAME-0, NAME-1.
    """

    Options: type[BaseModel] = ColmapOptions
    contents = "a sparse model (cameras and images, .bin or .txt) in sparse/, and depth maps"

    def __init__(self, options: ColmapOptions) -> None:
        self._depth = Template("depth", options.depth, ("image", "name"))
        self._models: dict[str, Path] = {}
        super().__init__(options)

    def find_scenes(self, root: Path) -> Iterator[SceneEntry]:
        """Yield the scenes; with `model: all` one for each model."""
        for entry in super().find_scenes(root):
            models = self._found(entry.folder)
            if self.options.model != ALL or len(models) == 1:
                yield entry
                continue
            for model in models:
                name = f"{entry.name}-{model.name}"
                self._models[name] = model
                yield SceneEntry(name, entry.folder, entry.below_root)

    def is_scene(self, folder: Path) -> bool:
        """Return whether there is a sparse model."""
        return bool(self._found(folder))

    def frames_of_scene(self, entry: SceneEntry) -> list[FrameSource]:
        """Return the frames of the scene's model."""
        return self._frames(entry.folder, self._models.get(entry.name) or self._only(entry.folder))

    def frames(self, folder: Path) -> list[FrameSource]:
        """Return a frame for each image of the only model.

        Raises:
            DataError: For several models without a setting that selects one, and what `read_model` raises.
        """
        return self._frames(folder, self._only(folder))

    def _frames(self, folder: Path, model: Path) -> list[FrameSource]:
        options, folders = self.options, Folders()
        path, images = read_model(model)
        frames: list[FrameSource] = []
        for image in images:
            depth_name = self._depth.filled(image=image.name, name=image.frame)
            depth_path = inside(options.root, folder, depth_name, str(path))
            depth = folders.one_of(depth_path, (*DEPTH_SUFFIXES, ".bin")) or depth_path
            color = inside(options.root, folder, f"{options.images}/{image.name}", str(path))
            frames.append(
                FrameSource(
                    name=image.frame, depth=depth, pose=image.T_cw, pose_file=path, camera=image.camera,
                    color=color if folders.has(color) else None,
                    depth_scale=1 / (options.metres_per_unit or 1.0) if depth.suffix == ".bin" else None,
                )
            )  # fmt: skip
        _tell_sizes(path, frames)
        return frames

    def _found(self, folder: Path) -> list[Path]:
        """Return the folders of the models of a scene that the options leave."""
        choice, sparse = self.options.model, folder / MODELS_FOLDER
        if choice not in (None, ALL):
            by_name = inside(self.options.root, folder, str(choice), "option model")
            numbered = sparse / str(choice) if str(choice).isdecimal() else by_name
            return [path for path in (by_name, numbered) if has_model(path)][:1]
        if has_model(sparse):
            return [sparse]
        models = [sparse / name for name in subfolders(sparse) if name.isdecimal() and has_model(sparse / name)]
        return models or [path for path in (folder,) if has_model(path)]

    def _only(self, folder: Path) -> Path:
        """Return the folder of the only model of a scene.

        Raises:
            DataError: If there are several, with the number of images of each.
        """
        models = self._found(folder)
        if len(models) == 1:
            return models[0]
        summaries = "; ".join(f"{model.name}: {_summary(model)}" for model in models[:MOST_LISTED])
        more = f"; {len(models) - MOST_LISTED} more" if len(models) > MOST_LISTED else ""
        raise DataError(
            f"{folder / MODELS_FOLDER}: {len(models)} models, which share no coordinates ({summaries}{more}); choose"
            " one with model: NUMBER (--option model=NUMBER), or model: all for a scene each"
        )


# The sparse model, text and binary (colmap.github.io/format.html): the cameras and the images; points are skipped.


MOST_LISTED = 5
"""Models that an error lists."""


def _summary(model: Path) -> str:
    """Return how many images a model has, and the first of them."""
    _, images = read_model(model)
    return f"{len(images)} image{'s' if len(images) > 1 else ''} from {images[0].name[:40]}"


def _tell_sizes(path: Path, frames: Sequence[FrameSource]) -> None:
    """Warn of the first image of each camera whose file has another size than the model says."""
    first = {frame.camera: frame.color for frame in reversed(frames) if frame.color is not None}
    for camera, color in first.items():
        try:
            size = color_size(color)
        except DataError:  # raised where the image is needed
            continue
        if camera.size is not None and camera.size != size:
            (width, height), (w, h) = camera.size, size
            logger.warning(
                "%s: says that %s has %dx%d pixels, but the file has %dx%d; intrinsics are scaled to it, right only"
                " where the image was resized after the reconstruction",
                path.parent, color.name, width, height, w, h,
            )  # fmt: skip


MODELS: Mapping[str, tuple[int, int]] = {
    "SIMPLE_PINHOLE": (3, 1), "PINHOLE": (4, 2), "SIMPLE_RADIAL": (4, 1), "RADIAL": (5, 1), "OPENCV": (8, 2),
    "OPENCV_FISHEYE": (8, 0), "FULL_OPENCV": (12, 2), "FOV": (5, 0), "SIMPLE_RADIAL_FISHEYE": (4, 0),
    "RADIAL_FISHEYE": (5, 0), "THIN_PRISM_FISHEYE": (12, 0), "RAD_TAN_THIN_PRISM_FISHEYE": (16, 0),
}  # fmt: skip
"""Number of parameters, and of focal lengths among them, or 0 for a model that distorts with zero coefficients."""

MAX_SIDE = 2**24
MAX_NAME = 1000

Stated = tuple[str, int, int, list[float]]
"""A camera as a file states it: model, width, height, parameters."""

Registered = tuple[list[float], int, str]
"""An image as a file states it: [qw qx qy qz tx ty tz], camera id, name."""


@dataclass(frozen=True, eq=False)
class ModelImage:
    """One registered image: its name in the model, its pose (4, 4) world-to-camera, its camera."""

    name: str
    T_cw: Poses
    camera: Camera

    @property
    def frame(self) -> str:
        """Return the name without its suffix: the frame's name in path templates."""
        return os.path.splitext(self.name)[0]  # noqa: PTH122  a name, not a path


def has_model(folder: Path) -> bool:
    """Return whether a folder holds a sparse model."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_model(folder: Path) -> tuple[Path, list[ModelImage]]:
    """Return the file of the images, and the images in the natural order of their names; binary goes before text.

    Raises:
        DataError: For a damaged file, an image without its camera, or a camera that distorts.
    """
    binary = (folder / "cameras.bin").is_file()
    path, cameras_path = (folder / f"{part}{'.bin' if binary else '.txt'}" for part in ("images", "cameras"))
    try:
        with open_file(cameras_path) as file:
            cameras = dict((_cameras_bin if binary else _cameras_txt)(file, cameras_path))
        with open_file(path) as file:
            registered = list((_images_bin if binary else _images_txt)(file, path))
    except OSError as error:
        raise DataError(f"{error.filename or path}: cannot be read ({error.strerror})") from error
    if not registered:
        raise DataError(f"{path}: holds no image; reconstruct again, or set model to the folder of another model")
    numbers = np.array([image[0] for image in registered])
    poses = from_quaternions(numbers[:, 4:], numbers[:, [1, 2, 3, 0]], path)
    images = []
    for (_, camera_id, name), T_cw in zip(registered, poses, strict=True):
        if camera_id not in cameras:
            raise DataError(f"{path}: image {name[:80]!r} has camera {camera_id}, which is not in {cameras_path.name}")
        images.append(ModelImage(name, T_cw, _pinhole(cameras[camera_id], f"{cameras_path}: camera {camera_id}")))
    return path, sorted(images, key=lambda image: natural(image.name))


def _pinhole(camera: Stated, where: str) -> Camera:
    model, width, height, parameters = camera
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise DataError(f"{where} has images of {width}x{height} pixels; {AGAIN}")
    _, focals = MODELS[model]
    if not focals or any(parameters[focals + 2 :]):
        raise DataError(
            f"{where} is {model}, which distorts; undistort the images ('colmap image_undistorter')"
            " and use the model that it writes"
        )
    cx, cy = parameters[focals : focals + 2]
    return Camera.stated((parameters[0], parameters[focals - 1], cx, cy), (width, height), where)


def _cameras_txt(file: BinaryIO, path: Path) -> Iterator[tuple[int, Stated]]:
    for line, text in numbered_lines(file):
        words = text.split()
        if not words or text.startswith("#"):
            continue
        model = words[1] if len(words) > 1 else ""
        if model not in MODELS or len(words) != 4 + MODELS[model][0]:
            raise DataError(f"{path}: line {line} is {text[:60]!r}; expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        camera_id, width, height = (_whole(words[k], path, line) for k in (0, 2, 3))
        yield camera_id, (model, width, height, [to_number(word, path, line) for word in words[4:]])


def _cameras_bin(file: BinaryIO, path: Path) -> Iterator[tuple[int, Stated]]:
    (count,) = _unpack(file, "<Q", path)
    for _ in range(count):
        camera_id, model_id, width, height = _unpack(file, "<IiQQ", path)
        if not 0 <= model_id < len(MODELS):
            raise DataError(
                f"{path}: camera {camera_id} has the model {model_id}, which is not known; undistort images"
            )
        model, (parameters, _) = [*MODELS.items()][model_id]
        yield camera_id, (model, width, height, [*_unpack(file, f"<{parameters}d", path)])


def _images_txt(file: BinaryIO, path: Path) -> Iterator[Registered]:
    """Yield the images, two lines each, of which the second, with its points, may be empty."""
    lines = numbered_lines(file)
    for line, text in lines:
        words = text.split(maxsplit=9)
        if not words or text.startswith("#"):
            continue
        if len(words) != 10:
            form = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise DataError(f"{path}: line {line} is {text[:60]!r}; expected {form}")
        yield [to_number(word, path, line) for word in words[1:8]], _whole(words[8], path, line), words[9]
        _, points = next(lines, (0, ""))
        if len(points.split()) % 3:
            raise DataError(f"{path}: line {line + 1} does not hold points X Y POINT3D_ID; an image has two lines")


def _images_bin(file: BinaryIO, path: Path) -> Iterator[Registered]:
    size = path.stat().st_size
    (count,) = _unpack(file, "<Q", path)
    for _ in range(count):
        _, *numbers, camera_id = _unpack(file, "<I7dI", path)
        start = file.tell()
        text, end, _ = file.read(MAX_NAME + 1).partition(b"\0")
        if not end:
            raise DataError(f"{path}: the name of an image does not end within {MAX_NAME} bytes; {AGAIN}")
        file.seek(start + len(text) + 1)
        name = text.decode("utf-8", errors="replace")
        (points,) = _unpack(file, "<Q", path)
        if points > (size - file.tell()) // 24:
            raise DataError(f"{path}: truncated in the points of image {name[:80]!r}; {AGAIN}")
        file.seek(24 * points, os.SEEK_CUR)
        yield numbers, camera_id, name


def _unpack(file: BinaryIO, layout: str, path: Path) -> tuple[Any, ...]:
    data = file.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise DataError(f"{path}: truncated after {file.tell()} bytes; {AGAIN}")
    return struct.unpack(layout, data)


def _whole(word: str, path: Path, line: int) -> int:
    value = to_number(word, path, line)
    if not value.is_integer() or abs(value) > 2**53:
        raise DataError(f"{path}: line {line}: {word[:40]!r} is not a whole number")
    return int(value)
