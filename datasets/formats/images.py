"""Depth, labels, scores and colour of image files: of the right kind and unit, or one DataError with the file.

Checksums and claimed sizes are checked before a decoder reads the bytes, because decoders may return half an image for
a truncated file, or allocate what a damaged header claims.
"""

from __future__ import annotations

import functools
import io
import math
import os
import re
import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Mask, UInt8, UInt16, UInt32
from semstab.data.features import Features
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.datasets.formats.disk import AGAIN, NPY_SHAPE, Claimed, decode_array, names_in, read_bytes
from semstab.datasets.geometry.lenses import Labels
from semstab.errors import ConfigError, DataError, summarize_error

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

DEPTH_SUFFIXES = (".png", ".npy", ".npz", ".exr", ".tiff", ".tif", ".pfm")
LABEL_SUFFIXES = (".png", ".npy", ".npz")
SCORE_SUFFIXES = (".npz", ".npy")
COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
MASK_SUFFIXES = (".png",)

MILLIMETRES = 1000.0
NO_CLASS = IGNORE_16BIT
HEADER_BYTES = 256
"""Bytes that hold the size of an array or of a float map."""

MOST_SCORES = 4096
"""Most classes of scores whose classes are not known."""

MAX_PIXELS = 2**26
"""Most pixels of depth, labels and masks of a frame whose image is not larger."""

MAX_IMAGE_BYTES = 3 * 2**27
"""Most bytes at once that an image may take while it is decoded: 16-bit depth of 67 megapixels, RGB labels of 44."""

ORDINARY = 2**22
"""Pixels up to which a file may be larger than its frame's image."""

BEYOND_IMAGE = 4
"""Times the pixels of its frame's image that a larger file may have."""

BEYOND_DEPTH = 16
"""Times the pixels of its frame's depth that a label map, scores or mask may have without an image."""

MAX_PHOTOGRAPH = 2**28
"""Most pixels of a colour image."""

DENSEST = 64
"""Pixels that a byte of a colour image may stand for, if that takes more than `MAX_IMAGE_BYTES`: of photographs ten.

As many bytes of scores, of another size than the depth, that a byte of their file may stand for.
"""

MAX_SIDE = 2**16
"""Most pixels of a side: a few bytes of a damaged header can claim 16 x 8,388,364, which takes seconds to unpack."""

Size = tuple[int, int]
Read = Callable[[Path], bytes]


@dataclass(frozen=True)
class FrameSize:
    """Bounds of a frame on the sizes of its files, before a file is decoded.

    Attributes:
        pixels: Returns the number of pixels of its image, 0 if unknown; called if a file claims many pixels.
        require: Raises DataError for a size (H, W) that the frame's view cannot have.
        depth: Shape (H, W) of its depth, for other files; None if depth does not bound the other files.
    """

    pixels: Callable[[], int] = lambda: 0
    require: Callable[[Size], None] = lambda size: None
    depth: Size | None = None


ANY_SIZE = FrameSize()


