"""Intervals for this map and for the next flight: what widens them, where they claim nothing, how often they hold."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from flights import Flight, fly, sums_of, world
from intervals import Row, trials
from scipy import stats
from simulated_events import grid, log_of

from semstab.model.statistics import NEXT_FLIGHT, THIS_MAP, Interval
from semstab.statistics.accumulate import Cubes, cluster_sums_of
from semstab.statistics.agreement import ratio_of
from semstab.statistics.cluster_sums import value
from semstab.statistics.intervals import (
    ONE_CUBE,
    confidence_intervals,
    difference,
    estimate,
    mean_of,
    spec_of,
    standard_error,
    unpaired,
)
from semstab.statistics.variance import cluster_grids


def sums_from(labels, side, voxel_size=0.125):
    log = log_of(labels, K=2, index=grid(side)[: len(labels)], voxel_size=voxel_size)
    return cluster_sums_of(log.table(), log)


def simulated(seed=0, **settings):
    rng = np.random.default_rng(seed)
    flight = Flight(**settings)
    over = world(flight, rng)
    return sums_of(fly(flight, over, rng), over)


# --- Ends -------------------------------------------------------------------------------------------------------------


def test_independent_places_have_the_interval_of_the_t_test():
    """256 cells of 4 voxels: the mean of PSA has the interval of the mean of the cells' means."""
    rng = np.random.default_rng(0)
    labels = (rng.random((32 * 32, 3)) < 0.3).astype(int)
    sums = sums_from(labels, 32)
    assert sums.cells == 256
    values = sums["psa"][:, 0]
    by_cell = np.bincount(np.unique(sums.cell, axis=0, return_inverse=True)[1].ravel(), weights=values) / 4
    found = estimate(sums, "psa", question=THIS_MAP)
    half = 1.96 * by_cell.std(ddof=1) / 16
    assert (found.high - found.low) / 2 == pytest.approx(half, rel=0.15)  # that errors reach no further is not certain
    assert found.decided


def test_no_error_seen_is_not_no_error():
    """100 places in two frames that agree, of two classes: some disagreement may have been missed."""
    labels = np.tile((np.arange(100) % 10 < 5)[:, None], (1, 2)).astype(int)
    sums = sums_from(labels, 10)
    alpha, psa = (estimate(sums, key, question=THIS_MAP) for key in ("alpha", "psa"))
    assert alpha.value == alpha.high == psa.high == 1
    assert psa.low == pytest.approx(0.025 ** (1 / 100))
    assert alpha.low == pytest.approx(1 - (1 - psa.low) / 0.5, abs=0.01)
    assert estimate(sums, "alpha").low < 0


def test_what_weighs_next_to_nothing_is_nowhere():
    """Of 150 classes so few voxels may be stable that the square of their number is none any more."""
    rng = np.random.default_rng(0)
    places = Cubes.of(log_of(np.zeros((32 * 32, 3), dtype=int), K=2, index=grid(32), voxel_size=0.125).table())
    columns = np.stack([rng.random(32 * 32) < 0.3, np.ones(32 * 32)], axis=1)
    assert places.estimate(columns, ratio_of).decided
    assert places.estimate(1e-112 * columns, ratio_of).undecided == ONE_CUBE


def test_few_places_that_disagree_leave_a_wide_interval_below():
    labels = np.zeros((36 * 36, 3), dtype=int)
    labels[: 18 * 36] = 1
    labels[[5, 700, 1200], 0] ^= 1
    found = estimate(sums_from(labels, 36), "alpha", question=THIS_MAP)
    assert 0.95 < found.low < found.value < found.high < 1


def test_places_that_err_alike_count_as_few():
    near = estimate(simulated(side=64, reach=6.0), "alpha", question=THIS_MAP)
    far = estimate(simulated(side=64, reach=0.5), "alpha", question=THIS_MAP)
    assert near.high - near.low > 3 * (far.high - far.low)
    assert near.block_size > far.block_size
    assert near.degrees < far.degrees


