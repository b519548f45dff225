"""The built-in city: geometry against brute force, flights against the paper's overlap, errors against theory."""

from __future__ import annotations

import runpy
import tracemalloc
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corners import combination

from semstab import Frame
from semstab.core.files import read_json
from semstab.datasets import GROUND_TRUTH, open_dataset
from semstab.datasets.city import City, CityScene, SimulatedModel
from semstab.datasets.city.ground import Ground
from semstab.datasets.city.hashing import splitmix64
from semstab.datasets.city.labellers import LABELLERS
from semstab.datasets.city.mesh import MOVERS, join, surface
from semstab.datasets.city.options import CONFUSION
from semstab.datasets.city.rendering import CityCaster
from semstab.datasets.city.simulation import CityView, Simulation
from semstab.datasets.city.things import flats
from semstab.errors import ConfigError, DataError

SMALL = {"width": 96, "height": 54, "frames": 3}


def city(**options: Any) -> City:
    dataset = open_dataset("city", SMALL | options)
    assert isinstance(dataset, City)
    return dataset


@pytest.fixture(scope="module")
def small() -> City:
    return city()


@cache
def full(name: str) -> CityScene:
    """A scene as it is by default, kept with its rendered frames for all tests."""
    return City(City.Options()).scene(name)


def positions(frame: Frame) -> np.ndarray:
    """World points (H, W, 3), with the expression that the backends document."""
    d, k, T = frame.depth.astype(np.float64), frame.intrinsics, frame.T_wc
    v, u = np.indices(d.shape)
    x, y = ((u - k.cx) / k.fx) * d, ((v - k.cy) / k.fy) * d
    return np.stack([((T[i, 0] * x + T[i, 1] * y) + T[i, 2] * d) + T[i, 3] for i in range(3)], axis=-1)


def voxels(frame: Frame, size: float) -> np.ndarray:
    return np.floor(positions(frame) / size).astype(np.int64)


def packed(q: np.ndarray) -> np.ndarray:
    q = q.reshape(-1, 3) + (1 << 20)
    return q[:, 0] << 42 | q[:, 1] << 21 | q[:, 2]


def view_of(scene: CityScene, index: int, *, as_frame: int | None = None) -> CityView:
    """A frame's view, pretending on request that it was taken as another frame."""
    frame = scene.frame(index, GROUND_TRUTH)
    rendered = scene.rendered[index]
    return CityView(index if as_frame is None else as_frame, rendered, frame.intrinsics, frame.T_wc)


def simulated(scene: CityScene, city_view: CityView, **model: Any) -> np.ndarray:
    return Simulation(SimulatedModel(**model), 0, "test", scene.name).labels(city_view)


def test_frames_depend_on_the_seed_and_not_on_the_order_of_calls(small) -> None:
    again, other = city(), city(seed=1)
    a, b, c = (d.scene("scene0").frame(1, "sim-flicker") for d in (small, again, other))
    assert np.array_equal(a.depth, b.depth)
    assert np.array_equal(a.labels, b.labels)
    assert np.array_equal(a.color, b.color)
    assert np.array_equal(a.T_wc, b.T_wc)
    assert (a.depth != c.depth).mean() > 0.5
    assert a.where("labels") == "city/scene0/frame 1, labels"
    backwards = city(cache_megabytes=0).scene("scene1")
    forwards = small.scene("scene1")
    expected = [forwards.frame(i, "sim-soft").scores for i in range(3)]
    found = [backwards.frame(i, "sim-soft").scores for i in (2, 1, 0)][::-1]
    for a, b in zip(expected, found, strict=True):
        assert np.array_equal(a, b)


