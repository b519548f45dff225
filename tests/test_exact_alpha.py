"""simulations/exact.py knows alpha: closed forms, labels by hand, what a camera sees; how coverage is counted."""

import dataclasses
import itertools

import exact
import exact_coverage
import numpy as np
import pytest
from exact_errors import ERRORS, border, in_squares, none, unlabelled
from exact_scenes import ExactScene, Solid, rectangle
from exact_views import ExactFlight, Pinhole, flight, strips


def by_hand(units):
    """Krippendorff's nominal alpha of lists of labels, from the matrix of coincidences."""
    units = [labels for labels in units if len(labels) >= 2]
    K = max(map(max, units)) + 1
    together = np.zeros((K, K))
    for labels in units:
        for a, b in itertools.permutations(labels, 2):
            together[a, b] += 1 / (len(labels) - 1)
    of = together.sum(axis=1)
    n = of.sum()
    return 1 - (n - 1) * (n - np.trace(together)) / (n**2 - (of**2).sum())


def test_alpha_is_that_of_the_matrix_of_coincidences():
    rng = np.random.default_rng(0)
    units = [rng.integers(0, 4, rng.integers(0, 6)).tolist() + [2] * int(rng.integers(0, 4)) for _ in range(50)]
    unit, label = np.array([(k, label) for k, labels in enumerate(units) for label in labels]).T
    order = rng.permutation(len(unit))
    found = exact.alpha_of(unit[order], label[order])
    assert found.value == pytest.approx(by_hand(units), abs=1e-12)
    assert found.points == sum(len(labels) >= 2 for labels in units)
    assert found.views == pytest.approx(np.mean([len(labels) for labels in units if len(labels) >= 2]))


def test_its_error_is_how_much_it_varies_with_the_points_drawn():
    rng, found = np.random.default_rng(0), []
    for _ in range(200):
        times = rng.integers(1, 6, 300)
        unit = np.repeat(np.arange(300), times)
        truth = rng.choice(3, 300, p=(0.6, 0.3, 0.1))[unit]
        found.append(exact.alpha_of(unit, np.where(rng.random(len(unit)) < 0.2, (truth + 1) % 3, truth)))
    assert np.mean([exact_value.error for exact_value in found]) == pytest.approx(
        np.std([exact_value.value for exact_value in found]), rel=0.15
    )


def plane(K, frames, seed=0):
    """A flight over a plane with stripes of all classes, each 0.5 m wide."""
    stripes = {4: lambda points: np.floor(2 * points[:, 0]).astype(int) % K}
    scene = ExactScene([Solid.prism(rectangle((-40, -40), (40, 40)), 0.0, 0, 0, bottom=-1.0, textures=stripes)])
    return ExactFlight(scene, Pinhole(80, 60), strips(frames, np.random.default_rng(seed)))


@pytest.mark.parametrize(("K", "wrong"), [(2, 0.1), (2, 0.3), (5, 0.2)])
def test_errors_of_pixels_on_a_plane_have_the_alpha_of_their_closed_form(K, wrong):
    flown, rng = plane(K, 12), np.random.default_rng(1)
    labeller = in_squares(wrong, 1, flown, K, rng)
    agree = (1 - wrong) ** 2 + wrong**2 / (K - 1)
    found = exact.exact(flown, labeller, 10000, rng)
    assert found.value == pytest.approx(1 - (1 - agree) / (1 - 1 / K), abs=0.02)
    assert found.points >= 10000


@pytest.mark.parametrize("path", ["orbit", "strips", "oblique", "street", "scan"])
def test_the_truth_has_an_alpha_of_one(path):
    rng = np.random.default_rng(0)
    flown = flight(path, 4, 8, (45, 60), rng)
    labeller = unlabelled(none(flown, 8, rng), 0.3, flown, rng)
    found = exact.exact(flown, labeller, 500, rng)
    assert (found.value, found.error) == (1.0, 0.0)