def test_errors_that_reach_as_far_as_the_scene_decide_nothing():
    found = estimate(simulated(side=48, reach=12.0), "alpha", question=THIS_MAP)
    assert "as far as the scene" in found.undecided
    only = estimate(sums_from(np.zeros((4, 3), dtype=int), 2, 0.5), "alpha", question=THIS_MAP)
    assert math.isnan(only.low)


# --- Frames -----------------------------------------------------------------------------------------------------------


def test_frames_of_uneven_quality_widen_what_is_said_of_the_next_flight():
    sums = simulated(frames=64, looks=64, quality="bad", side=32)
    here, next_one = estimate(sums, "alpha", question=THIS_MAP), estimate(sums, "alpha")
    assert next_one.high - next_one.low > 1.3 * (here.high - here.low)
    assert (here.question, next_one.question, next_one.frames) == (THIS_MAP, NEXT_FLIGHT, 64)
    assert next_one.decided


def test_where_frames_are_alike_the_next_flight_is_like_this_one():
    sums = simulated(frames=64, looks=64, side=32)
    here, next_one = estimate(sums, "alpha", question=THIS_MAP), estimate(sums, "alpha")
    assert next_one.high - next_one.low == pytest.approx(here.high - here.low, rel=0.25)


def test_few_frames_and_no_frames_say_so():
    few = estimate(simulated(frames=8, looks=4), "alpha")
    assert "fly 30 or more" in few.undecided
    sums = simulated(frames=8, looks=4)
    without = estimate(sums.coarsened(sums.edge, 0), "alpha")
    assert without.question == THIS_MAP
    assert without.value == pytest.approx(few.value)


def test_quality_that_lasts_as_long_as_the_flight_decides_nothing():
    found = estimate(simulated(6, frames=32, looks=32, quality="lasting", side=24), "alpha")
    assert "lasts about as long as the flight" in found.undecided
    assert estimate(simulated(6, frames=32, looks=32, side=24), "alpha").decided


def test_every_number_has_an_interval_around_it():
    sums = simulated(frames=64, looks=6, quality="uneven")
    for key, k in [(key, None) for key in ("psa", "vss", "entropy", "accuracy", "look_accuracy", "wrong_of_stable")] + [
        ("alpha", 0),
        ("accuracy", 1),
    ]:
        found = estimate(sums, key, k)
        assert found.low < found.value < found.high, key
        assert found.value == value(sums, key, k)


def test_numbers_asked_together_have_the_intervals_that_each_has_alone():
    """Cells of one are those of another without some; the same map elsewhere has nothing from before at hand."""
    labels = np.random.default_rng(0).integers(0, 2, (24 * 24, 4))
    labels[: 24 * 16] = 0
    labels[: 24 * 8, 2:] = -1  # seen twice
    log = log_of(labels, K=2, index=grid(24), voxel_size=0.125)
    sums = cluster_sums_of(log.table(), log)
    elsewhere = dataclasses.replace(sums, cell=sums.cell + np.array([5, -3, 2], np.int32))
    numbers = [("psa", None), ("alpha", None), ("vss", None), ("alpha", 1)]
    together = confidence_intervals(spec_of(sums, key, k) for key, k in numbers)
    assert len({found.places for found in together}) > 1
    for (key, k), found in zip(numbers, together, strict=True):
        alone = estimate(elsewhere, key, k)
        for field in ("value", "low", "high", "degrees", "block_size"):
            assert getattr(found, field) == pytest.approx(getattr(alone, field), rel=1e-9, nan_ok=True)
        assert found.undecided == alone.undecided


def test_the_order_of_cells_does_not_depend_on_what_was_asked_before():
    """Else the last bits of an interval would."""
    large = np.random.default_rng(0).permutation(np.stack(np.divmod(np.arange(30), 6), axis=1))
    small = large[:20]
    (alone,) = cluster_grids([small])
    with_more = cluster_grids([large, small[::2], small])[2]
    (again,) = cluster_grids([small])
    assert with_more.model is not alone.model
    np.testing.assert_array_equal(again.model.correlations, alone.model.correlations)
    np.testing.assert_array_equal(again.order, alone.order)


# --- Differences ------------------------------------------------------------------------------------------------------


