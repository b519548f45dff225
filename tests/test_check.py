"""Which mistake in poses, depth, unit or intrinsics the check finds, what it cannot tell, and that it never guesses."""

from __future__ import annotations

import dataset_writers
import numpy as np
import pytest
from dataset_writers import FORMATS, source
from hypothesis import given, settings
from hypothesis import strategies as st
from room_scene import AXES, CAMERA, HEIGHT, RAY_LENGTH, WIDTH, Room, opened, rigid, turn, walk, write

from semstab import Frame
from semstab.check import quick_check, require_sound
from semstab.check.conventions import Convention
from semstab.check.reprojection import MAX_PIXELS, STEPS, Sample, View, clusters, median_of_seen, pairs_within
from semstab.core.arrays import evenly
from semstab.datasets import open_dataset
from semstab.errors import DataError
from semstab.pixels.warp import correspond

ALL = range(12)


def stored(pose="camera_to_world", axes="opencv"):
    """What a file holds that is to be read by that convention."""
    direction = {"camera_to_world": lambda T: T, "world_to_camera": np.linalg.inv}[pose]
    return lambda T: direction(T @ AXES[axes])


def checked(room: Room, **options):
    return quick_check(room, range(len(room)), options)


def quicker(settings_):
    return [line.removeprefix("dataset.options.").partition(" (")[0] for line in settings_]


# --- mistakes


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_sound_scene_is_called_sound_with_its_error(noise):
    verdict = checked(Room(noise=noise))
    assert verdict.state == "sound"
    # the median of |a / b - 1| for a, b with Gaussian noise is 0.674 * sqrt(2) * noise; nearest pixels add to it
    assert verdict.error == pytest.approx(0.674 * np.sqrt(2) * noise, abs=1.5e-3)
    assert verdict.share > 0.6
    assert (verdict.mend, verdict.undetermined) == ((), ())