@pytest.mark.parametrize("path", ["orbit", "strips", "oblique", "street", "scan"])
def test_a_frame_meets_the_points_that_it_looks_at_with_the_same_labels(path):
    rng = np.random.default_rng(0)
    flown = flight(path, 1, 8, (45, 60), rng)
    labeller = unlabelled(border(flown, 8, rng), 0.3, flown, rng)
    u, v = rng.uniform(-0.5, np.array([[flown.sensor.width], [flown.sensor.height]]) - 0.5, (2, 3000))
    looked = flown.look(0, u, v)
    hit = looked.face >= 0
    some, met = flown.meet(0, looked.point[hit], looked.face[hit])
    assert hit.sum() > 1000
    assert len(some) == hit.sum()
    assert met.u == pytest.approx(u[hit], abs=1e-9)
    assert met.t == pytest.approx(looked.t[hit])
    assert (met.truth == looked.truth[hit]).mean() > 0.999  # the rest lies on a border, within rounding
    assert (labeller(met) == labeller(looked)[hit]).mean() > 0.999


def above_a_box():
    """A camera 10 m above the middle of a box 2 m wide and 4 m high."""
    ground = Solid.prism(rectangle((-20, -20), (20, 20)), 0.0, 0, 0, bottom=-1.0)
    pose = np.eye(4)
    pose[:3, :3], pose[2, 3] = np.diag([1.0, -1.0, -1.0]), 10.0
    return ExactFlight(
        ExactScene([ground, Solid.prism(rectangle((-1, -1), (1, 1)), 4.0, 1, 2)]), Pinhole(81, 61), pose[None]
    )


def test_a_box_hides_what_is_in_its_shadow():
    flown = above_a_box()
    xy = np.random.default_rng(0).uniform(-8, 8, (4000, 2))
    points = np.column_stack([xy, np.zeros(len(xy))])
    some, met = flown.meet(0, points, np.full(len(xy), 4))
    f = flown.sensor.intrinsics.fx
    image = np.abs(xy * f / 10)
    inside = (image[:, 0] < 40.5) & (image[:, 1] < 30.5)
    shadow = np.abs(xy).max(axis=1) < 10 / 6  # of the top's edges, 6 m below the camera
    assert set(some) == set(np.flatnonzero(inside & ~shadow))
    assert met.u == pytest.approx(40 + xy[some, 0] * f / 10)
    assert met.v == pytest.approx(30 - xy[some, 1] * f / 10)
    assert met.t == pytest.approx(10.0)
    assert met.point == pytest.approx(points[some])


def test_an_image_shows_the_box_and_the_ground():
    flown = above_a_box()
    (image,) = flown.images
    f = flown.sensor.intrinsics.fx
    top = np.maximum(np.abs(image.u - 40), np.abs(image.v - 30)) < f / 6
    assert (image.truth == np.where(top, 2, 0)).all()
    assert image.t == pytest.approx(np.where(top, 6.0, 10.0))


def test_points_are_as_frequent_as_their_surface_is_large():
    _, face = above_a_box().scene.draw(40000, np.random.default_rng(0))
    areas = [40.0, 40, 40, 40, 1600, 0, 8, 8, 8, 8, 4, 0]
    assert np.bincount(face, minlength=12) / 40000 == pytest.approx(np.array(areas) / np.sum(areas), abs=0.004)


def test_the_tool_is_near_the_exact_value_where_errors_are_alike_everywhere():
    true, told = exact.trial(exact.Condition("orbit", "pixels", 12), 0, (90, 120), 4000)
    assert told.value == pytest.approx(true.value, abs=0.03)


@pytest.mark.parametrize("error", [name for name in ERRORS if name != "none"])
def test_stronger_errors_leave_less_agreement_than_weak_ones(error):
    def at(strength):
        rng = np.random.default_rng(3)
        flown = flight("orbit", 8, 6, (45, 60), rng)
        wrong = [
            ERRORS[error](flown, 6, np.random.default_rng(4), strength)(image) != image.truth for image in flown.images
        ]
        return np.mean(np.concatenate(wrong)[np.concatenate([image.face for image in flown.images]) >= 0])

    assert 0 < at(0.3) < at(1.0) < 0.6


