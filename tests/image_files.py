"""Bytes of depth, label, score and colour files of every format, and the check that a reader refuses a file."""

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from semstab import LabelSpace
from semstab.datasets.formats.decoders import PNG_SIGNATURE
from semstab.errors import DataError

SHAPE = (6, 8)
METRES = np.random.default_rng(7).uniform(0.1, 60, SHAPE).astype(np.float32)
MILLIMETRES = np.round(METRES * 1000).astype(np.uint16)
IDS = np.random.default_rng(8).integers(0, 3, SHAPE).astype(np.uint8)
SPACE = LabelSpace("three", ("a", "b", "c"), ids=(0, 4, 7), colors=((0, 0, 0), (128, 64, 128), (0, 128, 0)))
RGB = np.array(SPACE.colors, dtype=np.uint8)[IDS]
OPAQUE = np.full(SHAPE, 255, np.uint8)
SCORES = np.random.default_rng(9).random((*SHAPE, 3))


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def refused(read, path, *args, match):
    """One line that names the file."""
    with pytest.raises(DataError, match=match) as caught:
        read(path, *args)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


def saved(image, kind="PNG", **options) -> bytes:
    """An array or a Pillow image as PNG or JPEG."""
    out = io.BytesIO()
    (image if isinstance(image, Image.Image) else Image.fromarray(image)).save(out, kind, **options)
    return out.getvalue()


def palette_png(ids, bits=8) -> bytes:
    """Index k has the colour (255 - k, k // 2, 7)."""
    image = Image.fromarray(ids).convert("L")
    image.putpalette([v for k in range(256) for v in (255 - k, k // 2, 7)])
    return saved(image, bits=bits)


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def raw_png(width, height, bits, color_type, samples, between=b"") -> bytes:
    """A PNG with right checksums, whatever its header and its samples (as stored, compressed) say."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color_type, 0, 0, 0))
    return PNG_SIGNATURE + header + between + png_chunk(b"IDAT", samples) + png_chunk(b"IEND", b"")


def tiff_bytes(array, *parameters) -> bytes:
    return cv2.imencode(".tiff", array, list(parameters))[1].tobytes()


def exr_header(right, bottom) -> bytes:
    return b"v/1\x01\x02\0\0\0dataWindow\0box2i\0\x10\0\0\0" + struct.pack("<4i", 0, 0, right, bottom) + bytes(40)


def npy_bytes(array) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def npz_bytes(compress=False, **arrays) -> bytes:
    out = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(out, **arrays)
    return out.getvalue()
