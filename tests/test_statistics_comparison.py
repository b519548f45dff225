"""Comparison of models: common voxels, differences of alpha, their test, and ranks, on simulated maps."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated_events import grid, log_of, spots_of
from statsmodels.stats.multitest import multipletests

from semstab.comparison.differences import holm, sums_difference
from semstab.comparison.observations import compared_observations
from semstab.comparison.ranking import ranked
from semstab.comparison.voxels import Region, common_voxels, coverage_of, held
from semstab.errors import DataError
from semstab.metrics.agreement import shared_rows
from semstab.statistics import psa

SIDE = 24


def drawn(rng, F, error, side=SIDE, visible=None, K=3):
    """Labels of a floor seen by F frames, which err with that probability (a number, or one a voxel); side and K."""
    usual = rng.integers(0, K, size=(side * side, 1))
    wrong = rng.random((side * side, F)) < np.broadcast_to(error, (side * side,))[:, None]
    labels = np.where(wrong, rng.integers(0, K, size=wrong.shape), usual)
    return labels if visible is None else np.where(visible, labels, -1), side, K


def table_of(voxels, op=2):
    return log_of(np.zeros((len(voxels), op), dtype=int), index=np.array(voxels)).table()


def test_shared_rows_are_the_voxels_that_all_maps_hold():
    a = table_of([(-5, 0, 0), (0, 0, 1), (0, 1, 0), (7, 7, 7)])
    b = table_of([(0, 0, 1), (0, 0, 2), (7, 7, 7)])
    c = table_of([(-9, 9, 9), (0, 0, 1), (0, 0, 2), (7, 7, 7)])
    assert [rows.tolist() for rows in shared_rows(a, b, c)] == [[1, 3], [0, 2], [1, 3]]
    assert [rows.tolist() for rows in shared_rows(a, table_of([(1, 1, 1)]))] == [[], []]
    a = table_of([(0, 0, 0)])
    with pytest.raises(DataError, match="fuse both with the same settings"):
        shared_rows(a, dataclasses.replace(a, voxel_size=0.4))


places = st.sets(st.tuples(*[st.integers(-2, 2)] * 3), min_size=1)


@given(st.lists(places, min_size=2, max_size=4))
def test_shared_rows_of_any_maps_are_the_intersection_of_their_voxels(maps):
    tables = [table_of(sorted(voxels)) for voxels in maps]
    shared = sorted(set.intersection(*maps))
    assert all(
        [*map(tuple, table.index[rows].tolist())] == shared
        for table, rows in zip(tables, shared_rows(*tables), strict=True)
    )


def test_coverage_by_hand_and_holm_as_in_statsmodels():
    labels = [[0, 0, 0], [0, 0, -1], [0, -1, -1]]
    a = log_of(labels, index=np.array([(0, 0, 0), (0, 0, 1), (0, 0, 2)])).table()
    b = log_of(labels[:2], index=np.array([(0, 0, 1), (5, 0, 0)])).table()
    first, second = coverage_of(("a", "b"), [held({"a": a, "b": b})])
    assert (first.voxels, first.observations, first.mean_op, first.repeated, first.recurrent) == (3, 6, 2, 2, 1)
    assert (first.common_share, first.alone) == (pytest.approx(1 / 3), 2)
    assert (second.common_share, second.alone) == (1 / 2, 1)
    p = [0.01, 0.2, 0.03, 0.5, 0.002]
    assert holm(p) == pytest.approx(multipletests(p, method="holm")[1])
    assert holm([math.nan, 0.02]) == [pytest.approx(math.nan, nan_ok=True), 0.02]


def two_models(rng, gap, side=32, F=8):
    """Two models that err block by block of 4 x 4 voxels, the second more by `gap`: their maps, and their spots."""
    blocks = rng.beta(2, 6, size=(side // 4, side // 4))
    error = np.kron(blocks, np.ones((4, 4))).ravel()
    shift = np.kron(rng.normal(0, 0.05, size=blocks.shape), np.ones((4, 4))).ravel()
    labels = {
        "a": drawn(rng, F, np.clip(error, 0, 1), side)[0],
        "b": drawn(rng, F, np.clip(error + gap + shift, 0, 1), side)[0],
    }
    tables = {name: log_of(of_model, index=grid(side)).table() for name, of_model in labels.items()}
    return tables, {name: spots_of(of_model, index=grid(side)) for name, of_model in labels.items()}


def alpha_difference(rng, gap, **options):
    """Alpha of the first model minus alpha of the second one, on common observations."""
    _, spots = two_models(rng, gap, **options)
    sums = compared_observations(spots).sums
    return sums_difference("alpha", sums["a"], sums["b"])


def test_the_test_of_alpha_keeps_its_level():
    """Two models of the same quality, 15 times: the interval holds 0 twelve times or more."""
    rng = np.random.default_rng(1)
    found = [alpha_difference(rng, 0.0, side=24) for _ in range(15)]
    assert sum(contrast.low <= 0 <= contrast.high for contrast in found) >= 12
    assert sum(contrast.p_value <= 0.05 for contrast in found) <= 3


def test_a_worse_model_is_found():
    change = alpha_difference(np.random.default_rng(2), 0.15)
    assert change.low > 0
    assert change.p_value < 0.001


def test_models_that_are_worse_have_the_last_rank():
    rng = np.random.default_rng(3)
    twins, worst = two_models(rng, 0.0)[1], two_models(rng, 0.4)[1]
    sums = compared_observations(twins | {"worst": worst["b"]}).sums
    found = ranked([sums], ("a", "b", "worst"))
    assert [rank for rank, _ in found.ranks] == [1, 3]
    assert found.ranks[-1] == (3, ("worst",))


def test_only_voxels_that_all_saw_twice_are_common():
    index = np.stack([np.zeros(4), np.zeros(4), np.arange(4)], axis=1)
    a = log_of([[0, 0], [0, 1], [0, -1], [0, 0]], index=index).table()
    b = log_of([[0, 1], [0, 1], [0, 0]], index=index[[0, 1, 2]]).table()
    common = common_voxels(lambda: [Region({"a": a, "b": b})])
    assert psa(common.tables["a"]).tolist() == psa(a)[:2].tolist()
    assert psa(common.tables["b"]).tolist() == [0, 0]
    apart = Region({"a": table_of([(0, 0, 0)]), "b": table_of([(9, 9, 9)])})
    assert len(common_voxels(lambda: [apart]).tables["a"]) == 0
