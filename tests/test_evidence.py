"""Evidence by its entries is the dense array, whatever part of it is looked at, and costs what its entries cost."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_events import log_of

from semstab import VoxelTable
from semstab.data.evidence import Evidence, row_chunks
from semstab.data.measures import Rows, margin
from semstab.metrics import dominant, entropy, vss
from semstab.statistics import describe

RNG = np.random.default_rng(0)
DENSE = RNG.random((50, 6)) * (RNG.random((50, 6)) < 0.4)
SPARSE = Evidence.from_rows(DENSE)


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
    order = np.random.default_rng(0).permutation(len(DENSE))
    np.testing.assert_array_equal(Evidence.joined(parts, order)[:], DENSE[order])


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


def test_hundreds_of_classes_have_statistics():
    labels = RNG.integers(0, 300, size=(60, 4))
    labels[:, 1:][RNG.random((60, 3)) < 0.6] = 7
    events = log_of(labels, K=300)
    assert -1 < describe(events.table(), events).agreement.voxel_alpha_op2.value < 1
