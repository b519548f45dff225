"""PNG, JPEG, TIFF and EXR bytes to samples: a whole image, or one DataError with the file.

Checksums and claimed sizes are checked before a decoder sees the bytes, because the decoders return half an image for
a truncated file, or allocate what a damaged header claims.
"""

from __future__ import annotations

import functools
import io
import os
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import deflate  # its checksums take a twentieth of zlib's time
import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, UInt8
from semstab.datasets.formats import png_grey
from semstab.datasets.formats.disk import AGAIN
from semstab.errors import DataError, one_line

MAX_PIXELS = 2**28
MAX_IMAGE_BYTES = 2**29
"""Of a decoded image: RGB of 178 megapixels."""

# --- PNG ------------------------------------------------------------------------------------------------------------

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_CHANNELS: Mapping[int, int] = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
PNG_KINDS: Mapping[int, str] = {0: "grey", 2: "RGB", 3: "palette", 4: "grey+alpha", 6: "RGBA"}


@dataclass(frozen=True)
class Png:
    """A PNG whose checksums hold: its header, and the chunks that a decoder cannot do without."""

    path: Path
    header: tuple[int, ...]
    chunks: list[tuple[bytes, memoryview]]

    @property
    def kind(self) -> str:
        """What a pixel is: a name in `PNG_KINDS`."""
        return PNG_KINDS[self.header[3]]

    @property
    def bits(self) -> int:
        """Bits of a sample."""
        return self.header[2]

    def samples(self) -> npt.NDArray[Any]:
        """Samples (H, W) or, in RGB order, (H, W, channels), uint8 or uint16; palettes expanded."""
        if self.kind == "grey" and (quick := self._quickly()) is not None:
            return quick
        image = _imdecode(self.path, self._encoded(), "IMREAD_UNCHANGED")
        return image if image.ndim == 2 else image[..., [2, 1, 0, 3][: image.shape[2]]]

    def indices(self) -> npt.NDArray[Any]:
        """The stored sample (H, W) of each pixel of a grey or palette image: of palettes the index, not the colour."""
        if (quick := self._quickly()) is not None:
            return quick
        image = _imdecode(self.path, self._encoded(as_grey=True), "IMREAD_UNCHANGED")
        if self.bits < 8:  # the decoder stretches 1, 2 and 4 bits to 0..255
            image = image // np.uint8(255 // (2**self.bits - 1))
        return image

    def metres(self, scale: float) -> Float32:
        """Samples (H, W) of a 16-bit grey image, of which `scale` make a metre."""
        width, height, *_ = self.header
        quick = png_grey.decode_metres(width, height, scale, self._data()) if self._is_common() else None
        return np.divide(self.samples(), scale, dtype=np.float32, casting="same_kind") if quick is None else quick

    def rgb(self) -> UInt8:
        """Colour (H, W, 3) uint8 of an image of any kind."""
        return np.ascontiguousarray(_imdecode(self.path, self._encoded(), "IMREAD_COLOR")[..., ::-1])

    def _quickly(self) -> npt.NDArray[Any] | None:
        """The stored samples of a one-channel image of the common kind; None where only the other decoder knows."""
        width, height, bits, *_ = self.header
        return png_grey.decode(width, height, bits, self._data()) if self._is_common() else None

    def _is_common(self) -> bool:
        """Whether samples are whole bytes, deflated, filtered as usual, not interlaced."""
        _, _, bits, _, compression, filters, interlace = self.header
        return bits >= 8 and not (compression or filters or interlace)

    def _data(self) -> Iterator[memoryview]:
        return (body for kind, body in self.chunks if kind == b"IDAT")

    def _encoded(self, as_grey: bool = False) -> bytes:
        """A PNG of these chunks; a palette image declared grey decodes to its indices."""
        width, height, bits, color_type, *rest = self.header
        ihdr = struct.pack(">IIBBBBB", width, height, bits, 0 if as_grey else color_type, *rest)
        dropped = (b"IHDR", b"PLTE") if as_grey else (b"IHDR",)
        kept = (_png_chunk(kind, body) for kind, body in self.chunks if kind not in dropped)
        return b"".join((PNG_SIGNATURE, _png_chunk(b"IHDR", ihdr), *kept))


def _png_chunk(kind: bytes, body: bytes | memoryview) -> bytes:
    return b"".join((struct.pack(">I", len(body)), kind, body, struct.pack(">I", zlib.crc32(body, zlib.crc32(kind)))))


