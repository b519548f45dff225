"""Agreement against its definition, closed forms and other libraries, and that it does not depend on OP."""

from __future__ import annotations

import itertools
import math

import krippendorff
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated_events import log_of, log_of_evidence, soft
from statsmodels.stats.inter_rater import fleiss_kappa as statsmodels_kappa

from semstab.metrics import vss
from semstab.statistics import alpha, class_agreement, decompose, fleiss_kappa, krippendorff_alpha, psa
from semstab.testing import checks

LABELS = st.lists(st.lists(st.integers(-1, 2), min_size=4, max_size=4), min_size=1, max_size=8).filter(
    lambda rows: all(max(row) >= 0 for row in rows)
)


@given(LABELS)
def test_alpha_of_arrays_is_that_of_the_package_krippendorff(rows):
    """Rows are units and columns are views; -1 is no label."""
    ratings = np.array(rows)
    unit = np.repeat(np.arange(len(ratings)), ratings.shape[1])
    counts = np.stack([(ratings == k).sum(axis=1) for k in range(3)], axis=1)
    again = counts[counts.sum(axis=1) >= 2]
    if np.count_nonzero(again.sum(axis=0)) < 2:
        assert math.isnan(alpha(unit, ratings.ravel()))
        return
    expected = krippendorff.alpha(value_counts=again, level_of_measurement="nominal")
    assert alpha(unit, ratings.ravel()) == pytest.approx(expected)
    assert alpha(unit[::-1] + 7, 10 * ratings.ravel()[::-1]) == pytest.approx(expected)


def test_alpha_of_arrays_needs_integers_of_one_shape():
    for unit, label in (([0, 0], [1]), ([0, 0], [1.0, 1.0]), ([[0, 0]], [[1, 1]])):
        with pytest.raises(ValueError, match="integers of one shape"):
            alpha(unit, label)


def by_pairs(evidence):
    """PSA of one voxel from its definition: the mean over ordered pairs of different frames."""
    return np.mean([s @ u for s, u in itertools.permutations(evidence, 2)])


def test_psa_by_hand_and_of_labels_drawn_from_soft_evidence():
    table = log_of([[0, 0, 1, -1], [0, 1, -1, -1], [2, 2, 2, 2], [1, -1, -1, -1]]).table()
    np.testing.assert_allclose(psa(table), [1 / 3, 0, 1, np.nan])
    rng = np.random.default_rng(0)
    evidence = soft(rng, 1, 4)
    draws = (rng.random((40_000, 4, 1)) > np.cumsum(evidence, axis=2)[..., :-1]).sum(axis=2)
    sampled = psa(log_of(draws).table())
    (expected,) = psa(log_of_evidence(evidence).table())
    assert sampled.mean() == pytest.approx(expected, abs=4 * sampled.std() / math.sqrt(len(sampled)))


@pytest.mark.parametrize("T", [2, 3, 7])
def test_psa_is_the_mean_over_pairs_of_frames(T):
    evidence = soft(np.random.default_rng(T), 20, T)
    np.testing.assert_allclose(psa(log_of_evidence(evidence).table()), [by_pairs(e) for e in evidence])


def test_psa_of_frames_without_a_common_class_is_zero_and_not_below():
    evidence = np.zeros((500, 2, 8))
    evidence[:, 0, :4], evidence[:, 1, 4:] = np.random.default_rng(0).dirichlet(np.ones(4), (2, 500))
    found = psa(log_of_evidence(evidence).table())
    assert found.min() == 0
    assert found.max() < 1e-6


def test_psa_has_the_same_expectation_for_every_number_of_frames_and_vss_has_not():
    rng = np.random.default_rng(1)
    pi = np.array([0.6, 0.3, 0.1])
    mean_vss = []
    for T in (2, 3, 5, 10, 40):
        table = log_of(rng.choice(3, size=(20_000, T), p=pi)).table()
        agreement = psa(table)
        assert agreement.mean() == pytest.approx((pi**2).sum(), abs=4 * agreement.std() / math.sqrt(len(table)))
        mean_vss.append(vss(table).mean())
    assert all(fewer > more + 0.01 for fewer, more in itertools.pairwise(mean_vss))


@pytest.mark.parametrize("T", [2, 3, 9])
def test_kappa_is_that_of_statsmodels(T):
    labels = np.random.default_rng(T).choice(4, size=(60, T), p=[0.5, 0.3, 0.15, 0.05])
    table = log_of(labels, K=4).table()
    assert fleiss_kappa(table) == pytest.approx(statsmodels_kappa(table.evidence))


