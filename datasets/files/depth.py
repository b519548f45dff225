"""Depth maps of a file a frame, of every kind: metres, or one DataError with the file."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from semstab.core.types import Float32
from semstab.data.frames import Intrinsics
from semstab.datasets.files.options import DepthReader, FileOptions, FrameSource
from semstab.datasets.formats.disk import AGAIN, read_bytes
from semstab.datasets.formats.image_sizes import ANY_SIZE, MAX_PIXELS, FrameSize
from semstab.datasets.formats.images import MILLIMETRES, Read, color_size, read_depth
from semstab.datasets.geometry.cameras import planar
from semstab.datasets.geometry.lenses import undistorted
from semstab.errors import DataError

# Depth maps of multi-view stereo programs: MVE's .mvei, OpenMVS's .dmap, COLMAP's .bin.
#
# Sources: Fuhrmann et al., MVE, GCH 2014 (libs/mve/image_io); openMVS (libs/MVS/Interface.h, HeaderDepthDataRaw);
# colmap.github.io/format.html.

MVEI = b"\x89MVE_IMAGE\n"
MVEI_HEADER = struct.Struct("<4i")
MVEI_FLOAT = 9
"""Type of a sample: 32-bit float."""

DMAP_HEADER = struct.Struct("<2sBb4I2f")
"""Magic, the kind of content, exponent; width and height of the image, then of the depth; least and largest depth."""
DMAP_CAMERA = 21 * 8
"""Bytes of K, R and C."""
HEADER_BYTES = 2**18
"""The bytes in which all that `dmap_header` reads lies: a name and the numbers of some thousand neighbours at most."""
SAMPLES: Mapping[bytes, np.dtype[Any]] = {b"DR": np.dtype("<f4"), b"D2": np.dtype("<f2")}
"""Type of a sample by magic; newer files hold halves, which times 2 ** exponent are metres."""


def read_mvei(path: Path, scale: float | None = None, read: Read = read_bytes) -> Float32:
    """Return depth (H, W) of a depth-LN.mvei, float32, as lengths of rays; 0 for pixels without depth.

    `scale` is units in a metre.

    Raises:
        DataError: If the file is no depth map, or truncated.
    """
    data = read(path)
    start = len(MVEI) + MVEI_HEADER.size
    if not data.startswith(MVEI) or len(data) < start:
        raise DataError(f"{path}: not an MVE image (it begins with {data[:11]!r}); {AGAIN}")
    width, height, channels, kind = MVEI_HEADER.unpack_from(data, len(MVEI))
    if (channels, kind) != (1, MVEI_FLOAT):
        raise DataError(f"{path}: {channels} channels of type {kind}; a depth map has one of type {MVEI_FLOAT} (float)")
    return _metres(path, data, start, (height, width), np.dtype("<f4"), scale or 1)


@dataclass(frozen=True)
class DmapHeader:
    """The header of a .dmap: shape (H, W), samples of `dtype` from byte `start`, times 2 ** exponent.

    Attributes:
        image: The name of the file that it is of.
    """

    image: str
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    exponent: int
    start: int


def dmap_header(path: Path, data: bytes) -> DmapHeader:
    """Read it from the first bytes of a file, a few thousand suffice.

    Raises:
        DataError: If it is none.
    """
    magic = data[:2]
    if magic not in SAMPLES or len(data) < DMAP_HEADER.size:
        raise DataError(f"{path}: not an OpenMVS depth map (it begins with {magic!r}); {AGAIN}")
    _, holds, exponent, _, _, width, height, _, _ = DMAP_HEADER.unpack_from(data)
    new = magic == b"D2"
    offset = DMAP_HEADER.size + (4 if new else 0)  # after the scale of confidences
    try:
        (length,) = struct.unpack_from("<H", data, offset)
        name = data[offset + 2 : offset + 2 + length].decode(errors="replace")
        offset += 2 + length
        (views,) = struct.unpack_from("<I", data, offset)
    except struct.error as error:
        raise DataError(f"{path}: the depth map is truncated after {len(data)} bytes; {AGAIN}") from error
    if not holds & 1:
        raise DataError(f"{path}: holds no depth; {AGAIN}")
    start = offset + 4 + 4 * views + DMAP_CAMERA  # beyond the file where that is damaged, which `_metres` says
    return DmapHeader(name, (height, width), SAMPLES[magic], exponent if new else 0, start)


def read_dmap(path: Path, scale: float | None = None, read: Read = read_bytes) -> Float32:
    """Return depth (H, W) of a .dmap along the optical axis, float32, 0 without depth; raises as `read_mvei`."""
    data = read(path)
    header = dmap_header(path, data)
    return _metres(path, data, header.start, header.shape, header.dtype, (scale or 1) / 2.0**header.exponent)


def read_depth_map(path: Path, scale: float | None = None, read: Read = read_bytes) -> Float32:
    """Return depth (H, W) of COLMAP's .bin, float32: the text 'width&height&channels&', then values, x fastest.

    `scale` is units in a metre.

    Raises:
        DataError: For a normal map, another format, or a truncated file.
    """
    data = read(path)
    header = re.match(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&", data)
    if header is None:
        raise DataError(f"{path}: not a depth map of COLMAP (it begins with {data[:12]!r}); {AGAIN}")
    width, height, channels = (int(number) for number in header.groups())
    if channels != 1:
        raise DataError(f"{path}: has {channels} channels (a normal map?); set depth to the depth maps")
    return _metres(path, data, header.end(), (height, width), np.dtype("<f4"), scale or 1)


def _metres(path: Path, data: bytes, start: int, shape: tuple[int, int], dtype: np.dtype[Any], scale: float) -> Float32:
    """Return samples (H, W) of `scale` units in a metre as float32 metres.

    Raises:
        DataError: If some are missing.
    """
    if not (min(shape) > 0 and math.prod(shape) <= MAX_PIXELS):
        raise DataError(f"{path}: claims {shape[1]}x{shape[0]} pixels; is it damaged?")
    end = start + math.prod(shape) * dtype.itemsize
    if len(data) < end:
        raise DataError(
            f"{path}: truncated: {shape[1]}x{shape[0]} pixels need {end} bytes, it has {len(data)}; {AGAIN}"
        )
    stored = np.frombuffer(data, dtype, math.prod(shape), start).reshape(shape)
    with np.errstate(all="ignore"):  # beyond float32 becomes inf: invalid, as it should
        metres: Float32 = np.divide(stored, scale, dtype=np.float32, casting="same_kind")
    return metres


FORMATS = {".bin": read_depth_map, ".mvei": read_mvei, ".dmap": read_dmap}
"""Functions that read depth, by the suffix of the file; `read_depth` reads the others."""


def stored_scale(frame: FrameSource, options: FileOptions) -> float:
    """Return units of a frame's depth file in a metre: the units of the options, else the usual units of its kind."""
    usual = MILLIMETRES if frame.depth.suffix.lower() == ".png" else 1.0
    return options.depth_scale or frame.depth_scale or usual


