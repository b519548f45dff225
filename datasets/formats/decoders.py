"""Decoders of image files: stored samples of whole files, or one DataError with the file.

Checksums and claimed sizes are checked before a decoder reads the bytes, because decoders may return half an image for
a truncated file, or allocate what a damaged header claims.
"""

from __future__ import annotations

import functools
import io
import os
import re
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import UInt8
from semstab.datasets.formats.disk import AGAIN
from semstab.datasets.formats.image_sizes import FrameSize, check_photograph, check_pixels
from semstab.errors import DataError, summarize_error

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

# --- PNG and JPEG by Pillow, because OpenCV fills the rest of a truncated image with grey -----------------------------

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_CHANNELS: Mapping[int, int] = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
PNG_KINDS: Mapping[int, str] = {0: "grey", 2: "RGB", 3: "palette", 4: "grey+alpha", 6: "RGBA"}


@dataclass(frozen=True)
class Png:
    """A PNG whose checksums hold: its kind, the bits of a sample, and the image, which is not decoded yet."""

    path: Path
    data: bytes
    kind: str
    bits: int
    image: ImageFile

    def samples(self) -> npt.NDArray[Any]:
        """Return the stored samples (H, W) or (H, W, channels), uint8 or uint16; of a palette the indices."""
        if self.kind in ("RGB", "RGBA") or (self.kind == "grey" and self.bits >= 8):
            image: npt.NDArray[Any] = imdecode(
                self.path, _critical_chunks(self.data), "IMREAD_UNCHANGED"
            )  # a fifth faster than Pillow
            return image if self.kind == "grey" else image[..., [2, 1, 0, 3][: len(self.kind)]]
        samples = np.array(self.image)
        if self.kind != "grey":
            return samples
        # Pillow reads one bit as bool and stretches two and four to 0..255
        return samples.astype(np.uint8) if self.bits == 1 else samples // np.uint8(255 // (2**self.bits - 1))


def _critical_chunks(data: bytes) -> bytes:
    """Return a whole PNG without ancillary chunks, of which OpenCV complains on stderr."""
    parts, start = [PNG_SIGNATURE], len(PNG_SIGNATURE)
    while start < len(data):
        end = start + 12 + int.from_bytes(data[start : start + 4], "big")
        parts += [data[start:end]] if data[start + 4 : start + 5].isupper() else []
        start = end
    return b"".join(parts)


