"""Motion-compensated flicker and the warp behind it, against a loop over pixels that goes through world coordinates."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semstab import Frame, Intrinsics, datasets
from semstab.errors import ConfigError
from semstab.metrics import CompensatedFlicker, compensated_flicker, flicker_percent
from semstab.pixels.warp import correspond, warp
from semstab.testing import checks, random_frames

seeds = st.integers(0, 2**32 - 1)


def turn(axis, angle):
    """A rotation about a unit axis (Rodrigues)."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def view(rng, shape, index=0):
    """A camera near the origin that looks along z at a rough wall, with gaps in depth and labels."""
    T_wc = np.eye(4)
    T_wc[:3, :3] = turn(rng.normal(size=3), rng.normal(0, 0.1))
    T_wc[:3, 3] = rng.normal(0, 0.3, 3)
    depth = rng.choice([2.0, 2.03, 3.0], size=shape).astype(np.float32)
    depth[rng.random(shape) < 0.2] = rng.choice([0, -1, np.nan, np.inf])
    labels = rng.choice([0, 1, 255], size=shape).astype(np.uint8)
    camera = Intrinsics(*rng.uniform(5, 9, 2), *rng.uniform(2, 5, 2))
    return Frame(index, depth, camera, T_wc, labels)


def seen_by(other, frame, u, v, tolerance):
    """The pixel (u, v) of `other` that sees the point behind a frame's pixel, or None: one pixel, the long way."""
    d = float(frame.depth[v, u])
    if not (math.isfinite(d) and d > 0):
        return None
    camera = frame.intrinsics
    x_w = frame.T_wc @ [(u - camera.cx) / camera.fx * d, (v - camera.cy) / camera.fy * d, d, 1]
    x, y, z, _ = np.linalg.solve(other.T_wc, x_w)
    if z <= 0:
        return None
    camera = other.intrinsics
    at = (round(camera.fx * x / z + camera.cx), round(camera.fy * y / z + camera.cy))
    H, W = other.shape
    if not (0 <= at[0] < W and 0 <= at[1] < H):
        return None
    there = float(other.depth[at[1], at[0]])
    return at if math.isfinite(there) and there > 0 and abs(there - z) <= tolerance * z else None


@checks
@given(seed=seeds, tolerance=st.sampled_from([0.005, 0.05, 0.5]))
def test_each_pixel_is_looked_up_where_its_point_is_seen(seed, tolerance):
    rng = np.random.default_rng(seed)
    frame, other = view(rng, (6, 8)), view(rng, (7, 5))
    pixel = correspond(frame, other, depth_tolerance=tolerance).pixel
    for v in range(6):
        for u in range(8):
            at = seen_by(other, frame, u, v, tolerance)
            assert pixel[v, u] == (-1 if at is None else at[1] * 5 + at[0])


@checks
@given(seed=seeds)
def test_compensated_flicker_is_a_loop_over_pixels(seed):
    rng = np.random.default_rng(seed)
    previous, current = view(rng, (7, 9)), view(rng, (6, 8), index=1)
    changed = covisible = 0
    for v, u in zip(*np.nonzero(current.valid), strict=True):
        at = seen_by(previous, current, int(u), int(v), 0.1)
        if at is not None and previous.valid[at[1], at[0]]:
            covisible += 1
            changed += int(previous.labels[at[1], at[0]] != current.labels[v, u])
    result = compensated_flicker(previous, current, depth_tolerance=0.1)
    assert result.flicker_percent == pytest.approx(100 * changed / covisible if covisible else math.nan, nan_ok=True)
    assert result.share == pytest.approx(covisible / np.count_nonzero(current.valid))


@checks
@given(seed=seeds)
def test_a_camera_at_rest_has_the_plain_flicker(seed):
    rng = np.random.default_rng(seed)
    previous = view(rng, (6, 8))
    labels = rng.choice([0, 1, 255], size=(6, 8)).astype(np.uint8)
    current = Frame(1, previous.depth, previous.intrinsics, previous.T_wc, labels)
    result = compensated_flicker(previous, current)
    assert result.flicker_percent == pytest.approx(flicker_percent(previous, current), rel=0, abs=0, nan_ok=True)
    both = np.count_nonzero(previous.valid & current.valid)
    assert result.share == both / np.count_nonzero(current.valid)


