"""Depth, labels, scores and colour of every format; damaged files are one line that names the file."""

import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from image_files import (
    IDS,
    METRES,
    MILLIMETRES,
    OPAQUE,
    RGB,
    SCORES,
    SHAPE,
    SPACE,
    exr_header,
    npy_bytes,
    npz_bytes,
    palette_png,
    png_chunk,
    raw_png,
    refused,
    saved,
    tiff_bytes,
    written,
)

from semstab import LabelSpace
from semstab.datasets.formats.decoders import PNG_SIGNATURE, reads_exr
from semstab.datasets.formats.images import read_color, read_depth, read_labels, read_scores
from semstab.errors import ConfigError, DataError

# --- depth


def test_depth_of_16_bit_png_is_millimetres_unless_a_scale_is_given(tmp_path):
    path = written(tmp_path / "d.png", saved(MILLIMETRES))
    depth = read_depth(path)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, (MILLIMETRES / 1000).astype(np.float32))
    np.testing.assert_array_equal(read_depth(path, 5000), (MILLIMETRES / 5000).astype(np.float32))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("d.npy", npy_bytes(METRES)), ("d.NPY", npy_bytes(np.asfortranarray(METRES))),
        ("d.npy", npy_bytes(METRES.astype(">f4"))), ("d.npy", npy_bytes(METRES.astype(np.float64))),
        ("d.npz", npz_bytes(depth=METRES, other=IDS)), ("d.npz", npz_bytes(compress=True, whatever=METRES)),
        ("d.tiff", tiff_bytes(METRES)), ("d.tif", tiff_bytes(METRES, cv2.IMWRITE_TIFF_COMPRESSION, 1)),
        ("d.tif", tiff_bytes(METRES.astype(np.float64))),
    ],
)  # fmt: skip
def test_depth_of_float_files_is_metres(tmp_path, name, content):
    path = written(tmp_path / name, content)
    depth = read_depth(path)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, METRES)
    np.testing.assert_array_equal(read_depth(path, 2.0), METRES / 2)


def test_depth_keeps_what_marks_a_pixel_invalid(tmp_path):
    path = written(tmp_path / "d.npy", npy_bytes(np.array([[0, -1, np.nan, np.inf, 1e300]])))
    np.testing.assert_array_equal(read_depth(path), np.array([[0, -1, np.nan, np.inf, np.inf]], np.float32))


@pytest.mark.parametrize("dtype", [np.uint16, np.int64])
def test_integer_depth_needs_a_scale(tmp_path, dtype):
    path = written(tmp_path / "d.npy", npy_bytes(MILLIMETRES.astype(dtype)))
    refused(read_depth, path, match="unknown unit; set depth_scale")
    np.testing.assert_allclose(read_depth(path, 1000), MILLIMETRES / 1000, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("d.png", saved(IDS), "expected 16-bit grey, got 8-bit grey "),
        ("d.png", saved(RGB), "expected 16-bit grey, got 8-bit RGB "),
        ("d.png", saved(np.dstack([RGB, IDS])), "expected 16-bit grey, got 8-bit RGBA "),
        ("d.npy", npy_bytes(METRES > 1), "depth is bool"),
        ("d.npy", npy_bytes(METRES[None]), r"shape \(1, 6, 8\)"),
        ("d.npy", npy_bytes(np.array([{"a": 1}], dtype=object)), "does not hold plain numbers"),
        ("d.npy", npy_bytes(METRES[:0]), "cannot hold an image"),
        ("d.npz", npz_bytes(a=METRES, b=METRES), r"holds arrays \['a', 'b'\]; name one 'depth'"),
        ("d.tiff", tiff_bytes(IDS), "expected 32-bit float metres, got 8-bit unsigned"),
        ("d.tiff", tiff_bytes(MILLIMETRES), "unknown unit; set depth_scale"),
        ("d.tiff", tiff_bytes(np.dstack([METRES] * 3)), "got 3 channels"),
        ("d.tiff", b"II+\0" + bytes(40), "not a whole TIFF"),
        ("d.exr", b"not an exr", "not a whole EXR"),
    ],
)
def test_depth_of_another_type_is_refused(tmp_path, name, content, match):
    refused(read_depth, written(tmp_path / name, content), match=match)


def test_exr_says_what_to_convert_to_where_opencv_cannot_read_it(tmp_path):
    path = written(tmp_path / "d.exr", exr_header(7, 5))
    refused(read_depth, path, match="damaged" if reads_exr() else r"convert the depth to \.npy")


# --- labels


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_labels_of_grey_png_are_its_values(tmp_path, dtype):
    labels = read_labels(written(tmp_path / "l.png", saved(IDS.astype(dtype) + dtype(250))))
    assert labels.dtype == dtype
    np.testing.assert_array_equal(labels, IDS + 250)


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_labels_of_palette_png_are_its_indices(tmp_path, bits):
    ids = np.random.default_rng(bits).integers(0, 2**bits, SHAPE).astype(np.uint8)
    content = palette_png(ids, bits)
    assert content[24:26] == bytes([bits, 3])
    np.testing.assert_array_equal(read_labels(written(tmp_path / "l.png", content)), ids)


