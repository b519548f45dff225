"""Alpha of features: what it equals, its intervals, its bounded memory, and what bad features say."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import math
import shutil

import numpy as np
import pytest
from command_line import bench, error_of
from numpy.testing import assert_array_equal
from room_scene import CAMERA, CLASSES, Room, opened, render, rigid, turn, walk, write
from simulated_events import grid, spots_at

import semstab
from semstab import Features
from semstab.comparison.differences import sums_difference
from semstab.core.files import write_image
from semstab.data.features import FeatureColours
from semstab.data.statistics.intervals import short
from semstab.errors import DataError
from semstab.online.metric import TemporalStability
from semstab.statistics import Sampler
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import ClusterSums, value
from semstab.statistics.feature_spots import FeatureObservations, FeatureStore
from semstab.statistics.features import FEATURE_ALPHA, alpha_of_features, feature_agreement, feature_sums, likeness
from semstab.statistics.intervals import estimate, scope_of

K = len(CLASSES)


def flight(frames=10, wrong=0.2, seed=0, **more):
    """Frames of a room whose labels are wrong in blocks of 6 x 6 pixels."""
    rng = np.random.default_rng(seed)
    for i, T in enumerate(walk(frames)):
        depth, labels = render(T)
        block = rng.random((12, 16)) < wrong
        other = rng.integers(0, K, (12, 16)).repeat(6, axis=0).repeat(6, axis=1)
        labels = np.where(block.repeat(6, axis=0).repeat(6, axis=1), other, labels).astype(np.uint8)
        yield semstab.Frame(i, depth, CAMERA, T, labels=labels, **more)


def of_classes(labels, D=K):
    """One-hot features of labels."""
    return np.eye(D, dtype=np.float32)[labels]


def sampled(frames, budget=1 << 19):
    sampler = Sampler(K, budget)
    for frame in frames:
        sampler.add(frame)
    return sampler


def agreement_of(features):
    """Alpha of features of observations, with all that goes with it."""
    alike = likeness(features)
    return feature_agreement(features, alike, feature_sums(features, alike))


def seen_by(vectors, index=None):
    """Features (n, F, D) of F views at n spots on a floor."""
    n, F, _ = vectors.shape
    spot, view = (indices.ravel() for indices in np.indices((n, F)))
    index = grid(int(n**0.5)) if index is None else index
    labels = np.zeros(n * F, np.uint16)
    spots = spots_at(index * 0.125, spot, view, labels, F, 1)
    unit = vectors / np.linalg.norm(vectors, axis=2, keepdims=True)
    return FeatureObservations.from_answers(spots.spot, spots.view, unit.reshape(n * F, -1).astype(np.float16), spots)


def alpha_by_hand(vectors):
    """1 - observed over expected mean of 1 - cosine, over all pairs of views of a spot, and of all pairs."""
    n, F, _ = vectors.shape
    pairs = [*itertools.permutations(range(F), 2)]
    observed = np.mean([[1 - spot[a] @ spot[b] for a, b in pairs] for spot in vectors])
    every = vectors.reshape(n * F, -1)
    others = every @ every.T
    expected = 1 - (others.sum() - np.trace(others)) / (n * F * (n * F - 1))
    return 1 - observed / expected


def test_features_that_are_labels_have_the_alpha_of_the_first_answers():
    frames = [dataclasses.replace(frame, features=of_classes(frame.labels)) for frame in flight()]
    sampler = sampled(frames)
    plain = sampled(flight()).sample()
    with_features = sampler.sample()
    assert all(np.array_equal(getattr(plain, name), getattr(with_features, name)) for name in ("spot", "label", "near"))
    first = sums_of_spots(with_features).answers[0]
    assert 0.3 < value(first, "voxel_alpha") < 0.9
    assert alpha_of_features(sampler.features()) == pytest.approx(value(first, "voxel_alpha"), abs=1e-12)


def test_their_intervals_are_those_of_the_labels():
    frames = [dataclasses.replace(frame, features=of_classes(frame.labels)) for frame in flight(24)]
    sampler = sampled(frames)
    first = sums_of_spots(sampler.sample()).answers[0]
    expected = estimate(first, "voxel_alpha", scope=scope_of(first, key="voxel_alpha"))
    found = agreement_of(sampler.features()).alpha
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=1e-9)
    assert found.scope == expected.scope


@pytest.mark.parametrize("D", [3, 40])
def test_alpha_is_that_of_all_pairs(D):
    rng = np.random.default_rng(D)
    vectors = rng.normal(size=(64, 1, D)) + 0.8 * rng.normal(size=(64, 5, D)) + 0.5
    features = seen_by(vectors)
    exact = features.rows(slice(0, len(features))).reshape(64, 5, D)
    assert alpha_of_features(features) == pytest.approx(alpha_by_hand(exact), abs=1e-12)
    assert alpha_of_features(features) == pytest.approx(
        alpha_by_hand(vectors / np.linalg.norm(vectors, axis=2, keepdims=True)), abs=2e-3
    )


def test_alpha_is_one_where_views_agree_and_zero_by_chance():
    rng = np.random.default_rng(1)
    same = np.repeat(rng.normal(size=(400, 1, 16)), 6, axis=1)
    assert alpha_of_features(seen_by(same)) == pytest.approx(1, abs=1e-6)
    assert abs(alpha_of_features(seen_by(rng.normal(size=(400, 6, 16))))) < 0.02


def test_agreement_of_pairs_in_a_bin_is_that_of_all_their_vectors():
    rng = np.random.default_rng(2)
    drift = np.cumsum(rng.normal(size=(1, 24, 60)), axis=1) * 0.3
    vectors = rng.normal(size=(400, 1, 60)) + rng.normal(size=(400, 24, 60)) + drift
    features = seen_by(vectors)
    s = features.rows(slice(0, len(features))).reshape(400, 24, 60)
    found = {(stratum.low, stratum.high): stratum.alpha.value for stratum in agreement_of(features).correlogram.time}
    a, b = s[:, :-1].reshape(-1, 60), s[:, 1:].reshape(-1, 60)  # pairs of views next to each other
    both = np.concatenate([a, b])
    n, total = len(both), both.sum(axis=0)
    expected = (total @ total - (both**2).sum()) / (n * (n - 1))
    assert found[1, 2] == pytest.approx(1 - (1 - (a * b).sum(axis=1).mean()) / (1 - expected), abs=1e-12)
    assert found[1, 2] > found[9, 17]


def test_memory_is_bounded_by_dropping_every_second_spot(caplog):
    frames = [dataclasses.replace(frame, features=of_classes(frame.labels, 64)) for frame in flight()]
    whole = sampled(frames)
    small = Sampler(K)
    small._features = FeatureStore(1 << 18)
    with caplog.at_level(logging.INFO, "semstab"):
        for frame in frames:
            small.add(frame)
    assert "features of 64 components: at most 0.25 MB are kept, 2048 answers of spots" in caplog.text
    few, all_of_them = small.features(), whole.features()
    assert len(few.vectors) <= (1 << 18) / (2 * 64) < len(all_of_them.vectors)
    assert few.one_in >= 2
    few_points, all_points = set(map(tuple, few.spots.point)), set(map(tuple, all_of_them.spots.point))
    assert few_points <= all_points
    assert alpha_of_features(few) == pytest.approx(alpha_of_features(all_of_them), abs=0.1)


def test_a_sampler_that_drops_spots_drops_their_features():
    frames = [dataclasses.replace(frame, features=of_classes(frame.labels)) for frame in flight()]
    sampler = sampled(frames, budget=2_000)
    spots, features = sampler.sample(), sampler.features()
    assert len(spots) <= 2_000
    assert len(features.vectors) == len(spots)
    first = sums_of_spots(spots).answers[0]
    assert alpha_of_features(features) == pytest.approx(value(first, "voxel_alpha"), abs=1e-12)


def test_frames_of_a_standing_camera_are_one_view():
    T = rigid(turn(0, 0), (0, 0, -1))
    depth, _ = render(T)
    rng = np.random.default_rng(0)
    frames = [
        semstab.Frame(i, depth, CAMERA, T, features=rng.normal(size=(9, 12, 8)).astype(np.float32)) for i in range(3)
    ]
    moved = rigid(turn(0, 0), (0.2, 0, -1))
    frames.append(semstab.Frame(3, render(moved)[0], CAMERA, moved, features=np.ones((9, 12, 8), np.float32)))
    features = sampled(frames).features()
    assert len(features.spots.views) == 2
    similarity = likeness(features).own
    assert similarity[features.log.frame == 0].max() < 0.99  # the mean of three vectors is shorter
    assert similarity[features.log.frame == 3] == pytest.approx(1)


def test_a_bad_frame_is_named_and_a_bad_place_is_found():
    rng = np.random.default_rng(3)
    vectors = np.repeat(rng.normal(size=(900, 1, 12)), 10, axis=1) + 0.2 * rng.normal(size=(900, 10, 12))
    vectors[:, 4] = rng.normal(size=(900, 12))
    index = grid(30)
    corner = (index[:, 0] < 8) & (index[:, 1] < 8)
    vectors[corner] = rng.normal(size=(corner.sum(), 10, 12))
    found = agreement_of(seen_by(vectors, index))
    assert [outlier.frame for outlier in found.outlying_frames.frames] == [4]
    assert found.places[0].centre[0] < 1 > found.places[0].centre[1]
    assert found.places[0].cosine < 0.2 < found.places[-1].cosine


def test_agreement_falls_with_the_angle_between_views():
    """A feature that turns with the camera."""
    rng = np.random.default_rng(4)
    frames = []
    for i, T in enumerate(walk(24)):
        depth, labels = render(T)
        turned = of_classes(labels, 8)
        turned[..., 6], turned[..., 7] = np.cos(0.15 * i), np.sin(0.15 * i)
        turned = turned + 0.02 * rng.normal(size=turned.shape)
        frames.append(semstab.Frame(i, depth, CAMERA, T, features=turned.astype(np.float32)))
    alphas = [stratum.alpha.value for stratum in agreement_of(sampled(frames).features()).correlogram.time]
    assert len(alphas) >= 4
    assert alphas == sorted(alphas, reverse=True)
    assert alphas[0] - alphas[-1] > 0.2


def test_sums_of_a_half_and_the_other_half_add_up():
    rng = np.random.default_rng(5)
    features = seen_by(rng.normal(size=(400, 6, 12)) + 1)
    sums = feature_sums(features, likeness(features))
    assert value(sums.coarsened(sums.edge * 4, 2), FEATURE_ALPHA) == pytest.approx(value(sums, FEATURE_ALPHA))


# --- Grids and bad input ----------------------------------------------------------------------------------------------


def test_a_coarse_grid_covers_the_image_evenly():
    features = Features.over(np.ones((3, 4, 2)), (72, 96))
    assert features.first == (11.5, 11.5)
    assert features.step == (24.0, 24.0)
    u, v = np.array([0, 23, 24, 95]), np.array([0, 23, 24, 71])
    assert features.cells(u, v).tolist() == [0, 0, 5, 11]
    half = features.every(2)
    assert half.cells(u // 2, v // 2).tolist() == [0, 0, 5, 11]
    number = np.arange(12).reshape(3, 4)
    assert features.image(number, (72, 96), -1)[v, u].tolist() == [0, 0, 5, 11]


def test_a_stated_grid_leaves_out_what_it_does_not_show():
    patches = Features(np.ones((2, 2, 3), np.float16), first=(10, 10), step=(8, 8))
    assert patches.cells(np.array([5, 6, 21, 22]), np.array([10, 10, 10, 10])).tolist() == [-1, 0, 1, -1]
    assert patches.image(np.ones((2, 2)), (30, 30), 0).sum() == 16**2
    assert patches.vectors.dtype == np.float16


def test_vectors_have_unit_length():
    features = Features.over(np.full((2, 2, 4), 3.0), (10, 10))
    assert np.linalg.norm(features.vectors, axis=2) == pytest.approx(np.ones((2, 2)))
    with pytest.raises(ValueError, match="read-only"):
        features.vectors[0, 0, 0] = 1


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda f: f.__setitem__((2, 3, 0), np.nan), "frame 0, features: features: the vector of cell (3, 2) is not"),
        (lambda f: f.__setitem__((2, 3), 0), "the vector of cell (3, 2) has no length"),
    ],
)
def test_a_bad_vector_is_named(change, line):
    depth, _ = render(walk(1)[0])
    features = np.ones((9, 12, 8), np.float32)
    change(features)
    with pytest.raises(DataError) as error:
        semstab.Frame(0, depth, CAMERA, np.eye(4), features=features)
    assert line in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("features", "line"),
    [
        (np.ones((8, 9, 12), np.uint8), "features must be float"),
        (np.ones((9, 12), np.float32), "features must be (h, w, D)"),
        (np.ones((9, 12, 1), np.float32), "at least 2"),
        (np.ones((384, 9, 12), np.float32), "are they (D, h, w)?"),
    ],
)
def test_a_bad_shape_is_named(features, line):
    depth, _ = render(walk(1)[0])
    with pytest.raises(DataError, match="frame 0, features") as error:
        semstab.Frame(0, depth, CAMERA, np.eye(4), features=features)
    assert line in str(error.value)


def test_frames_have_features_of_one_number_of_components():
    one, other = itertools.islice(flight(), 2)
    sampler = sampled([dataclasses.replace(one, features=of_classes(one.labels))])
    with pytest.raises(DataError, match="frame 1, features: features have 9 components, 5 in the frames before"):
        sampler.add(dataclasses.replace(other, features=of_classes(other.labels, 9)))


# --- The program's own frames, folders and predictors -----------------------------------------------------------------


def test_a_metric_takes_features_and_adds_up_over_processes():
    metric, halves = TemporalStability(K), [TemporalStability(K), TemporalStability(K)]
    for i, frame in enumerate(flight(12)):
        features = np.moveaxis(of_classes(frame.labels), -1, 0)
        for part in (metric, halves[i % 2]):
            part.update(frame.labels, frame.depth, CAMERA, frame.T_wc, features=features)
    numbers = metric.compute()
    assert numbers["feature_alpha"] == pytest.approx(alpha_of_features(metric.states()[""].features))
    assert numbers["feature_alpha"] > 0.3
    summary = metric.by_sequence()[""]
    assert summary.feature_alpha_low < summary.feature_alpha < summary.feature_alpha_high
    halves[0].merge_state(halves[1])
    assert halves[0].compute()["feature_alpha"] == pytest.approx(numbers["feature_alpha"], abs=0.08)
    alone = TemporalStability(2)
    for frame in flight(4):
        alone.update(None, frame.depth, CAMERA, frame.T_wc, features=np.moveaxis(of_classes(frame.labels), -1, 0))
    assert 0.3 < alone.compute()["feature_alpha"] < 1


def test_a_metric_names_features_of_another_batch():
    (frame,) = flight(1)
    with pytest.raises(DataError, match=r"features of shape \(2, 8, 9, 12\) for 1 frames"):
        TemporalStability(K).update(frame.labels, frame.depth, CAMERA, frame.T_wc, features=np.ones((2, 8, 9, 12)))


def test_fused_frames_have_alpha_of_features():
    frames = [
        {
            "depth": f.depth, "intrinsics": CAMERA, "T_wc": f.T_wc, "features": of_classes(f.labels)[4::8, 4::8]
        }
        for f in flight(12)
    ]  # fmt: skip
    result = semstab.fuse(frames, voxel_size=0.2)
    statistics = result.record().statistics
    assert statistics.features.alone
    assert result.summary.feature_alpha == statistics.features.alpha.value
    assert np.isnan(
        [result.summary.alpha, result.summary.vss_op3, result.summary.sbd_op3, result.summary.flicker]
    ).all()
    assert statistics.verdict.level == "no verdict"
    assert "features and no labels" in statistics.verdict.line


def written(folder, **features):
    """A posed folder of a room with labels of 'net', and features by model: functions of a frame's labels."""
    room = Room(poses=walk(12))
    write(folder, room)
    for model, make in features.items():
        (folder / "features" / model).mkdir(parents=True)
        for i in range(len(room)):
            made = make(room.frame(i, "net").labels)
            if isinstance(made, dict):
                np.savez(folder / f"features/{model}/{i:03d}.npz", **made)
            else:
                np.save(folder / f"features/{model}/{i:03d}.npy", made)
    return folder