def test_a_camera_at_rest_sees_every_pixel_where_it_is():
    """Also with a pose that is orthonormal to 1e-3 only: what moves a pixel there and back is one matrix's inverse."""
    frame = random_frames(seed=5, count=1)[0]
    T_wc = frame.T_wc.copy()
    T_wc[0, 1] += 4e-4
    frame = Frame(0, frame.depth, frame.intrinsics, T_wc, frame.labels)
    expected = np.arange(frame.depth.size).reshape(frame.shape)
    usable = np.isfinite(frame.depth) & (frame.depth > 0)
    assert (correspond(frame, frame).pixel == np.where(usable, expected, -1)).all()


# --- By hand ----------------------------------------------------------------------------------------------------------


def at_x(x, labels, depth, index=0, **more):
    """A camera at (x, 0, 0) that looks along z; one pixel is 0.25 m at depth 2 m."""
    labels = np.array(labels, dtype=np.uint8)
    T_wc = np.eye(4)
    T_wc[0, 3] = x
    depth = np.broadcast_to(np.array(depth, dtype=np.float32), labels.shape[:2])
    kind = {"scores": labels.astype(np.float32)} if labels.ndim == 3 else {"labels": labels}
    return Frame(index, depth, Intrinsics(8, 8, 0, 0), T_wc, **kind, **more)


def test_motion_alone_is_no_flicker():
    """A wall at 2 m with a pattern; the camera moves by one pixel, so the pattern moves by one.

    3 of 4 pixels stay in view. Without compensation each border of the pattern counts.
    """
    previous = at_x(0, [[0, 0, 1, 2]], 2)
    current = at_x(0.25, [[0, 1, 2, 2]], 2)
    assert flicker_percent(previous, current) == 50
    assert compensated_flicker(previous, current) == CompensatedFlicker(0, 0.75)


def test_what_changes_on_the_surface_is_flicker():
    current = at_x(0.25, [[0, 2, 2, 2]], 2)
    result = compensated_flicker(at_x(0, [[0, 0, 1, 2]], 2), current)
    assert result.flicker_percent == pytest.approx(100 / 3)


def test_what_was_occluded_does_not_count():
    """A board at 1 m hides a pixel of the wall.

    From 0.25 m to the right, the board is out of view, and the wall behind it, seen for the first time, is not compared
    with the board.
    """
    previous = at_x(0, [[0, 1, 0, 0]], [[2, 1, 2, 2]])
    current = at_x(0.25, [[0, 0, 0, 0]], 2)
    assert correspond(current, previous).pixel.tolist() == [[-1, 2, 3, -1]]
    assert compensated_flicker(previous, current) == CompensatedFlicker(0, 0.5)
    assert compensated_flicker(previous, current, depth_tolerance=0.6) == CompensatedFlicker(100 / 3, 0.75)


def test_the_tolerance_is_a_share_of_the_distance():
    current = at_x(0, [[0, 0]], [[2.0, 4.0]])
    assert correspond(current, at_x(0, [[0, 0]], [[2.03, 4.03]])).visible.tolist() == [[False, True]]
    assert correspond(current, at_x(0, [[0, 0]], [[1.97, 3.97]])).visible.tolist() == [[False, True]]


def test_the_nearest_pixel_is_asked():
    """A shift of 0.11 m is 0.44 pixels: the same pixel is nearest. One of 0.14 m is 0.56 pixels: the next one is."""
    wall = at_x(0, [[0, 1, 2, 3]], 2)
    assert correspond(at_x(0.11, [[0] * 4], 2), wall).pixel.tolist() == [[0, 1, 2, 3]]
    assert correspond(at_x(0.14, [[0] * 4], 2), wall).pixel.tolist() == [[1, 2, 3, -1]]
    assert correspond(at_x(-0.11, [[0] * 4], 2), wall).pixel.tolist() == [[0, 1, 2, 3]]
    assert correspond(at_x(-0.14, [[0] * 4], 2), wall).pixel.tolist() == [[-1, 0, 1, 2]]


def test_points_behind_the_other_camera_are_not_seen():
    back = at_x(0, [[0, 0]], 2)
    T_wc = np.eye(4)
    T_wc[2, 3] = 3
    assert not correspond(back, Frame(1, back.depth, back.intrinsics, T_wc, back.labels)).visible.any()


