"""Depth, labels, scores and colour of every format, and files that hold something else."""

import zlib

import cv2
import numpy as np
import pytest
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
    raw_png,
    refused,
    saved,
    tiff_bytes,
    written,
)

from semstab.datasets.formats import images
from semstab.datasets.formats.images import read_color, read_depth, read_labels, read_scores
from semstab.errors import ConfigError
from semstab.model.labels import LabelSpace

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
        ("d.npy", npy_bytes(METRES)),
        ("d.NPY", npy_bytes(np.asfortranarray(METRES))),
        ("d.npy", npy_bytes(METRES.astype(">f4"))),
        ("d.npy", npy_bytes(METRES.astype(np.float64))),
        ("d.npz", npz_bytes(depth=METRES, other=IDS)),
        ("d.npz", npz_bytes(compress=True, whatever=METRES)),
        ("d.tiff", tiff_bytes(METRES)),
        ("d.tif", tiff_bytes(METRES, cv2.IMWRITE_TIFF_COMPRESSION, 1)),
        ("d.tif", tiff_bytes(METRES.astype(np.float64))),
    ],
)
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
    refused(read_depth, path, match="damaged" if images.reads_exr() else r"convert the depth to \.npy")


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
        (IDS, None, np.uint8),
        (IDS.astype(np.uint16), None, np.uint16),
        (IDS.astype(np.int64), None, np.uint8),
        (IDS.astype(">i4"), None, np.uint8),
        (IDS.astype(np.int32) + 300, None, np.uint16),
        (IDS.astype(np.int32) + 250, LabelSpace("wide", ("a", "b"), ids=(0, 400)), np.uint16),
    ],
)
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
