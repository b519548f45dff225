"""Damaged depth, label, score and colour files: an array, or one line that names the file, and nothing on stderr."""

import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from image_files import (
    IDS,
    METRES,
    MILLIMETRES,
    SCORES,
    SHAPE,
    SPACE,
    exr_header,
    npy_bytes,
    npz_bytes,
    png_chunk,
    raw_png,
    refused,
    saved,
    tiff_bytes,
    written,
)

from semstab.datasets.formats.images import PNG_SIGNATURE, read_color, read_depth, read_labels, read_scores
from semstab.errors import DataError

NOISE = np.random.default_rng(7).integers(0, 256, (24, 32, 3)).astype(np.uint8)


def read_khw(path):
    return read_scores(path, "KHW", SHAPE)


WHOLE = {
    "depth.png": (saved(MILLIMETRES), read_depth),
    "labels.png": (saved(IDS), read_labels),
    "color.png": (saved(NOISE), read_color),
    "color.jpg": (saved(NOISE, "JPEG"), read_color),
    "depth.npy": (npy_bytes(METRES), read_depth),
    "depth.npz": (npz_bytes(depth=METRES), read_depth),
    "labels.npz": (npz_bytes(compress=True, labels=IDS), read_labels),
    "depth.tiff": (tiff_bytes(METRES), read_depth),
    "scores.npz": (npz_bytes(compress=True, scores=SCORES.transpose(2, 0, 1).astype(np.float16)), read_khw),
}


@pytest.mark.parametrize("name", list(WHOLE))
def test_truncated_files_are_refused(tmp_path, name, capfd):
    content, read = WHOLE[name]
    read(written(tmp_path / name, content))
    # of a TIFF the last four bytes point to the next image, of a PNG they are the checksum of an empty chunk
    most = len(content) - 5 if name.endswith(("tiff", "png")) else len(content) - 1
    for size in {0, 1, 7, 8, 20, 33, 60, *np.linspace(1, most, 60).astype(int).tolist()}:
        refused(read, written(tmp_path / name, content[:size]), match="copy or export it again")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", [name for name in WHOLE if name.endswith(("png", "npz"))])
def test_a_flipped_bit_in_the_data_is_found(tmp_path, name):
    content, read = WHOLE[name]
    flipped = bytearray(content)
    flipped[content.index(b"IDAT") + 8 if name.endswith("png") else len(content) // 3] ^= 4
    refused(read, written(tmp_path / name, flipped), match="copy or export it again")


@pytest.mark.parametrize("name", list(WHOLE))
def test_files_of_another_kind_are_refused(tmp_path, name):
    read = WHOLE[name][1]
    path = written(tmp_path / name, b"<html>404</html>" * 20)
    refused(read, path, match="not a|again")
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    refused(read, path, match="git lfs pull")
    path.unlink()
    refused(read, path, match="cannot be read")
    path.mkdir()
    refused(read, path, match="cannot be read")


# --- PNG, JPEG, TIFF, EXR


def test_remarks_in_a_png_do_not_matter(tmp_path, capfd):
    remark = png_chunk(b"iCCP", b"broken profile\0\0" + b"x" * 9)
    content = raw_png(8, 1, 8, 0, zlib.compress(b"\0abcdefgh"), between=remark)
    assert read_labels(written(tmp_path / "l.png", content)).tobytes() == b"abcdefgh"
    assert capfd.readouterr() == ("", "")


def wide_tiff() -> bytes:
    width = struct.pack("<HHII", 256, 3, 1, 8)
    assert width in tiff_bytes(METRES)
    return tiff_bytes(METRES).replace(width, struct.pack("<HHII", 256, 4, 1, 10**9))


def wide_jpeg() -> bytes:
    content = bytearray(saved(NOISE, "JPEG"))
    struct.pack_into(">HH", content, content.index(b"\xff\xc0") + 5, 65000, 65000)
    return content


@pytest.mark.parametrize(
    ("name", "content", "size"),
    [
        ("d.png", raw_png(60000, 60000, 16, 0, b""), "60000x60000"),
        ("d.tiff", wide_tiff(), "1000000000x6"),
        ("d.exr", exr_header(10**6, 10**6), "1000001x1000001"),
        ("c.jpg", wide_jpeg(), "65000x65000"),
    ],
)
def test_absurd_sizes_are_refused_before_memory_is_taken(tmp_path, name, content, size):
    read = read_color if name == "c.jpg" else read_depth
    refused(read, written(tmp_path / name, content), match=f"claims {size} pixels")


# --- npy and npz


@pytest.mark.parametrize(
    ("shape", "match"),
    [
        ("(100000, 1000000)", "needs 400000000000 bytes, the file has 64"),
        ("(" + "9" * 60 + ",)", "needs [0-9]{60,} bytes"),
        ("(" + "1, " * 60 + ")", "cannot hold an image"),
        ("(6, -8)", "header is damaged"),
    ],
)
def test_an_array_must_fit_its_file(tmp_path, shape, match):
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode()
    content = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(64)
    refused(read_depth, written(tmp_path / "d.npy", content), match=match)
    with zipfile.ZipFile(tmp_path / "d.npz", "w") as archive:
        archive.writestr("depth.npy", content)
    refused(read_depth, tmp_path / "d.npz", match=match)


def test_nothing_is_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("unpickled",))

    content = npz_bytes(depth=np.array([Trap()], dtype=object))
    refused(read_depth, written(tmp_path / "d.npz", content), match="does not hold plain numbers")


