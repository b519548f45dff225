"""Spatial blocks, and intervals from resampling them that cover as often as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from simulated_events import grid

from semstab.errors import DataError
from semstab.metrics.agreement import voxel_keys
from semstab.statistics import BlockBootstrap, spatial_blocks
from semstab.statistics.agreement import alpha_columns, alpha_of, psa_columns, ratio_of
from semstab.statistics.blocks import gradient_of, interval
from semstab.statistics.sampling.cubes import cubes

COVERED = (0.91, 0.99)
"""Of 300 intervals at 95 % this share is within 3 standard errors."""


def test_slopes_are_exact():
    """Of a mean s / n: 1 / n and -s / n^2, to the last digits; NaN where it is not defined."""
    sums = np.array([0.3e6, 1e6])
    np.testing.assert_allclose(gradient_of(ratio_of, sums), [1e-6, -0.3e-6], rtol=1e-15)
    assert np.isnan(gradient_of(alpha_of, np.array([0.5, 1.0, 0.7, 0.5, 0.5]))).any()


def weights(blocks, replicates=400, seed=0):
    return np.random.default_rng(seed).multinomial(blocks, np.full(blocks, 1 / blocks), size=replicates).astype(float)


def coverage(draw, statistic, truth, blocks, bounds=(-np.inf, np.inf), datasets=300):
    """The share of intervals, over datasets of block sums that `draw` makes, that hold the truth."""
    resamples = weights(blocks)
    rng = np.random.default_rng(1)
    estimates = [interval(draw(rng), statistic, resamples, bounds) for _ in range(datasets)]
    return np.mean([e.low <= truth <= e.high for e in estimates])


# --- Blocks -----------------------------------------------------------------------------------------------------------


def test_blocks_are_cubes_aligned_with_the_voxels():
    index = np.array([[-1, 0, 0], [0, 0, 0], [3, 3, 3], [4, 0, 0]])
    blocks = spatial_blocks(index, 0.5, size=2.0)
    assert blocks.of.tolist() == [0, 1, 1, 2]
    assert (blocks.count, blocks.size) == (3, 2.0)


def test_blocks_are_the_largest_of_which_enough_are_occupied():
    blocks = spatial_blocks(grid(64), 0.2)
    assert (blocks.count, blocks.size) == (36, pytest.approx(12 * 0.2))
    assert np.bincount(blocks.of).max() == 144
    assert spatial_blocks(grid(64), 0.2, least=64).size == pytest.approx(9 * 0.2)
    assert spatial_blocks(grid(3), 0.2).count == 9
    assert spatial_blocks(grid(3)[:0], 0.2).count == 0


def test_sums_by_block_add_up():
    rng = np.random.default_rng(0)
    columns = rng.random((64 * 64, 3))
    blocks = spatial_blocks(grid(64), 0.2, size=1.6)
    sums = blocks.sums(columns)
    np.testing.assert_allclose(sums.sum(axis=0), columns.sum(axis=0))
    np.testing.assert_allclose(sums[5], columns[blocks.of == 5].sum(axis=0))


def test_keys_are_one_to_one_and_ascend_with_the_index():
    rng = np.random.default_rng(1)
    index = np.unique(rng.integers(-(2**20), 2**20, size=(200, 3)), axis=0)
    a, b = voxel_keys(index, index[::7])
    assert (np.diff(a) > 0).all()
    assert np.array_equal(a[::7], b)


def test_maps_that_span_too_much_are_refused():
    with pytest.raises(DataError, match="larger voxels"):
        voxel_keys(np.array([[-(2**31), -(2**31), -(2**31)], [2**31 - 1] * 3]))


# --- Intervals --------------------------------------------------------------------------------------------------------


def uneven_blocks(rng, blocks=64, mean=0.9):
    """Sums of a share in blocks of very different size, that differ in their expectation."""
    size = np.maximum(1, rng.lognormal(3, 0.7, blocks)).astype(int)
    agree = rng.binomial(size, rng.beta(10 * mean, 10 * (1 - mean), blocks))
    return np.stack([agree, size], axis=1).astype(float)


def test_intervals_of_a_mean_cover_at_their_level_when_blocks_differ():
    assert COVERED[0] <= coverage(uneven_blocks, ratio_of, 0.9, 64, (0, 1)) <= COVERED[1]


def test_intervals_cover_where_few_blocks_hold_all_the_disagreement():
    def draw(rng):
        size = np.full(64, 50.0)
        return np.stack([size * np.where(rng.random(64) < 0.15, rng.random(64), 1.0), size], axis=1)

    assert coverage(draw, ratio_of, 1 - 0.15 / 2, 64, (0, 1)) >= COVERED[0]


def alpha_blocks(rng, blocks=64, voxels=20, T=4):
    """Sums for alpha: a voxel's frames show its own class, except for a share of the block's own that is random."""
    pi = np.array([0.6, 0.3, 0.1])
    own = rng.choice(3, size=(blocks, voxels, 1), p=pi)
    noise = rng.random((blocks, voxels, T)) < rng.beta(3, 7, size=(blocks, 1, 1))
    labels = np.where(noise, rng.choice(3, size=(blocks, voxels, T), p=pi), own)
    e = np.eye(3)[labels].sum(axis=2)
    agreement = ((e**2).sum(axis=-1) - T) / (T * (T - 1))
    columns = [T * agreement, np.full_like(agreement, T), np.full_like(agreement, T), *np.moveaxis(e, -1, 0)]
    return np.stack(columns, axis=-1).sum(axis=1)


def test_intervals_of_alpha_cover_at_their_level():
    """Two frames agree beyond chance where neither is noise: alpha is the mean of (1 - noise)^2."""
    truth = 1 - 2 * 0.3 + 3 * 4 / (10 * 11)
    assert COVERED[0] <= coverage(alpha_blocks, alpha_of, truth, 64, (-1, 1), 200) <= COVERED[1]


def test_blocks_cover_what_resampling_voxels_one_by_one_does_not():
    """A floor of 64 x 64 voxels whose errors reach over 3 voxels, a quarter of a block's edge."""
    rng = np.random.default_rng(2)
    by_block = BlockBootstrap(spatial_blocks(grid(64), 0.2), replicates=200)
    by_voxel = BlockBootstrap(spatial_blocks(grid(64), 0.2, size=0.2), replicates=40)
    assert (by_block.blocks.count, by_voxel.blocks.count) == (36, 4096)

    def covers(bootstrap):
        field = uniform_filter(rng.normal(size=(64, 64)), 3) > 0
        estimate = bootstrap.estimate(np.stack([field.ravel(), np.ones(64 * 64)], axis=1).astype(float), ratio_of)
        return estimate.low <= 0.5 <= estimate.high

    assert np.mean([covers(by_block) for _ in range(200)]) >= 0.88
    assert np.mean([covers(by_voxel) for _ in range(40)]) <= 0.8