def test_a_scene_is_flown_again_along_another_course_at_the_same_height():
    condition = exact.Condition("orbit", "blobs", 5)
    scene = flight("orbit", 1, 6, (45, 60), np.random.default_rng(0)).scene
    one, other = (exact_coverage.again(condition, scene, np.random.default_rng(seed)) for seed in (1, 2))
    assert np.abs(one.poses[:, :2, 3] - other.poses[:, :2, 3]).max() > 2
    assert one.poses[:, 2, 3] == pytest.approx(18, abs=3)
    assert np.hypot(*other.poses[:, :2, 3].T) == pytest.approx(18, abs=3)
    for flown in (one, other):
        assert flown.poses[:, :3, :3] @ flown.poses[:, :3, :3].transpose(0, 2, 1) == pytest.approx(
            np.tile(np.eye(3), (5, 1, 1))
        )
        assert np.mean(flown.images[0].face >= 0) > 0.8  # it looks at the scene


def flown(scene, exact, said, half, level="usable", probability=0.95, condition="orbit, blobs"):
    return exact_coverage.Flown(condition, scene, exact, said, said - half, said + half, level, probability)


def test_coverage_counts_the_scene_s_exact_alpha_and_not_that_of_a_flight():
    rows = [
        flown(0, 0.70, 0.72, 0.014),
        flown(0, 0.74, 0.75, 0.014),
        flown(1, 0.9, 0.9, 0.01),
        flown(1, 0.9, 0.9, 0.01),
    ]
    name, count, targets, off, held, spread_held, _ = exact_coverage.cells("orbit, blobs", rows)
    assert (name, count, targets) == ("orbit, blobs", "4", "0.72 to 0.90")
    assert off.startswith("+0.008")
    assert held.startswith("0.750")  # .736 to .764 misses .72
    assert spread_held.startswith("0.500")  # and both miss what they say on average, .735


def test_stated_probabilities_are_counted_by_tenths_and_by_group():
    rows = [flown(0, 0.70, 0.72, 0.01, probability=0.65), flown(0, 0.70, 0.81, 0.01, "stable", 0.62)]
    rows += [
        flown(0, 0.9, 0.9, 0.01, "stable", 1.0, "orbit, burst"),
        flown(0, 0.9, 0.8, 0.5, "undecided", 0.5, "orbit, lasting"),
    ]
    lines = {line[0]: line[1:] for line in exact_coverage.tenths(rows)}
    assert lines["60% to 70%"] == ["0.50, stated 0.64", "2", "-", "0", "-", "0"]
    assert lines["90% to 100%"] == ["-", "0", "1.00, stated 1.00", "1", "-", "0"]
    assert lines["undecided"] == ["0.00 of 2", "0", "0.00 of 1", "0", "1.00 of 1", "1"]


def test_what_is_saved_is_read_as_it_was(tmp_path):
    rows = [flown(0, 0.70, 0.72, 0.01), flown(1, 0.1, 0.2, 0.3, "undecided", 0.4)]
    with (tmp_path / "flights.csv").open("w", newline="") as file:
        exact_coverage.writer_to(file).writerows(map(dataclasses.astuple, rows))
    assert exact_coverage.load(tmp_path / "flights.csv") == rows


def test_all_flights_of_a_scene_have_its_errors_of_place_and_others_are_drawn_again(monkeypatch):
    monkeypatch.setattr(exact_coverage, "SIZE", (45, 60))
    monkeypatch.setattr(exact_coverage, "POINTS", 500)
    for error, least, most in (("place", 1.0, 1.0), ("blobs", 0.0, 0.99)):
        rows = list(exact_coverage.flights(exact.Condition("orbit", error, 4), 1, 2, 0))
        assert [row.scene for row in rows] == [0, 0]
        assert all(least <= row.exact <= most for row in rows)