@contextmanager
def whole_png(
    path: Path, data: bytes, sizes: FrameSize | None = None, more: Mapping[str, int] = MappingProxyType({})
) -> Iterator[Png]:
    """Yield a PNG that is whole; it is decoded within the context.

    The size of a frame's file is checked first; `more` has the bytes that a pixel takes beyond the file's, by kind.
    """
    from PIL import PngImagePlugin

    if not data.startswith(PNG_SIGNATURE) or data[12:16] != b"IHDR":
        raise DataError(f"{path}: not a PNG image (it begins with {data[:8]!r}); {AGAIN}")
    with in_one_line(path, "PNG"):
        if sizes is not None and len(data) > 26:
            width, height, bits, colors = struct.unpack_from(">IIBB", data, 16)
            stored = PNG_CHANNELS.get(colors, 4) * max(1, bits // 8)
            check_pixels(path, width, height, stored + more.get(PNG_KINDS.get(colors, ""), 0), sizes)
        PngImagePlugin.PngImageFile(io.BytesIO(data)).verify()  # while it decodes, Pillow leaves out the checksums
        image = PngImagePlugin.PngImageFile(io.BytesIO(data))
        yield Png(path, data, PNG_KINDS[data[25]], data[24], image)


@contextmanager
def in_one_line(path: Path, what: str) -> Iterator[None]:
    """Turn the exceptions of Pillow for damaged files into DataError."""
    try:
        yield
    except DataError:
        raise
    except Exception as error:
        raise DataError(f"{path}: not a whole {what} image ({summarize_error(error)}); {AGAIN}") from error


def decode_jpeg(path: Path, data: bytes) -> UInt8:
    """Return RGB (H, W, 3)."""
    from PIL import JpegImagePlugin

    with in_one_line(path, "JPEG"):
        image = JpegImagePlugin.JpegImageFile(io.BytesIO(data))
        check_photograph(path, data, *image.size)
        return np.array(image.convert("RGB"))


# --- TIFF and EXR by OpenCV, twice as fast as Pillow ------------------------------------------------------------------


def decode_color_tiff(path: Path, data: bytes) -> UInt8:
    """Return RGB (H, W, 3) of an 8-bit image, or of a deeper one its upper bits."""
    tags = tiff_tags(path, data)
    check_photograph(path, data, tags[256], tags[257])
    channels = tags.get(277, 1)
    if channels not in (1, 3, 4):
        raise DataError(f"{path}: {channels} channels are no colour; save RGB")
    return np.ascontiguousarray(imdecode(path, data, "IMREAD_COLOR")[..., ::-1])


def decode_tiff(path: Path, data: bytes, sizes: FrameSize) -> npt.NDArray[Any]:
    """Return one channel (H, W), of the type it was stored in."""
    tags = tiff_tags(path, data)
    bits, channels, sample = tags.get(258, 1), tags.get(277, 1), tags.get(339, 1)
    if channels != 1:
        raise DataError(f"{path}: expected one channel of 32-bit float, got {channels} channels")
    if (sample, bits) not in ((3, 32), (3, 64), (1, 16)):
        kind = {1: "unsigned", 2: "signed", 3: "float"}.get(sample, "other")
        raise DataError(f"{path}: expected 32-bit float metres, got {bits}-bit {kind}; convert it")
    check_pixels(path, tags[256], tags[257], bits // 8 + (0 if bits == 32 else 4), sizes)
    return imdecode(path, data, "IMREAD_UNCHANGED")


def tiff_tags(path: Path, data: bytes) -> dict[int, int]:
    """Return the first value of each short or long tag of the first image of a TIFF, its size among them."""
    tags = {}
    try:
        order = {b"II*\0": "<", b"MM\0*": ">"}[data[:4]]
        (start,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, start)
        for entry in range(start + 2, start + 2 + 12 * count, 12):
            tag, kind, _, value = struct.unpack_from(order + "HHII", data, entry)
            (short,) = struct.unpack_from(order + "H", data, entry + 8)
            tags[tag] = short if kind == 3 else value
    except (struct.error, KeyError) as error:
        raise DataError(f"{path}: not a whole TIFF image; {AGAIN}") from error
    if not {256, 257} <= tags.keys():
        raise DataError(f"{path}: a TIFF image without a size; {AGAIN}")
    return tags


def decode_exr(path: Path, data: bytes, sizes: FrameSize) -> npt.NDArray[Any]:
    """Return one channel (H, W), where the installed OpenCV reads EXR at all (the wheels of OpenCV 5 do not)."""
    window = data.find(b"dataWindow\0box2i\0")
    if not data.startswith(b"v/1\x01") or window < 0 or len(data) < window + 37:
        raise DataError(f"{path}: not a whole EXR image; {AGAIN}")
    left, top, right, bottom = struct.unpack_from("<4i", data, window + 21)
    check_pixels(path, right - left + 1, bottom - top + 1, 4, sizes)
    if not reads_exr():
        raise DataError(
            f"{path}: the installed OpenCV cannot read EXR; convert the depth to .npy (float32 metres),"
            ' or pip install "opencv-python-headless<5"'
        )
    depth = imdecode(path, data, "IMREAD_UNCHANGED")
    if depth.ndim == 3 and (depth[..., :1] == depth[..., :3]).all():  # Blender writes depth as three equal channels
        depth = depth[..., 0]
    if depth.ndim != 2:
        raise DataError(f"{path}: expected one channel, got {depth.shape[2]}; export the depth channel alone")
    return depth


PFM_HEADER = re.compile(rb"P([Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,40})\s")


def decode_pfm(path: Path, data: bytes, sizes: FrameSize) -> npt.NDArray[Any]:
    """Return one channel (H, W) of a portable float map, whose rows go from the bottom to the top."""
    header = PFM_HEADER.match(data)
    if header is None:
        raise DataError(f"{path}: not a PFM image (it begins with {data[:8]!r}); {AGAIN}")
    width, height, channels = int(header[2]), int(header[3]), 1 if header[1] == b"f" else 3
    check_pixels(path, width, height, 4 * channels + 4, sizes)
    try:
        order = "<" if float(header[4]) < 0 else ">"
    except ValueError as error:
        raise DataError(f"{path}: not a whole PFM image; {AGAIN}") from error
    needed, available = 4 * width * height * channels, len(data) - header.end()
    if available < needed:
        raise DataError(f"{path}: truncated: {width}x{height} pixels need {needed} bytes, it has {available}; {AGAIN}")
    stored = np.frombuffer(data, f"{order}f4", width * height * channels, header.end())
    bits = stored.view(np.uint32).reshape(-1, channels)  # NaN, too, is what it is in the other channels
    if channels > 1 and (bits != bits[:, :1]).any():
        raise DataError(f"{path}: expected one channel, got {channels} that differ; export the depth channel alone")
    return stored.reshape(height, width, channels)[::-1, :, 0]


@functools.cache
def reads_exr() -> bool:
    """Return whether the installed OpenCV was built with EXR."""
    return re.search(r"OpenEXR:\s+(?!NO)\S", opencv().getBuildInformation()) is not None


@functools.cache
def opencv() -> ModuleType:
    """Return OpenCV, which then complains of damaged files by errors alone."""
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # a damaged file becomes a DataError
    return cv2


def imdecode(path: Path, data: bytes, mode: str) -> npt.NDArray[Any]:
    """Return an image as OpenCV decodes it, by the name of its mode."""
    cv2 = opencv()
    try:
        image: npt.NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), getattr(cv2, mode))
    except cv2.error as error:
        raise DataError(f"{path}: the image cannot be decoded ({summarize_error(error)}); {AGAIN}") from error
    if image is None:
        raise DataError(f"{path}: the image is damaged; {AGAIN}")
    return image
