"""Depth, labels, scores and colour of image files: of the right kind and unit, or one DataError with the file."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Mask, UInt8, UInt16, UInt32
from semstab.data.features import Features
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.datasets.formats.decoders import (
    PFM_HEADER,
    decode_color_tiff,
    decode_exr,
    decode_jpeg,
    decode_pfm,
    decode_tiff,
    in_one_line,
    whole_png,
)
from semstab.datasets.formats.disk import NPY_SHAPE, decode_array, names_in, read_bytes
from semstab.datasets.formats.image_sizes import (
    ANY_SIZE,
    DENSEST,
    MAX_IMAGE_BYTES,
    FrameSize,
    Size,
    check_photograph,
    check_pixels,
    claimed_by,
)
from semstab.datasets.geometry.lenses import Labels
from semstab.errors import ConfigError, DataError

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

Read = Callable[[Path], bytes]


def read_depth(
    path: Path, scale: float | None = None, read: Read = read_bytes, allowed_sizes: FrameSize = ANY_SIZE
) -> Float32:
    """Return depth (H, W) in metres, float32, as stored: values that mark a pixel invalid stay.

    `scale` is units per metre; not given, a 16-bit PNG holds millimetres and float files hold metres.

    Raises:
        DataError: For another type, more than one channel, integers without a scale, or a damaged file.
    """
    data = read(path)
    suffix = path.suffix.lower()
    if suffix == ".png":
        with whole_png(path, data, allowed_sizes, {"grey": 4, "RGBA": 16}) as png:
            packed = _unpacked(png.samples()) if (png.kind, png.bits) == ("RGBA", 8) else None
            if packed is None and (png.kind != "grey" or png.bits != 16):
                raise DataError(
                    f"{path}: expected 16-bit grey, got {png.bits}-bit {png.kind} (a picture of the depth?);"
                    " export the depth values"
                )
            depth = png.samples() if packed is None else packed
            scale = scale or (MILLIMETRES if packed is None else 1.0)
    elif suffix in (".tiff", ".tif"):
        depth = decode_tiff(path, data, allowed_sizes)
    elif suffix == ".exr":
        depth = decode_exr(path, data, allowed_sizes)
    elif suffix == ".pfm":
        depth = decode_pfm(path, data, allowed_sizes)
    else:
        depth = decode_array(path, data, "depth", claimed_by(path, allowed_sizes, 4))
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
    allowed_sizes: FrameSize = ANY_SIZE,
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
        return _narrow(path, decode_array(path, data, "labels", claimed_by(path, allowed_sizes, 4)), space, void)
    with whole_png(path, data, allowed_sizes, {"grey": 1, "palette": 1, "RGB": 6, "RGBA": 8}) as png:
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
    allowed_sizes: FrameSize = ANY_SIZE,
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
        check_pixels(path, W, H, sizes=allowed_sizes)
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


def read_confidence(path: Path, read: Read = read_bytes, allowed_sizes: FrameSize = ANY_SIZE) -> UInt8 | UInt16:
    """Return (H, W) how sure depth is, as stored.

    Raises:
        DataError: If it is no one-channel PNG, or damaged.
    """
    with whole_png(path, read(path), allowed_sizes, {"grey": 1}) as png:
        if png.kind != "grey":
            raise DataError(f"{path}: a {png.bits}-bit {png.kind} PNG is no image of confidence; export it again")
        return png.samples()


def read_mask(path: Path, read: Read = read_bytes, allowed_sizes: FrameSize = ANY_SIZE) -> Mask:
    """Return mask (H, W) bool, True where the image is 0: black is left out, as COLMAP and nerfstudio have it.

    Raises:
        DataError: If it is no one-channel PNG, or damaged.
    """
    with whole_png(path, read(path), allowed_sizes, {"grey": 1, "palette": 1}) as png:
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
        with whole_png(path, data) as png:
            check_photograph(path, data, *png.image.size)
            if png.kind == "grey" and png.bits == 16:
                return np.repeat((png.samples() >> 8).astype(np.uint8)[..., None], 3, axis=2)
            png.image.info.pop("transparency", None)  # Pillow warns of it
            return np.array(png.image if png.image.mode == "RGB" else png.image.convert("RGB"))
    return decode_color_tiff(path, data) if suffix in (".tif", ".tiff") else decode_jpeg(path, data)


def color_size(path: Path) -> Size:
    """Return (width, height) of a colour image, from its header.

    Raises:
        DataError: If that is damaged.
    """
    from PIL import Image

    with in_one_line(path, "colour"), Image.open(path) as image:
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
