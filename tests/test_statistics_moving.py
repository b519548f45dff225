"""Spots that moved: views see through them, before and after."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from street import DRIVES, Street

from semstab import Frame, Intrinsics
from semstab.data.statistics import MisplacedFrame, poses_that_do_not_fit
from semstab.statistics import Sampler, SpotObservations
from semstab.statistics.kept_depth import MOST_KEPT, DepthMemory, KeptDepth
from semstab.statistics.kept_points import KeptPoints
from semstab.statistics.loops.moving import HIDDEN, SEEN, THROUGH, UNKNOWN, tally
from semstab.statistics.moving import moving_percent, static_spots
from semstab.statistics.votes import SpotVotes, confirmed, lone, next_to_moved

H, W, FOCAL, HEIGHT = 120, 160, 120.0, 20.0
CAMERA = Intrinsics(FOCAL, FOCAL, (W - 1) / 2, (H - 1) / 2)
FLOOR, PARKED, DRIVING = 0, 1, 2
FRAMES = 24


def box_at(frame: int) -> tuple[float, float]:
    """The box drives 3 m a frame, and is 4 m long."""
    return -30.0 + 3.0 * frame, 2.0


def away(_: int) -> tuple[float, float]:
    """A place that no view shows."""
    return -50.0, 0.0


def frames(
    *,
    noise: float = 0.0,
    shift: float = 0.0,
    shifted: range = range(0),
    place: Callable[[int], tuple[float, float]] = box_at,
) -> Iterator[Frame]:
    """A camera looks down on a floor with two boxes, 3 m high, of which one moves; some poses are wrong."""
    rng = np.random.default_rng(3)
    u, v = np.meshgrid((np.arange(W) - CAMERA.cx) / FOCAL, (np.arange(H) - CAMERA.cy) / FOCAL)
    for k in range(FRAMES):
        x, y = 0.4 * k - 5.0, 0.0
        depth, labels = np.full((H, W), HEIGHT), np.full((H, W), FLOOR, np.uint8)
        for number, (left, top) in ((PARKED, (-3.0, -5.0)), (DRIVING, place(k))):
            top_of_box = HEIGHT - 3.0
            px, py = x + u * top_of_box, y + v * top_of_box
            inside = (left <= px) & (px < left + 4.0) & (top <= py) & (py < top + 4.0)
            depth[inside], labels[inside] = top_of_box, number
        pose = np.eye(4)
        pose[:3, 3] = x, y, shift * (k in shifted)
        noisy = depth * (1 + noise * rng.standard_normal((H, W)))
        yield Frame(k, noisy.astype(np.float32), CAMERA, pose, labels=labels)


def sampled(some: Iterator[Frame], *, moving: bool = True) -> SpotObservations:
    sampler = Sampler(3, moving=moving)
    for frame in some:
        sampler.add(frame)
    return sampler.sample()


def classes(spots: SpotObservations) -> np.ndarray:
    """The class of each spot, which is the same in all views; -1 for one without answers."""
    class_of = np.full(len(spots.point), -1)
    class_of[spots.spot] = spots.label
    return class_of


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_what_drives_has_moved_and_what_stands_has_not(noise: float) -> None:
    spots = sampled(frames(noise=noise))
    class_of, votes = classes(spots), spots.votes
    assert votes is not None
    assert votes.moved[class_of == DRIVING].mean() > 0.7
    assert not votes.moved[class_of == PARKED].any()
    assert votes.static[class_of == PARKED].mean() > 0.7
    assert votes.moved[class_of == FLOOR].mean() < 0.005
    assert votes.static[class_of == FLOOR].mean() > 0.7
    assert not (votes.moved & votes.static).any()


def test_nothing_moved_where_all_stands() -> None:
    spots = sampled(frames(noise=0.01, place=away))
    assert spots.votes is not None
    assert spots.votes.moved.mean() < 0.001
    assert not spots.votes.misplaced.any()
    assert spots.votes.false_rate < 0.01
    assert spots.votes.false_share < 0.005
    assert max(moving_percent(spots).values()) < 0.1


def test_views_before_a_spot_was_found_see_through_it() -> None:
    """A box arrives in the last frames and stays: all views that see through it are earlier ones."""
    late = []
    for frame in frames(place=away):
        assert frame.labels is not None
        depth, labels = frame.depth.copy(), frame.labels.copy()
        if frame.index >= FRAMES - 8:
            u, v = np.meshgrid((np.arange(W) - CAMERA.cx) / FOCAL, (np.arange(H) - CAMERA.cy) / FOCAL)
            px, py = frame.T_wc[0, 3] + u * (HEIGHT - 3), v * (HEIGHT - 3)
            inside = (np.abs(px - 2.0) < 2.0) & (np.abs(py - 4.0) < 2.0)
            depth[inside], labels[inside] = HEIGHT - 3.0, DRIVING
        late.append(dataclasses.replace(frame, depth=depth, labels=labels))
    spots = sampled(iter(late))
    assert spots.votes is not None
    assert spots.votes.moved[classes(spots) == DRIVING].mean() > 0.7


def test_frames_with_wrong_poses_are_named_and_do_not_look_like_movers() -> None:
    wrong = range(10, 13)
    spots = sampled(frames(shift=-1.5, shifted=wrong, place=away))
    votes = spots.votes
    assert votes is not None
    assert spots.views.frame[votes.misplaced].tolist() == list(wrong)
    assert not spots.moved.any()
    assert (votes.through_of_view[10:13] > 0.1).all()
    assert (np.delete(votes.through_of_view, wrong) < 0.1).all()


def test_six_stretches_of_frames_are_named_and_the_others_counted() -> None:
    misplaced = [MisplacedFrame(k, f"{k:03d}", 0.5) for k in (0, 1, 4, 6, 8, 10, 12, 14)]
    expected = "poses of frames 000 to 001, 004, 006, 008, 010, 012 do not fit: 50 % of their spots are seen through"
    assert poses_that_do_not_fit(misplaced[:-1]) == expected
    assert "008, 010, 012 and 1 more do not fit" in poses_that_do_not_fit(misplaced)
    assert poses_that_do_not_fit(misplaced[2:3]).startswith("the pose of frame 004 does not fit: 50 % of its")
    assert poses_that_do_not_fit([]) == ""


def test_votes_change_neither_spots_nor_answers() -> None:
    with_votes, without = sampled(frames()), sampled(frames(), moving=False)
    assert without.votes is None
    assert not without.moved.any()
    for name in ("spot", "view", "label", "near", "point", "drawn"):
        np.testing.assert_array_equal(getattr(with_votes, name), getattr(without, name))


def test_votes_are_kept_in_files_and_go_with_their_spots(tmp_path) -> None:  # type: ignore[no-untyped-def]
    spots = sampled(frames(shift=-1.5, shifted=range(10, 12)))
    spots.save(tmp_path / "spots.parquet")
    read = SpotObservations.load(tmp_path / "spots.parquet")
    assert spots.votes is not None
    assert read.votes is not None
    for name, values in vars(spots.votes).items():
        np.testing.assert_array_equal(getattr(read.votes, name), values)
    half = spots.within(1 << 31)
    assert half.votes is not None
    assert 0 < len(half.point) < len(spots.point)
    np.testing.assert_array_equal(half.votes.through, spots.votes.through[spots.drawn < 1 << 31])
    static = static_spots(spots)
    assert 0 < len(static) < len(spots)
    assert not static.moved.any()


def test_of_long_flights_every_so_many_views_are_kept() -> None:
    memory, depth = DepthMemory(), np.ones((4, 4), np.float32)
    for view in range(5 * MOST_KEPT):
        if memory.wants(view):
            memory.add(KeptDepth.of_image(view, np.eye(4), (1.0, 1.0, 0.0, 0.0), depth))
    views = [stored.view for stored in memory.kept]
    assert MOST_KEPT / 2 < len(views) <= MOST_KEPT
    assert set(np.diff(views)) == {8}
    assert views[0] == 0


def test_two_views_and_a_third_of_the_votes_decide() -> None:
    visible, through = np.array([0, 0, 1, 3, 4, 9, 1], np.uint16), np.array([0, 2, 1, 2, 2, 1, 0], np.uint16)
    none = np.zeros(0)
    votes = SpotVotes(
        visible, 0 * visible, through, 0 * visible, visible > 100, none, none > 0, np.array([1000, 3]), 0.01
    )
    assert votes.moved.tolist() == [False, True, False, True, False, False, False]
    assert votes.static.tolist() == [False, False, False, False, True, True, False]
    # votes 2 of 2, 2 of 5, 3 of 6, and 4 of 10 or 3 of 10 at an end, with a rate of 3.5 in 1001
    q = 3.5 / 1001
    expected = np.mean([q**2, 10 * q**2 * (1 - q) ** 3 + 10 * q**3, 20 * q**3, 210 * q**4 + 2 * q**3])
    assert votes.false_share == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(("in_time", "at_end"), [
    ("sssssssss", 0), ("ssssssttt", 3), ("tttssssss", 3), ("ttssssttt", 3), ("tthtsssts", 3), ("sssthhtht", 3),
    ("sstttssss", 0), ("ssssst--t", 2), ("ttttttttt", 9), ("hh-hhh---", 0),
])  # fmt: skip
def test_votes_count_at_an_end_if_the_spot_is_not_seen_there(in_time: str, at_end: int) -> None:
    """Votes of views in their order: s sees it, t sees through it, h has it hidden, - does not tell."""
    votes = np.array(["-sht".index(vote) for vote in in_time], np.uint8)[:, None]
    counts, found, between = np.zeros((1, 3), np.uint16), np.zeros(1, np.uint16), np.zeros(2, np.int64)
    tally(votes, np.ones(len(votes), np.bool_), counts, found, between)
    assert counts[0].tolist() == [in_time.count(kind) for kind in "sht"]
    assert found[0] == at_end


@pytest.mark.parametrize(("leaves", "moved"), [(20, True), (22, False)])
def test_what_stood_for_long_and_left_has_moved_if_three_views_see_through_it(leaves: int, moved: bool) -> None:
    spots = sampled(frames(place=lambda k: (-5.0, 2.0) if k < leaves else away(k)))
    votes, on_box = spots.votes, classes(spots) == DRIVING
    assert votes is not None
    assert (votes.through[on_box] <= FRAMES - leaves).all()
    assert votes.moved[on_box].mean() > 0.6 if moved else votes.static[on_box].mean() > 0.6
    assert votes.moved[~on_box].mean() < 0.005
    pixels = frames(place=lambda _: (-5.0, 2.0))
    sampler = Sampler(3)
    for frame in frames(place=lambda k: (-5.0, 2.0) if k < leaves else away(k)):
        sampler.add(frame)
    mask = sampler.moving_pixels(votes, frame := next(pixels))
    assert frame.labels is not None
    assert mask[frame.labels == DRIVING].mean() > 0.9 if moved else not mask.any()


@pytest.mark.parametrize(("around", "spacing", "told"), [
    ("mm", 1.0, True), ("m", 1.0, False), ("mmss", 1.0, True), ("mmsss", 1.0, False), ("mm", 0.5, False),
    ("mmm", 0.0, False), ("", 1.0, False),
])  # fmt: skip
def test_an_unknown_spot_next_to_spots_that_moved_moved_too(around: str, spacing: float, told: bool) -> None:
    """Moved and static spots lie 1.2 m around it; another spot, which is as unknown, lies far away."""
    angle = np.arange(len(around))
    point = np.concatenate(
        [np.zeros((1, 3)), np.full((1, 3), 9.0), 1.2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)]
    )
    moved, static = (np.array([False, False, *(kind == letter for letter in around)]) for kind in "ms")
    assert next_to_moved(point, moved, static, spacing).tolist() == [told, *[False] * (len(around) + 1)]


def test_spots_next_to_spots_that_moved_are_told_in_two_steps() -> None:
    """Columns of a grid: one of spots that moved, then unknown ones, or unknown ones between moved and static ones."""
    x, y = np.meshgrid(np.arange(6), np.arange(5), indexing="ij")
    point, column = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float64), x.ravel()
    nothing = np.zeros(len(point), np.bool_)
    told = next_to_moved(point, column == 0, nothing, 1.0)
    assert told.tolist() == np.isin(column, (1, 2)).tolist()
    told = next_to_moved(point, column == 0, column == 2, 1.0)
    assert told.tolist() == (column == 1).tolist()
    told = next_to_moved(point, column == 0, (column == 1) & (y.ravel() < 4), 1.0)
    assert not told[column > 1].any()


@pytest.mark.parametrize(("around", "spacing", "told"), [
    ("??", 1.0, True), ("?", 1.0, False), ("mm", 1.0, True), ("?m", 1.0, True), ("??ss", 1.0, True),
    ("??sss", 1.0, False), ("??", 0.5, False), ("", 1.0, False),
])  # fmt: skip
def test_a_suspect_spot_is_confirmed_by_two_more_around_it(around: str, spacing: float, told: bool) -> None:
    """Suspect, moved and static spots lie 1.2 m around a suspect one; a suspect one far away has no others around."""
    angle = np.arange(len(around))
    point = np.concatenate(
        [np.zeros((1, 3)), np.full((1, 3), 9.0), 1.2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)]
    )
    suspect, moved, static = (np.array([letter == "?"] * 2 + [kind == letter for kind in around]) for letter in "?ms")
    assert confirmed(point, suspect, moved, static, spacing)[:2].tolist() == [told, False]
    assert not confirmed(point, suspect, moved, static, spacing)[~suspect].any()


def test_one_vote_of_four_makes_a_spot_suspect_and_with_others_it_has_moved() -> None:
    """Spots in a row, 1 m apart: of the first three one view of four sees through, of a lone one, too."""
    visible, through = np.array([3, 3, 3, 9, 9, 3], np.uint16), np.array([1, 1, 1, 0, 0, 1], np.uint16)
    point, none = np.arange(6.0)[:, None] * [1, 0, 0], np.zeros(0)
    votes = SpotVotes(
        visible, 0 * visible, through, 0 * visible, visible > 100, none, none > 0, np.array([1000, 3]), 0.01
    )
    assert votes.static.all()
    told = dataclasses.replace(votes, next_to=votes.by_neighbours(point, 2.0))
    assert told.moved.tolist() == [True] * 3 + [False] * 3
    assert (told.static == ~told.moved).all()
    q, by_votes = 3.5 / 1001, 4 * 6 * (3.5 / 1001) ** 2 / 6
    suspect = 4 * 4 * q / 6  # of the mean spot: four of six have four votes, the others need three of nine
    assert told.false_share == pytest.approx(by_votes + suspect * 15 * suspect**2, rel=0.1)


@pytest.mark.parametrize(("ground", "beside", "kind"), [
    (10.2, 10.05, 3), (10.2, 10.01, 0), (10.05, 10.2, 0), (10.0, 10.2, 1), (9.0, 10.2, 2),
])  # fmt: skip
def test_a_view_sees_through_a_spot_if_its_block_and_those_around_are_far_behind(
    ground: float, beside: float, kind: int
) -> None:
    """A spot 10 m away; depth in its block, and in the block next to it."""
    depth = np.full((9, 9), 10.2)
    depth[4, 4], depth[4, 5] = ground, beside
    view = KeptDepth.of_image(0, np.eye(4), (9.0, 9.0, 4.0, 4.0), depth)
    assert view.stride == 1
    assert (view.votes(np.array([[0.0, 0.0, 10.0]]), 1e-4) & 3).tolist() == [kind]


def view_of(depths: np.ndarray, *, around: bool = False) -> KeptPoints:
    """A LiDAR's view with a point in each direction of a grid (h, w), 10 pixels apart; 0 without a point."""
    (h, w), step = depths.shape, 10.0
    row, column = (step * index.ravel() for index in np.mgrid[:h, :w])
    with np.errstate(divide="ignore"):
        points = column, row, np.where(depths.ravel() > 0, 1 / depths.ravel(), 0.0)
    camera = (w * step / (2 * np.pi), 200.0, 0.0, 0.0) if around else (90.0, 90.0, 0.0, 0.0)
    return KeptPoints.from_points(0, np.eye(4), camera, around, step, (int(h * step), int(w * step)), points)