@pytest.mark.parametrize(
    ("bits", "ids"), [(1, [0, 0, 0, 1, 1, 0, 1, 1]), (2, [0, 1, 2, 3, 0, 1, 2, 3]), (4, [1, 11] * 4)]
)
def test_labels_of_narrow_grey_png_are_its_values(tmp_path, bits, ids):
    content = raw_png(8, 1, bits, 0, zlib.compress(b"\0" + b"\x1b" * bits))
    assert read_labels(written(tmp_path / "l.png", content)).tolist() == [ids]


@pytest.mark.parametrize("image", [RGB, np.dstack([RGB, OPAQUE])])
@pytest.mark.parametrize(("ids", "dtype"), [(SPACE.ids, np.uint8), ((0, 300, 65534), np.uint16)])
def test_labels_of_rgb_png_go_by_the_colours_of_the_classes(tmp_path, image, ids, dtype):
    space = LabelSpace("three", SPACE.classes, ids=ids, colors=SPACE.colors)
    labels = read_labels(written(tmp_path / "l.png", saved(image)), space)
    assert labels.dtype == dtype
    np.testing.assert_array_equal(labels, np.array(ids)[IDS])


@pytest.mark.parametrize("channels", [(0, 1), (0, 2), (1, 2)])
def test_colours_of_eight_bits_a_channel_are_told_apart(tmp_path, channels):
    """Colours that have a bit each, in two of the three channels."""
    colors = [tuple(1 << bit if k == channel else 0 for k in range(3)) for channel in channels for bit in range(8)]
    space = LabelSpace("bits", tuple(f"class {k}" for k in range(16)), colors=tuple(colors))
    image = np.array([colors, colors], np.uint8)
    labels = read_labels(written(tmp_path / "l.png", saved(image)), space)
    assert labels.tolist() == [[*range(16)]] * 2


def test_a_colour_of_no_class_names_colour_pixel_and_file(tmp_path):
    image = RGB.copy()
    image[2, 5] = (1, 2, 3)
    image[4, 1] = (9, 9, 9)
    path = written(tmp_path / "l.png", saved(image))
    match = r"colour \(1, 2, 3\) at pixel \(5, 2\) \(2 pixels\) is no class of 'three'"
    refused(read_labels, path, SPACE, match=match)
    refused(read_labels, path, match="set classes or taxonomy")


def test_classes_that_share_a_colour_are_refused(tmp_path):
    space = LabelSpace("twins", ("a", "b"), colors=((1, 1, 1), (1, 1, 1)))
    with pytest.raises(ConfigError, match=r"taxonomy twins: two classes have the colour \(1, 1, 1\)"):
        read_labels(written(tmp_path / "l.png", saved(RGB)), space)


def test_transparent_label_colours_are_refused(tmp_path):
    image = np.dstack([RGB, OPAQUE])
    image[3, 1, 3] = 128
    refused(read_labels, written(tmp_path / "l.png", saved(image)), SPACE, match=r"pixel \(1, 3\) is transparent")


@pytest.mark.parametrize(
    ("array", "space", "dtype"),
    [
        (IDS, None, np.uint8), (IDS.astype(np.uint16), None, np.uint16), (IDS.astype(np.int64), None, np.uint8),
        (IDS.astype(">i4"), None, np.uint8), (IDS.astype(np.int32) + 300, None, np.uint16),
        (IDS.astype(np.int32) + 250, LabelSpace("wide", ("a", "b"), ids=(0, 400)), np.uint16),
    ],
)  # fmt: skip
def test_labels_of_arrays_are_narrowed(tmp_path, array, space, dtype):
    for name, content in (("l.npy", npy_bytes(array)), ("l.npz", npz_bytes(ids=array))):
        labels = read_labels(written(tmp_path / name, content), space)
        assert labels.dtype == dtype
        np.testing.assert_array_equal(labels, array)


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("l.npy", npy_bytes(IDS.astype(np.int64) - 1), "ids from -1 to 1"),
        ("l.npy", npy_bytes(IDS.astype(np.int64) * 65536), "ids from 0 to 131072"),
        ("l.npy", npy_bytes(IDS.astype(np.float32)), "must be integer ids .* got float32"),
        ("l.npy", npy_bytes(IDS[None]), r"shape \(1, 6, 8\)"),
        ("l.png", saved(np.dstack([IDS, IDS])), r"8-bit grey\+alpha PNG cannot hold labels"),
        ("l.png", cv2.imencode(".png", RGB.astype(np.uint16))[1].tobytes(), "16-bit RGB PNG cannot hold labels"),
    ],
)
def test_labels_of_another_type_are_refused(tmp_path, name, content, match):
    refused(read_labels, written(tmp_path / name, content), SPACE, match=match)