def stored_depth(
    frame: FrameSource,
    options: FileOptions,
    read: Read,
    camera: Callable[[tuple[int, int]], Intrinsics],
    allowed_sizes: FrameSize = ANY_SIZE,
) -> Float32:
    """Return depth (H, W) of a frame's file in metres along the optical axis; values that mean 'no depth' become 0.

    Args:
        frame: The frame whose depth is read.
        options: The settings of the dataset's files.
        read: Reads the content of a file.
        camera: Gives the intrinsics of the depth image of a shape.
        allowed_sizes: The sizes that the frame's files may have.
    """
    scale = options.depth_scale or frame.depth_scale
    depth = _reader(frame, allowed_sizes)(frame.depth, scale, read)
    if np.isnan(depth[0, 0]) and np.isnan(depth).all():  # one frame that saw nothing ends no run; it is counted
        depth = np.zeros_like(depth)
    for value in options.invalid_depth:
        with np.errstate(over="ignore"):
            depth[depth == np.float32(value) / np.float32(stored_scale(frame, options))] = 0
    if options.depth_kind == "inverse":
        with np.errstate(over="ignore", divide="ignore"):
            depth = np.where(depth > 0, 1 / depth, np.float32(0)).astype(np.float32)
    if options.max_depth is not None:
        depth[depth >= options.max_depth] = 0
    if frame.depth_lens is not None:
        K = camera((depth.shape[0], depth.shape[1]))
        depth = undistorted(depth, frame.depth_lens, K, (depth.shape[0], depth.shape[1]), str(frame.depth), "depth is")
    return planar(depth, camera((depth.shape[0], depth.shape[1]))) if options.depth_kind == "ray" else depth


def _reader(frame: FrameSource, sizes: FrameSize = ANY_SIZE) -> DepthReader:
    """Return what reads a frame's depth: its own reader, or the one of the file's suffix."""
    return frame.depth_reader or FORMATS.get(frame.depth.suffix.lower(), partial(read_depth, allowed_sizes=sizes))


def shape_of(frame: FrameSource, options: FileOptions) -> tuple[int, int]:
    """Return (H, W) of the depth of a frame: the size of its camera, else of its depth file or colour image.

    Raises:
        DataError: If none is known.
    """
    size = options.intrinsics_size or frame.camera.size
    if size is not None:
        return size[1], size[0]
    if frame.depth.is_file():
        H, W = _reader(frame)(frame.depth, 1.0, Path.read_bytes).shape
        return H, W
    if frame.label_camera is not None or frame.color is None or not frame.color.is_file():
        raise DataError(f"{frame.color or frame.name}: no colour image gives the size of depth; set intrinsics_size")
    width, height = color_size(frame.color)
    return height, width
