"""Drift against its null: the null against all orders, tests that keep their level, and drift that is found."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace

import numba
import numpy as np
import pytest
from flights import Flight, fly, world
from flights import log_of as log_of_flight
from scipy.stats import false_discovery_control
from simulated_events import log_of, log_of_evidence, soft

from semstab.core.json_form import to_json
from semstab.errors import ConfigError
from semstab.metrics import sbd, vss
from semstab.model.events import Events
from semstab.model.information import js_divergence, normalise
from semstab.statistics import benjamini_hochberg, expected_sbd, flips, voxel_drift
from semstab.statistics.drift import in_stretches, order_test, persistence, trend_columns


def sbd_of(evidence):
    """SBD of one voxel from its definition."""
    belief = normalise(np.cumsum(evidence, axis=0))
    return js_divergence(belief[1:], belief[:-1]).mean()


def r_squared(evidence):
    """R^2 of evidence (T, K) on the number of the observation, by least squares."""
    design = np.stack([np.ones(len(evidence)), np.arange(len(evidence))], axis=1)
    fitted = design @ np.linalg.lstsq(design, evidence, rcond=None)[0]
    return ((fitted - evidence.mean(axis=0)) ** 2).sum() / ((evidence - evidence.mean(axis=0)) ** 2).sum()


def over_all_orders(evidence):
    """Null, two-sided p-value of SBD, and p-value of the trend, over all T! orders."""
    orders = [evidence[list(order)] for order in itertools.permutations(range(len(evidence)))]
    drifts, trends = np.array([sbd_of(o) for o in orders]), np.array([r_squared(o) for o in orders])
    low, high = np.mean(drifts <= drifts[0] + 1e-9), np.mean(drifts >= drifts[0] - 1e-9)
    return drifts.mean(), min(1, 2 * min(low, high)), np.mean(trends >= trends[0] - 1e-9)


def drifting(rng, n, T):
    """Labels (n, T) of two classes whose belief moves one way: the second one's share rises from 0.1 to 0.9."""
    return (rng.random((n, T)) < np.linspace(0.1, 0.9, T)).astype(int)


def shuffled(rng, labels):
    return rng.permuted(labels, axis=1)


def small(events, **settings):
    return voxel_drift(events.table(), events, **settings)