def coarse(labels):
    return of_classes(labels)[4::8, 4::8].astype(np.float16)


def test_a_folder_has_features_with_and_without_labels(tmp_path):
    written(tmp_path / "room", net=coarse, clip=coarse)
    scene = opened(tmp_path / "room")
    assert scene.models == ("net", "clip")
    assert scene.frame(3, "net").features.vectors.dtype == np.float16
    assert scene.frame(3, "clip").features.first == (3.5, 3.5)
    done = bench("room", "--voxel-size", "0.2", "-o", "run", cwd=tmp_path).stdout
    assert "clip: features: alpha" in done
    result = semstab.load_result(tmp_path / "run")
    net, clip = (result.record(model=model).statistics for model in ("net", "clip"))
    assert net.features.alpha == clip.features.alpha
    assert not net.features.alone
    assert clip.features.alone
    assert net.headline.alpha.value > 0.5
    alone = bench("room", "--voxel-size", "0.2", "-o", "alone", "--model", "clip", cwd=tmp_path).stdout
    assert "FEATURES    alpha" in alone
    assert "no VSS, SBD, entropy, flicker, classes and verdict: they need labels" in " ".join(alone.split())


def test_labels_have_the_same_numbers_with_features_and_without(tmp_path):
    written(tmp_path / "room", net=coarse)
    bench("room", "--voxel-size", "0.2", "-o", "with", cwd=tmp_path)
    shutil.rmtree(tmp_path / "room" / "features")
    bench("room", "--voxel-size", "0.2", "-o", "without", cwd=tmp_path)
    one, other = (semstab.load_result(tmp_path / name).record() for name in ("with", "without"))
    assert one.map_summary == other.map_summary
    assert dataclasses.replace(one.statistics, features=None) == other.statistics