# --- any bytes

FUZZ = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
READERS = {
    ".png": [read_depth, read_color, lambda path: read_labels(path, SPACE)],
    ".npy": [read_depth, read_labels, read_khw],
    ".npz": [read_depth, read_labels, read_khw],
    ".jpg": [read_color],
    ".tiff": [read_depth],
    ".exr": [read_depth],
}
BEGINNINGS = {
    ".png": PNG_SIGNATURE,
    ".npy": b"\x93NUMPY\x01\0",
    ".npz": b"PK\x03\x04",
    ".jpg": b"\xff\xd8\xff",
    ".tiff": b"II*\0",
    ".exr": b"v/1\x01\x02\0\0\0dataWindow\0box2i\0\x10\0\0\0",
}


def survives(path: Path) -> None:
    for read in READERS[path.suffix]:
        message = path.name
        try:
            assert isinstance(read(path), np.ndarray)
        except DataError as error:
            message = str(error)
        assert path.name in message
        assert "\n" not in message


@pytest.mark.parametrize("suffix", list(READERS))
@given(content=st.binary(max_size=200))
@FUZZ
def test_random_bytes_are_an_array_or_a_data_error(tmp_path, suffix, content):
    survives(written(tmp_path / f"file{suffix}", content))
    survives(written(tmp_path / f"file{suffix}", BEGINNINGS[suffix] + content))


@given(
    size=st.tuples(st.integers(0, 9), st.integers(0, 9)),
    bits=st.sampled_from([1, 2, 3, 4, 8, 16]),
    kind=st.integers(0, 7),
    samples=st.binary(max_size=120),
    compressed=st.booleans(),
)
@FUZZ
def test_png_with_right_checksums_is_an_array_or_a_data_error(tmp_path, size, bits, kind, samples, compressed):
    content = raw_png(*size, bits, kind, zlib.compress(samples) if compressed else samples)
    survives(written(tmp_path / "file.png", content))


HEADERS = r"\{'descr': '[<>|=]?[a-zA-Z]\d{0,2}', 'fortran_order': (True|False), 'shape': \([\d, ]{0,20}\), \}"


@given(header=st.one_of(st.text(max_size=80), st.from_regex(HEADERS, fullmatch=True)), body=st.binary(max_size=64))
@FUZZ
def test_npy_with_any_header_is_an_array_or_a_data_error(tmp_path, header, body):
    text = header.encode("utf-8", errors="surrogatepass")
    survives(written(tmp_path / "file.npy", b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + body))
