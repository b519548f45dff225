"""Poses and intrinsics: their forms and conventions, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from posed_scene import fails, first_frame, opened, pose, say, write_scene

from semstab.datasets.formats.disk import read_intrinsics, read_pose
from semstab.errors import DataError


@pytest.fixture
def folder(tmp_path) -> Path:
    return write_scene(tmp_path / "scene0")


POINT_CV = np.array([0.2, -0.3, 2.0])
"""A point right of, above and before the camera: OpenCV axes."""


@pytest.mark.parametrize(
    ("axes", "point"), [("opencv", POINT_CV), ("opengl", [0.2, 0.3, -2.0]), ("ned", [2.0, 0.2, -0.3])]
)
@pytest.mark.parametrize("convention", ["camera_to_world", "world_to_camera"])
def test_poses_of_any_convention_see_the_same_point(folder, axes, point, convention):
    T = pose(5)
    expected = T[:3, :3] @ point + T[:3, 3]
    np.savetxt(folder / "pose/frame1.txt", T if convention == "camera_to_world" else np.linalg.inv(T))
    say(folder, camera_axes=axes, pose_convention=convention)
    T_wc = first_frame(folder).T_wc
    np.testing.assert_allclose(T_wc[:3, :3] @ POINT_CV + T_wc[:3, 3], expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    "text",
    [
        "1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n",
        "1 0 0 5\n0 1 0 6\n0 0 1 7\n",
        "1,0,0,5,0,1,0,6,0,0,1,7,0,0,0,1",
        "\ufeff1.0, 0, 0, 5e0\r\n0\t1 0 6\r\n0 0 1 7\r\n",
    ],
)
def test_a_pose_is_16_or_12_numbers(tmp_path, text):
    (tmp_path / "p.txt").write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(
        read_pose(tmp_path / "p.txt"), [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
    )


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "the file is empty"),
        ("\n", "got 0 numbers"),
        ("1 2 3 0 0 0 1", r"got 7 numbers \(position and quaternion\?\)"),
        ("1 0 0 0 1 0 0 0 1", "got 9 numbers"),
        ("1 0 0 x 0 1 0 0 0 0 1 0", "expected numbers .*'x'"),
        pytest.param("1 " * 40000, "too many for such a file", id="long"),
    ],
)
def test_a_pose_of_another_form_is_refused(folder, text, match):
    (folder / "pose/frame1.txt").write_text(text)
    fails(DataError, rf"pose/frame1\.txt: .*{match}", first_frame, folder)


@pytest.mark.parametrize(
    ("T", "convention", "match"),
    [
        (np.full((4, 4), -np.inf), "camera_to_world", "not finite"),
        (np.full((4, 4), np.nan), "world_to_camera", "not finite"),
        (np.zeros((4, 4)), "world_to_camera", "cannot be inverted"),
        (np.diag([1.0, 1, -1, 1]), "camera_to_world", "mirrors"),
        (np.diag([2.0, 2, 2, 1]), "world_to_camera", "not orthonormal"),
        (pose(1).T, "camera_to_world", "transposed"),
    ],
)
def test_a_pose_that_is_not_rigid_names_its_file(folder, T, convention, match):
    np.savetxt(folder / "pose/frame1.txt", T)
    fails(DataError, rf"pose/frame1\.txt: .*{match}", first_frame, folder, pose_convention=convention)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("10 11 3 2", "got 4 numbers"),
        ("10 0 0 0 11 0 3 2 1", "is no camera matrix"),
        ("10 0 3 0 nan 2 0 0 1", "is no camera matrix"),
        ("10 1 3 0 11 2 0 0 1", "skew"),
        ("-10 0 3 0 11 2 0 0 1", "focal lengths must be positive"),
        ("ten", "expected numbers"),
    ],
)
def test_intrinsics_that_are_none_are_refused(folder, text, match):
    (folder / "intrinsics.txt").write_text(text)
    fails(DataError, rf"intrinsics\.txt: .*{match}", opened, folder)


def test_missing_intrinsics_are_named(folder):
    (folder / "intrinsics.txt").unlink()
    fails(DataError, r"intrinsics\.txt: cannot be read", opened, folder)


NUMBERISH = st.text(alphabet="0123456789.eE+-_, \n\tnaif", max_size=120)


@given(content=st.one_of(st.binary(max_size=120), NUMBERISH.map(str.encode)))
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_text_is_a_matrix_or_a_data_error(tmp_path, content):
    path = tmp_path / "matrix.txt"
    path.write_bytes(content)
    for read in (read_pose, read_intrinsics):
        message = path.name
        try:
            read(path)
        except DataError as error:
            message = str(error)
        assert path.name in message
        assert "\n" not in message