def parse_png(path: Path, data: bytes) -> Png:
    """Check every chunk up to the end marker; drop the ancillary ones, of which decoders complain on stderr."""
    if not data.startswith(PNG_SIGNATURE):
        raise DataError(f"{path}: not a PNG image (it begins with {data[:8]!r}); {AGAIN}")
    view, start = memoryview(data), len(PNG_SIGNATURE)
    chunks: list[tuple[bytes, memoryview]] = []
    while not chunks or chunks[-1][0] != b"IEND":
        end = start + 12 + int.from_bytes(view[start : start + 4], "big")
        if end > len(data):
            raise DataError(f"{path}: the PNG is truncated after {len(data)} bytes; {AGAIN}")
        if deflate.crc32(view[start + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            raise DataError(f"{path}: the PNG is damaged (checksum of the chunk at byte {start}); {AGAIN}")
        kind = data[start + 4 : start + 8]
        if kind[:1].isupper():
            chunks.append((kind, view[start + 8 : end - 4]))
        start = end
    if chunks[0][0] != b"IHDR" or len(chunks[0][1]) != 13:
        raise DataError(f"{path}: the PNG has no header; {AGAIN}")
    width, height, bits, color_type, *_ = header = struct.unpack(">IIBBBBB", chunks[0][1])
    if color_type not in PNG_KINDS or bits not in (1, 2, 4, 8, 16):
        raise DataError(f"{path}: the PNG header is damaged (colour type {color_type}, {bits} bits); {AGAIN}")
    _check_pixels(path, width, height, PNG_CHANNELS[color_type] * max(1, bits // 8))
    return Png(path, header, chunks)


# --- JPEG, TIFF, EXR ------------------------------------------------------------------------------------------------


def decode_jpeg(path: Path, data: bytes) -> UInt8:
    """RGB (H, W, 3). Pillow, because OpenCV fills the rest of a truncated JPEG with grey."""
    from PIL import JpegImagePlugin

    damage = (OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, struct.error, ZeroDivisionError)
    try:
        image = JpegImagePlugin.JpegImageFile(io.BytesIO(data))
        _check_pixels(path, *image.size, 3)
        return np.array(image.convert("RGB"))
    except DataError:
        raise
    except damage as error:
        raise DataError(f"{path}: not a whole JPEG image ({one_line(error)}); {AGAIN}") from error


def decode_color_tiff(path: Path, data: bytes) -> UInt8:
    """RGB (H, W, 3) of an 8-bit image, or of a deeper one its upper bits."""
    channels = _checked_tags(path, data, pixel_bytes=3).get(277, 1)
    if channels not in (1, 3, 4):
        raise DataError(f"{path}: {channels} channels are no colour; save RGB")
    return np.ascontiguousarray(_imdecode(path, data, "IMREAD_COLOR")[..., ::-1])


def decode_tiff(path: Path, data: bytes) -> npt.NDArray[Any]:
    """One channel (H, W), of the type it was stored in."""
    tags = _checked_tags(path, data)
    bits, channels, sample = tags.get(258, 1), tags.get(277, 1), tags.get(339, 1)
    if channels != 1:
        raise DataError(f"{path}: expected one channel of 32-bit float, found {channels} channels")
    if (sample, bits) not in ((3, 32), (3, 64), (1, 16)):
        kind = {1: "unsigned", 2: "signed", 3: "float"}.get(sample, "other")
        raise DataError(f"{path}: expected 32-bit float metres, found {bits}-bit {kind}; convert it")
    return _imdecode(path, data, "IMREAD_UNCHANGED")


def _checked_tags(path: Path, data: bytes, pixel_bytes: int = 1) -> dict[int, int]:
    """The tags of a TIFF whose size can be read."""
    try:
        tags = _tiff_tags(data)
        width, height = tags[256], tags[257]
    except (struct.error, KeyError) as error:
        raise DataError(f"{path}: not a whole TIFF image; {AGAIN}") from error
    _check_pixels(path, width, height, pixel_bytes)
    return tags


def _tiff_tags(data: bytes) -> dict[int, int]:
    """The first value of each short or long tag of the first image. Raises struct.error, KeyError where damaged."""
    order = {b"II*\0": "<", b"MM\0*": ">"}[data[:4]]
    (start,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, start)
    tags = {}
    for entry in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind, _, value = struct.unpack_from(order + "HHII", data, entry)
        (short,) = struct.unpack_from(order + "H", data, entry + 8)
        tags[tag] = short if kind == 3 else value
    return tags


def decode_exr(path: Path, data: bytes) -> npt.NDArray[Any]:
    """One channel (H, W), where the installed OpenCV reads EXR at all (the wheels of OpenCV 5 do not)."""
    window = data.find(b"dataWindow\0box2i\0")
    if not data.startswith(b"v/1\x01") or window < 0 or len(data) < window + 37:
        raise DataError(f"{path}: not a whole EXR image; {AGAIN}")
    left, top, right, bottom = struct.unpack_from("<4i", data, window + 21)
    _check_pixels(path, right - left + 1, bottom - top + 1)
    if not reads_exr():
        raise DataError(
            f"{path}: the installed OpenCV cannot read EXR; convert the depth to .npy (float32 metres),"
            ' or pip install "opencv-python-headless<5"'
        )
    depth = _imdecode(path, data, "IMREAD_UNCHANGED")
    if depth.ndim == 3 and (depth[..., :1] == depth[..., :3]).all():  # Blender writes depth as three equal channels
        depth = depth[..., 0]
    if depth.ndim != 2:
        raise DataError(f"{path}: expected one channel, found {depth.shape[2]}; export the depth channel alone")
    return depth


# --- OpenCV ---------------------------------------------------------------------------------------------------------


@functools.cache
def reads_exr() -> bool:
    """Whether the installed OpenCV was built with EXR."""
    return re.search(r"OpenEXR:\s+(?!NO)\S", _opencv().getBuildInformation()) is not None


@functools.cache
def _opencv() -> ModuleType:
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # a damaged file becomes a DataError
    return cv2


def _imdecode(path: Path, data: bytes, mode: str) -> npt.NDArray[Any]:
    cv2 = _opencv()
    try:
        image: npt.NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), getattr(cv2, mode))
    except cv2.error as error:
        raise DataError(f"{path}: the image cannot be decoded ({one_line(error)}); {AGAIN}") from error
    if image is None:
        raise DataError(f"{path}: the image is damaged; {AGAIN}")
    return image


def _check_pixels(path: Path, width: int, height: int, pixel_bytes: int = 1) -> None:
    """Before memory is allocated for what a header claims."""
    most = min(MAX_PIXELS, MAX_IMAGE_BYTES // pixel_bytes)
    if not (width > 0 and height > 0 and width * height <= most):
        raise DataError(f"{path}: claims {width}x{height} pixels (at most {most} are read); is it damaged?")
