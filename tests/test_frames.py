import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semstab import Frame, Intrinsics
from semstab.datasets.geometry.cameras import Camera
from semstab.errors import DataError
from semstab.testing import checks

CAMERA = Intrinsics(fx=2, fy=3, cx=1, cy=0.5)
PATHS = {name: f"scene3/{name}/0012.png" for name in ("depth", "pose", "labels", "scores", "color", "intrinsics")}


def a_frame(**changes):
    """A good frame of 2x3 pixels, but for the changes."""
    fields = {
        "index": 12, "depth": np.ones((2, 3), np.float32), "intrinsics": CAMERA, "T_wc": np.eye(4),
        "labels": np.zeros((2, 3), np.uint8),
    }  # fmt: skip
    return Frame(**fields | changes)


def pose(**changes):
    T = np.eye(4)
    for place, value in changes.items():
        T[int(place[1]), int(place[2])] = value
    return T


# --- What is refused --------------------------------------------------------------------------------------------------

REFUSED = {
    "depth is not an image": ("depth", {"depth": np.ones(6, np.float32)}, "shape (6,)"),
    "depth is empty": ("depth", {"depth": np.ones((0, 3), np.float32)}, "shape (0, 3)"),
    "depth is in whole numbers": ("depth", {"depth": np.ones((2, 3), np.uint16)}, "depth is uint16; convert"),
    "pose is 3x3": ("pose", {"T_wc": np.eye(3)}, "shape (3, 3)"),
    "pose is not finite": ("pose", {"T_wc": pose(T03=math.nan)}, "not finite"),
    "pose is transposed": ("pose", {"T_wc": pose(T30=5.0)}, "transposed?"),
    "rotation mirrors": ("pose", {"T_wc": np.diag([1.0, 1, -1, 1])}, "mirrors (determinant -1)"),
    "rotation scales": ("pose", {"T_wc": np.diag([2.0, 2, 2, 1])}, "scale?"),
    "rotation shears": ("pose", {"T_wc": pose(T01=0.5)}, "not orthonormal"),
    "labels of another size": ("labels", {"labels": np.zeros((3, 2), np.uint8)}, "labels are 2x3 but depth is 3x2"),
    "camera is four numbers": ("intrinsics", {"intrinsics": (2, 3, 1, 0.5)}, "3x3 matrix, got shape (4,)"),
    "camera is transposed": ("intrinsics", {"intrinsics": CAMERA.matrix.T}, "transposed?"),
    "camera is a word": ("intrinsics", {"intrinsics": "pinhole"}, "not a 3x3 matrix"),
    "labels are float": ("labels", {"labels": np.zeros((2, 3))}, "labels are float64"),
    "labels are negative": ("labels", {"labels": np.full((2, 3), -1)}, "from -1 to 0; write 255"),
    "labels are too large": ("labels", {"labels": np.full((2, 3), 70_000)}, "from 0 to 70000"),
    "labels and scores": ("labels", {"scores": np.ones((2, 3, 4))}, "one of the two"),
    "neither labels nor scores": ("labels", {"labels": None}, "one of the two"),
    "scores of another size": (
        "scores",
        {"labels": None, "scores": np.ones((4, 3, 2))},
        "scores are 3x4 but depth is 3x2",
    ),
    "scores begin with K": ("scores", {"labels": None, "scores": np.ones((4, 2, 3))}, "(K, H, W) = (4, 2, 3); turn"),
    "scores are flat": ("scores", {"labels": None, "scores": np.ones((2, 3))}, "(H, W, K)"),
    "scores are whole numbers": ("scores", {"labels": None, "scores": np.ones((2, 3, 4), int)}, "must be float"),
    "scores of one class": ("scores", {"labels": None, "scores": np.ones((2, 3, 1))}, "at least 2"),
    "scores are logits": ("scores", {"labels": None, "scores": np.full((2, 3, 2), -1.0)}, "softmax"),
    "colour is grey": ("color", {"color": np.zeros((2, 3), np.uint8)}, "colour must be uint8 (H, W, 3)"),
    "colour is float": ("color", {"color": np.zeros((2, 3, 3))}, "got float64"),
}


