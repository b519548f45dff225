"""One-channel PNGs in half of OpenCV's time: libdeflate inflates, compiled code undoes the row filters.

Depth and labels are such images, and decoding them is what a run waits for. No kept decoder is as fast: those on zlib
and libpng take twice as long, and the one that does not (kornia-rs) holds the interpreter's lock, so that two threads
decode no faster than one. Whatever is unusual or damaged here is left to the decoder that knows every kind of PNG and
says what is wrong. Filters: PNG specification, section 9.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import deflate
import numpy as np
import numpy.typing as npt

from semstab.core.compiled import serial
from semstab.core.types import Float32, UInt8

LARGEST_RATIO = 1032
"""A byte of a deflate stream becomes at most that many: what claims more is not worth the memory."""


def decode(width: int, height: int, bits: int, parts: Iterable[memoryview]) -> npt.NDArray[Any] | None:
    """Samples (height, width), uint8 or uint16, of a non-interlaced image with one channel of 8 or 16 bits.

    `parts` are the bodies of its IDAT chunks. None where they do not decode to just that.
    """
    B = bits // 8
    if (raw := _inflated(height * (1 + width * B), parts)) is None:
        return None
    out = np.empty((height, width, B), dtype=np.uint8)
    if not _unfilter(raw, out):
        return None
    return out.view("<u2" if B == 2 else np.uint8)[..., 0]


def decode_metres(width: int, height: int, scale: float, parts: Iterable[memoryview]) -> Float32 | None:
    """Samples (height, width) of such an image of 16 bits, divided by `scale`: one pass less than in two steps."""
    if (raw := _inflated(height * (1 + width * 2), parts)) is None:
        return None
    out = np.empty((height, width), dtype=np.float32)
    return out if _unfilter_metres(raw, np.float32(scale), out) else None


def _inflated(size: int, parts: Iterable[memoryview]) -> UInt8 | None:
    """The `size` bytes of filtered rows; None where it is another number, or damaged."""
    stream = b"".join(parts)
    if size > LARGEST_RATIO * len(stream):
        return None
    try:
        raw = np.frombuffer(deflate.zlib_decompress(stream, size), dtype=np.uint8)
    except deflate.DeflateError:
        return None
    return raw if raw.size == size else None


@serial
def _unfilter(raw: Any, out: Any) -> bool:
    """Undo the filters of each row of `raw` into out (H, W, B), the lowest byte of a sample first."""
    H, W, B = out.shape
    above = np.zeros((W, B), dtype=np.uint8)
    for y in range(H):
        if not _unfilter_samples(raw[y * (1 + W * B) : (y + 1) * (1 + W * B)], above, out[y]):
            return False
        above = out[y]
    return True


@serial
def _unfilter_metres(raw: Any, scale: Any, out: Any) -> bool:
    """Undo the filters of each row of 16-bit samples, and divide by the scale into out (H, W)."""
    H, W = out.shape
    rows = np.zeros((2, W, 2), dtype=np.uint8)
    for y in range(H):
        row = rows[y % 2]
        if not _unfilter_samples(raw[y * (1 + W * 2) : (y + 1) * (1 + W * 2)], rows[1 - y % 2], row):
            return False
        for x in range(W):
            out[y, x] = np.float32(np.uint16(row[x, 0]) | (np.uint16(row[x, 1]) << np.uint16(8))) / scale
    return True


@serial
def _unfilter_samples(raw: Any, above: Any, out: Any) -> bool:
    """Undo the filter of a row, whose kind is its first byte, into out (W, B); False for a kind that is none."""
    B = out.shape[1]
    if raw[0] > 4:
        return False
    for k in range(B):
        _unfilter_row(raw[0], raw[1 + k :: B], above[:, B - 1 - k], out[:, B - 1 - k])
    return True


@serial
def _unfilter_row(kind: int, row: Any, above: Any, out: Any) -> None:
    """One byte of each sample of a row: a is the byte to the left, b the one above, c the one above left."""
    a, c = np.uint8(0), np.uint8(0)
    if kind == 0:
        for x in range(len(row)):
            out[x] = row[x]
    elif kind == 1:
        for x in range(len(row)):
            a = np.uint8(a + row[x])
            out[x] = a
    elif kind == 2:
        for x in range(len(row)):
            out[x] = row[x] + above[x]
    elif kind == 3:
        for x in range(len(row)):
            a = np.uint8(row[x] + (np.int64(a) + np.int64(above[x])) // 2)
            out[x] = a
    else:
        for x in range(len(row)):
            b = above[x]
            a = np.uint8(row[x] + _paeth(np.int64(a), np.int64(b), np.int64(c)))
            c = b
            out[x] = a


@serial
def _paeth(a: Any, b: Any, c: Any) -> Any:
    """Of left, above and above left the one nearest to a + b - c; in that order on ties."""
    to_a, to_b, to_c = abs(b - c), abs(a - c), abs(a + b - 2 * c)
    if to_a <= to_b and to_a <= to_c:
        return a
    return b if to_b <= to_c else c
