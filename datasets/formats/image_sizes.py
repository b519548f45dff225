"""Bounds on the size of images, checked before a decoder allocates what a header claims."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semstab.datasets.formats.disk import Claimed
from semstab.errors import DataError

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


def claimed_by(path: Path, sizes: FrameSize, more: int) -> Claimed:
    """Check the size of an array (H, W) before it is unpacked; a pixel takes `more` bytes beyond the file's."""

    def check(shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if len(shape) == 2:  # others are refused by what they are for
            check_pixels(path, shape[1], shape[0], dtype.itemsize + more, sizes)
        elif math.prod(shape) * dtype.itemsize > MAX_IMAGE_BYTES:
            raise DataError(f"{path}: claims an array of shape {shape}; expected (H, W)")

    return check


def check_pixels(path: Path, width: int, height: int, pixel_bytes: int = 1, sizes: FrameSize = ANY_SIZE) -> None:
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


def check_photograph(path: Path, data: bytes, width: int, height: int) -> None:
    """Check a colour image's size: one that takes much memory has the bytes of a photograph."""
    _check_sides(path, width, height)
    pixels, free = width * height, MAX_IMAGE_BYTES // 10  # Pillow's four bytes, and two copies of three
    if pixels > max(free, min(MAX_PHOTOGRAPH, DENSEST * len(data))):
        raise DataError(f"{path}: claims {width}x{height} pixels in {len(data)} bytes; is it damaged?")


def _check_sides(path: Path, width: int, height: int) -> None:
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise DataError(f"{path}: claims {width}x{height} pixels (at most {MAX_SIDE} on a side); is it damaged?")