@pytest.mark.parametrize("T", [2, 3, 4, 5])
def test_few_observations_are_compared_with_all_orders_exactly(T):
    rng = np.random.default_rng(T)
    evidence = np.concatenate([soft(rng, 6, T), np.eye(3)[[[0] + [1] * (T - 1), [0, 1] * (T // 2) + [2] * (T % 2)]]])
    drift = small(log_of_evidence(evidence))
    null, p_value, trend_p = np.transpose([over_all_orders(e) for e in evidence])
    np.testing.assert_allclose(drift.null, null)
    np.testing.assert_allclose(drift.excess, [sbd_of(e) for e in evidence] - null, atol=1e-12)
    np.testing.assert_allclose(drift.p_value, p_value)
    if T > 2:
        np.testing.assert_allclose(drift.trend, [r_squared(e) for e in evidence])
        np.testing.assert_allclose(drift.trend_p, trend_p)
    else:
        assert np.isnan([drift.trend, drift.trend_p]).all()


def test_many_observations_are_compared_with_random_orders():
    """All 5040 orders of 7 observations against 1999 random ones: within 4 standard errors."""
    evidence = soft(np.random.default_rng(0), 3, 7)
    events = log_of_evidence(evidence)
    drift = small(events, draws=1999, most=1999, enough=1999)
    for i, e in enumerate(evidence):
        null, p_value, trend_p = over_all_orders(e)
        assert drift.null[i] == pytest.approx(null, rel=0.05)
        assert drift.p_value[i] == pytest.approx(p_value, abs=2 * 4 * math.sqrt(0.25 / 1999))
        assert drift.trend_p[i] == pytest.approx(trend_p, abs=4 * math.sqrt(0.25 / 1999))


@pytest.mark.parametrize("labels", [[0, 1], [0, 0, 1], [0, 1, 2, 2], [0, 0, 0, 1, 1, 2], [0, 1, 1, 1, 1, 1, 1]])
def test_the_null_of_one_hot_observations_is_known_from_their_counts(labels):
    evidence = np.eye(3)[labels]
    orders = set(itertools.permutations(labels))
    expected = np.mean([sbd_of(np.eye(3)[list(order)]) for order in orders])
    table = log_of([labels]).table()
    np.testing.assert_allclose(expected_sbd(table), [expected])
    np.testing.assert_allclose(small(log_of_evidence(evidence[None])).null, [expected])


def test_the_null_is_undefined_where_a_frame_disagrees_with_itself_and_zero_where_all_agree():
    """Beyond 256 observations the table of drifts ends, and drawn orders take over."""
    events = log_of_evidence([[[1, 0], [0.5, 0.5]], [[1, 0], [1, 0]], [[1, 0], [0, 1]]])
    np.testing.assert_allclose(expected_sbd(events.table()), [np.nan, 0, 0.311278], atol=1e-6)
    drift = small(events)
    assert drift.null[1] == drift.excess[1] == 0
    assert math.isnan(drift.p_value[1])
    assert math.isnan(small(log_of([[0, -1]])).null[0])
    many = log_of(np.random.default_rng(2).integers(0, 2, size=(3, 300)))
    assert np.isnan(expected_sbd(many.table())).all()
    drift = small(many, draws=100)
    assert (np.abs(drift.excess) < 0.5 * drift.null).all()


def test_in_every_stratum_the_mean_sbd_of_noise_is_what_random_order_gives():
    """The fall of SBD with OP is arithmetic: the very same noise, seen more often."""
    rng = np.random.default_rng(3)
    means = []
    for T in (2, 4, 8, 16):
        table = log_of(rng.choice(3, size=(4000, T), p=[0.7, 0.2, 0.1])).table()
        excess = sbd(table) - expected_sbd(table)
        assert excess.mean() == pytest.approx(0, abs=4 * excess.std() / math.sqrt(len(table)) + 1e-12)
        means.append(sbd(table).mean())
    assert all(fewer > 1.5 * more for fewer, more in itertools.pairwise(means))


@pytest.mark.parametrize("T", [5, 9])
def test_p_values_keep_their_level_under_noise(T):
    rng = np.random.default_rng(T)
    events = log_of(rng.choice(3, size=(2500, T), p=[0.5, 0.3, 0.2]))
    drift = small(events, most=499)
    for p in (drift.p_value, drift.trend_p):
        tested = p[~np.isnan(p)]
        for level in (0.01, 0.05, 0.2):
            assert np.mean(tested <= level) <= level + 3 * math.sqrt(level * (1 - level) / len(tested))


def test_a_belief_that_moves_one_way_is_found_where_vss_cannot_tell_it_from_noise():
    rng = np.random.default_rng(4)
    moving = drifting(rng, 300, 40)
    noise = shuffled(rng, moving)
    events = log_of(np.concatenate([moving, noise]), K=2)
    table = events.table()
    assert np.array_equal(vss(table)[:300], vss(table)[300:])
    drift = small(events)
    found = benjamini_hochberg(drift.trend_p) <= 0.05
    assert found[:300].mean() > 0.75
    assert found[300:].sum() <= 0.05 * found.sum() + 3 * math.sqrt(0.05 * found.sum())
    assert drift.excess[:300].mean() < 0, "late evidence moves the belief less, so SBD falls below its null"
    assert (drift.p_value[:300] <= 0.05).mean() > 3 * (drift.p_value[300:] <= 0.05).mean()


def test_trend_is_one_over_steps_in_random_order_and_one_for_a_straight_move():
    rng = np.random.default_rng(5)
    noise = small(log_of(rng.integers(0, 2, size=(4000, 6))), most=100)
    excess = (noise.trend - noise.trend_null)[~np.isnan(noise.trend)]
    assert excess.mean() == pytest.approx(0, abs=4 * excess.std() / math.sqrt(len(excess)))
    share = np.linspace(0, 1, 8)
    straight = small(log_of_evidence(np.stack([1 - share, share], axis=1)[None]))
    assert straight.trend[0] == pytest.approx(1)
    assert straight.trend_p[0] <= 0.005


def test_the_same_seed_gives_the_same_numbers_for_any_number_of_threads():
    events = log_of_evidence(soft(np.random.default_rng(6), 100, 8))
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = small(events, seed=7)
    finally:
        numba.set_num_threads(threads)
    together, other = small(events, seed=7), small(events, seed=8)
    np.testing.assert_array_equal(alone.p_value, together.p_value)
    np.testing.assert_array_equal(alone.null, together.null)
    assert not np.array_equal(together.null, other.null)
    a, b = (order_test(events.table(), events, seed=1, frame_orders=50) for _ in range(2))
    assert to_json(a) == to_json(b)


def test_an_empty_log_one_without_disagreement_and_settings_that_make_no_sense():
    for labels in (np.zeros((0, 3), dtype=int), [[1, 1, 1]]):
        events = log_of(labels)
        assert math.isnan(order_test(events.table(), events).p_value)
        assert not len(trend_columns(events.table(), small(events))[0])
        assert len(flips(events).rate) == len(labels)
    with pytest.raises(ConfigError, match="draws = 0, most = 5"):
        small(log_of([[0, 1]]), draws=0, most=5)


def scene(labels, K=2, frame_orders=99):
    return drift_of(log_of(labels, K=K), frame_orders)


def drift_of(events, frame_orders=99):
    """The tests of a scene, with the share of the disagreement that goes one way in time, and in random order."""
    table = events.table()
    one_way, by_chance, total = trend_columns(table, small(events, draws=1, most=1))[1].sum(axis=0)
    test = order_test(table, events, frame_orders=frame_orders)
    return SimpleNamespace(**vars(test), trend=one_way / total, trend_null=by_chance / total)


def test_the_scene_test_keeps_its_level_when_voxels_err_together():
    """40 voxels with one and the same labels are one voxel, not 40."""
    rng = np.random.default_rng(10)
    p_values = [scene(np.repeat(rng.integers(0, 2, size=(1, 40)), 40, axis=0)) for _ in range(30)]
    slack = 3 * math.sqrt(0.05 * 0.95 / 30)
    assert np.mean([s.p_value <= 0.05 for s in p_values]) <= 0.05 + slack
    assert np.mean([s.trend_p <= 0.05 for s in p_values]) <= 0.05 + slack


def test_the_scene_test_finds_a_common_drift():
    """Where it is small; a belief that moves all the time cannot be told from errors that last."""
    rng = np.random.default_rng(11)
    labels = (rng.random((600, 40)) < np.linspace(0.35, 0.65, 40)).astype(int)
    seen = rng.random(labels.shape) < 0.6
    seen[:, 0] = True
    moving = scene(np.where(seen, labels, -1))
    noise = scene(np.where(seen, shuffled(rng, labels), -1))
    assert moving.trend_p == 0.01
    assert moving.trend > moving.trend_null + 0.02
    assert noise.trend_p > 0.05
    moving = scene(drifting(rng, 200, 40))
    assert moving.trend > moving.trend_null + 0.1
    assert np.isnan([moving.trend_p, scene(drifting(rng, 200, 12)).trend_p]).all()


def flown(quality, frames, looks, seed):
    rng, flight = np.random.default_rng(seed), Flight(24, 2.0, 1.0, frames, looks, quality)
    over = world(flight, rng)
    return log_of_flight(fly(flight, over, rng), over, flight)


@pytest.mark.parametrize(("quality", "lasts"), [("alike", False), ("objects", True), ("direction", True)])
def test_errors_that_last_or_depend_on_the_view_are_noticed(quality, lasts):
    """Objects err for 3 frames on average, locations from a direction of their own; see simulations/drift.py."""
    logs = [flown(quality, 60, 60, seed) for seed in range(4)]
    found = [persistence(log.table(), log) for log in logs]
    assert (min(found) > 4) == lasts
    assert (max(found) > 4) == lasts
    tests = [order_test(log.table(), log, frame_orders=99) for log in logs]
    assert not any(test.trend_p <= 0.02 for test in tests)
    assert all(math.isnan(test.trend_p) for test in tests) == lasts


def test_stretches_are_the_means_of_their_observations():
    rng = np.random.default_rng(3)
    evidence, seen = rng.dirichlet(np.ones(3), (5, 8)), rng.random((5, 8)) < 0.7
    seen[:, 0] = True
    found = in_stretches(log_of_evidence(evidence, seen), 3)
    expected = [
        (i, b, evidence[i, own].mean(axis=0))
        for i in range(5)
        for b in range(3)
        if (own := [f for f in range(3 * b, min(3 * b + 3, 8)) if seen[i, f]])
    ]
    assert found.voxel.tolist() == [i for i, _, _ in expected]
    assert found.frame.tolist() == [b for _, b, _ in expected]
    np.testing.assert_allclose(found.evidence, [mean for _, _, mean in expected])


def test_frames_need_not_be_numbered_from_zero_nor_come_in_order():
    """The observed order is the order of integration; the null does not depend on the frames' numbers."""
    plain = log_of(np.random.default_rng(0).integers(0, 2, size=(400, 36)))
    other = Events(
        plain.ix, plain.iy, plain.iz, plain.voxel, 1000 - plain.frame, plain.evidence, plain.pixels, plain.voxel_size
    )
    a, b = (drift_of(e, 199) for e in (plain, other))
    assert a.trend == b.trend
    assert a.trend_p == pytest.approx(b.trend_p, abs=0.15)


def test_flips_by_hand_and_of_noise():
    events = log_of([[0, 0, 1, 1, -1, 1], [0, 1, 0, -1, -1, -1], [2, -1, -1, -1, -1, -1], [1, 1, -1, -1, -1, -1]])
    changes = flips(events)
    np.testing.assert_allclose(changes.rate, [1 / 4, 1, np.nan, 0])
    np.testing.assert_allclose(changes.null, [3 * 2 / 10, 2 / 3, np.nan, 0])
    np.testing.assert_allclose(changes.since, [3, 0, np.nan, np.nan])
    soft_ones = log_of_evidence([[[0.6, 0.4], [0.9, 0.1], [0.5, 0.5], [0.4, 0.6]]])  # of the largest evidence
    assert flips(soft_ones).rate[0] == pytest.approx(1 / 3)
    rng = np.random.default_rng(13)
    noise = flips(log_of(rng.integers(0, 3, size=(5000, 6))))
    excess = noise.rate - noise.null
    assert excess.mean() == pytest.approx(0, abs=4 * excess.std() / math.sqrt(5000))
    lasting = flips(log_of(np.sort(rng.integers(0, 3, size=(500, 6)), axis=1)))
    assert (lasting.rate - lasting.null).mean() < -0.2


def test_benjamini_hochberg_is_that_of_scipy_and_leaves_out_what_was_not_tested():
    p = np.random.default_rng(14).random(50) ** 3
    np.testing.assert_allclose(benjamini_hochberg(p), false_discovery_control(p))
    with_gaps = np.insert(p, [0, 10, 50], np.nan)
    np.testing.assert_allclose(benjamini_hochberg(with_gaps)[~np.isnan(with_gaps)], false_discovery_control(p))
    assert np.isnan(benjamini_hochberg(with_gaps)).sum() == 3
    assert len(benjamini_hochberg(np.zeros(0))) == 0