@pytest.mark.parametrize(("field", "changes", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_a_frame_that_contradicts_itself_is_refused(field, changes, message):
    with pytest.raises(DataError) as in_memory:
        a_frame(**changes)
    with pytest.raises(DataError) as from_files:
        a_frame(**changes, files=PATHS)
    assert str(in_memory.value).startswith(f"frame 12, {field}: ")
    assert str(from_files.value).startswith(f"scene3/{field}/0012.png: ")
    for error in (in_memory, from_files):
        assert message in str(error.value)
        assert "\n" not in str(error.value)


def test_an_index_below_0_is_refused() -> None:
    with pytest.raises(DataError, match=r"^frame -3: its index is below 0; number frames from 0$"):
        a_frame(index=-3)


def test_what_has_one_meaning_is_taken() -> None:
    matrix = [[2, 0, 1], [0, 3, 0.5], [0, 0, 1]]
    assert a_frame(intrinsics=matrix).intrinsics == CAMERA
    for values, dtype in (([0, 2, 255], np.uint8), ([0, 2, 256], np.uint16), ([True, False, True], np.uint8)):
        labels = a_frame(labels=np.array([values, values])).labels
        assert labels.dtype == dtype
        np.testing.assert_array_equal(labels, [values, values])


@pytest.mark.parametrize("off", [0.0005, -0.0005])
def test_poses_of_few_digits_are_good_enough(off):
    assert a_frame(T_wc=pose(T01=off, T33=1 + off)).T_wc[0, 1] == off


def test_not_a_number_is_no_negative_score():
    scores = np.array([[[0.5, math.nan], [math.inf, 0.0], [0.5, 0.5]]])
    frame = a_frame(depth=np.ones((1, 3)), labels=None, scores=scores)
    assert frame.valid.tolist() == [[False, False, True]]


# --- What it holds ----------------------------------------------------------------------------------------------------


def test_depth_is_float32_and_the_pose_float64():
    frame = a_frame(depth=np.ones((2, 3)), T_wc=np.eye(4, dtype=np.float32).tolist())
    assert (frame.depth.dtype, frame.T_wc.dtype, frame.shape) == (np.float32, np.float64, (2, 3))


def test_arrays_are_read_only_and_the_callers_stay_writable():
    depth, labels = np.ones((2, 3), np.float32), np.zeros((2, 3), np.uint8)
    frame = a_frame(depth=depth, labels=labels)
    for array in (frame.depth, frame.labels, frame.T_wc, frame.valid, frame.predicted):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    depth[0, 0], labels[0, 0] = 2, 2


def test_the_pose_is_the_frames_own():
    T = np.eye(4)
    frame = a_frame(T_wc=T)
    T[0, 3] = 7
    assert frame.T_wc[0, 3] == 0


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf, -math.inf])
def test_a_pixel_without_depth_is_not_valid(bad):
    assert a_frame(depth=np.array([[1, bad, 1], [1, 1, 1]])).valid.tolist() == [[True, False, True], [True] * 3]


@pytest.mark.parametrize(("dtype", "ignore", "other"), [(np.uint8, 255, 254), (np.uint16, 65535, 255)])
def test_the_ignore_id_goes_with_the_type_of_the_map(dtype, ignore, other):
    frame = a_frame(labels=np.array([[0, ignore, other], [0, 0, 0]], dtype))
    assert frame.ignore_id == ignore
    assert frame.valid.tolist() == [[True, False, True], [True] * 3]


def test_scores_predict_their_largest_class_the_lowest_on_ties():
    scores = np.array([[[0, 2, 1], [1, 1, 0], [0, 0, 0]]], dtype=np.float16)
    frame = a_frame(depth=np.ones((1, 3)), labels=None, scores=scores)
    assert frame.predicted.tolist() == [[1, 0, 255]]
    assert frame.valid.tolist() == [[True, True, False]]


def test_many_classes_predict_16_bit_labels():
    scores = np.zeros((1, 2, 300), np.float32)
    scores[0, 0, 255] = 1
    frame = a_frame(depth=np.ones((1, 2)), labels=None, scores=scores)
    assert frame.predicted.tolist() == [[255, 65535]]
    assert frame.predicted.dtype == np.uint16