def test_labels_do_not_matter_to_the_warp_but_to_flicker():
    previous, current = at_x(0, [[255, 1, 1]], 2), at_x(0, [[0, 255, 1]], 2)
    assert correspond(current, previous).visible.all()
    assert compensated_flicker(previous, current) == CompensatedFlicker(0, 0.5)


def test_where_nothing_is_seen_twice_flicker_is_undefined():
    result = compensated_flicker(at_x(0, [[0, 0]], 2), at_x(9, [[0, 0]], 2))
    assert math.isnan(result.flicker_percent)
    assert result.share == 0
    result = compensated_flicker(at_x(0, [[0, 0]], 2), at_x(0, [[255, 255]], 2))
    assert math.isnan(result.flicker_percent)
    assert math.isnan(result.share)


def test_soft_scores_count_by_their_largest_class():
    scores = [[[3, 1], [1, 3], [0, 0]]]
    assert compensated_flicker(at_x(0, [[0, 0, 0]], 2), at_x(0, scores, 2)) == CompensatedFlicker(50, 1)


def test_frames_may_differ_in_size():
    """The previous frame has every other pixel: pixels 0, 1, 2, 3 are nearest to its pixels 0, 0.5, 1, 1.5."""
    large = at_x(0, [[0, 1, 2, 3, 4]], 2)
    small = large.every(2)
    assert correspond(large, small).pixel[0, ::2].tolist() == [0, 1, 2]
    assert correspond(small, large).pixel.tolist() == [[0, 2, 4]]
    assert compensated_flicker(large, small) == CompensatedFlicker(0, 1)


@pytest.mark.parametrize("tolerance", [0, -0.1, 1, math.nan])
def test_a_tolerance_that_makes_no_sense_is_refused(tolerance):
    frame = at_x(0, [[0]], 2)
    with pytest.raises(ConfigError, match="depth_tolerance = "):
        compensated_flicker(frame, frame, depth_tolerance=tolerance)


@checks
@given(seed=seeds)
def test_coordinates_as_large_as_utm_change_nothing(seed):
    rng = np.random.default_rng(seed)
    frames = [view(rng, (6, 8)), view(rng, (6, 8))]
    moved = []
    for frame in frames:
        T_wc = frame.T_wc.copy()
        T_wc[:3, 3] += (500_000, 4_000_000, 100)
        moved.append(Frame(0, frame.depth, frame.intrinsics, T_wc, frame.labels))
    assert (correspond(*moved).pixel == correspond(*frames).pixel).all()


# --- The warp on its own ----------------------------------------------------------------------------------------------


def test_any_image_can_be_warped():
    source, target = at_x(0, [[0, 0, 1, 2]], 2), at_x(0.25, [[0, 0, 0, 0]], 2)
    labels, visible = warp(source.labels, source, target, fill=255)
    assert labels.tolist() == [[0, 1, 2, 255]]
    assert visible.tolist() == [[True, True, True, False]]
    color = np.arange(12, dtype=np.uint8).reshape(1, 4, 3)
    warped, _ = warp(color, source, target)
    assert warped.tolist() == [[[3, 4, 5], [6, 7, 8], [9, 10, 11], [0, 0, 0]]]


def test_warping_there_and_back_keeps_the_pixels_that_are_seen_both_times():
    rng = np.random.default_rng(1)
    source = at_x(0, rng.integers(0, 4, (5, 9)), 2)
    target = at_x(0.5, rng.integers(0, 4, (5, 9)), 2)
    there, _ = warp(source.labels, source, target, fill=9)
    back, visible = warp(there, target, source, fill=9)
    assert visible[:, 2:].all()
    assert (back[:, 2:] == source.labels[:, 2:]).all()


# --- The built-in scene, where truth is known -------------------------------------------------------------------------


def test_ground_truth_hardly_flickers_once_motion_is_compensated():
    """Its labels stay on their surfaces: what is left are traffic, and borders that fall between two pixels."""
    options = {"width": 192, "height": 108, "frames": 20}
    scene = datasets.open_dataset("city", options).scene("scene0")
    frames = [scene.frame(index, "gt") for index in range(3)]
    for previous, current in itertools.pairwise(frames):
        result = compensated_flicker(previous, current)
        assert flicker_percent(previous, current) > 40
        assert result.flicker_percent < 3
        assert result.share > 0.5