def read_depth(path: Path, scale: float | None = None, read: Read = read_bytes, own: FrameSize = ANY_SIZE) -> Float32:
    """Return depth (H, W) in metres, float32, as stored: values that mark a pixel invalid stay.

    `scale` is units per metre; not given, a 16-bit PNG holds millimetres and float files hold metres.

    Raises:
        DataError: For another type, more than one channel, integers without a scale, or a damaged file.
    """
    data = read(path)
    suffix = path.suffix.lower()
    if suffix == ".png":
        with _whole_png(path, data, own, {"grey": 4, "RGBA": 16}) as png:
            packed = _unpacked(png.samples()) if (png.kind, png.bits) == ("RGBA", 8) else None
            if packed is None and (png.kind != "grey" or png.bits != 16):
                raise DataError(
                    f"{path}: expected 16-bit grey, got {png.bits}-bit {png.kind} (a picture of the depth?);"
                    " export the depth values"
                )
            depth = png.samples() if packed is None else packed
            scale = scale or (MILLIMETRES if packed is None else 1.0)
    elif suffix in (".tiff", ".tif"):
        depth = _decode_tiff(path, data, own)
    elif suffix == ".exr":
        depth = _decode_exr(path, data, own)
    elif suffix == ".pfm":
        depth = _decode_pfm(path, data, own)
    else:
        depth = decode_array(path, data, "depth", _claimed(path, own, 4))
    if depth.ndim != 2 or depth.dtype.kind not in "fui":
        raise DataError(f"{path}: depth is {depth.dtype} of shape {depth.shape}; store float32 metres (H, W)")
    if scale is None and depth.dtype.kind != "f":
        raise DataError(f"{path}: depth is {depth.dtype}, of unknown unit; set depth_scale (units per metre)")
    with np.errstate(all="ignore"):  # beyond float32 becomes inf: invalid, as it should
        metres: Float32 = np.divide(depth, scale or 1, dtype=np.float32, casting="same_kind")
    return metres


NEAREST = 1e-4
"""Metres: bytes of a picture that are read as floats are below, or no numbers."""


def _unpacked(samples: npt.NDArray[Any]) -> Float32 | None:
    """Return float32 depth that TartanAir V2 packs into the channels blue, green, red, alpha; None for a picture."""
    depth: Float32 = np.ascontiguousarray(samples[..., [2, 1, 0, 3]]).view("<f4")[..., 0]
    nonzero = depth[depth != 0]  # an opaque picture is all NaN or negative, a transparent one tiny
    return depth if len(nonzero) and bool(((nonzero >= NEAREST) & np.isfinite(nonzero)).all()) else None


def read_labels(
    path: Path,
    space: LabelSpace | None = None,
    read: Read = read_bytes,
    own: FrameSize = ANY_SIZE,
    void: Collection[int] = (),
) -> Labels:
    """Return the class ids (H, W) uint8 or uint16, in the ids of the file; RGB maps through the colours of `space`.

    Wider integers are narrowed; of these the ids `void` are ignored.

    Raises:
        DataError: For a colour or an id that no class can have, an RGB map without `space`, another type, or a damaged
            file.
    """
    data = read(path)
    if path.suffix.lower() != ".png":
        return _narrow(path, decode_array(path, data, "labels", _claimed(path, own, 4)), space, void)
    with _whole_png(path, data, own, {"grey": 1, "palette": 1, "RGB": 6, "RGBA": 8}) as png:
        if png.kind not in ("grey", "palette") and (png.kind not in ("RGB", "RGBA") or png.bits != 8):
            raise DataError(
                f"{path}: a {png.bits}-bit {png.kind} PNG cannot hold labels; save ids as 8- or 16-bit grey"
            )
        samples = png.samples()
    if samples.ndim == 2:
        return samples
    if space is None:
        raise DataError(f"{path}: the labels are colours; set classes or taxonomy, so that each has a class")
    return _labels_by_color(path, samples, space)


