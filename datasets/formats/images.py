"""Depth, labels, scores and colour of image files: of the right kind and unit, or one DataError with the file.

Checksums and claimed sizes are checked before a decoder reads the bytes, because decoders may return half an image for
a truncated file, or allocate what a damaged header claims.
"""

from __future__ import annotations

import functools
import io
import os
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Mask, UInt8, UInt16, UInt32
from semstab.datasets.formats.disk import AGAIN, MAX_SCORE_BYTES, decode_array, read_bytes
from semstab.datasets.geometry.lenses import Labels
from semstab.errors import ConfigError, DataError, one_line
from semstab.model.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace

DEPTH_SUFFIXES = (".png", ".npy", ".npz", ".exr", ".tiff", ".tif")
LABEL_SUFFIXES = (".png", ".npy", ".npz")
SCORE_SUFFIXES = (".npz", ".npy")
COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
MASK_SUFFIXES = (".png",)

MILLIMETRES = 1000.0
NO_CLASS = IGNORE_16BIT
PIXELS_AT_ONCE = 2**20
"""Pixels of a label map of colours at a time: the lookup takes many times the memory of the image."""

MAX_PIXELS = 2**28
MAX_IMAGE_BYTES = 2**29
"""Largest decoded image: RGB of 178 megapixels."""

Size = tuple[int, int]
Read = Callable[[Path], bytes]


def read_depth(path: Path, scale: float | None = None, read: Read = read_bytes) -> Float32:
    """Depth (H, W) in metres, float32, as stored: what marks a pixel invalid stays.

    `scale` is units per metre; not given, a 16-bit PNG holds millimetres and float files hold metres.
    Raises DataError for another type, more than one channel, integers without a scale, or a damaged file.
    """
    data = read(path)
    suffix = path.suffix.lower()
    if suffix == ".png":
        depth, scale = _decode_depth_png(path, data), scale or MILLIMETRES
    elif suffix in (".tiff", ".tif"):
        depth = _decode_tiff(path, data)
    elif suffix == ".exr":
        depth = _decode_exr(path, data)
    else:
        depth = decode_array(path, data, "depth")
    if depth.ndim != 2 or depth.dtype.kind not in "fui":
        raise DataError(f"{path}: depth is {depth.dtype} of shape {depth.shape}; store float32 metres (H, W)")
    if scale is None and depth.dtype.kind != "f":
        raise DataError(f"{path}: depth is {depth.dtype}, of unknown unit; set depth_scale (units per metre)")
    with np.errstate(all="ignore"):  # beyond float32 becomes inf: invalid, as it should
        metres: Float32 = np.divide(depth, scale or 1, dtype=np.float32, casting="same_kind")
    return metres


def read_labels(path: Path, space: LabelSpace | None = None, read: Read = read_bytes) -> Labels:
    """Class ids (H, W) uint8 or uint16, in the ids of the file; RGB maps through the colours of `space`.

    Wider integers are narrowed. Raises DataError for a colour or an id that no class can have, an RGB map without
    `space`, another type, or a damaged file.
    """
    data = read(path)
    if path.suffix.lower() != ".png":
        return _narrow(path, decode_array(path, data, "labels"), space)
    png = parse_png(path, data)
    if png.kind in ("grey", "palette"):
        return png.indices()
    if png.kind not in ("RGB", "RGBA") or png.bits != 8:
        raise DataError(f"{path}: a {png.bits}-bit {png.kind} PNG cannot hold labels; save ids as 8- or 16-bit grey")
    if space is None:
        raise DataError(f"{path}: the labels are colours; set classes or taxonomy, so that each has a class")
    return _labels_by_color(path, _opaque(path, png.samples()), space)


def read_scores(
    path: Path, layout: Literal["KHW", "HWK"], size: Size, read: Read = read_bytes
) -> npt.NDArray[np.floating[Any]]:
    """Soft scores (H, W, K) float16, float32 or float64, C-contiguous; `layout` is the file's.

    `size` is (H, W) of the depth, to recognise the other layout. Raises DataError where the file has another
    type or layout, or is damaged.
    """
    scores = decode_array(path, read(path), "scores", MAX_SCORE_BYTES)
    if scores.ndim != 3 or scores.dtype.kind != "f":
        raise DataError(
            f"{path}: scores must be float16 or float32 with three axes, got {scores.dtype} of shape {scores.shape}"
        )
    sizes = {"KHW": scores.shape[1:], "HWK": scores.shape[:2]}
    other = "HWK" if layout == "KHW" else "KHW"
    if sizes[layout] != size and sizes[other] == size:
        raise DataError(f"{path}: scores of shape {scores.shape} are not {layout}; set scores_layout: {other}")
    return np.ascontiguousarray(scores.transpose(1, 2, 0) if layout == "KHW" else scores)