def test_depth_is_the_nearest_triangles(small: City) -> None:
    scene = small.scene("scene1")
    frame = scene.frame(1, GROUND_TRUTH)
    surfaces = [scene.town.still, scene.town.moving(frame.timestamp, frame.T_wc[:3, 3])]
    rng = np.random.default_rng(5)
    errors = []
    for u, v in zip(rng.integers(0, 96, 12), rng.integers(0, 54, 12), strict=True):
        k = frame.intrinsics
        ray = frame.T_wc[:3, :3] @ [(u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0]
        hits = [moeller_trumbore(s.vertices[s.faces], frame.T_wc[:3, 3], ray) for s in surfaces]
        nearest = min((t.min(), k) for k, t in enumerate(hits))
        errors.append(abs(frame.depth[v, u] / nearest[0] - 1))
        if errors[-1] < 1e-6:
            assert surfaces[nearest[1]].classes[hits[nearest[1]].argmin()] == frame.labels[v, u]
    assert np.sum(np.array(errors) > 1e-6) <= 1, "embree's float32 may take the neighbour at a silhouette, rarely"


def moeller_trumbore(triangles: np.ndarray, origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Ray parameter for each triangle (m, 3, 3), inf where it is missed; float64, no acceleration."""
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(ray, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (e1 * p).sum(axis=1)
        s = origin - a
        u = (s * p).sum(axis=1) * inverse
        q = np.cross(s, e1)
        v = (q @ ray) * inverse
        t = (e2 * q).sum(axis=1) * inverse
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return np.where(inside, t, np.inf)


def test_a_frame_reprojects_into_its_neighbour() -> None:
    scene = full("scene0")
    a, b = scene.frame(4, GROUND_TRUTH), scene.frame(5, GROUND_TRUTH)
    local = (positions(a).reshape(-1, 3) - b.T_wc[:3, 3]) @ b.T_wc[:3, :3]
    k = b.intrinsics
    u, v = local[:, 0] / local[:, 2] * k.fx + k.cx, local[:, 1] / local[:, 2] * k.fy + k.cy
    u, v = np.rint(u).astype(int), np.rint(v).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < b.shape[1]) & (v < b.shape[0])
    found = b.depth[v[inside], u[inside]]
    assert inside.mean() > 0.4
    assert np.median(np.abs(found / local[inside, 2] - 1)) < 2e-3
    same = a.labels.reshape(-1)[inside] == b.labels[v[inside], u[inside]]
    assert same.mean() > 0.85


@pytest.mark.parametrize(
    ("name", "low", "high"), [("scene0", 1.9, 2.2), pytest.param("scene2", 1.1, 1.27, marks=combination)]
)
def test_overlap_and_classes_are_as_in_the_paper(name: str, low: float, high: float) -> None:
    """Mean OP at 0.2 m: about 2 in two scenes, 1.15 to 1.25 in three; every class occurs in every scene."""
    scene = full(name)
    frames = [scene.frame(i, GROUND_TRUTH) for i in range(len(scene))]
    visits = np.concatenate([np.unique(packed(voxels(f, 0.2))) for f in frames])
    assert low < len(visits) / len(np.unique(visits)) < high
    share = np.bincount(np.concatenate([f.labels.ravel() for f in frames]), minlength=256)
    share = share / (len(frames) * frames[0].depth.size)
    assert (share[:8] > 2e-4).all()
    assert share[255] == 0, "the terrain covers the view"
    assert all(30 < np.median(f.depth) < 80 for f in frames)


def test_moving_cars_move_and_a_surface_without_triangles_is_never_hit() -> None:
    town = full("scene0").town
    before, after = (town.moving(seconds, np.zeros(3)) for seconds in (1.0, 2.0))
    assert set(np.unique(before.classes)) == set(MOVERS)
    assert not np.isin(town.still.classes, MOVERS).any(), "the class of a pixel tells whether what it shows moves"
    assert not np.array_equal(before.vertices, after.vertices)
    for movers, slow, fast in zip(town.movers, (6, 0.9), (13, 1.7), strict=True):
        step = np.hypot(*(movers.spots(2.0) - movers.spots(1.0))[:, :2].T)
        within = step < 20  # others begin again at the other end
        assert within.mean() > 0.9
        assert (step[within] >= slow).all()
        assert (step[within] <= fast).all()
    nothing = CityCaster(surface(np.empty((0, 3)), np.empty((0, 3)), 0))
    face = nothing.first(np.zeros((2, 3)), np.ones((2, 3)))
    assert (face == -1).all()
    assert np.isinf(nothing.depth(face, np.zeros(3), np.ones((2, 3)))).all()


def test_a_town_may_lack_flats() -> None:
    rng = np.random.default_rng(0)
    nothing = join(flats(np.empty((0, 5)), Ground.random(rng), rng))
    assert nothing.faces.shape == nothing.colors.shape == (0, 3)


def test_more_frames_sample_the_same_flight_and_a_utm_origin_shifts_the_voxels(small) -> None:
    few, many = (city(frames=n).scene("scene0") for n in (3, 5))
    assert np.array_equal(few.frame(1, GROUND_TRUTH).T_wc, many.frame(2, GROUND_TRUTH).T_wc)
    assert few.frame(2, GROUND_TRUTH).timestamp == many.frame(4, GROUND_TRUTH).timestamp
    assert city(frames=1).scene("scene0").frame(0, GROUND_TRUTH).timestamp == 0.0
    origin = (480_000.0, 5_400_000.0, 120.0)  # whole numbers of voxels and of the model's cells
    near, far = small.scene("scene0"), city(origin=origin).scene("scene0")
    a, b = near.frame(1, "sim-flicker"), far.frame(1, "sim-flicker")
    assert np.array_equal(a.depth, b.depth)
    shift = np.round(np.array(origin) / 0.2).astype(np.int64)
    moved = (voxels(a, 0.2) + shift != voxels(b, 0.2)).any(axis=-1)
    assert moved.mean() < 1e-3
    assert (a.labels != b.labels).mean() < 1e-3


def test_memory_of_large_frames_and_of_the_cache_is_bounded() -> None:
    """12 bytes a pixel stay; what is needed on the way does not grow with the image (a 4K frame peaks at 180 MB)."""
    scene = city(width=960, height=540).scene("scene0")
    scene.still = full("scene0").still
    tracemalloc.start()
    frame = scene.frame(1, "sim-flicker")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert frame.shape == (540, 960)
    assert peak < 120e6
    scene = city(width=320, height=180, cache_megabytes=1).scene("scene0")
    for index in range(3):
        scene.frame(index, GROUND_TRUTH)
    assert 0 < sum(r.nbytes for r in scene.rendered.values()) <= 1_000_000


def test_scenes_and_models_and_unknown_names(small) -> None:
    assert small.scenes == ("scene0", "scene1", "scene2", "scene3", "scene4")
    scene = small.scene("scene2")
    assert scene.models == ("sim-steady", "sim-flicker", "sim-soft")
    assert scene.further == tuple(f"trick-{name}" for name in LABELLERS)
    assert scene.ground_truth
    assert np.array_equal(scene.up, [0, 0, 1])
    assert len(scene) == 3
    assert scene.label_space("sim-soft").classes[2] == "road"
    assert small.scene("scene2") is scene
    with pytest.raises(DataError, match="did you mean 'scene1'"):
        small.scene("scen1")
    with pytest.raises(ConfigError, match="did you mean 'sim-steady'"):
        small.scene("scene0").frame(0, "sim-stedy")
    with pytest.raises(DataError, match="there is no frame 3"):
        small.scene("scene0").frame(3, GROUND_TRUTH)
    scene = city(models={"perfect": {}}).scene("scene0")
    for index in range(3):
        truth = small.scene("scene0").frame(index, GROUND_TRUTH).labels
        assert np.array_equal(scene.frame(index, "perfect").labels, truth)


def test_digest_tells_contents_apart_without_rendering() -> None:
    scene = city().scene("scene0")
    digests = {
        scene.digest([0, 1], "sim-steady"), scene.digest([0, 2], "sim-steady"), scene.digest([0, 1], "sim-flicker"),
        scene.digest([0, 1], GROUND_TRUTH), city(seed=1).scene("scene0").digest([0, 1], "sim-steady"),
        city().scene("scene1").digest([0, 1], "sim-steady"),
        city(models={"sim-steady": {"flicker": 0.5}}).scene("scene0").digest([0, 1], "sim-steady"),
    }  # fmt: skip
    assert len(digests) == 7
    assert city(cache_megabytes=1).scene("scene0").digest([0, 1], "sim-steady") in digests
    assert "town" not in vars(scene)


@pytest.mark.parametrize(("options", "message"), [
    ({"width": 4000}, "less than or equal to 3840"), ({"frames": 0}, "greater than or equal to 1"),
    ({"origin": [float("nan"), 0, 0]}, "less than or equal to 100000000"), ({"wdith": 10}, "did you mean 'width'"),
    ({"models": {"mine": {"place": 1.5}}}, "less than or equal to 1"),
    ({"models": {"gt": {}}}, "cannot name a model"), ({"models": {"a/b": {}}}, "cannot name a model"),
    ({"models": {"mine": {"difficulty": {"lorry": 2}}}}, "class 'lorry' is not known"),
])  # fmt: skip
def test_bad_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        open_dataset("city", options)


def test_flicker_follows_its_theory() -> None:
    """Voxels seen twice disagree with f = 2p(1-p): mean VSS = 1 - f/2, SBD = f * 0.31128 bits (pure voxels)."""
    p = 0.15
    scene = full("scene0")
    model = {"flicker": p, "cell": 0.2}
    keys, wrong, true = [], [], []
    for index in range(len(scene)):
        view = view_of(scene, index)
        labels = simulated(scene, view, **model)
        key, first = np.unique(packed(voxels(scene.frame(index, GROUND_TRUTH), 0.2)), return_index=True)
        keys.append(key)
        wrong.append((labels != view.rendered.classes).ravel()[first])
        true.append(view.rendered.classes.ravel()[first])
    key, error, truth = (np.concatenate(parts) for parts in (keys, wrong, true))
    order = np.argsort(key, kind="stable")
    key, error, truth = key[order], error[order], truth[order]
    _, start, count = np.unique(key, return_index=True, return_counts=True)
    twice = start[count == 2]
    twice = twice[truth[twice] == truth[twice + 1]]
    disagree = (error[twice] != error[twice + 1]).mean()
    expected = 2 * p * (1 - p)
    assert len(twice) > 50_000
    assert abs(error.mean() - p) < 5 * np.sqrt(p * (1 - p) / len(error))
    assert abs(disagree - expected) < 5 * np.sqrt(expected * (1 - expected) / len(twice))


def test_flicker_is_one_draw_a_cell_and_frame(small: City) -> None:
    scene = small.scene("scene0")
    view = view_of(scene, 1)
    labels = simulated(scene, view, flicker=0.3, cell=0.8)
    wrong = (labels != view.rendered.classes).ravel()
    cell = packed(voxels(scene.frame(1, GROUND_TRUTH), 0.8))
    _, parent = np.unique(cell, return_inverse=True)
    share = np.bincount(parent, wrong) / np.bincount(parent)
    assert np.isin(share, (0.0, 1.0)).all()
    again = simulated(scene, view_of(scene, 1, as_frame=2), flicker=0.3, cell=0.8)
    assert 0.2 < (labels != again).mean() < 0.6


def test_place_errors_are_the_same_in_every_view() -> None:
    scene = full("scene1")
    label_of: dict[tuple[int, int], int] = {}
    met = errors = 0
    for index in (6, 7, 8):
        view = view_of(scene, index)
        labels = simulated(scene, view, place=0.2).ravel()
        pairs = np.stack([packed(voxels(scene.frame(index, GROUND_TRUTH), 0.8)), view.rendered.classes.ravel()], axis=1)
        pairs, first, parent = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
        assert np.array_equal(labels[first][parent.ravel()], labels), "one label for a cell and true class"
        for pair, label in zip(map(tuple, pairs.tolist()), labels[first].tolist(), strict=True):
            met += pair in label_of
            assert label_of.setdefault(pair, label) == label
            errors += label != pair[1]
    assert met > 5_000
    assert 0.18 < errors / (len(label_of) + met) < 0.22


def test_view_errors_repeat_with_the_view_and_change_with_it() -> None:
    scene = full("scene1")
    model = {"view": 0.6, "cell": 0.8}
    first = simulated(scene, view_of(scene, 3), **model)
    assert np.array_equal(first, simulated(scene, view_of(scene, 3, as_frame=9), **model))
    truth = view_of(scene, 3).rendered
    wrong = first != truth.classes
    assert wrong[truth.incidence < 0.4].mean() > 1.5 * wrong[truth.incidence > 0.9].mean() > 0
    far = view_of(scene, 5)
    second = simulated(scene, far, **model) != far.rendered.classes
    a = dict(zip(packed(voxels(scene.frame(3, GROUND_TRUTH), 0.8)).tolist(), wrong.ravel().tolist(), strict=True))
    b = dict(zip(packed(voxels(scene.frame(5, GROUND_TRUTH), 0.8)).tolist(), second.ravel().tolist(), strict=True))
    both = a.keys() & b.keys()
    share = np.mean([b[cell] for cell in both if a[cell]])
    assert len(both) > 500
    assert share < 0.8


def test_border_errors_stay_at_borders_and_difficulty_scales_rates() -> None:
    scene = full("scene0")
    view = view_of(scene, 2)
    labels = simulated(scene, view, border=2.0)
    truth = view.rendered.classes
    wrong = labels != truth
    assert 0.005 < wrong.mean() < 0.2
    padded = np.pad(truth, 2, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))
    assert (windows[wrong] == labels[wrong][:, None, None]).any(axis=(1, 2)).all(), "within 2 pixels of their class"
    assert (labels != simulated(scene, view_of(scene, 2, as_frame=3), border=2.0)).any()
    assert np.array_equal(simulated(scene, view, border=0.0), truth)
    wrong = simulated(scene, view, flicker=0.1, cell=0.05, difficulty={"road": 0, "building": 2}) != truth
    road, building, grass = (wrong[truth == k].mean() for k in (2, 1, 5))
    assert road == 0
    assert abs(building - 0.2) < 0.02
    assert abs(grass - 0.1) < 0.02


def test_soft_scores_sum_to_one_and_keep_the_class(small: City) -> None:
    model = {"place": 0.1, "flicker": 0.1, "border": 1.0}
    scene = city(models={"soft": model | {"softness": 0.4}}).scene("scene0")
    frame = scene.frame(1, "soft")
    assert frame.labels is None
    assert frame.scores.dtype == np.float32
    assert frame.scores.shape == (54, 96, 8)
    np.testing.assert_allclose(frame.scores.sum(axis=2), 1, atol=1e-6)
    hard = Simulation(SimulatedModel(**model), 0, "soft", "scene0").labels(view_of(scene, 1))
    assert np.array_equal(frame.predicted, hard)
    best = frame.scores.max(axis=2)
    assert 0.6 <= best.min() < 0.7 < best.max() <= 1
    truth = scene.frame(1, GROUND_TRUTH).labels
    mistaken = np.argwhere(hard != truth)
    second = frame.scores.copy()
    np.put_along_axis(second, hard[..., None].astype(int), -1, axis=2)
    assert all(second[v, u].argmax() == truth[v, u] for v, u in mistaken)


def test_known_settings_give_known_results() -> None:
    """The hash is splitmix64, whose outputs for the states 0 and 1 are published."""
    assert [hex(int(x)) for x in splitmix64(np.array([0, 1], dtype=np.uint64))] == [
        "0xe220a8397b1dcdaf",
        "0x910a2dec89025cc1",
    ]


def test_no_class_is_confused_with_itself_and_shares_sum_to_one() -> None:
    names = full("scene0").label_space(GROUND_TRUTH).classes
    assert set(CONFUSION) == set(names)
    for true, row in CONFUSION.items():
        assert set(row) < set(names) - {true}
        assert np.isclose(sum(row.values()), 1.0)


GOLDEN = runpy.run_path(str(Path(__file__).parent / "golden/regenerate.py"))


def test_the_city_is_what_its_version_stands_for() -> None:
    """Raise GENERATOR_VERSION with a change of the city; `python tests/golden/regenerate.py` then writes the file."""
    found, golden = GOLDEN["golden_city"](), read_json(Path(__file__).parent / "golden/city.json")
    assert found.keys() == golden.keys()
    assert found["version"] == golden["version"]
    for scene in found.keys() - {"version"}:
        labels = [content[scene].pop("labels") for content in (found, golden)]
        for model, counts in labels[0].items():  # a ray at an edge may hit either side
            assert np.abs(np.array(counts) - labels[1][model]).max() <= 3
        approximately(found[scene], golden[scene], scene)


def approximately(found: Any, expected: Any, where: str) -> None:
    """Every number is the same to six digits; depth and colour of images to three."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), where
    if isinstance(expected, dict | list):
        for key in expected if isinstance(expected, dict) else range(len(expected)):
            approximately(found[key], expected[key], f"{where}, {key}")
        return
    image = where.endswith("depth") or where.split(", ")[1] == "color"
    assert found == pytest.approx(expected, rel=1e-3 if image else 1e-6, abs=1e-9), where