def test_a_stated_grid_is_read(tmp_path):
    stated = {"first": np.array([7.5, 3.5]), "step": np.array([8.0, 8.0])}
    written(tmp_path / "room", clip=lambda labels: {"features": coarse(labels), **stated})
    features = opened(tmp_path / "room").frame(0, "clip").features
    assert (features.first, features.step) == ((7.5, 3.5), (8.0, 8.0))


@pytest.mark.parametrize(("key", "hold"), [("first", "they hold 1 and 2"), ("step", "they hold 2 and 1")])
def test_a_grid_of_one_number_is_one_line(tmp_path, key, hold):
    stated = {"first": np.array([7.5, 3.5]), "step": np.array([8.0, 8.0]), key: np.array(8.0)}
    written(tmp_path / "room", clip=lambda labels: {"features": coarse(labels), **stated})
    error = error_of("room", "--voxel-size", "0.2", "-o", "run", "--model", "clip", cwd=tmp_path)
    assert f"'first' and 'step' must hold two numbers, of columns and of rows; {hold}" in error


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (np.full((9, 12, 5), np.nan), "cell (0, 0) is not finite"),
        (np.ones((9, 12)), "features must be float (h, w, D)"),
        (np.ones((9, 12, 7)), "features have 7 components, 5 in the frames before"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path, content, line):
    written(tmp_path / "room", clip=coarse)
    np.save(tmp_path / "room/features/clip/005.npy", content)
    error = error_of("room", "--voxel-size", "0.2", "-o", "run", "--model", "clip", cwd=tmp_path)
    assert line in error
    assert "005.npy" in error


