"""Cubes of space, keys of voxels, and the slopes that variances rest on."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_events import log_of

from semstab.data.voxel_keys import voxel_keys
from semstab.errors import DataError
from semstab.statistics.agreement import alpha_columns, alpha_of, psa_columns, ratio_of
from semstab.statistics.cluster_sums import cubes_of
from semstab.statistics.variance import gradient_of


def test_slopes_are_exact_and_columns_leave_out_voxels_seen_once():
    """Of a mean s / n: 1 / n and -s / n^2, to the last digits; NaN where it is not defined."""
    sums = np.array([0.3e6, 1e6])
    np.testing.assert_allclose(gradient_of(ratio_of, sums), [1e-6, -0.3e-6], rtol=1e-15)
    assert np.isnan(gradient_of(alpha_of, np.array([0.5, 1.0, 0.7, 0.5, 0.5]))).any()
    table = log_of([[0, 1, 0], [1, -1, -1]]).table()
    assert not psa_columns(table)[1].any()
    assert not alpha_columns(table)[1].any()


def test_keys_are_one_to_one_and_ascend_with_the_index():
    rng = np.random.default_rng(1)
    index = np.unique(rng.integers(-(2**20), 2**20, size=(200, 3)), axis=0)
    a, b = voxel_keys(index, index[::7])
    assert (np.diff(a) > 0).all()
    assert np.array_equal(a[::7], b)
    with pytest.raises(DataError, match="larger voxels"):
        voxel_keys(np.array([[-(2**31), -(2**31), -(2**31)], [2**31 - 1] * 3]))


@pytest.mark.parametrize("far", [0, 10**6])
@pytest.mark.parametrize("spread", [3, 40, 100_000])
def test_cubes_are_the_smallest_of_which_few_enough_hold_the_voxels(spread, far):
    rng = np.random.default_rng(spread)
    index = np.unique(far + rng.integers(-spread, spread, size=(6000, 3)), axis=0).astype(np.int32)
    some = rng.random(len(index)) < 0.5
    cell, of, edge = cubes_of(tuple(index.T), 0.3, counted=some)
    at = {size: np.floor((index[some] + 0.5) * (0.3 / size)) for size in (edge, edge / 2)}
    assert len(np.unique(at[edge], axis=0)) == len(cell) <= 256
    assert edge == 0.5 or len(np.unique(at[edge / 2], axis=0)) > 256
    np.testing.assert_array_equal(cell[of[some]], at[edge])
    np.testing.assert_array_equal(cell, np.unique(cell, axis=0))
    assert (of[~some] == -1).all()