# --- scores and colour


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("layout", ["KHW", "HWK"])
def test_scores_are_hwk_and_contiguous(tmp_path, dtype, layout):
    scores = SCORES.astype(dtype)
    stored = scores.transpose(2, 0, 1) if layout == "KHW" else scores
    for name, content in (("s.npz", npz_bytes(compress=True, scores=stored)), ("s.npy", npy_bytes(stored))):
        read = read_scores(written(tmp_path / name, content), layout, SHAPE)
        assert read.dtype == dtype
        assert read.flags.c_contiguous
        np.testing.assert_array_equal(read, scores)


@pytest.mark.parametrize(
    ("scores", "match"),
    [
        (SCORES, r"shape \(6, 8, 3\) are not KHW; set scores_layout: HWK"),
        (np.ones((3, *SHAPE), np.uint8), "must be float16 or float32 with three axes, got uint8"),
        (np.ones(SHAPE), r"must be float16 or float32 with three axes, .* shape \(6, 8\)"),
    ],
)
def test_scores_of_another_type_or_layout_are_refused(tmp_path, scores, match):
    path = written(tmp_path / "s.npz", npz_bytes(scores=scores))
    refused(read_scores, path, "KHW", SHAPE, match=match)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (saved(RGB), RGB),
        (saved(IDS), np.dstack([IDS] * 3)),
        (palette_png(IDS), np.dstack([255 - IDS, IDS // 2, np.full(SHAPE, 7)])),
    ],
    ids=["RGB", "grey", "palette"],
)
def test_colour_of_any_png_is_rgb(tmp_path, content, expected):
    np.testing.assert_array_equal(read_color(written(tmp_path / "c.png", content)), expected)


def test_colour_of_jpeg_is_rgb(tmp_path):
    red = np.full((16, 16, 3), (250, 10, 10), np.uint8)
    color = read_color(written(tmp_path / "c.jpg", saved(red, "JPEG", quality=95)))
    assert np.abs(color.astype(int) - red).max() < 8


# --- damaged files


NOISE = np.random.default_rng(7).integers(0, 256, (24, 32, 3)).astype(np.uint8)


def read_khw(path):
    return read_scores(path, "KHW", SHAPE)


WHOLE = {
    "depth.png": (saved(MILLIMETRES), read_depth), "labels.png": (saved(IDS), read_labels),
    "color.png": (saved(NOISE), read_color), "color.jpg": (saved(NOISE, "JPEG"), read_color),
    "depth.npy": (npy_bytes(METRES), read_depth), "depth.npz": (npz_bytes(depth=METRES), read_depth),
    "labels.npz": (npz_bytes(compress=True, labels=IDS), read_labels), "depth.tiff": (tiff_bytes(METRES), read_depth),
    "scores.npz": (npz_bytes(compress=True, scores=SCORES.transpose(2, 0, 1).astype(np.float16)), read_khw),
}  # fmt: skip


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
        ("c.png", raw_png(16, 8388364, 8, 2, b""), "16x8388364"),
        ("d.tiff", wide_tiff(), "1000000000x6"),
        ("d.exr", exr_header(10**6, 10**6), "1000001x1000001"),
        ("c.jpg", wide_jpeg(), "65000x65000"),
    ],
)
def test_absurd_sizes_are_refused_before_memory_is_taken(tmp_path, name, content, size):
    read = read_color if name.startswith("c.") else read_depth
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
    ".npy": [read_depth, read_labels, read_khw], ".npz": [read_depth, read_labels, read_khw], ".jpg": [read_color],
    ".tiff": [read_depth], ".exr": [read_depth],
}  # fmt: skip
BEGINNINGS = {
    ".png": PNG_SIGNATURE, ".npy": b"\x93NUMPY\x01\0", ".npz": b"PK\x03\x04", ".jpg": b"\xff\xd8\xff",
    ".tiff": b"II*\0", ".exr": b"v/1\x01\x02\0\0\0dataWindow\0box2i\0\x10\0\0\0",
}  # fmt: skip


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
    size=st.tuples(st.integers(0, 9), st.integers(0, 9)), bits=st.sampled_from([1, 2, 3, 4, 8, 16]),
    kind=st.integers(0, 7), samples=st.binary(max_size=120), compressed=st.booleans(),
)  # fmt: skip
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


@pytest.mark.parametrize("alpha", [0, 1, 40, 200, 255])
def test_a_picture_with_an_alpha_channel_is_no_packed_depth(tmp_path, alpha) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (6, 8, 4), np.uint8)
    picture[..., 3] = alpha
    assert cv2.imwrite(str(tmp_path / "d.png"), picture)
    refused(read_depth, tmp_path / "d.png", match="expected 16-bit grey, got 8-bit RGBA")


def test_packed_depth_is_float_metres(tmp_path) -> None:
    depth = np.array([[0.0, 0.25, 3.5], [1e4, 80.125, 6.0]], "<f4")
    assert cv2.imwrite(str(tmp_path / "d.png"), depth[..., None].view(np.uint8))
    np.testing.assert_array_equal(read_depth(tmp_path / "d.png"), depth)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.png", 2.0), depth / 2)