def test_a_frame_without_features_is_missing(tmp_path):
    written(tmp_path / "room", net=coarse)
    (tmp_path / "room/features/net/005.npy").unlink()
    assert "features/net/005" in error_of("room", "--voxel-size", "0.2", "-o", "run", cwd=tmp_path)


NETWORK = """
import numpy as np

class net:
    gives_features = True
    {classes}
    def predict(self, image):
        patches = image[4::8, 4::8].astype(np.float32) + 1
        {answer}
"""


@pytest.mark.parametrize("alone", [True, False])
def test_a_network_of_a_file_gives_features(tmp_path, alone):
    written(tmp_path / "room")
    (tmp_path / "room/color").mkdir()
    for i, T in enumerate(walk(12)):
        _, labels = render(T)
        write_image(tmp_path / f"room/color/{i:03d}.png", np.stack([40 * labels, 200 - 40 * labels, labels], axis=-1))
    answer = "return patches" if alone else "return dict(features=patches, labels=image[..., 0].astype(np.uint8))"
    classes = "" if alone else f"classes = {list(CLASSES)}"
    (tmp_path / "net.py").write_text(NETWORK.format(classes=classes, answer=answer))
    words = "room", "--voxel-size", "0.2", "-o", "run", "--predict", "net.py:net"
    bench(*words, cwd=tmp_path)
    statistics = semstab.load_result(tmp_path / "run").record().statistics
    assert statistics.features.alone == alone
    assert statistics.features.alpha.value > 0.6
    assert np.load(tmp_path / "run/predictions/room/features/net/000.npy").shape == (9, 12, 3)