def spot_at(column: float, row: float, depth: float) -> np.ndarray:
    """A spot (1, 3) that such a view shows there, in steps of its grid."""
    return np.array([[10 * column / 90 * depth, 10 * row / 90 * depth, depth]])


@pytest.mark.parametrize(("near", "kind"), [
    ({}, THROUGH), ({(4, 4): 10.1}, SEEN), ({(4, 4): 10.2}, THROUGH), ({(4, 4): 6.0}, UNKNOWN),
    ({(5, 5): 10.0}, SEEN), ({(5, 5): 6.0}, UNKNOWN), ({(3, 3): 10.0}, THROUGH), ({(3, 3): 6.0}, THROUGH),
    ({(8, 4): 10.0}, THROUGH), ({(row, 4): 0.0 for row in range(5)}, THROUGH),
    ({(row, column): 0.0 for row in range(5) for column in range(9)}, UNKNOWN),
])  # fmt: skip
def test_a_view_sees_through_a_spot_with_farther_points_around_and_no_close_ones(
    near: dict[tuple[int, int], float], kind: int
) -> None:
    """A spot 10 m away, points 14 m away, and others in some directions."""
    depths = np.full((9, 9), 14.0)
    for at, depth in near.items():
        depths[at] = depth
    assert (view_of(depths).votes(spot_at(4, 4, 10.0), 0.001) & 3).tolist() == [kind]


