"""Comparison of models: standardisation, paired differences, tests and ranks, on simulated maps."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from simulated_events import grid, log_of, spots_of
from statsmodels.stats.multitest import multipletests

from semstab.core.types import THESE_FRAMES, THIS_SCENE
from semstab.data.measures import VSS
from semstab.errors import ConfigError, DataError
from semstab.metrics import vss
from semstab.metrics.agreement import shared_rows
from semstab.statistics import claimed_together, compare_models, coverage, paired, psa, standardised
from semstab.statistics.agreement import PSA
from semstab.statistics.paired_differences import EDGES, common_weights, holm, stratum_counts

SIDE = 24


def noisy(*arguments, **options):
    """The map of `drawn` labels."""
    labels, side, K = drawn(*arguments, **options)
    return log_of(labels, K=K, index=grid(side)).table()


def drawn(rng, F, error, side=SIDE, seen=None, K=3):
    """Labels of a floor seen by F frames, which err with that probability (a number, or one a voxel); side and K."""
    own = rng.integers(0, K, size=(side * side, 1))
    wrong = rng.random((side * side, F)) < np.broadcast_to(error, (side * side,))[:, None]
    labels = np.where(wrong, rng.integers(0, K, size=wrong.shape), own)
    return labels if seen is None else np.where(seen, labels, -1), side, K


def often(rng, F, low):
    """Which of F frames see which voxel: each at least `low` of them, from the first on."""
    return np.arange(F) < rng.integers(low, F + 1, size=(SIDE * SIDE, 1))


def table_of(voxels, op=2):
    return log_of(np.zeros((len(voxels), op), dtype=int), index=np.array(voxels)).table()


def test_shared_rows_are_the_voxels_that_all_maps_hold():
    a = table_of([(-5, 0, 0), (0, 0, 1), (0, 1, 0), (7, 7, 7)])
    b = table_of([(0, 0, 1), (0, 0, 2), (7, 7, 7)])
    c = table_of([(-9, 9, 9), (0, 0, 1), (0, 0, 2), (7, 7, 7)])
    assert [rows.tolist() for rows in shared_rows(a, b, c)] == [[1, 3], [0, 2], [1, 3]]
    assert [rows.tolist() for rows in shared_rows(a, table_of([(1, 1, 1)]))] == [[], []]
    a = table_of([(0, 0, 0)])
    with pytest.raises(DataError, match="fuse both alike"):
        shared_rows(a, dataclasses.replace(a, voxel_size=0.4))
    with pytest.raises(ConfigError, match="must ascend from 2"):
        standardised({"a": a}, PSA, edges=(1, 5))


def test_coverage_by_hand_and_holm_as_in_statsmodels():
    labels = [[0, 0, 0], [0, 0, -1], [0, -1, -1]]
    a = log_of(labels, index=np.array([(0, 0, 0), (0, 0, 1), (0, 0, 2)])).table()
    b = log_of(labels[:2], index=np.array([(0, 0, 1), (5, 0, 0)])).table()
    first, second = coverage({"a": a, "b": b})
    assert (first.voxels, first.observations, first.mean_op, first.repeated, first.recurrent) == (3, 6, 2, 2, 1)
    assert (first.common_share, first.alone) == (pytest.approx(1 / 3), 2)
    assert (second.common_share, second.alone) == (1 / 2, 1)
    p = [0.01, 0.2, 0.03, 0.5, 0.002]
    assert holm(p) == pytest.approx(multipletests(p, method="holm")[1])
    assert holm([math.nan, 0.02]) == [pytest.approx(math.nan, nan_ok=True), 0.02]


def test_standardised_values_of_one_model_seen_more_or_less_often_are_the_same():
    """VSS falls with OP; at a common distribution of OP the difference is gone."""
    rng = np.random.default_rng(0)
    tables = {
        "rarely": noisy(rng, 8, 0.7, seen=np.arange(8) < rng.choice([2, 8], p=[0.8, 0.2], size=(SIDE**2, 1))),
        "often": noisy(rng, 8, 0.7, seen=np.arange(8) < rng.choice([2, 8], p=[0.2, 0.8], size=(SIDE**2, 1))),
    }
    raw = {name: vss(table).mean() for name, table in tables.items()}
    at_common = standardised(tables, VSS)
    assert raw["rarely"] - raw["often"] > 0.05
    difference = at_common["rarely"].value - at_common["often"].value
    spread = (at_common["rarely"].high - at_common["rarely"].low) / 2
    assert abs(difference) < 1.5 * spread < 0.04


def test_standardised_value_by_hand():
    """Strata OP = 2 and OP = 4 with weights 2/3 and 1/3; PSA there is 1/2 and 1 in a, 1 and 1/2 in b."""
    index = np.stack([np.zeros(3), np.zeros(3), np.arange(3)], axis=1)
    a = log_of([[0, 0, -1, -1], [0, 1, -1, -1], [0, 0, 0, 0]], index=index).table()
    b = log_of([[0, 0, -1, -1], [1, 1, -1, -1], [0, 0, 0, 1]], index=index).table()
    np.testing.assert_allclose(common_weights(stratum_counts({"a": a, "b": b}))[[0, 2]], [2 / 3, 1 / 3])
    values = standardised({"a": a, "b": b}, PSA)
    assert values["a"].value == pytest.approx(2 / 3 * 1 / 2 + 1 / 3)
    assert values["b"].value == pytest.approx(2 / 3 + 1 / 3 * 1 / 2)
    a = log_of([[0, 0, -1, -1], [0, 0, 0, 1]], index=index[:2]).table()
    b = log_of([[0, 1, -1, -1], [0, 1, -1, -1]], index=index[:2]).table()  # lacks a stratum, which counts for none
    assert common_weights(stratum_counts({"a": a, "b": b})).tolist() == [1.0] + [0.0] * len(EDGES)
    assert standardised({"a": a, "b": b}, PSA)["a"].value == 1
    never = log_of([[0, -1]], index=index[:1]).table()
    assert math.isnan(standardised({"a": a, "b": never}, PSA)["a"].value)


def two_models(rng, gap, side=32, F=8):
    """Two models that err block by block of 4 x 4 voxels, the second more by `gap`: their maps, and their spots."""
    blocks = rng.beta(2, 6, size=(side // 4, side // 4))
    error = np.kron(blocks, np.ones((4, 4))).ravel()
    shift = np.kron(rng.normal(0, 0.05, size=blocks.shape), np.ones((4, 4))).ravel()
    labels = {
        "a": drawn(rng, F, np.clip(error, 0, 1), side)[0],
        "b": drawn(rng, F, np.clip(error + gap + shift, 0, 1), side)[0],
    }
    tables = {name: log_of(own, index=grid(side)).table() for name, own in labels.items()}
    return tables, {name: spots_of(own, index=grid(side)) for name, own in labels.items()}


def pair_of(rng, gap, **options):
    """What is compared of two models."""
    tables, spots = two_models(rng, gap, **options)
    return compare_models(tables, observations=spots).paired


def test_paired_differences_cover_and_their_test_keeps_its_level():
    """Two models of the same quality, 15 times: the interval holds 0, and the test says so, 14 times."""
    rng = np.random.default_rng(1)
    held, rejected = 0, 0
    for _ in range(15):
        result = pair_of(rng, 0.0, side=24)
        by_measure = {row.measure: row for row in result.differences}
        held += by_measure["psa"].difference.low <= 0 <= by_measure["psa"].difference.high
        rejected += by_measure["alpha"].p_value <= 0.05
    assert held >= 12
    assert rejected <= 3


def test_a_worse_model_is_found_by_difference_test_and_rank():
    result = pair_of(np.random.default_rng(2), 0.15)
    by_measure = {row.measure: row for row in result.differences}
    assert by_measure["psa"].difference.low > 0
    assert by_measure["alpha"].difference.low > 0
    assert by_measure["voxel_alpha"].difference.low > 0
    assert by_measure["entropy"].difference.high < 0
    assert by_measure[result.primary].p_value < 0.001
    assert math.isnan(by_measure["psa"].p_value)  # it describes
    for ranking in result.rankings:
        assert [rank.model for rank in ranking.ranks] == ["a", "b"]
        assert ranking.ranks[0].best > 0.95
    rng = np.random.default_rng(3)
    twins, worst = two_models(rng, 0.0), two_models(rng, 0.4)
    tables, spots = (own | {"worst": other["b"]} for own, other in zip(twins, worst, strict=True))
    rankings = {own.measure: own for own in compare_models(tables, observations=spots).paired.rankings}
    for measure in ("alpha", "psa"):
        ranks = {rank.model: rank for rank in rankings[measure].ranks}
        assert ranks["worst"].rank == ranks["worst"].low == 3
        assert ranks["a"].best + ranks["b"].best == pytest.approx(1, abs=0.01)
        assert {ranks["a"].low, ranks["b"].low} == {1}
        assert {ranks["a"].high, ranks["b"].high} == {2}


def test_models_are_compared_by_accuracy_where_there_is_a_truth():
    rng = np.random.default_rng(5)
    true = rng.integers(0, 3, size=(SIDE**2, 1))
    wrong = rng.random((SIDE**2, 1)) < 0.2
    a, b = (log_of(np.repeat(labels, 3, axis=1), index=grid(SIDE)).table() for labels in (true, (true + wrong) % 3))
    result = paired({"a": a, "b": b}, a)
    (accuracy,) = (row for row in result.differences if row.measure == "accuracy")
    assert accuracy.difference.value == pytest.approx(wrong.mean())
    assert accuracy.difference.low <= 0.2 <= accuracy.difference.high
    (agreement,) = (row for row in result.differences if row.measure == "psa")
    assert agreement.difference.value == 0


def test_only_voxels_that_all_saw_twice_are_compared():
    index = np.stack([np.zeros(4), np.zeros(4), np.arange(4)], axis=1)
    a = log_of([[0, 0], [0, 1], [0, -1], [0, 0]], index=index).table()
    b = log_of([[0, 1], [0, 1], [0, 0]], index=index[[0, 1, 2]]).table()
    result = paired({"a": a, "b": b})
    assert result.voxels == 2
    assert result.values["psa"]["a"].value == pytest.approx(psa(a)[:2].mean())
    assert result.values["psa"]["b"].value == 0
    tables = {"a": table_of([(0, 0, 0)]), "b": table_of([(9, 9, 9)])}
    result = paired(tables)
    assert result.voxels == result.cubes == 0
    assert math.isnan(result.values["psa"]["a"].value)
    assert all(math.isnan(row.p_value) for row in result.differences)
    assert all(math.isnan(rank.best) for ranking in result.rankings for rank in ranking.ranks)


def test_pairs_of_all_scenes_are_corrected_together_where_something_may_be_claimed():
    tables, spots = two_models(np.random.default_rng(4), 0.05, side=16)
    found = compare_models(tables, observations=spots)
    (p,) = (row.p_value for row in found.paired.differences if row.measure == found.paired.primary)
    unclaimed = tuple(dataclasses.replace(row, undecided="too few") for row in found.paired.differences)
    silent = dataclasses.replace(found, paired=dataclasses.replace(found.paired, differences=unclaimed))
    together = claimed_together([found, silent, found])
    assert 0 < p < 1
    corrected = [
        row.p_holm for scene in together for row in scene.paired.differences if row.measure == found.paired.primary
    ]
    assert corrected == [
        pytest.approx(min(1, 2 * p)), pytest.approx(math.nan, nan_ok=True), pytest.approx(min(1, 2 * p)),
    ]  # fmt: skip


def test_what_describes_says_what_its_interval_answers():
    """With logs of enough frames the next flight, where the sums tell; SBD for this map."""
    rng = np.random.default_rng(6)
    logs = {name: log_of(rng.integers(0, 2, size=(256, 30)), K=2, index=grid(16)) for name in "ab"}
    result = paired({name: log.table() for name, log in logs.items()}, logs=logs)
    answers = {row.measure: row.scope for row in result.differences}
    assert answers["psa"] == answers["voxel_alpha"] == THIS_SCENE
    assert answers["sbd"] == answers["vss"] == answers["entropy"] == THESE_FRAMES
    assert all(row.difference.low < 0 < row.difference.high for row in result.differences)