def test_a_map_does_not_differ_from_itself_and_a_worse_one_does():
    sums = simulated(frames=64, looks=64, side=32)
    same = difference(sums, sums, "psa")
    assert same.low == same.value == same.high == 0
    rng = np.random.default_rng(0)
    flight = Flight(frames=64, looks=64, side=32)
    over = world(flight, rng)
    worse = sums_of(fly(flight, over, rng, ease=0.4), over)
    found = difference(sums, worse, "alpha")
    assert found.low > 0
    assert found.p_value < 0.001


def test_places_and_frames_are_paired_where_both_maps_have_them():
    """One scene and the same bad frames for both: what they share does not blur the difference."""
    flight = Flight(frames=64, looks=64, side=32, quality="bad")
    over = world(flight, np.random.default_rng(0))
    pair = [sums_of(fly(flight, over, np.random.default_rng(1), ease=ease), over) for ease in (1.0, 0.8)]
    paired, apart = difference(*pair, "alpha"), difference(*pair, "alpha", same_frames=False)
    assert paired.high - paired.low < 0.7 * (apart.high - apart.low)
    elsewhere = [dataclasses.replace(sums, cell=sums.cell + 1000 * i) for i, sums in enumerate(pair)]
    unpaired = difference(*elsewhere, "alpha", question=THIS_MAP)
    both = [estimate(sums, "alpha", question=THIS_MAP) for sums in pair]
    assert unpaired.high - unpaired.low > max(one.high - one.low for one in both)


# --- Coverage, a small part of simulations -----------------------------------------------------------------------


def covered(row: Row) -> bool:
    """Whether so many of few intervals hold that their level may be 95 %: 3 standard errors below."""
    return row.covered() >= 0.95 - 3 * math.sqrt(0.95 * 0.05 / len(row.intervals))


@pytest.mark.parametrize(
    ("flight", "question"),
    [
        (Flight(side=64, reach=2.0), THIS_MAP),
        (Flight(side=64, reach=4.0, ease=2.0), THIS_MAP),
        (Flight(24, 1.5, 1.0, 60, 60, "bad"), NEXT_FLIGHT),
        (Flight(24, 1.5, 1.0, 30, 5, "lasting"), NEXT_FLIGHT),
    ],
)
def test_intervals_hold_what_they_are_about(flight, question):
    (row,) = trials(flight, 40, 0, question, ("alpha",))
    assert covered(row)


# --- Of several numbers -----------------------------------------------------------------------------------------------


def around(value, error, degrees=30.0, **more):
    half = stats.t.ppf(0.975, degrees) * error
    return Interval(value, value - half, value + half, degrees=degrees, **more)


def test_a_mean_over_scenes_errs_less_than_each():
    scenes = [around(0.3, 0.1), around(-0.1, 0.1), around(0.1, 0.1), around(0.1, 0.1)]
    found = mean_of(scenes)
    assert found.value == pytest.approx(0.1)
    assert (found.high - found.value) == pytest.approx((scenes[0].high - 0.3) / 2)
    assert found.degrees == pytest.approx(120)
    assert found.p_value == pytest.approx(2 * stats.t.sf(0.1 / 0.05, 120))
    assert mean_of(scenes[:1]) is scenes[0]


def test_a_mean_says_what_is_undecided_in_a_scene_and_answers_the_lesser_question():
    found = mean_of([around(0.0, 1.0, question=NEXT_FLIGHT), around(0.0, 1.0, question=THIS_MAP, undecided="too few")])
    assert (found.question, found.undecided) == (THIS_MAP, "too few")


def test_numbers_that_share_nothing_differ_by_both_errors():
    found = unpaired(around(0.5, 0.3, 20), around(0.1, 0.4, 50))
    assert found.value == pytest.approx(0.4)
    assert standard_error(around(0.5, 0.3, 20)) == pytest.approx(0.3)
    assert found.p_value == pytest.approx(2 * stats.t.sf(0.4 / 0.5, 0.25**2 / (0.09**2 / 20 + 0.16**2 / 50)))
    assert found.low == pytest.approx(0.4 - math.hypot(0.3 * stats.t.ppf(0.975, 20), 0.4 * stats.t.ppf(0.975, 50)))