def test_the_interval_of_equal_blocks_is_that_of_the_t_test():
    """For the mean of many alike blocks bootstrap-t and Student's t agree: value -+ 1.96 s / sqrt(n)."""
    rng = np.random.default_rng(3)
    values = rng.normal(5, 2, 400)
    estimate = interval(np.stack([values, np.ones(400)], axis=1), ratio_of, weights(400, 4000))
    half = 1.96 * values.std(ddof=1) / 20
    assert estimate.value == pytest.approx(values.mean())
    assert (estimate.low, estimate.high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.1 * half)


def test_intervals_keep_to_the_range_and_know_when_they_know_nothing():
    perfect = np.tile([10.0, 10.0], (20, 1))
    assert interval(perfect, ratio_of, weights(20), (0, 1)).low == 1
    one = interval(np.array([[3.0, 4.0]]), ratio_of, weights(1))
    assert one.value == 0.75
    assert math.isnan(one.low)
    none = interval(np.zeros((0, 2)), ratio_of, np.zeros((400, 0)))
    assert math.isnan(none.value)
    nearly = np.tile([10.0, 10.0], (20, 1)) - np.eye(20, 2)
    assert interval(nearly, ratio_of, weights(20), (0, 1)).high <= 1


def test_columns_leave_out_voxels_seen_once():
    from simulated_events import log_of

    table = log_of([[0, 1, 0], [1, -1, -1]]).table()
    assert not psa_columns(table)[1].any()
    assert not alpha_columns(table)[1].any()


@pytest.mark.parametrize("spread", [3, 40, 100_000])
def test_cubes_are_the_smallest_of_which_few_enough_hold_the_voxels(spread):
    rng = np.random.default_rng(spread)
    index = np.unique(rng.integers(-spread, spread, size=(6000, 3)), axis=0).astype(np.int32)
    some = rng.random(len(index)) < 0.5
    cell, of, edge = cubes(tuple(index.T), 0.3, some=some)
    at = {size: np.floor((index[some] + 0.5) * (0.3 / size)) for size in (edge, edge / 2)}
    assert len(np.unique(at[edge], axis=0)) == len(cell) <= 256
    assert edge == 0.5 or len(np.unique(at[edge / 2], axis=0)) > 256
    np.testing.assert_array_equal(cell[of[some]], at[edge])
    np.testing.assert_array_equal(cell, np.unique(cell, axis=0))
    assert (of[~some] == -1).all()
