"""COLMAP's sparse models, text and binary: the cameras and the images; points are skipped.

The formats are those of colmap.github.io/format.html. Its own reader in Python is not used, because it needs points
and rigs as well, loads them all, and allocates what a damaged file claims.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np

from semstab.core.files import open_file
from semstab.datasets.formats.disk import AGAIN, natural, to_number
from semstab.datasets.geometry.cameras import Camera, Poses, from_quaternions
from semstab.errors import DataError
from semstab.model.frames import Intrinsics

MODELS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip
"""By model id."""
PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16)
FOCALS = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2, "SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2, "FULL_OPENCV": 2}
"""Focal lengths among the parameters of the models that are a pinhole where their distortion is zero."""

MAX_SIDE = 2**24
MAX_NAME = 1000


@dataclass(frozen=True, eq=False)
class ModelImage:
    """One registered image: its name in the model, its pose (4, 4) world-to-camera, its camera."""

    name: str
    T_cw: Poses
    camera: Camera


def has_model(folder: Path) -> bool:
    """Whether a folder holds a sparse model."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_model(folder: Path) -> tuple[Path, list[ModelImage]]:
    """The file of the images, and the images in the natural order of their names; binary files go before text.

    Raises DataError for a damaged file, an image without its camera, or a camera that distorts.
    """
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    path = folder / f"images{suffix}"
    cameras = dict(_cameras_bin(folder / "cameras.bin") if suffix == ".bin" else _cameras_txt(folder / "cameras.txt"))
    records = list(_images_bin(path) if suffix == ".bin" else _images_txt(path))
    if not records:
        raise DataError(f"{path}: holds no image; reconstruct again, or set model to the folder of another model")
    numbers = np.array([record[0] for record in records])
    poses = from_quaternions(numbers[:, 4:], numbers[:, [1, 2, 3, 0]], path)
    images = []
    for (_, camera_id, name), T_cw in zip(records, poses, strict=True):
        if camera_id not in cameras:
            raise DataError(f"{path}: image {name[:80]!r} has camera {camera_id}, which is not in cameras{suffix}")
        images.append(ModelImage(name, T_cw, _pinhole(cameras[camera_id], camera_id, folder / f"cameras{suffix}")))
    return path, sorted(images, key=lambda image: natural(image.name))


def image_name(name: str) -> str:
    """The name of an image in the model without its suffix: what path templates call the frame."""
    return os.path.splitext(name)[0]  # noqa: PTH122  a name, not a path


# --- cameras --------------------------------------------------------------------------------------------------------

Stated = tuple[str, tuple[int, int], list[float]]
"""A camera as it is written: model, (width, height), parameters."""


def _pinhole(camera: Stated, camera_id: int, path: Path) -> Camera:
    model, size, parameters = camera
    focals = FOCALS.get(model)
    if focals is None or any(parameters[focals + 2 :]):
        raise DataError(
            f"{path}: camera {camera_id} is {model}, which distorts; undistort the images ('colmap image_undistorter')"
            " and use the model that it writes"
        )
    fx, fy, (cx, cy) = parameters[0], parameters[focals - 1], parameters[focals : focals + 2]
    try:
        return Camera(Intrinsics(fx, fy, cx, cy), size)
    except DataError as error:
        raise DataError(f"{path}: camera {camera_id}: {error}") from error


def _cameras_txt(path: Path) -> Iterator[tuple[int, Stated]]:
    with _opened(path) as file:
        for line, text in _lines(file):
            words = text.split()
            if not text or text.startswith("#"):
                continue
            model = words[1] if len(words) > 1 else ""
            if model not in MODELS or len(words) != 4 + PARAMETERS[MODELS.index(model)]:
                raise DataError(f"{path}: line {line} is {text[:60]!r}; expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
            width, height = (int(_whole(word, path, line)) for word in words[2:4])
            parameters = [to_number(word, path, line) for word in words[4:]]
            yield int(_whole(words[0], path, line)), (model, _size(width, height, path), parameters)


def _cameras_bin(path: Path) -> Iterator[tuple[int, Stated]]:
    with _opened(path) as file:
        (count,) = _unpack(file, "<Q", path)
        for _ in range(count):
            camera_id, model_id, width, height = _unpack(file, "<IiQQ", path)
            if not 0 <= model_id < len(MODELS):
                raise DataError(
                    f"{path}: camera {camera_id} has the model {model_id}, which is not known; undistort the images"
                )
            parameters = list(_unpack(file, f"<{PARAMETERS[model_id]}d", path))
            yield camera_id, (MODELS[model_id], _size(width, height, path), parameters)


def _size(width: int, height: int, path: Path) -> tuple[int, int]:
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise DataError(f"{path}: a camera has images of {width}x{height} pixels; {AGAIN}")
    return width, height


# --- images ---------------------------------------------------------------------------------------------------------

Record = tuple[list[float], int, str]
"""An image as it is written: [qw qx qy qz tx ty tz], camera id, name."""


def _images_txt(path: Path) -> Iterator[Record]:
    """Each image has two lines, of which the second, with its points, may be empty."""
    with _opened(path) as file:
        lines = _lines(file)
        for line, text in lines:
            if not text or text.startswith("#"):
                continue
            words = text.split(maxsplit=9)
            if len(words) != 10:
                raise DataError(
                    f"{path}: line {line} is {text[:60]!r}; expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
                )
            numbers = [to_number(word, path, line) for word in words[1:8]]
            yield numbers, int(_whole(words[8], path, line)), words[9]
            _, points = next(lines, (0, ""))
            if len(points.split()) % 3:
                raise DataError(f"{path}: line {line + 1} does not hold points X Y POINT3D_ID; an image has two lines")


def _images_bin(path: Path) -> Iterator[Record]:
    size = path.stat().st_size if path.is_file() else 0
    with _opened(path) as file:
        (count,) = _unpack(file, "<Q", path)
        for _ in range(count):
            _, *numbers, camera_id = _unpack(file, "<I7dI", path)
            name = _name(file, path)
            (points,) = _unpack(file, "<Q", path)
            if points > (size - file.tell()) // 24:
                raise DataError(f"{path}: truncated in the points of image {name[:80]!r}; {AGAIN}")
            file.seek(24 * points, 1)
            yield numbers, camera_id, name


def _name(file: BufferedReader, path: Path) -> str:
    """A text up to a zero byte."""
    start = file.tell()
    text, end, _ = file.read(MAX_NAME + 1).partition(b"\0")
    if not end:
        raise DataError(f"{path}: the name of an image does not end within {MAX_NAME} bytes; {AGAIN}")
    file.seek(start + len(text) + 1)
    return text.decode("utf-8", errors="replace")


# --- files ----------------------------------------------------------------------------------------------------------


def _opened(path: Path) -> BufferedReader:
    try:
        return open_file(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error


def _lines(file: BufferedReader) -> Iterator[tuple[int, str]]:
    """Number and stripped text of every line: images.txt can be gigabytes of points, so it is not read whole."""
    for number, line in enumerate(file, start=1):
        yield number, line.decode("utf-8", errors="replace").strip()


def _unpack(file: BufferedReader, layout: str, path: Path) -> tuple[Any, ...]:
    data = file.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise DataError(f"{path}: truncated after {file.tell()} bytes; {AGAIN}")
    return struct.unpack(layout, data)


def _whole(word: str, path: Path, line: int) -> float:
    value = to_number(word, path, line)
    if not value.is_integer() or abs(value) > 2**53:
        raise DataError(f"{path}: line {line}: {word[:40]!r} is not a whole number")
    return value