def test_a_network_that_says_that_it_has_features_gives_them(tmp_path):
    written(tmp_path / "room")
    (tmp_path / "room/color").mkdir()
    for i in range(12):
        write_image(tmp_path / f"room/color/{i:03d}.png", np.zeros((72, 96, 3), np.uint8))
    text = NETWORK.format(classes=f"classes = {list(CLASSES)}", answer="return image[..., 0] * 0")
    (tmp_path / "net.py").write_text(text)
    error = error_of("room", "--voxel-size", "0.2", "-o", "run", "--predict", "net.py:net", cwd=tmp_path)
    assert "gives_features = True let it give a dict with features and labels" in error


def noisy(deviation, components=K):
    """Return features: the true classes with noise, and further components that hold nothing."""
    rng = np.random.default_rng(5)

    def make(labels):
        cells = of_classes(labels, components)[4::8, 4::8]
        return (cells + deviation * rng.normal(size=cells.shape)).astype(np.float32)

    return make


@pytest.fixture(scope="module")
def runs_of_features(tmp_path_factory):
    """Runs of one room: a network at two settings, another network, and the same name with other components."""
    folder = tmp_path_factory.mktemp("features")
    settings = {"base": ("clip", noisy(0.1)), "noise": ("clip", noisy(0.6)), "other": ("dino", noisy(0.6)),
                "wide": ("clip", noisy(0.1, K + 2))}  # fmt: skip
    for run, (model, make) in settings.items():
        shutil.rmtree(folder / "room", ignore_errors=True)
        written(folder / "room", **{model: make})
        bench("room", "--voxel-size", "0.2", "-o", run, "--model", model, cwd=folder)
    return folder