def test_kappa_and_alpha_of_a_class_are_those_of_the_class_against_the_rest():
    labels = np.random.default_rng(3).choice(3, size=(80, 5), p=[0.6, 0.3, 0.1])
    events = log_of(labels)
    rows = class_agreement(events.table(), events)
    counts = events.table().evidence
    for k, row in enumerate(rows):
        assert row.kappa_op2 == pytest.approx(statsmodels_kappa(np.stack([counts[:, k], 5 - counts[:, k]], axis=1)))
        assert row.observations == counts[:, k].sum()
    labels = np.random.default_rng(4).integers(-1, 3, size=(80, 5))
    labels = labels[(labels >= 0).any(axis=1)]
    events = log_of(labels)
    for k, row in enumerate(class_agreement(events.table(), events)):
        data = np.where(labels >= 0, labels == k, np.nan).T
        assert row.voxel_alpha_op2 == pytest.approx(krippendorff.alpha(data, level_of_measurement="nominal"))


@checks
@given(LABELS)
def test_alpha_is_that_of_krippendorff_with_observations_missing(labels):
    labels = np.array(labels)
    table = log_of(labels).table()
    paired = labels[(labels >= 0).sum(axis=1) >= 2]
    if len(np.unique(paired[paired >= 0])) < 2:
        assert math.isnan(krippendorff_alpha(table))
    else:
        data = np.where(labels >= 0, labels, np.nan).T
        assert krippendorff_alpha(table) == pytest.approx(krippendorff.alpha(data, level_of_measurement="nominal"))


def test_kappa_and_alpha_of_soft_evidence_are_their_definitions():
    evidence = soft(np.random.default_rng(5), 15, 4)
    events = log_of_evidence(evidence)
    table = events.table()
    observed = np.mean([by_pairs(e) for e in evidence])
    p = evidence.mean(axis=(0, 1))
    assert fleiss_kappa(table) == pytest.approx(1 - (1 - observed) / (1 - p @ p))
    assert krippendorff_alpha(table) == pytest.approx(1 - (1 - observed) / (1 - by_pairs(evidence.reshape(-1, 3))))
    for k, row in enumerate(class_agreement(table, events)):
        both = np.stack([evidence[..., k], 1 - evidence[..., k]], axis=-1)
        agree = np.mean([by_pairs(e) for e in both])
        q = both.mean(axis=(0, 1))
        assert row.kappa_op2 == pytest.approx(1 - (1 - agree) / (1 - q @ q))
        assert row.voxel_alpha_op2 == pytest.approx(1 - (1 - agree) / (1 - by_pairs(both.reshape(-1, 2))))


def test_alpha_is_zero_for_chance_one_for_agreement_without_voxels_seen_once():
    rng = np.random.default_rng(6)
    chance = log_of(rng.choice(3, size=(20_000, 4), p=[0.7, 0.2, 0.1])).table()
    assert krippendorff_alpha(chance) == pytest.approx(0, abs=0.02)
    assert fleiss_kappa(chance) == pytest.approx(0, abs=0.02)
    unanimous = log_of(np.repeat(rng.integers(0, 3, size=(50, 1)), 4, axis=1)).table()
    assert krippendorff_alpha(unanimous) == pytest.approx(1)
    assert fleiss_kappa(unanimous) == pytest.approx(1)
    labels = np.array([[0, 0, 1], [1, 1, 1], [2, 0, -1]])
    once = np.array([[2, -1, -1], [-1, 0, -1]])
    events, more = log_of(labels), log_of(np.concatenate([labels, once]))
    assert krippendorff_alpha(more.table()) == krippendorff_alpha(events.table())
    assert fleiss_kappa(more.table()) == fleiss_kappa(events.table())
    assert class_agreement(more.table(), more) == class_agreement(events.table(), events)
    events = log_of(np.random.default_rng(8).integers(0, 3, size=(30, 4)))
    assert class_agreement(events.table()) == class_agreement(events.table(), events)
    mixed = log_of_evidence(soft(np.random.default_rng(9), 5, 3))
    assert all(math.isnan(row.voxel_alpha_op2) for row in class_agreement(mixed.table()))
    assert not any(math.isnan(row.voxel_alpha_op2) for row in class_agreement(mixed.table(), mixed))


@pytest.mark.parametrize("labels", [[[0, -1]], [[1, 1], [1, 1]]])
def test_agreement_beyond_chance_is_undefined_where_there_is_no_pair_or_one_class(labels):
    table = log_of(labels).table()
    assert math.isnan(fleiss_kappa(table))
    assert math.isnan(krippendorff_alpha(table))


def test_entropy_between_frames_is_the_generalised_jensen_shannon_divergence():
    """Unanimous frames of (1/2, 1/2): all within. One-hot frames that disagree: all between."""
    evidence = [[[0.5, 0.5], [0.5, 0.5]], [[1, 0], [0, 1]], [[1, 0], [1, 0]]]
    parts = decompose(log_of_evidence(evidence).table())
    np.testing.assert_allclose(parts.within, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(parts.between, [0, 1, 0], atol=1e-12)
    evidence = soft(np.random.default_rng(10), 25, 6, K=4)
    parts = decompose(log_of_evidence(evidence).table())
    mean = evidence.mean(axis=1, keepdims=True)
    divergence = (evidence * np.log(evidence / mean)).sum(axis=2).mean(axis=1) / math.log(4)
    np.testing.assert_allclose(parts.between, divergence)
    np.testing.assert_allclose(parts.within + parts.between, parts.total)
