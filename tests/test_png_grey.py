"""The quick way to decode grey PNGs equals OpenCV's, for every filter, and leaves what is damaged to it."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from image_files import png_chunk, raw_png

from semstab.datasets.formats import png_grey
from semstab.datasets.formats.codecs import Png, parse_png

FILTERS = ("NONE", "SUB", "UP", "AVG", "PAETH")


def stream_of(png: Png) -> list[memoryview]:
    return [body for kind, body in png.chunks if kind == b"IDAT"]


def decoded(data: bytes):
    png = parse_png("a.png", data)
    assert png.kind == "grey"
    width, height, bits, *_ = png.header
    quick = png_grey.decode(width, height, bits, stream_of(png))
    np.testing.assert_array_equal(png.samples(), quick)
    return quick, cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("kind", [*(f"IMWRITE_PNG_FILTER_{name}" for name in FILTERS), "IMWRITE_PNG_ALL_FILTERS"])
def test_every_filter(dtype, kind) -> None:
    rng = np.random.default_rng(3)
    smooth = np.add.outer(np.arange(37) * 7, np.arange(53) * 11) * (1 if dtype == np.uint8 else 97)
    image = (smooth + rng.integers(0, 9, smooth.shape)).astype(dtype)
    quick, other = decoded(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_FILTER, getattr(cv2, kind)])[1].tobytes())
    np.testing.assert_array_equal(quick, image)
    np.testing.assert_array_equal(other, image)
    assert quick.dtype == dtype
    assert quick.flags.c_contiguous


@pytest.mark.parametrize("bits", [8, 16])
def test_the_usual_image_never_meets_the_other_decoder(monkeypatch, bits) -> None:
    png = parse_png("a.png", raw_png(1, 1, bits, 0, zlib.compress(b"\0\7\7"[: 1 + bits // 8])))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was asked"))
    value = 7 if bits == 8 else 0x0707
    assert png.samples().tolist() == png.indices().tolist() == [[value]]
    if bits == 16:
        assert png.metres(1.0).tolist() == [[value]]


@given(st.integers(1, 9), st.integers(1, 9), st.sampled_from([8, 16]), st.data())
def test_any_filtered_bytes(width, height, bits, data) -> None:
    """Rows of arbitrary bytes behind arbitrary filters: whatever the encoder, the result is the decoder's."""
    row = width * bits // 8
    kinds = data.draw(st.lists(st.integers(0, 4), min_size=height, max_size=height))
    rows = [data.draw(st.binary(min_size=row, max_size=row)) for _ in kinds]
    filtered = b"".join(bytes([kind]) + content for kind, content in zip(kinds, rows, strict=True))
    quick, other = decoded(raw_png(width, height, bits, 0, zlib.compress(filtered)))
    np.testing.assert_array_equal(quick, other)


@pytest.mark.parametrize(
    "stream",
    [
        zlib.compress(bytes(6 * 9))[:-1],  # truncated
        zlib.compress(bytes(5 * 9)),  # a row short
        zlib.compress(bytes(7 * 9)),  # a row more
        zlib.compress(b"\x05" + bytes(53)),  # there is no filter 5
        zlib.compress(bytes(6 * 9))[:-4] + b"\0\0\0\7",  # another checksum
        b"",
    ],
)
def test_what_is_damaged_is_left_to_the_other_decoder(stream) -> None:
    assert png_grey.decode(8, 6, 8, [memoryview(stream)]) is None


def test_no_memory_is_taken_for_what_a_header_claims() -> None:
    assert png_grey.decode(1 << 14, 1 << 14, 16, [memoryview(zlib.compress(bytes(100)))]) is None


def test_interlaced_and_narrow_images_are_left_to_the_other_decoder() -> None:
    narrow = raw_png(8, 1, 4, 0, zlib.compress(b"\0\x12\x34\x56\x78"))
    assert parse_png("a.png", narrow).indices().tolist() == [[1, 2, 3, 4, 5, 6, 7, 8]]
    header = png_chunk(b"IHDR", b"\0\0\0\1\0\0\0\1\x08\0\0\0\1")
    interlaced = narrow[:8] + header + png_chunk(b"IDAT", zlib.compress(b"\0\7")) + png_chunk(b"IEND", b"")
    assert parse_png("a.png", interlaced).samples().tolist() == [[7]]


@given(st.integers(1, 9), st.integers(1, 9), st.floats(1e-3, 1e6), st.data())
def test_metres_are_the_samples_divided_by_the_scale(width, height, scale, data) -> None:
    kinds = data.draw(st.lists(st.integers(0, 4), min_size=height, max_size=height))
    rows = [data.draw(st.binary(min_size=2 * width, max_size=2 * width)) for _ in kinds]
    filtered = b"".join(bytes([kind]) + content for kind, content in zip(kinds, rows, strict=True))
    png = parse_png("a.png", raw_png(width, height, 16, 0, zlib.compress(filtered)))
    metres = png_grey.decode_metres(width, height, scale, stream_of(png))
    expected = np.divide(png.samples(), scale, dtype=np.float32, casting="same_kind")
    np.testing.assert_array_equal(metres, expected)
    np.testing.assert_array_equal(png.metres(scale), expected)
    assert metres.dtype == np.float32


def test_metres_of_a_damaged_stream_are_left_to_the_other_decoder() -> None:
    assert png_grey.decode_metres(4, 6, 1000.0, [memoryview(zlib.compress(bytes(6 * 9))[:-1])]) is None
    assert png_grey.decode_metres(4, 1, 1000.0, [memoryview(zlib.compress(b"\x05" + bytes(8)))]) is None