def test_features_of_one_network_at_two_settings_are_compared(runs_of_features):
    base, noise = (
        semstab.load_result(runs_of_features / run).record().statistics.features.alpha for run in ("base", "noise")
    )
    said = " ".join(bench("compare", "base", "noise", cwd=runs_of_features).stdout.split())
    (found,) = semstab.compare_features(runs_of_features / "base", runs_of_features / "noise")
    assert found.difference.value == pytest.approx(noise.value - base.value)
    assert found.difference.low < found.difference.value < found.difference.high < 0
    assert f"features of noise are less stable than of base: alpha of features {found.difference.text('+')}" in said
    assert base.text(digits=3).replace(" to ", ", ") in said
    same = bench("compare", "base", "base", cwd=runs_of_features).stdout
    assert "do not differ significantly in stability" in same
    markdown = bench("compare", "base", "noise", "--markdown", cwd=runs_of_features).stdout
    assert "- features of noise are less stable" in markdown
    assert "| base |" in markdown


@pytest.mark.parametrize(("other", "why"), [
    ("other", "clip and dino are two networks"), ("wide", f"clip has {K} and {K + 2} components"),
])  # fmt: skip
def test_features_of_two_networks_are_not_compared_by_size(runs_of_features, other, why):
    said = " ".join(bench("compare", "base", other, cwd=runs_of_features).stdout.split())
    assert why in said
    assert "networks are not compared by its size" in said
    assert "+0." not in said
    rule = "alpha of features drop < .02"
    line = error_of("gate", other, "--against", "base", "--rule", rule, cwd=runs_of_features)
    assert f"{why}, and features of different networks cannot be compared by size" in line