@pytest.mark.parametrize(
    ("room", "lines"),
    [
        (Room(told_pose=stored("world_to_camera")), ["pose_convention: world_to_camera"]),
        (Room(told_pose=stored(axes="ned")), ["camera_axes: ned"]),
        (
            Room(told_pose=stored("world_to_camera", "opengl")),
            ["pose_convention: world_to_camera", "camera_axes: opengl"],
        ),
        (Room(told_depth=lambda z: z * RAY_LENGTH, noise=0.01), ["depth_kind: ray"]),
        (
            Room(told_depth=lambda z: z * RAY_LENGTH, told_pose=stored(axes="opengl")),
            ["camera_axes: opengl", "depth_kind: ray"],
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_named_with_the_line_that_mends_it(room, lines):
    verdict = checked(room)
    assert verdict.state == "unsound"
    assert quicker(verdict.mend) == lines
    assert all(line in verdict.text for line in lines)


@pytest.mark.parametrize("scale", [1e-4, 5.0, 6553.5])
def test_a_wrong_depth_scale_is_measured(tmp_path, scale):
    """What is stored are `scale` units a metre; scene.yaml says 1."""
    folder = write(tmp_path / "room", Room(walk(6), told_depth=lambda z: z * scale))
    verdict = quick_check(opened(folder), range(6))
    assert verdict.state == "unsound"
    assert verdict.mend == (f"depth_scale: {scale:.5g}",)
    assert f"set it in {folder}/scene.yaml" in verdict.text
    times = f"{scale:.4g} times too long" if scale > 1 else f"{1 / scale:.4g} times too short"
    assert f"depth is {times}, or metres_per_unit is " in verdict.text
    assert quick_check(opened(folder, depth_scale=scale), range(6)).state == "sound"


@pytest.mark.parametrize("size", [(0.5, 0.5), (2, 1)])
def test_intrinsics_of_another_image_size_are_found(size):
    other = (round(WIDTH * size[0]), round(HEIGHT * size[1]))
    verdict = checked(Room(camera=CAMERA.resized((WIDTH, HEIGHT), other)))
    assert verdict.state == "unsound"
    (line,) = quicker(verdict.mend)
    found = [int(side) for side in line.removeprefix("intrinsics_size: [").rstrip("]").split(",")]
    assert found == pytest.approx(other, abs=4)


def test_what_mends_it_mends_it(tmp_path):
    """The advice, written down, makes the scene sound; which advice it is, is tested in memory."""
    combinations = [
        ("camera_to_world", "opencv", "planar"),
        ("world_to_camera", "opengl", "ray"),
        ("camera_to_world", "ned", "ray"),
    ]
    for k, (pose, axes, kind) in enumerate(combinations):
        room = Room(walk(6), told_pose=stored(pose, axes), told_depth=lambda z, k=kind: z * RAY_LENGTH ** (k == "ray"))
        folder = write(tmp_path / f"room{k}", room)
        verdict = quick_check(opened(folder), range(6))
        assert verdict.state == ("sound" if k == 0 else "unsound")
        with (folder / "scene.yaml").open("a") as file:
            file.write("\n".join(verdict.mend) + "\n")
        assert quick_check(opened(folder), range(6)).state == "sound"


@pytest.mark.parametrize("configured", [{"camera_axes": "opengl"}, {"depth_kind": "ray"}])
def test_a_wrong_setting_of_a_right_scene_is_taken_back(tmp_path, configured):
    """Whatever is configured, alternatives are measured against what the files hold."""
    folder = write(tmp_path / "room", Room(walk(6)), **configured)
    verdict = quick_check(opened(folder), range(6))
    (name,) = configured
    assert verdict.mend == (f"{name}: {'planar' if name == 'depth_kind' else 'opencv'}",)
    # an option goes before scene.yaml, so the advice is the option
    over = {name: configured[name], "root": str(folder)}
    verdict = quick_check(opened(folder, **{name: configured[name]}), range(6), over)
    assert verdict.mend == (f"dataset.options.{name}: {'planar' if name == 'depth_kind' else 'opencv'}",)


def test_the_unit_of_the_poses_is_offered_where_the_dataset_has_one():
    verdict = checked(Room(told_depth=lambda z: z * 10), depth_scale=1000.0, metres_per_unit=1.0)
    assert verdict.mend == ("dataset.options.depth_scale: 10000",)
    assert "set it in the configuration; depth is 10 times too long, or metres_per_unit is 10" in verdict.text


def test_a_dataset_without_the_option_is_to_be_converted():
    verdict = checked(Room(told_pose=stored(axes="opengl")))
    assert "the dataset has no such option: convert it" in verdict.text


def test_large_coordinates_do_not_matter():
    far = rigid(turn(0.4, 0.1), (4e5, 5e6, 30))
    assert checked(Room(told_pose=lambda T: far @ T)).state == "sound"
    verdict = checked(Room(told_pose=lambda T: np.linalg.inv(far @ T)))
    assert quicker(verdict.mend) == ["pose_convention: world_to_camera"]


@pytest.mark.parametrize("name", ["hololens", "colmap, text", "polycam", "midair"])
def test_a_wrong_option_of_a_dataset_is_taken_back(tmp_path, name):
    """Formats differ in what their poses map and in axes: one of each kind; the advice is what it needs."""
    form, other = FORMATS[name], {"camera_to_world": "world_to_camera", "world_to_camera": "camera_to_world"}
    form.write(tmp_path / "data", source(form.scale))
    right = dataset_writers.opened(form, tmp_path / "data").options
    for option, wrong in (
        ("pose_convention", other[right.pose_convention]),
        ("camera_axes", "opengl" if right.camera_axes != "opengl" else "opencv"),
        (None, None),
    ):
        scene = dataset_writers.opened(form, tmp_path / "data", **({option: wrong} if option else {}))
        verdict = quick_check(scene, range(4), scene.options.model_dump())
        mend = () if option is None else (f"dataset.options.{option}: {getattr(right, option)}",)
        assert (verdict.state, verdict.mend) == ("unsound" if option else "sound", mend)


# --- what frames cannot tell


def test_a_camera_that_only_turns_says_nothing_about_the_unit():
    poses = [rigid(turn(0.1 * i, 0.1 * np.sin(i)), (0, 0, 0)) for i in range(10)]
    for factor in (1, 10):
        verdict = checked(Room(poses, told_depth=lambda z, f=factor: z * f))
        assert verdict.state == "sound"
        assert quicker(verdict.undetermined) == ["depth_scale"]
        assert verdict.reason == "the camera hardly moves"
    wrong = checked(Room(poses, told_pose=np.linalg.inv))
    assert quicker(wrong.mend) == ["pose_convention: world_to_camera"]


def test_a_camera_that_does_not_move_at_all_is_unclear():
    verdict = checked(Room([walk(1)[0]] * 5))
    assert verdict.state == "unclear"
    assert "it does so under every other convention of the poses as well" in verdict.text
    assert verdict.reason == "the camera hardly moves and the camera hardly turns"


def test_a_flight_straight_ahead_over_flat_ground_hides_mistakes():
    """A camera that looks straight down and flies along x: every turned convention sees the same flat ground."""
    poses = [rigid(np.eye(3), (0.2 * i, 0, 0)) for i in range(10)]
    for told_pose in (stored(), stored("world_to_camera"), stored(axes="opengl")):
        verdict = checked(Room(poses, told_pose=told_pose, told_depth=lambda z: np.full_like(z, 2.0)))
        assert verdict.state == "sound"
        undetermined = quicker(verdict.undetermined)
        assert {"depth_scale", "pose_convention: world_to_camera", "camera_axes: opengl"} <= set(undetermined)
        assert "depth_kind: ray" not in undetermined
        assert "the same motion: the map is only turned" in " ".join(verdict.undetermined)
        assert verdict.reason == "the camera hardly turns and all depths are similar"


@pytest.mark.parametrize("factor", [1, 1000])
def test_frames_that_share_nothing_are_unclear(factor):
    poses = [rigid(turn(2.1 * i, 0), (0.3 * i, 0, 0)) for i in range(3)]
    verdict = checked(Room(poses, told_depth=lambda z: z * factor))
    assert verdict.state == "unclear"
    assert "seen again by another frame: too few to tell" in verdict.text


def test_one_frame_is_unclear_and_no_depth_is_too():
    assert "it takes two frames" in checked(Room(walk(1))).text
    for nothing in (0.0, -1.0, np.nan, np.inf):
        verdict = checked(Room(walk(3), told_depth=lambda z, value=nothing: np.full_like(z, value)))
        assert verdict.state == "unclear"
        assert verdict.text == "no pixel of the sampled frames has valid depth"


def test_depth_that_belongs_to_nothing_is_unsound_without_advice():
    rng = np.random.default_rng(5)
    verdict = checked(Room(walk(6), told_depth=lambda z: rng.uniform(0.5, 9, z.shape)))
    assert (verdict.state, verdict.mend) == ("unsound", ())
    assert "no other convention explains it" in verdict.text


def test_few_points_that_belong_to_nothing_leave_it_open():
    """Of 600 pixels with such depth in each of two frames, 70 % are seen again: fewer than 1,000."""
    rng, some = np.random.default_rng(5), np.zeros((HEIGHT, WIDTH), bool)
    some[5:25, 5:35] = True
    verdict = checked(Room(walk(2), told_depth=lambda z: np.where(some, rng.uniform(2, 4, z.shape), 0)))
    assert (verdict.state, verdict.mend) == ("unclear", ())
    assert verdict.error > 0.15
    assert verdict.share > 0.6
    assert "no other convention explains it; are poses and depth this imprecise?" in verdict.text


@pytest.mark.parametrize("scale", [2e4, 5e-5])
def test_a_unit_beyond_four_decades_is_not_proposed(scale):
    """It could not be told from those outside of the factors that are tried."""
    assert not [line for line in checked(Room(told_depth=lambda z: z * scale)).mend if "depth_scale" in line]


def test_little_noise_in_the_unit_is_measurement():
    verdict = checked(Room(told_depth=lambda z: z * 1.05))
    assert (verdict.state, verdict.mend) == ("imprecise", ())
    assert "depth as smooth as this has about 0.15%" in verdict.text


@settings(max_examples=6, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    pose=st.sampled_from(["camera_to_world", "world_to_camera"]),
    axes=st.sampled_from(sorted(AXES)),
    kind=st.sampled_from(["planar", "ray"]),
    decade=st.integers(-4, 4),
)
def test_whatever_is_planted_is_found_or_said_to_be_unclear(seed, pose, axes, kind, decade):
    """Random walks: the planted convention is the advice, or the check does not decide; it never names another one."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0, (0.06, 0.06, 0.06, 0.1, 0.1, 0.1), (8, 6))
    path = np.cumsum(steps, axis=0) - [0, 0, 0, 0, 0, 0.5]
    poses = [rigid(turn(*row[:3]), np.clip(row[3:], -1.2, 1.2)) for row in path]
    room = Room(
        poses,
        told_pose=stored(pose, axes),
        told_depth=lambda z: z * RAY_LENGTH ** (kind == "ray") * 10.0**decade,
        noise=0.005,
    )
    verdict = checked(room, depth_scale=1.0)
    planted = []
    planted += [f"pose_convention: {pose}"] * (pose != "camera_to_world")
    planted += [f"camera_axes: {axes}"] * (axes != "opencv")
    planted += [f"depth_kind: {kind}"] * (kind != "planar")
    planted += [f"depth_scale: {10.0**decade:.5g}"] * (decade != 0)
    if not planted:
        assert verdict.state == "sound"
    elif verdict.mend:
        assert quicker(verdict.mend) == planted
    else:
        assert verdict.state == "unclear" or verdict.undetermined or "no other convention" in verdict.text


@settings(max_examples=4, deadline=None, derandomize=True)
@given(
    angles=st.tuples(*[st.floats(-3, 3)] * 3), offset=st.tuples(*[st.floats(-100, 100)] * 3), unit=st.floats(0.01, 100)
)
def test_the_error_does_not_depend_on_the_world(angles, offset, unit):
    """Neither on where the world's origin is and how it is turned, nor on the unit that depth and poses share."""
    world = rigid(turn(*angles), offset)

    def told(T):
        moved = world @ T
        return rigid(moved[:3, :3], moved[:3, 3] * unit)

    here, there = checked(Room(walk(4))), checked(Room(walk(4), told_pose=told, told_depth=lambda z: z * unit))
    assert there.state == here.state
    assert there.error == pytest.approx(here.error, rel=0.05)
    assert there.share == pytest.approx(here.share, rel=0.01)


# --- in a run


def test_the_quick_check_reads_few_frames_each_once():
    short, long = Room(), Room(walk(60))
    checked(short)
    assert sorted(index for index, _ in short.read) == list(range(len(short)))
    checked(long)
    assert 40 < len({index for index, _ in long.read}) == len(long.read) < 50
    assert {model for _, model in long.read} == {"gt"}  # no model need predict for it


def test_an_unreadable_frame_is_passed_over():
    class Damaged(Room):
        def frame(self, index, model, *, color=True):
            if index % 2:
                raise DataError("damaged")
            return super().frame(index, model, color=color)

    assert checked(Damaged()).state == "sound"

    class AllDamaged(Room):
        def frame(self, index, model, *, color=True):
            raise DataError("damaged")

    assert checked(AllDamaged()).state == "unclear"


def test_frames_without_ground_truth_are_read_with_the_model():
    class Sparse(Room):
        def frame(self, index, model, *, color=True):
            if model == "gt":
                raise DataError("no ground truth here")
            return super().frame(index, model, color=color)

    assert checked(Sparse()).state == "sound"


def test_unsound_data_are_refused_in_one_line():
    with pytest.raises(
        DataError, match=r"^room: depth reprojects with .* --no-geometry-check fuses the scene as it is$"
    ) as caught:
        require_sound(Room(told_pose=np.linalg.inv), ALL)
    assert "\n" not in str(caught.value)
    assert require_sound(Room(), ALL).state == "sound"


def test_the_city_is_sound():
    scene = open_dataset("city", {"width": 96, "height": 54}).scene("scene1")
    verdict = quick_check(scene, range(20))
    assert verdict.state == "sound"
    assert verdict.error < 0.003


# --- parts


@given(length=st.integers(1, 5000), count=st.integers(1, 5))
def test_clusters_lie_in_the_sequence_and_hold_neighbours(length, count):
    groups = clusters(length, count)
    assert 1 <= len(groups) <= count
    for group in groups:
        assert group[0] >= 0
        assert group[-1] < length
        assert [position - group[0] for position in group] == list(STEPS[: len(group)])
        assert len(group) >= 2 or length == 1
    pairs = pairs_within(groups)
    assert len(set(pairs)) == len(pairs)
    assert all(a != b for a, b in pairs)


def test_frames_are_spread_over_the_sequence():
    assert evenly(5, 8) == [0, 1, 2, 3, 4]
    assert evenly(101, 3) == [0, 50, 100]
    assert evenly(3, 0) == []


def test_a_look_up_agrees_with_the_warp():
    """The check's vectorised reprojection against the compiled one that flicker uses."""
    room = Room()
    frames = [room.frame(i, "gt") for i in (0, 4)]
    views = dict(enumerate(View.from_frame(frame, 10_000) for frame in frames))
    sample = Sample(views, [(0, 1)], Convention())
    matched = sample.matched((0, 1), Convention(), np.array([1.0]))
    assert len(views[0].u) == HEIGHT * WIDTH
    found = correspond(frames[0], frames[1], depth_tolerance=0.02)
    pixel = np.full(HEIGHT * WIDTH, -1)
    same = matched.error[0] * matched.z[0] <= 0.02 * matched.z[0]
    pixel[(views[0].v * WIDTH + views[0].u)[same]] = (matched.v * WIDTH + matched.u)[0][same]
    np.testing.assert_array_equal(pixel.reshape(HEIGHT, WIDTH), found.pixel)


def test_a_large_image_is_thinned_with_its_camera():
    depth = np.arange(1, 3001 * 1001 + 1, dtype=np.float32).reshape(1001, 3001)
    labels = np.zeros(depth.shape, np.uint8)
    view = View.from_frame(Frame(0, depth, CAMERA, np.eye(4), labels=labels), 100)
    assert view.stride == 2
    assert view.depth.size <= MAX_PIXELS
    assert len(view.u) == 100
    whole = View.from_frame(Frame(0, depth, CAMERA, np.eye(4), labels=labels), 100)
    np.testing.assert_array_equal(view.u, whole.u)
    camera = view.sampled_camera(Convention())
    assert (camera.fx, camera.cx) == (CAMERA.fx / 2, CAMERA.cx / 2)


@given(st.lists(st.one_of(st.floats(0, 10), st.just(np.inf)), max_size=9))
def test_the_median_is_of_those_that_are_seen(errors):
    finite = sorted(error for error in errors if np.isfinite(error))
    expected = finite[(len(finite) - 1) // 2] if finite else np.nan
    if errors:
        np.testing.assert_equal(float(median_of_seen(np.array(errors))), expected)