def read_mask(path: Path, read: Read = read_bytes) -> Mask:
    """Mask (H, W) bool, True where the image is 0: black is left out, as COLMAP and nerfstudio have it.

    Raises DataError where it is no one-channel PNG, or damaged.
    """
    png = parse_png(path, read(path))
    if png.kind not in ("grey", "palette"):
        raise DataError(f"{path}: a {png.bits}-bit {png.kind} PNG is no mask; save it as grey, 0 where left out")
    mask: Mask = png.indices() == 0
    return mask


def read_color(path: Path) -> UInt8:
    """Colour (H, W, 3) uint8 RGB from PNG, JPEG or TIFF, not rotated by EXIF. Raises DataError for a damaged file."""
    data = read_bytes(path)
    suffix = path.suffix.lower()
    if suffix == ".png":
        return parse_png(path, data).rgb()
    return _decode_color_tiff(path, data) if suffix in (".tif", ".tiff") else _decode_jpeg(path, data)


def color_size(path: Path) -> Size:
    """(width, height) of a colour image, from its header. Raises DataError where that is damaged."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: not an image ({one_line(error)})") from error


def _decode_depth_png(path: Path, data: bytes) -> npt.NDArray[Any]:
    png = parse_png(path, data)
    if png.kind != "grey" or png.bits != 16:
        raise DataError(
            f"{path}: expected 16-bit grey, found {png.bits}-bit {png.kind} (a picture of the depth?);"
            " export the depth values"
        )
    return png.samples()


# --- labels ---------------------------------------------------------------------------------------------------------


def _narrow(path: Path, ids: npt.NDArray[Any], space: LabelSpace | None) -> Labels:
    """Integer ids of any width as uint8 where the classes (without `space`: the ids) fit, else uint16."""
    if ids.ndim != 2 or ids.size == 0 or ids.dtype.kind not in "ui":
        raise DataError(f"{path}: labels must be integer ids (H, W), got {ids.dtype} of shape {ids.shape}")
    if ids.dtype in (np.uint8, np.uint16):
        return ids
    low, high = int(ids.min()), int(ids.max())
    if low < 0 or high > IGNORE_16BIT:
        raise DataError(f"{path}: label ids from {low} to {high}; store ids from 0, and 255 (65535) for 'ignore'")
    fits = high <= IGNORE_8BIT and (space is None or max(space.ids) < IGNORE_8BIT)
    return ids.astype(np.uint8) if fits else ids.astype(np.uint16)


def _opaque(path: Path, image: UInt8) -> UInt8:
    """RGB of an RGB or fully opaque RGBA image."""
    if image.shape[2] == 4 and (transparent := image[..., 3] < 255).any():
        y, x = np.argwhere(transparent)[0]
        raise DataError(f"{path}: pixel ({x}, {y}) is transparent, so its label colour is not exact; save as RGB")
    return image[..., :3]


def _labels_by_color(path: Path, rgb: UInt8, space: LabelSpace) -> Labels:
    table, (H, W) = _ids_by_color(space), rgb.shape[:2]
    ids = np.empty((H, W), dtype=np.uint8 if max(space.ids) < IGNORE_8BIT else np.uint16)
    rows, count, first = max(1, PIXELS_AT_ONCE // W), 0, (0, 0)
    for top in range(0, H, rows):
        part = table[_packed(rgb[top : top + rows])]
        if (unknown := part == NO_CLASS).any():
            y, x = np.argwhere(unknown)[0]
            first = first if count else (top + int(y), int(x))
            count += int(np.count_nonzero(unknown))
        ids[top : top + rows] = part
    if count:
        raise DataError(
            f"{path}: colour {tuple(rgb[first].tolist())} at pixel ({first[1]}, {first[0]}) ({count} pixels) is no"
            f" class of '{space.name}'; set taxonomy to the one whose colours the image has"
        )
    return ids


@functools.lru_cache(maxsize=2)
def _ids_by_color(space: LabelSpace) -> UInt16:
    """(2^24,) class id of each packed colour. Raises ConfigError where two classes share a colour."""
    if len(set(space.colors)) < len(space):
        shared = next(color for color in space.colors if space.colors.count(color) > 1)
        raise ConfigError(f"taxonomy {space.name}: two classes have the colour {shared}; give each its own")
    table = np.full(1 << 24, NO_CLASS, dtype=np.uint16)
    table[_packed(np.array(space.colors, dtype=np.uint8))] = space.ids
    return table


def _packed(rgb: UInt8) -> UInt32:
    """RGB (..., 3) as one 24-bit number each."""
    r, g, b = (rgb[..., channel].astype(np.uint32) for channel in range(3))
    return (r << np.uint32(16)) | (g << np.uint32(8)) | b


# --- PNG ------------------------------------------------------------------------------------------------------------

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_CHANNELS: Mapping[int, int] = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
PNG_KINDS: Mapping[int, str] = {0: "grey", 2: "RGB", 3: "palette", 4: "grey+alpha", 6: "RGBA"}


@dataclass(frozen=True)
class Png:
    """A PNG whose checksums hold: its kind, bits of a sample, all chunks, and the bytes without ancillary chunks."""

    path: Path
    kind: str
    bits: int
    chunks: list[tuple[bytes, memoryview]]
    data: bytes

    def samples(self) -> npt.NDArray[Any]:
        """Samples (H, W) or, in RGB order, (H, W, channels), uint8 or uint16; palettes expanded."""
        image = self._decode("IMREAD_UNCHANGED")
        return image if image.ndim == 2 else image[..., [2, 1, 0, 3][: image.shape[2]]]

    def indices(self) -> npt.NDArray[Any]:
        """The stored sample (H, W) of each pixel of a grey or palette image: of a palette the index, not the colour."""
        image = self._decode("IMREAD_UNCHANGED", as_grey=True)
        if self.bits < 8:  # the decoder stretches 1, 2 and 4 bits to 0..255
            image = image // np.uint8(255 // (2**self.bits - 1))
        return image

    def rgb(self) -> UInt8:
        """Colour (H, W, 3) uint8 of an image of any kind."""
        return np.ascontiguousarray(self._decode("IMREAD_COLOR")[..., ::-1])

    def _decode(self, mode: str, as_grey: bool = False) -> npt.NDArray[Any]:
        """Decode the chunks; a palette image that is declared grey decodes to its indices."""
        data = self.data
        if as_grey and self.kind == "palette":
            header = bytearray(self.chunks[0][1])
            header[17] = 0  # colour type grey
            header[21:] = struct.pack(">I", zlib.crc32(header[4:21]))
            data = b"".join(
                (PNG_SIGNATURE, header, *(chunk for kind, chunk in self.chunks if kind in (b"IDAT", b"IEND")))
            )
        return _imdecode(self.path, data, mode)


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
        if zlib.crc32(view[start + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            raise DataError(f"{path}: the PNG is damaged (checksum of the chunk at byte {start}); {AGAIN}")
        kind = data[start + 4 : start + 8]
        chunks.append((kind, view[start:end]))
        start = end
    if chunks[0][0] != b"IHDR" or len(chunks[0][1]) != 25:
        raise DataError(f"{path}: the PNG has no header; {AGAIN}")
    width, height, bits, color_type = struct.unpack_from(">IIBB", chunks[0][1], 8)
    if color_type not in PNG_KINDS or bits not in (1, 2, 4, 8, 16):
        raise DataError(f"{path}: the PNG header is damaged (colour type {color_type}, {bits} bits); {AGAIN}")
    _check_pixels(path, width, height, PNG_CHANNELS[color_type] * max(1, bits // 8))
    critical = [chunk for kind, chunk in chunks if kind[:1].isupper()]
    plain = data if len(critical) == len(chunks) else b"".join((PNG_SIGNATURE, *critical))
    return Png(path, PNG_KINDS[color_type], bits, chunks, plain)


# --- JPEG, TIFF, EXR ------------------------------------------------------------------------------------------------


def _decode_jpeg(path: Path, data: bytes) -> UInt8:
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


def _decode_color_tiff(path: Path, data: bytes) -> UInt8:
    """RGB (H, W, 3) of an 8-bit image, or of a deeper one its upper bits."""
    channels = _checked_tags(path, data, pixel_bytes=3).get(277, 1)
    if channels not in (1, 3, 4):
        raise DataError(f"{path}: {channels} channels are no colour; save RGB")
    return np.ascontiguousarray(_imdecode(path, data, "IMREAD_COLOR")[..., ::-1])


def _decode_tiff(path: Path, data: bytes) -> npt.NDArray[Any]:
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


def _decode_exr(path: Path, data: bytes) -> npt.NDArray[Any]:
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
    """Return whether the installed OpenCV was built with EXR."""
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