def test_a_gate_judges_alpha_of_features(runs_of_features):
    alpha = semstab.load_result(runs_of_features / "base").record().statistics.features.alpha
    passed = bench("gate", "base", "--rule", f"alpha of features > {alpha.low - 0.02:.3f}", cwd=runs_of_features)
    assert "the gate passes" in passed.stdout
    assert f"{short(alpha.value, digits=3)} [" in passed.stdout
    failed = bench("gate", "base", "--rule", f"feature_alpha > {alpha.high + 0.02:.3f}", cwd=runs_of_features, code=4)
    assert "the gate fails" in failed.stdout
    rule = "alpha of features drop < .02"
    assert "fails" in bench("gate", "noise", "--against", "base", "--rule", rule, cwd=runs_of_features, code=4).stdout
    result = semstab.gate(runs_of_features / "base", None, semstab.GateConfig(rules=("alpha of features > .1",)))
    interval = result.judgements[0].interval
    assert alpha.low < interval.low < alpha.value < interval.high < alpha.high  # each end at 5 %, not at 2.5 %


def test_the_change_of_one_networks_features_is_paired_on_common_frames():
    """What is hard for both settings is no error of their difference."""
    rng, wrong = np.random.default_rng(1), []
    for frame in flight(24, wrong=0.4):
        wrong.append(of_classes(frame.labels) + 0.3 * rng.normal(size=(*frame.labels.shape, K)))
    frames = [dataclasses.replace(frame, features=cells) for frame, cells in zip(flight(24), wrong, strict=True)]
    other = [
        dataclasses.replace(frame, features=frame.features.vectors.astype(float) + 0.1 * rng.normal(size=cells.shape))
        for frame, cells in zip(frames, wrong, strict=True)
    ]
    one, two = (sums_with_features(sampled(of)) for of in (frames, other))
    paired, apart = (sums_difference("feature_alpha", two, one, apart=apart) for apart in (False, True))
    assert paired.value == pytest.approx(value(two, "feature_alpha") - value(one, "feature_alpha"))
    assert paired.high - paired.low < 0.5 * (apart.high - apart.low)


def test_sums_of_features_are_in_the_file_of_sums(tmp_path):
    frames = [dataclasses.replace(frame, features=of_classes(frame.labels)) for frame in flight(8)]
    sums = sums_with_features(sampled(frames))
    sums.save(tmp_path / "sums.parquet")
    again = ClusterSums.load(tmp_path / "sums.parquet")
    assert_array_equal(again.features.columns, sums.features.columns)
    assert value(again, "feature_alpha") == value(sums, "feature_alpha")
    coarse = again.coarsened(again.edge * 2, 4)
    assert value(coarse, "feature_alpha") == pytest.approx(value(sums, "feature_alpha"))
    assert math.isnan(value(dataclasses.replace(sums, features=None), "feature_alpha"))