@pytest.mark.parametrize(("left", "right", "kind"), [
    (9.7, 10.4, SEEN), (6.0, 16.0, UNKNOWN), (9.0, 9.5, HIDDEN), (10.2, 10.8, THROUGH), (10.1, 10.8, SEEN),
])  # fmt: skip
def test_a_view_sees_a_spot_between_points_of_a_steep_surface_not_of_two_surfaces(
    left: float, right: float, kind: int
) -> None:
    depths = np.where(np.arange(9) < 4.5, left, right) * np.ones((9, 1))
    assert (view_of(depths).votes(spot_at(4.5, 4, 10.0), 0.001) & 3).tolist() == [kind]


def test_limits_of_points_grow_with_how_depth_differs_between_views() -> None:
    view = view_of(np.full((9, 9), 10.5))
    votes = [int(view.votes(spot_at(4, 4, 10.0), sigma)[0] & 3) for sigma in (0.001, 0.05, 0.06)]
    assert votes == [THROUGH, THROUGH, SEEN]


def test_points_of_a_scan_close_a_circle() -> None:
    """A spot behind the sensor, at the first and the last column, between points 14 m away."""
    depths = np.zeros((60, 90))
    depths[:, :8] = depths[:, -8:] = 14.0
    spot = np.array([[-10.0, -0.01, 0.0], [-10.0, 0.01, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    assert (view_of(depths, around=True).votes(spot, 0.001) & 3).tolist() == [THROUGH, THROUGH, UNKNOWN, UNKNOWN]


@pytest.mark.parametrize(
    ("depth", "on_surface"), [(10.0, True), (10.05, True), (10.2, False), (14.0, True), (12.0, False)]
)
def test_a_spot_between_points_of_two_surfaces_lies_on_neither(depth: float, on_surface: bool) -> None:
    depths = np.where(np.arange(9) < 4.5, 10.0, 14.0) * np.ones((9, 1))
    assert view_of(depths).at_points(spot_at(4.5, 4, depth), 0.001).tolist() == [on_surface]


def test_the_points_of_256_views_take_64_megabytes() -> None:
    """A scan of 128 rings and 4000 columns."""
    rng = np.random.default_rng(0)
    u, v, w = rng.uniform(0, 8000, 512_000), rng.uniform(1500, 2100, 512_000), np.ones(512_000)
    view = KeptPoints.from_points(0, np.eye(4), (1273.0, 1273.0, 0.0, 0.0), True, 2.0, (4001, 8000), (u, v, w))
    assert view.near.nbytes <= 64e6 / MOST_KEPT * 1.02
    assert np.mean(view.near > 0) > 0.9


@pytest.mark.parametrize(("around", "spacing", "is_lone"), [
    ("m", 1.0, False), ("msss", 1.0, False), ("mssss", 1.0, True), ("mmssssss", 1.0, False), ("mm", 0.5, True),
    ("m?????", 1.0, False), ("", 1.0, True),
])  # fmt: skip
def test_a_spot_that_moved_is_lone_without_another_one_and_a_quarter_of_those_around(
    around: str, spacing: float, is_lone: bool
) -> None:
    """Moved, static and unknown spots lie 2 m around a spot that moved, next to each other."""
    angle = 0.05 * np.arange(len(around))
    point = np.concatenate([np.zeros((1, 3)), 2.0 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)])
    moved, static = (np.array([kind == letter for letter in "m" + around]) for kind in "ms")
    assert lone(point, moved, static, spacing)[0] == is_lone
    assert not lone(point, moved, static, spacing)[~moved].any()


def test_of_points_a_lone_spot_is_static_and_one_between_points_that_views_see_too() -> None:
    """Nine views see through the nine spots of a thing, but for the third, and all through another spot, far away."""
    memory, thing = DepthMemory(), [spot_at(4 + 0.2 * a, 4 + 0.2 * b, 10.0) for a in range(3) for b in range(3)]
    for k in range(9):
        depths = np.full((9, 20), 14.0)
        depths[1:8, 1:8] = 10.0 if k == 2 else 14.0
        memory.add(dataclasses.replace(view_of(depths), view=k))
    point = np.concatenate([*thing, spot_at(15, 4, 10.0), spot_at(15, 4, 14.0)])
    firm = np.array([*[True] * 10, False])
    votes = memory.votes_on(point, np.full(len(point), 2, np.int32), firm, 9, 0.0, 0.5)
    assert votes.moved.tolist() == [True] * 9 + [False] * 2
    assert votes.through[9] == 0
    assert votes.static[10]
    alone = memory.votes_on(point, np.full(len(point), 2, np.int32), firm, 9, 0.0, 0.0)
    assert alone.moved[9]


def test_a_spot_at_an_edge_that_other_views_see_is_not_told_by_spots_that_moved() -> None:
    """Two views before and two after see through the first spots; the others, at an edge, are of floor and thing."""
    point = np.array([[-0.2, 0.0, 10.0], [0.0, 0.0, 10.0], [0.2, 0.0, 10.0], [0.0, 0.1, 12.0], [0.0, 0.1, 10.0]])
    memory = DepthMemory()
    for k in range(5):
        depth = np.full((90, 90), 10.0 if k == 2 else 12.0)
        memory.add(KeptDepth.of_image(k, np.eye(4), (90.0, 90.0, 44.5, 44.5), depth))
    firm = np.array([True, True, True, False, False])
    votes = memory.votes_on(point, np.full(5, 2, np.int32), firm, 5, 0.0, 5.0)
    assert votes.moved.tolist() == [True, True, True, False, True]
    assert not votes.decided[3]


def test_an_oncoming_car_is_found_in_scans_by_what_it_left_behind() -> None:
    """Nothing else is: scans see through its place before and after, and points around are farther."""
    found, still = (asked_by_scans(oncoming) for oncoming in (4.0, 0.0))
    drives, spots = found
    assert spots.votes is not None
    assert spots.votes.moved[drives].mean() > 0.8
    assert not spots.votes.moved[classes(spots) == 0].any()
    assert spots.votes.decided[classes(spots) >= 0].mean() > 0.5
    assert still[1].votes is not None
    assert not still[1].votes.moved.any()


def asked_by_scans(oncoming: float) -> tuple[np.ndarray, SpotObservations]:
    """Return which spots are on the car that drives, and the spots."""
    sampler = Sampler(2)
    for k, (points, ids, T_wc) in enumerate(Street.made(5, rows=64, oncoming=oncoming)):
        sampler.add(Frame(k, points=points, labels=(ids == DRIVES).astype(np.uint8), T_wc=T_wc))
    spots = sampler.sample()
    return classes(spots) == 1, spots
