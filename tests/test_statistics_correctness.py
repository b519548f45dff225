"""Right beside stable: against scikit-learn, by hand, and where a simulated model is stably wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest
from simulated_events import grid, log_of, log_of_evidence

from semstab.data.information import normalise
from semstab.errors import DataError
from semstab.statistics import consistent_wrong, correctness, describe, join_truth, reliability
from semstab.statistics.agreement import consistency_posterior, shares_of
from semstab.statistics.correctness import Predictions, by_stratum


def random_beliefs(n=400, K=4, seed=0):
    rng = np.random.default_rng(seed)
    return rng.dirichlet(np.full(K, 0.5), size=n), rng.integers(0, K - 1, size=n)


def test_the_truth_of_a_voxel_is_what_most_of_its_ground_truth_says():
    table = log_of([[0], [0], [0], [0]]).table()
    index = np.array([[0, 0, 0], [0, 0, 1], [0, 0, 2], [0, 9, 9]])
    truth = log_of([[1, 1, 0], [2, -1, -1], [0, 1, -1], [2, 2, 2]], index=index).table()
    joined = join_truth(table, truth)
    assert joined.label.tolist() == [1, 2, -1, -1]
    assert joined.known.tolist() == [True, True, False, False]
    with pytest.raises(DataError, match="of 3 classes"):
        join_truth(log_of([[0]]).table(), log_of([[0]], K=4).table())


def test_accuracy_and_miou_are_scikit_learns_and_brier_is_of_normalised_evidence():
    from sklearn.metrics import accuracy_score, jaccard_score

    belief, label = random_beliefs()
    found = correctness(belief, label)
    predicted = belief.argmax(axis=1)
    assert found.accuracy == pytest.approx(accuracy_score(label, predicted))
    assert found.miou == pytest.approx(jaccard_score(label, predicted, average="macro"))
    events = log_of_evidence([[[0.2, 0.8], [0.6, 0.4], [0.7, 0.3]]])
    table = events.table()
    truth = join_truth(table, log_of_evidence([[[0.0, 1.0]]]).table())
    (everything, *_) = by_stratum(
        Predictions.from_evidence(table.evidence, truth.label), table.op, truth.known, (1, 2, 5)
    )
    assert everything.brier == pytest.approx(2 * normalise(table.evidence)[0, 0] ** 2)


def test_miou_brier_score_and_calibration_error_by_hand():
    belief = np.array([[0.9, 0.1, 0.0], [0.8, 0.2, 0.0]])
    assert correctness(belief, np.array([0, 1])).miou == pytest.approx((1 / 2 + 0) / 2)
    belief = np.array([[0.5, 0.5], [1.0, 0.0], [0.0, 1.0]])
    assert correctness(belief, np.array([0, 0, 0])).brier == pytest.approx((0.5 + 0 + 2) / 3)
    # Ten voxels of confidence 0.9, six right; ten of 0.5 and all right: (0.3 + 0.5) / 2
    belief = np.array([[0.9, 0.1]] * 10 + [[0.5, 0.5]] * 10)
    label = np.array([0] * 6 + [1] * 4 + [0] * 10)
    assert correctness(belief, label).ece == pytest.approx(0.4)
    bins = [row for row in reliability(belief, label) if row.voxels]
    assert [(row.voxels, row.confidence, row.accuracy) for row in bins] == [
        (10, 0.5, 1.0),
        (10, pytest.approx(0.9), 0.6),
    ]
    assert all(row.low < row.confidence <= row.high for row in bins)


def test_a_calibrated_model_has_hardly_any_calibration_error():
    rng = np.random.default_rng(1)
    belief = rng.dirichlet(np.ones(3), size=50_000)
    label = (rng.random((50_000, 1)) > np.cumsum(belief, axis=1)[:, :-1]).sum(axis=1)
    found = correctness(belief, label)
    assert found.ece < 0.01
    assert found.brier == pytest.approx((1 - (belief**2).sum(axis=1)).mean(), abs=0.01)
    belief, label = random_beliefs(seed=2)
    belief[:3] = np.eye(4)[:3]
    assert sum(row.voxels for row in reliability(belief, label)) == len(belief)


def test_strata_hold_the_voxels_of_their_op():
    table = log_of([[0, -1, -1], [1, 1, -1], [2, 2, 2], [0, 0, 1]]).table()
    truth = join_truth(table, log_of([[0], [0], [2], [1]]).table())
    rows = {
        row.name: (row.voxels, row.accuracy)
        for row in by_stratum(Predictions.from_evidence(table.evidence, truth.label), table.op, truth.known, (1, 2, 5))
    }
    assert rows["all"] == (4, 0.5)
    assert rows["OP=1"] == (1, 1.0)
    assert rows["OP=2"] == (1, 0.0)
    assert rows["3<=OP<=5"] == (2, 0.5)
    assert rows["OP>5"][0] == 0
    assert math.isnan(rows["OP>5"][1])


def test_quadrants_by_hand():
    """Of five voxels one is seen twice only, and one has no truth; seen so often, places are what they look like."""
    labels = np.full((6, 40), -1)
    labels[:4] = np.arange(40) >= np.array([40, 0, 26, 26])[:, None]
    labels[4, :2], labels[5] = 2, 2
    table = log_of(labels).table()
    true = log_of([[0], [0], [0], [1], [0]]).table()
    truth, found = join_truth(table, true), describe(table, truth=true).correctness.quadrants
    assert found.voxels == 4
    shares = (found.consistent_right, found.consistent_wrong, found.inconsistent_right, found.inconsistent_wrong)
    assert [share.value for share in shares] == pytest.approx([0.25, 0.25, 0.25, 0.25], abs=0.01)
    assert found.wrong_of_consistent_op3.value == pytest.approx(0.5, abs=0.01)
    assert consistent_wrong(table, truth).tolist() == [False, True, False, False, False, False]
    table = log_of([[0] * 90 + [1] * 10, [0] * 80 + [1] * 20]).table()
    truth = join_truth(table, log_of([[1], [1]]).table())
    assert consistent_wrong(table, truth).tolist() == [True, False]
    table = log_of([[0, 0]]).table()
    found = describe(table, truth=table).correctness.quadrants
    assert found.voxels == 0
    assert math.isnan(found.consistent_wrong.value)
    assert math.isnan(correctness(np.zeros((0, 3)), np.zeros(0, dtype=int)).accuracy)


def test_a_part_of_a_map_has_the_bits_of_the_whole() -> None:
    rng = np.random.default_rng(4)
    labels = np.where(np.arange(9) < rng.integers(2, 10, (400, 1)), rng.random((400, 9)) < 0.3, -1)
    table = log_of(labels.astype(int), K=2).table()
    whole, shares = consistency_posterior(table), shares_of(table)
    for part in ([0], [5], [*range(7)], [*range(200, 400)]):
        assert np.array_equal(consistency_posterior(table.rows(np.array(part)), shares), whole[part])


@pytest.mark.parametrize("q", [0.8, 0.95])
def test_the_share_of_stable_places_does_not_depend_on_how_often_they_were_seen(q):
    """One error rate, at OP 3 to 30; with q = 0.8 the PSA alone called .51, .32, .38 and .12 of them stable."""
    rng = np.random.default_rng(7)
    T = np.repeat([3, 5, 10, 30], 400)
    wrong = (rng.random((len(T), 30)) > q).astype(int)
    likely = consistency_posterior(log_of(np.where(np.arange(30) < T[:, None], wrong, -1), K=2).table())
    shares = [likely[t == T].mean() for t in (3, 5, 10, 30)]
    assert max(abs(share - (q > 0.9)) for share in shares) < 0.05


def test_half_of_the_places_are_stable_at_any_op():
    rng = np.random.default_rng(8)
    T = np.repeat([3, 5, 10, 30], 600)
    right = np.where(rng.random(len(T)) < 0.5, 0.98, 0.75)[:, None]
    wrong = (rng.random((len(T), 30)) > right).astype(int)
    likely = consistency_posterior(log_of(np.where(np.arange(30) < T[:, None], wrong, -1), K=2).table())
    assert [likely[t == T].mean() for t in (3, 5, 10, 30)] == pytest.approx([0.5] * 4, abs=0.06)


def test_a_model_that_errs_the_same_way_in_every_view_is_stable_and_wrong():
    """30 % of the places are wrong in all frames, 10 % of the labels at random."""
    rng = np.random.default_rng(3)
    side, F = 40, 8
    true = rng.integers(0, 3, size=(side**2, 1))
    place = rng.random((side**2, 1)) < 0.3
    flicker = rng.random((side**2, F)) < 0.1
    labels = np.where(flicker, rng.integers(0, 3, size=flicker.shape), (true + place) % 3)
    table = log_of(labels, index=grid(side)).table()
    true = log_of(true, index=grid(side)).table()
    truth, found = join_truth(table, true), describe(table, truth=true).correctness.quadrants
    assert found.wrong_of_consistent_op3.low <= place.mean() <= found.wrong_of_consistent_op3.high
    assert consistent_wrong(table, truth)[~place[:, 0]].mean() < 0.01