def sums_with_features(sampler):
    """Sums of spots with sums of their features, as a run stores them."""
    observed = sampler.features()
    return dataclasses.replace(sums_of_spots(sampler.sample()), features=feature_sums(observed, likeness(observed)))


def test_a_baseline_of_features_is_paired(runs_of_features):
    config = semstab.GateConfig(rules=("alpha of features drop < .5",))
    bench("gate", "base", "--rule", "alpha of features > .1", "--save-baseline", "base.semstab", cwd=runs_of_features)
    of_file, of_folder = (
        semstab.gate(runs_of_features / "noise", runs_of_features / base, config) for base in ("base.semstab", "base")
    )
    assert "clip gives features" in error_of("gate", "base.semstab", "--rule", "alpha > .8", cwd=runs_of_features)
    intervals = [result.judgements[0].interval for result in (of_file, of_folder)]
    assert intervals[0].value == pytest.approx(intervals[1].value)
    assert intervals[0].low == pytest.approx(intervals[1].low, abs=0.02)


def test_features_of_labels_are_named_in_python(tmp_path):
    written(tmp_path / "room", clip=coarse)
    bench("room", "--voxel-size", "0.2", "-o", "run", cwd=tmp_path)
    run = tmp_path / "run"
    with pytest.raises(semstab.ConfigError, match=r"net has labels; semstab\.compare compares them"):
        semstab.compare_features(f"{run}:clip", f"{run}:net")
    with pytest.raises(semstab.ConfigError, match=r"name two runs or more"):
        semstab.compare_features(f"{run}:clip")


def test_what_features_alone_have_not_is_one_line(runs_of_features):
    assert "clip gives features" in error_of("gate", "base", "--rule", "alpha > .8", cwd=runs_of_features)
    assert "leave out --out and --scope" in error_of("compare", "base", "noise", "-o", "out", cwd=runs_of_features)
    assert not (runs_of_features / "out").exists()


def test_features_alone_are_not_compared_with_labels(tmp_path):
    written(tmp_path / "room", clip=coarse)
    bench("room", "--voxel-size", "0.2", "-o", "run", cwd=tmp_path)
    line = error_of("compare", "run:clip", "run:net", cwd=tmp_path)
    assert "clip gives features and no labels, and what is compared is of labels" in line
    assert "has no alpha of features" in error_of("gate", "run:net", "--rule", "feature_alpha > .8", cwd=tmp_path)


def test_tiles_have_the_features_of_the_whole_map(tmp_path):
    written(tmp_path / "room", clip=coarse)
    words = "run", "room", "--voxel-size", "0.1", "--model", "clip", "--rerun", "off"
    bench(*words, "-o", "whole", cwd=tmp_path)
    bench(*words, "-o", "tiles", "--tile-size", "16", cwd=tmp_path)
    whole, tiles = (semstab.load_result(tmp_path / name).record().statistics for name in ("whole", "tiles"))
    assert whole.features == tiles.features


def test_colours_tell_features_apart():
    rng = np.random.default_rng(0)
    cells = np.eye(6)[rng.integers(0, 3, (20, 20))] + 0.01 * rng.normal(size=(20, 20, 6))
    features = Features.over(cells, (40, 40))
    colours = FeatureColours.from_features(features)(features).astype(int)
    assert colours.shape == (20, 20, 3)
    kind = cells.argmax(axis=2)
    means = np.array([colours[kind == k].mean(axis=0) for k in range(3)])
    apart = np.linalg.norm(means[:, None] - means[None], axis=2)[~np.eye(3, dtype=bool)]
    assert apart.min() > 80
    two = Features.over(cells[..., :2] + 0.1, (40, 40))
    assert FeatureColours.from_features(two)(two).shape == (20, 20, 3)
