"""Drift beside random order, exactly and by turns; flips."""

from __future__ import annotations

import itertools
import math

import numba
import numpy as np
import pytest
from simulated_events import grid, log_of, log_of_evidence, soft

from semstab.data.information import js_divergence, normalise
from semstab.metrics import sbd, vss
from semstab.statistics import describe, expected_sbd, flips


def sbd_of(evidence):
    """SBD of one voxel from its definition."""
    belief = normalise(np.cumsum(evidence, axis=0))
    return js_divergence(belief[1:], belief[:-1]).mean()


def drifting(rng, n, T):
    """Labels (n, T) of two classes whose belief moves one way: the second one's share rises from 0.1 to 0.9."""
    return (rng.random((n, T)) < np.linspace(0.1, 0.9, T)).astype(int)


# --- Random order -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("labels", [[0, 1], [0, 0, 1], [0, 1, 2, 2], [0, 0, 0, 1, 1, 2], [0, 1, 1, 1, 1, 1, 1]])
def test_the_null_of_one_hot_observations_is_known_from_their_counts(labels):
    evidence = np.eye(3)[labels]
    orders = set(itertools.permutations(labels))
    expected = np.mean([sbd_of(np.eye(3)[list(order)]) for order in orders])
    table = log_of([labels]).table()
    np.testing.assert_allclose(expected_sbd(table), [expected])
    log = log_of_evidence(evidence[None])
    np.testing.assert_allclose(expected_sbd(log.table(), log), [expected])


@pytest.mark.parametrize("T", [2, 3, 7])
def test_soft_observations_are_compared_with_turns_of_a_random_order(T):
    """The mean over voxels of the same evidence, each with an order of its own, is that of all orders."""
    evidence = soft(np.random.default_rng(T), 1, T)
    drifts = [sbd_of(evidence[0, list(order)]) for order in itertools.permutations(range(T))]
    log = log_of_evidence(np.repeat(evidence, 2000, axis=0))
    null = expected_sbd(log.table(), log)
    assert null.mean() == pytest.approx(np.mean(drifts), abs=4 * null.std() / math.sqrt(2000) + 1e-12)
    if T == 2:
        np.testing.assert_allclose(null, np.mean(drifts))  # both orders, four times each
    else:
        turns = [sbd_of(np.roll(evidence[0, list(order)], -(turn * T // 8), axis=0)) for turn in range(8)
                 for order in itertools.permutations(range(T))]  # fmt: skip
        by_order = np.reshape(turns, (8, -1)).mean(axis=0)
        assert np.abs(null[:50, None] - by_order).min(axis=1).max() < 1e-9


def test_the_null_is_undefined_where_a_frame_disagrees_with_itself_zero_if_all_agree():
    """Beyond 256 observations the table of drifts ends, and turns take over where there is a log."""
    events = log_of_evidence([[[1, 0], [0.5, 0.5]], [[1, 0], [1, 0]], [[1, 0], [0, 1]]])
    np.testing.assert_allclose(expected_sbd(events.table()), [np.nan, 0, 0.311278], atol=1e-6)
    expected = expected_sbd(events.table(), events)
    np.testing.assert_allclose(expected[1:], [0, 0.311278], atol=1e-6)
    assert expected[0] > 0
    once = log_of([[0, -1]])
    assert math.isnan(expected_sbd(once.table(), once)[0])
    many = log_of(np.random.default_rng(2).integers(0, 2, size=(400, 300)))
    assert np.isnan(expected_sbd(many.table())).all()
    excess = sbd(many.table()) - expected_sbd(many.table(), many)
    assert excess.mean() == pytest.approx(0, abs=4 * excess.std() / 20)


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


def test_the_same_seed_gives_the_same_numbers_for_any_number_of_threads():
    """A voxel's order follows from its place: a part of the map has the numbers of the whole."""
    events = log_of_evidence(soft(np.random.default_rng(6), 100, 8))
    table, threads = events.table(), numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = expected_sbd(table, events, seed=7)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(alone, expected_sbd(table, events, seed=7))
    assert not np.array_equal(alone, expected_sbd(table, events, seed=8))
    rows = np.arange(20, 60)
    np.testing.assert_array_equal(alone[rows], expected_sbd(table.rows(rows), events.rows(rows), seed=7))


def test_a_belief_that_moves_one_way_has_less_drift_than_noise_of_the_same_labels():
    rng = np.random.default_rng(4)
    moving = drifting(rng, 900, 40)
    logs = [log_of(labels, K=2, index=grid(30)) for labels in (moving, rng.permuted(moving, axis=1))]
    assert np.array_equal(vss(logs[0].table()), vss(logs[1].table()))
    drift, noise = (describe(log.table(), log).drift for log in logs)
    assert drift.excess.high < 0, "late evidence moves the belief less, so SBD falls below its null"
    assert noise.excess.low < 0 < noise.excess.high


# --- Flips ------------------------------------------------------------------------------------------------------------


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