def read_scores(
    path: Path,
    layout: Literal["KHW", "HWK"],
    size: Size,
    read: Read = read_bytes,
    own: FrameSize = ANY_SIZE,
    classes: int | None = None,
) -> npt.NDArray[np.floating[Any]]:
    """Return soft scores (H, W, K) float16, float32 or float64, C-contiguous; `layout` is the file's.

    `size` is (H, W) of the depth, to recognise the other layout; `classes` the number of classes, if known.

    Raises:
        DataError: If the file has another type or layout, too many classes, or is damaged.
    """

    def claimed(shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if len(shape) != 3 or dtype.kind != "f":
            raise DataError(f"{path}: scores must be float16 or float32 with three axes, got {dtype} of shape {shape}")
        sizes = {"KHW": shape[1:], "HWK": shape[:2]}
        other = "HWK" if layout == "KHW" else "KHW"
        if sizes[layout] != size and sizes[other] == size:
            raise DataError(f"{path}: scores of shape {shape} are not {layout}; set scores_layout: {other}")
        (H, W), K = sizes[layout], shape[0 if layout == "KHW" else 2]
        if (classes or MOST_SCORES) < K:
            raise DataError(f"{path}: has scores of {K} classes, but there are {classes or f'at most {MOST_SCORES}'}")
        _check_pixels(path, W, H, sizes=own)
        taken = math.prod(shape) * dtype.itemsize
        if sizes[layout] != size and taken > max(MAX_IMAGE_BYTES // 2, DENSEST * len(data)):
            raise DataError(
                f"{path}: claims scores of shape {shape} in {len(data)} bytes, but depth is {size[1]}x{size[0]};"
                " bring them to one size"
            )

    data = read(path)
    scores = decode_array(path, data, "scores", claimed)
    return np.ascontiguousarray(scores.transpose(1, 2, 0) if layout == "KHW" else scores)


def read_features(path: Path, size: Size, read: Read = read_bytes) -> Features:
    """Return features of an image of `size` (H, W): an .npy (h, w, D), or an .npz with `features` and their grid.

    The grid covers the image evenly, unless the .npz has `first` and `step`: column and row, in pixels of the depth, of
    the first cell's centre, and columns and rows from one centre to the next.

    Raises:
        DataError: If the file has another type or layout, or is damaged.
    """

    def claimed(shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if len(shape) != 3 or dtype.kind != "f":
            raise DataError(f"{path}: features must be float (h, w, D), got {dtype} of shape {shape}")

    data = read(path)
    vectors = decode_array(path, data, "features", claimed)
    try:
        if path.suffix.lower() == ".npz" and {"first", "step"} <= set(names_in(data)):
            first, step = (decode_array(path, data, name).ravel().tolist() for name in ("first", "step"))
            if len(first) != 2 or len(step) != 2:
                raise DataError(
                    f"'first' and 'step' must hold two numbers, of columns and of rows; they hold {len(first)} and"
                    f" {len(step)}"
                )
            return Features(vectors, (first[0], first[1]), (step[0], step[1]))
        return Features.over(vectors, size)
    except (DataError, ValueError) as error:
        raise DataError(f"{path}: {error}") from error


def read_confidence(path: Path, read: Read = read_bytes, own: FrameSize = ANY_SIZE) -> UInt8 | UInt16:
    """Return (H, W) how sure depth is, as stored.

    Raises:
        DataError: If it is no one-channel PNG, or damaged.
    """
    with _whole_png(path, read(path), own, {"grey": 1}) as png:
        if png.kind != "grey":
            raise DataError(f"{path}: a {png.bits}-bit {png.kind} PNG is no image of confidence; export it again")
        return png.samples()


def read_mask(path: Path, read: Read = read_bytes, own: FrameSize = ANY_SIZE) -> Mask:
    """Return mask (H, W) bool, True where the image is 0: black is left out, as COLMAP and nerfstudio have it.

    Raises:
        DataError: If it is no one-channel PNG, or damaged.
    """
    with _whole_png(path, read(path), own, {"grey": 1, "palette": 1}) as png:
        if png.kind not in ("grey", "palette"):
            raise DataError(f"{path}: a {png.bits}-bit {png.kind} PNG is no mask; save it as grey, 0 where left out")
        mask: Mask = png.samples() == 0
    return mask


def read_color(path: Path, read: Read = read_bytes) -> UInt8:
    """Return the colour (H, W, 3) uint8 RGB of PNG, JPEG, TIFF or .npy, not rotated by EXIF.

    Raises:
        DataError: If damaged.
    """
    data = read(path)
    suffix = path.suffix.lower()
    if suffix == ".npy":
        color = decode_array(path, data, "color")
        if color.dtype != np.uint8 or color.shape[2:] != (3,):
            raise DataError(f"{path}: colour is {color.dtype} of shape {color.shape}; store uint8 RGB (H, W, 3)")
        return color
    if suffix == ".png":
        with _whole_png(path, data) as png:
            _check_photograph(path, data, *png.image.size)
            if png.kind == "grey" and png.bits == 16:
                return np.repeat((png.samples() >> 8).astype(np.uint8)[..., None], 3, axis=2)
            png.image.info.pop("transparency", None)  # Pillow warns of it
            return np.array(png.image if png.image.mode == "RGB" else png.image.convert("RGB"))
    return _decode_color_tiff(path, data) if suffix in (".tif", ".tiff") else _decode_jpeg(path, data)


def color_size(path: Path) -> Size:
    """Return (width, height) of a colour image, from its header.

    Raises:
        DataError: If that is damaged.
    """
    from PIL import Image

    with _one_line(path, "colour"), Image.open(path) as image:
        return image.size


def depth_size(path: Path) -> Size | None:
    """Return (width, height) of a depth image from its header, or None if the header is damaged or has no size."""
    suffix = path.suffix.lower()
    try:
        if suffix in (".png", ".tif", ".tiff"):
            return color_size(path)
        with path.open("rb") as file:
            head = file.read(HEADER_BYTES)
    except (OSError, DataError):  # raised where the image is needed
        return None
    if suffix == ".pfm" and (match := PFM_HEADER.match(head)):
        return int(match[2]), int(match[3])
    if suffix == ".npy" and (shape := NPY_SHAPE.search(head)):
        sides = [int(side) for side in re.findall(rb"\d+", shape[1])]
        return (sides[1], sides[0]) if len(sides) == 2 else None
    return None


# --- labels ---------------------------------------------------------------------------------------------------------


def _narrow(path: Path, ids: npt.NDArray[Any], space: LabelSpace | None, void: Collection[int]) -> Labels:
    """Return integer ids of any width as uint8 where the classes (without `space`: the ids) fit, else uint16."""
    if ids.ndim != 2 or ids.size == 0 or ids.dtype.kind not in "ui":
        raise DataError(f"{path}: labels must be integer ids (H, W), got {ids.dtype} of shape {ids.shape}")
    if ids.dtype in (np.uint8, np.uint16):
        return ids
    valid, bounds = np.ones(ids.shape, np.bool_), np.iinfo(ids.dtype)
    for value in void:  # without copies of wide ids, which isin makes
        valid &= ids != value
    low, high = int(ids.min(where=valid, initial=bounds.max)), int(ids.max(where=valid, initial=bounds.min))
    low, high = (low, high) if low <= high else (0, 0)
    if low < 0 or high > IGNORE_16BIT:
        outside = np.unique(ids[valid & ((ids < 0) | (ids > IGNORE_16BIT))])
        mend = f"; if {outside[0]} is 'ignore', set void_ids: {{MODEL: [{outside[0]}]}}" if len(outside) == 1 else ""
        raise DataError(f"{path}: label ids from {low} to {high}{mend}; store ids from 0, and 255 (65535) for 'ignore'")
    fits = high <= IGNORE_8BIT and (space is None or max(space.ids) < IGNORE_8BIT)
    narrowed: Labels = ids.astype(np.uint8) if fits else ids.astype(np.uint16)
    narrowed[~valid] = IGNORE_8BIT if fits else IGNORE_16BIT
    return narrowed


def _labels_by_color(path: Path, image: UInt8, space: LabelSpace) -> Labels:
    """Return ids (H, W) of an RGB or fully opaque RGBA image."""
    if image.shape[2] == 4 and (transparent := image[..., 3] < 255).any():
        y, x = np.argwhere(transparent)[0]
        raise DataError(f"{path}: pixel ({x}, {y}) is transparent, so its label colour is not exact; save as RGB")
    table, (H, W) = _ids_by_color(space), image.shape[:2]
    ids, rows = np.empty((H, W), np.uint16), max(1, 2**16 // W)  # as many as fit into the processor's cache
    for top in range(0, H, rows):
        ids[top : top + rows] = table[_packed(image[top : top + rows])]
    if (unknown := ids == NO_CLASS).any():
        y, x = np.argwhere(unknown)[0]
        raise DataError(
            f"{path}: colour {tuple(image[y, x, :3].tolist())} at pixel ({x}, {y}) ({np.count_nonzero(unknown)} pixels)"
            f" is no class of '{space.name}'; {_cause(image[..., :3], unknown, table)}"
        )
    return ids.astype(np.uint8) if max(space.ids) < IGNORE_8BIT else ids


NEIGHBOURS = 4
"""Pixels from a mixed one, at most, to those whose colours are mixed in it."""

MIXED_SHARE, LEAST_KNOWN = 0.8, 0.3
"""The share of the unknown pixels that mixtures explain, and of all that have a class besides."""


def _cause(image: UInt8, unknown: Mask, table: UInt16) -> str:
    """Return why colours (H, W, 3) may be no class, and what to do."""
    used = [name for name, channel in zip(("red", "green", "blue"), range(3), strict=True) if image[..., channel].any()]
    if (image == image[..., :1]).all():
        return "its three channels are equal: are they ids? save one of them, image[..., 0], as grey"
    if len(used) == 1:
        return f"only its {used[0]} channel is not 0: are these ids, as CARLA's? save that channel alone, as grey"
    if np.count_nonzero(table[_packed(image[..., ::-1])] == NO_CLASS) < 0.05 * unknown.size:
        return (
            "with red and blue exchanged it is one: OpenCV writes BGR; exchange them (image[..., ::-1]) and save again"
        )
    mixed = _is_mixed(image, unknown) | _is_mixed(image.swapaxes(0, 1), unknown.T).T
    if (~unknown).mean() >= LEAST_KNOWN and mixed[unknown].mean() >= MIXED_SHARE:
        return "such colours are mixtures of neighbouring classes at borders; resize label maps by the nearest pixel"
    return "set taxonomy to the one whose colours the image has"


def _is_mixed(image: UInt8, unknown: Mask) -> Mask:
    """Return the unknown pixels (H, W) whose colour lies between those of the next known ones in their row."""
    H, W = unknown.shape
    u = np.arange(W)
    before = np.maximum.accumulate(np.where(unknown, -W, u), axis=1)
    after = np.minimum.accumulate(np.where(unknown, 2 * W, u)[:, ::-1], axis=1)[:, ::-1]
    near = unknown & (u - before <= NEIGHBOURS) & (after - u <= NEIGHBOURS)
    rows = np.arange(H)[:, None]
    a, b = (image[rows, column.clip(0, W - 1)].astype(np.int16) for column in (before, after))
    between = (image >= np.minimum(a, b) - 1) & (image <= np.maximum(a, b) + 1)
    mixed: Mask = near & between.all(axis=2)
    return mixed


@functools.lru_cache(maxsize=2)
def _ids_by_color(space: LabelSpace) -> UInt16:
    """Return (2^24,) class id of each packed colour.

    Raises:
        ConfigError: If two classes share a colour.
    """
    if len(set(space.colors)) < len(space):
        shared = next(color for color in space.colors if space.colors.count(color) > 1)
        raise ConfigError(f"taxonomy {space.name}: two classes have the colour {shared}; give each its own")
    table = np.full(1 << 24, NO_CLASS, dtype=np.uint16)
    table[_packed(np.array(space.colors, dtype=np.uint8))] = space.ids
    return table


def _packed(rgb: UInt8) -> UInt32:
    """Return RGB, or RGB and more, (..., 3) as one 24-bit number each."""
    r, g, b = (rgb[..., channel].astype(np.uint32) for channel in range(3))
    return (r << np.uint32(16)) | (g << np.uint32(8)) | b


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
            image: npt.NDArray[Any] = _imdecode(
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
def _whole_png(
    path: Path, data: bytes, sizes: FrameSize | None = None, more: Mapping[str, int] = MappingProxyType({})
) -> Iterator[Png]:
    """Yield a PNG that is whole; it is decoded within the context.

    The size of a frame's file is checked first; `more` has the bytes that a pixel takes beyond the file's, by kind.
    """
    from PIL import PngImagePlugin

    if not data.startswith(PNG_SIGNATURE) or data[12:16] != b"IHDR":
        raise DataError(f"{path}: not a PNG image (it begins with {data[:8]!r}); {AGAIN}")
    with _one_line(path, "PNG"):
        if sizes is not None and len(data) > 26:
            width, height, bits, colors = struct.unpack_from(">IIBB", data, 16)
            stored = PNG_CHANNELS.get(colors, 4) * max(1, bits // 8)
            _check_pixels(path, width, height, stored + more.get(PNG_KINDS.get(colors, ""), 0), sizes)
        PngImagePlugin.PngImageFile(io.BytesIO(data)).verify()  # while it decodes, Pillow leaves out the checksums
        image = PngImagePlugin.PngImageFile(io.BytesIO(data))
        yield Png(path, data, PNG_KINDS[data[25]], data[24], image)


@contextmanager
def _one_line(path: Path, what: str) -> Iterator[None]:
    """Turn the exceptions of Pillow for damaged files into DataError."""
    try:
        yield
    except DataError:
        raise
    except Exception as error:
        raise DataError(f"{path}: not a whole {what} image ({summarize_error(error)}); {AGAIN}") from error


def _decode_jpeg(path: Path, data: bytes) -> UInt8:
    from PIL import JpegImagePlugin

    with _one_line(path, "JPEG"):
        image = JpegImagePlugin.JpegImageFile(io.BytesIO(data))
        _check_photograph(path, data, *image.size)
        return np.array(image.convert("RGB"))


# --- TIFF and EXR by OpenCV, twice as fast as Pillow ------------------------------------------------------------------


def _decode_color_tiff(path: Path, data: bytes) -> UInt8:
    """Return RGB (H, W, 3) of an 8-bit image, or of a deeper one its upper bits."""
    tags = _tags(path, data)
    _check_photograph(path, data, tags[256], tags[257])
    channels = tags.get(277, 1)
    if channels not in (1, 3, 4):
        raise DataError(f"{path}: {channels} channels are no colour; save RGB")
    return np.ascontiguousarray(_imdecode(path, data, "IMREAD_COLOR")[..., ::-1])


def _decode_tiff(path: Path, data: bytes, sizes: FrameSize) -> npt.NDArray[Any]:
    """Return one channel (H, W), of the type it was stored in."""
    tags = _tags(path, data)
    bits, channels, sample = tags.get(258, 1), tags.get(277, 1), tags.get(339, 1)
    if channels != 1:
        raise DataError(f"{path}: expected one channel of 32-bit float, got {channels} channels")
    if (sample, bits) not in ((3, 32), (3, 64), (1, 16)):
        kind = {1: "unsigned", 2: "signed", 3: "float"}.get(sample, "other")
        raise DataError(f"{path}: expected 32-bit float metres, got {bits}-bit {kind}; convert it")
    _check_pixels(path, tags[256], tags[257], bits // 8 + (0 if bits == 32 else 4), sizes)
    return _imdecode(path, data, "IMREAD_UNCHANGED")


def _tags(path: Path, data: bytes) -> dict[int, int]:
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


def _decode_exr(path: Path, data: bytes, sizes: FrameSize) -> npt.NDArray[Any]:
    """Return one channel (H, W), where the installed OpenCV reads EXR at all (the wheels of OpenCV 5 do not)."""
    window = data.find(b"dataWindow\0box2i\0")
    if not data.startswith(b"v/1\x01") or window < 0 or len(data) < window + 37:
        raise DataError(f"{path}: not a whole EXR image; {AGAIN}")
    left, top, right, bottom = struct.unpack_from("<4i", data, window + 21)
    _check_pixels(path, right - left + 1, bottom - top + 1, 4, sizes)
    if not reads_exr():
        raise DataError(
            f"{path}: the installed OpenCV cannot read EXR; convert the depth to .npy (float32 metres),"
            ' or pip install "opencv-python-headless<5"'
        )
    depth = _imdecode(path, data, "IMREAD_UNCHANGED")
    if depth.ndim == 3 and (depth[..., :1] == depth[..., :3]).all():  # Blender writes depth as three equal channels
        depth = depth[..., 0]
    if depth.ndim != 2:
        raise DataError(f"{path}: expected one channel, got {depth.shape[2]}; export the depth channel alone")
    return depth


PFM_HEADER = re.compile(rb"P([Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,40})\s")


def _decode_pfm(path: Path, data: bytes, sizes: FrameSize) -> npt.NDArray[Any]:
    """Return one channel (H, W) of a portable float map, whose rows go from the bottom to the top."""
    header = PFM_HEADER.match(data)
    if header is None:
        raise DataError(f"{path}: not a PFM image (it begins with {data[:8]!r}); {AGAIN}")
    width, height, channels = int(header[2]), int(header[3]), 1 if header[1] == b"f" else 3
    _check_pixels(path, width, height, 4 * channels + 4, sizes)
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
        raise DataError(f"{path}: the image cannot be decoded ({summarize_error(error)}); {AGAIN}") from error
    if image is None:
        raise DataError(f"{path}: the image is damaged; {AGAIN}")
    return image


def _claimed(path: Path, sizes: FrameSize, more: int) -> Claimed:
    """Check the size of an array (H, W) before it is unpacked; a pixel takes `more` bytes beyond the file's."""

    def check(shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if len(shape) == 2:  # others are refused by what they are for
            _check_pixels(path, shape[1], shape[0], dtype.itemsize + more, sizes)
        elif math.prod(shape) * dtype.itemsize > MAX_IMAGE_BYTES:
            raise DataError(f"{path}: claims an array of shape {shape}; expected (H, W)")

    return check


def _check_pixels(path: Path, width: int, height: int, pixel_bytes: int = 1, sizes: FrameSize = ANY_SIZE) -> None:
    """Check an image's size before memory is allocated for the size that a header claims, by its frame's image."""
    pixels = width * height
    _check_sides(path, width, height)
    most = min(MAX_PIXELS, MAX_IMAGE_BYTES // pixel_bytes)
    if pixels > ORDINARY and (image := sizes.pixels()):
        most = max(ORDINARY, image, min(most, BEYOND_IMAGE * image))
        if pixels > most:
            raise DataError(f"{path}: claims {width}x{height} pixels, but the image has {image}; export them again")
    if pixels > most:
        raise DataError(f"{path}: claims {width}x{height} pixels (at most {most} are read); is it damaged?")
    sizes.require((height, width))
    if sizes.depth is not None and pixels > max(ORDINARY, BEYOND_DEPTH * math.prod(sizes.depth)) and not sizes.pixels():
        H, W = sizes.depth
        raise DataError(
            f"{path}: claims {width}x{height} pixels, but depth is {W}x{H} (without an image, {BEYOND_DEPTH} times the"
            " pixels of the depth are read at most); bring them to one size"
        )


def _check_photograph(path: Path, data: bytes, width: int, height: int) -> None:
    """Check a colour image's size: one that takes much memory has the bytes of a photograph."""
    _check_sides(path, width, height)
    pixels, free = width * height, MAX_IMAGE_BYTES // 10  # Pillow's four bytes, and two copies of three
    if pixels > max(free, min(MAX_PHOTOGRAPH, DENSEST * len(data))):
        raise DataError(f"{path}: claims {width}x{height} pixels in {len(data)} bytes; is it damaged?")


def _check_sides(path: Path, width: int, height: int) -> None:
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise DataError(f"{path}: claims {width}x{height} pixels (at most {MAX_SIDE} on a side); is it damaged?")
