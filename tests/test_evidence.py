"""Evidence by its entries is the dense array, whatever part of it is looked at, and costs what its entries cost."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_events import log_of

from semstab.metrics import dominant, entropy, vss
from semstab.model.evidence import Evidence, row_chunks
from semstab.model.measures import Rows, margin
from semstab.model.voxels import VoxelTable
from semstab.statistics import RULES, describe, fuse
from semstab.statistics.fusion_rules import fuse_all

RNG = np.random.default_rng(0)
DENSE = RNG.random((50, 6)) * (RNG.random((50, 6)) < 0.4)
SPARSE = Evidence.of(DENSE)


@pytest.mark.parametrize(
    "rows",
    [np.s_[:], np.s_[3:9], 7, -1, np.array([4, 1, 1]), DENSE[:, 0] > 0, np.s_[:, [2, 0]], np.s_[5, 2], np.s_[::3]],
)
def test_indexing_gives_dense_rows(rows):
    np.testing.assert_array_equal(SPARSE[rows], DENSE[rows])


def test_numpy_sees_the_dense_array():
    np.testing.assert_array_equal(np.asarray(SPARSE), DENSE)
    np.testing.assert_array_equal(SPARSE**2 + 1, DENSE**2 + 1)
    np.testing.assert_array_equal(SPARSE.argmax(axis=1), DENSE.argmax(axis=1))
    np.testing.assert_array_equal(SPARSE.max(axis=1), DENSE.max(axis=1))
    np.testing.assert_allclose(SPARSE.sum(axis=0), DENSE.sum(axis=0), rtol=1e-15)
    assert (SPARSE.shape, SPARSE.dtype, len(SPARSE)) == (DENSE.shape, DENSE.dtype, 50)


def test_rows_are_taken_and_joined():
    parts = [SPARSE.take(np.arange(20)), SPARSE.take(np.s_[20:])]
    np.testing.assert_array_equal(Evidence.joined(parts)[:], DENSE)


def test_one_pass_over_the_entries_finds_the_measures_of_dense_rows():
    n, K = 30_000, 30  # several chunks
    dense = np.round(RNG.random((n, K)) * (RNG.random((n, K)) < 0.1), 3)
    dense[:, 0] += 1
    zeros = np.zeros(n)
    table = VoxelTable(
        zeros, zeros, np.arange(n), op=zeros + 3, evidence=dense, drift_sum=zeros, pixels=zeros, first_frame=zeros,
        last_frame=zeros, self_sum=zeros, frame_entropy_sum=zeros, voxel_size=0.1,
    )  # fmt: skip
    assert len(list(row_chunks(n, K))) > 3
    rows = Rows(table.op, dense, zeros)
    for formula in (vss, entropy, margin):
        np.testing.assert_allclose(formula(table), formula(rows), rtol=1e-13, atol=1e-15)
    np.testing.assert_array_equal(dominant(table), dominant(rows))
    some = np.arange(5, n, 7)
    np.testing.assert_array_equal(vss(table.measured().rows(some)), vss(table)[some])


def test_measures_of_a_belief_count_the_classes_that_were_not_seen():
    labels = RNG.integers(0, 4, size=(200, 6))
    for rule in ("majority", "product", "geometric"):
        fused = fuse(log_of(labels, K=9), rule)
        rows = Rows(fused.op, fused.belief, fused.drift_sum)
        for formula in (vss, entropy, margin):
            np.testing.assert_allclose(formula(fused), formula(rows), rtol=1e-13, atol=1e-15)
        np.testing.assert_array_equal(dominant(fused), dominant(rows))


def test_some_voxels_of_a_log_are_fused_as_they_are_in_all_of_it():
    labels = np.where(RNG.random((300, 5)) < 0.2, 1, RNG.integers(0, 3, size=(300, 1)))
    events = log_of(np.where(np.arange(5) < RNG.integers(1, 6, size=(300, 1)), labels, -1), K=4)
    table = events.table()
    again = np.flatnonzero(table.op >= 2)
    known = fuse_all(events, RULES, evidence=table.evidence.take(again), rows=again)
    for one, other in zip(known, fuse_all(events, RULES), strict=True):
        np.testing.assert_array_equal(one.belief, other.belief[again])
        np.testing.assert_array_equal(one.drift_sum, other.drift_sum[again])


def test_hundreds_of_classes_have_statistics_and_every_fusion_rule():
    """With 101 classes or more a floor of 0.01 left the products no room, and the statistics failed at their end."""
    labels = RNG.integers(0, 300, size=(60, 4))
    labels[:, 1:][RNG.random((60, 3)) < 0.6] = 7
    events = log_of(labels, K=300)
    assert [row.rule for row in describe(events.table(), events).fusion_rules] == [
        "averaging", "majority", "product", "geometric",
    ]  # fmt: skip
    for rule in ("averaging", "majority", "product", "geometric"):
        np.testing.assert_allclose(fuse(events, rule).belief.sum(axis=1), 1)
