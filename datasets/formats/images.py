"""Depth, labels, scores and colour as semstab means them: of the right kind and unit, or a DataError with the file."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Mask, UInt8, UInt16, UInt32
from semstab.datasets.formats.codecs import Png, decode_color_tiff, decode_exr, decode_jpeg, decode_tiff, parse_png
from semstab.datasets.formats.disk import MAX_SCORE_BYTES, decode_array, read_bytes
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
"""Of a label map of colours: looking them up takes many times the memory of the image."""

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
        return _depth_png(path, data).metres(scale or MILLIMETRES)
    if suffix in (".tiff", ".tif"):
        depth = decode_tiff(path, data)
    elif suffix == ".exr":
        depth = decode_exr(path, data)
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
    """Soft scores (H, W, K) float16, float32 or float64, C-contiguous; `layout` is that of the file.

    `size` is (H, W) of the depth, to recognise the other layout. Raises DataError where the file has another
    type or layout, or is damaged.
    """
    scores = decode_array(path, read(path), "scores", MAX_SCORE_BYTES)
    if scores.ndim != 3 or scores.dtype.kind != "f":
        raise DataError(
            f"{path}: scores must be float16 or float32 with three axes, got {scores.dtype} of shape {scores.shape}"
        )
    found = {"KHW": scores.shape[1:], "HWK": scores.shape[:2]}
    other = "HWK" if layout == "KHW" else "KHW"
    if found[layout] != size and found[other] == size:
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
    return decode_color_tiff(path, data) if suffix in (".tif", ".tiff") else decode_jpeg(path, data)


def color_size(path: Path) -> Size:
    """(width, height) of a colour image, from its header. Raises DataError where that is damaged."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: not an image ({one_line(error)})") from error


def _depth_png(path: Path, data: bytes) -> Png:
    png = parse_png(path, data)
    if png.kind != "grey" or png.bits != 16:
        raise DataError(
            f"{path}: expected 16-bit grey, found {png.bits}-bit {png.kind} (a picture of the depth?);"
            " export the depth values"
        )
    return png


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
        found = table[_packed(rgb[top : top + rows])]
        if (unknown := found == NO_CLASS).any():
            y, x = np.argwhere(unknown)[0]
            first = first if count else (top + int(y), int(x))
            count += int(np.count_nonzero(unknown))
        ids[top : top + rows] = found
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