# --- Pixel stride -----------------------------------------------------------------------------------------------------


def test_every_second_pixel_lies_where_it_lay():
    labels = np.arange(20, dtype=np.uint8).reshape(4, 5)
    color = np.zeros((4, 5, 3), np.uint8)
    frame = a_frame(depth=np.ones((4, 5)), labels=labels, color=color, files=PATHS, timestamp=3.5)
    half = frame.every(2)
    assert half.labels.tolist() == [[0, 2, 4], [10, 12, 14]]
    assert (half.color.shape, half.index, half.timestamp, half.files) == ((2, 3, 3), 12, 3.5, PATHS)
    u, v = 2, 1  # pixel (2, 1) of the half image is pixel (4, 2) of the whole
    assert (u - half.intrinsics.cx) / half.intrinsics.fx == (4 - CAMERA.cx) / CAMERA.fx
    assert (v - half.intrinsics.cy) / half.intrinsics.fy == (2 - CAMERA.cy) / CAMERA.fy


def test_every_pixel_is_the_frame_itself():
    frame = a_frame()
    assert frame.every(1) is frame


def test_scores_are_strided_with_their_pixels():
    scores = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    assert a_frame(labels=None, scores=scores).every(2).scores.tolist() == [[[0, 1], [4, 5]]]


# --- Intrinsics -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [{"fx": 0}, {"fy": -1}, {"cx": math.nan}, {"fx": math.inf}])
def test_intrinsics_must_make_sense(bad):
    name = next(iter(bad))
    with pytest.raises(DataError, match=rf"^intrinsics: {name} = "):
        Intrinsics(**{"fx": 1, "fy": 1, "cx": 0, "cy": 0} | bad)


def test_intrinsics_from_a_matrix_and_back():
    assert Intrinsics.from_matrix(CAMERA.matrix) == CAMERA
    assert Intrinsics.from_matrix(np.pad(CAMERA.matrix, (0, 1))) == CAMERA


def test_a_camera_matrix_has_a_shape_and_no_skew():
    with pytest.raises(DataError, match="3x3"):
        Intrinsics.from_matrix(np.eye(2))
    with pytest.raises(DataError, match="skew"):
        Intrinsics.from_matrix([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])


def test_resizing_keeps_the_corners_of_the_image():
    """Pixel centres are whole numbers, so the left edge of the image is u = -0.5 and the right one W - 0.5."""
    half = CAMERA.resized((640, 480), (320, 240))
    for edge, edge_of_half in ((-0.5, -0.5), (639.5, 319.5)):
        assert (edge_of_half - half.cx) / half.fx == pytest.approx((edge - CAMERA.cx) / CAMERA.fx)
    for edge, edge_of_half in ((-0.5, -0.5), (479.5, 239.5)):
        assert (edge_of_half - half.cy) / half.fy == pytest.approx((edge - CAMERA.cy) / CAMERA.fy)


def test_the_centre_of_an_image_stays_its_centre():
    centred = Intrinsics(fx=4, fy=4, cx=1.5, cy=1.5)  # of 4x4 pixels
    assert centred.resized((4, 4), (2, 2)) == Intrinsics(fx=2, fy=2, cx=0.5, cy=0.5)


sizes = st.tuples(st.integers(1, 4000), st.integers(1, 4000))


@checks
@given(sizes, sizes)
def test_resizing_there_and_back(size, to):
    back = CAMERA.resized(size, to).resized(to, size)
    assert np.allclose(back.matrix, CAMERA.matrix, rtol=0, atol=1e-9)


@pytest.mark.parametrize("numbers", [(0, 50, 10, 10), (50, 1e12, 10, 10), (50, 1e-4, 10, 10)])
def test_a_camera_that_there_is_not_is_refused_with_the_file_that_states_it(numbers) -> None:
    with pytest.raises(DataError, match=r"^cameras\.txt: intrinsics: f[xy] = "):
        Camera.stated(numbers, None, "cameras.txt")
