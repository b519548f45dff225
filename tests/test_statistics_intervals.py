"""Intervals for this map and for the next flight: what widens them, where they claim nothing, how often they hold."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from flights import SimulatedFlight, fly, sums_of, world
from intervals import trials
from scipy import stats
from simulated_events import grid, log_of, spots_of

from semstab.core.types import OTHER_SCENES, THESE_FRAMES, THIS_SCENE
from semstab.data.statistics import Interval
from semstab.statistics.accumulate import Cubes, cluster_sums_of, sums_of_spots
from semstab.statistics.agreement import ratio_of
from semstab.statistics.cluster_sums import value
from semstab.statistics.intervals import (
    NO_LOCATIONS,
    RESOLUTION,
    _ends,
    difference,
    estimate,
    mean_of,
    probability_above,
    standard_error,
    unpaired,
)  # fmt: skip
from semstab.statistics.variance import Spread


def sums_from(labels, side, voxel_size=0.125):
    index = grid(side)[: len(labels)]
    log = log_of(labels, K=2, index=index, voxel_size=voxel_size)
    return cluster_sums_of(log.table(), log, spots=spots_of(labels, 2, index, spacing=voxel_size))


def moved(sums, by):
    """The same map, elsewhere."""
    answers = tuple(moved(part, by) for part in sums.answers)
    return dataclasses.replace(sums, cell=sums.cell + np.array(by, np.int32), answers=answers)


def simulated(seed=0, **settings):
    rng = np.random.default_rng(seed)
    flight = SimulatedFlight(**settings)
    over = world(flight, rng)
    return sums_of(fly(flight, over, rng), over)


def test_independent_places_have_the_interval_of_the_t_test():
    """256 cells of 4 voxels: the mean of PSA has the interval of the mean of the cells' means."""
    rng = np.random.default_rng(0)
    labels = (rng.random((32 * 32, 3)) < 0.3).astype(int)
    sums = sums_from(labels, 32)
    assert sums.cells == 256
    values = sums["psa"][:, 0]
    by_cell = np.bincount(np.unique(sums.cell, axis=0, return_inverse=True)[1].ravel(), weights=values) / 4
    found = estimate(sums, "psa", scope=THESE_FRAMES)
    half = 1.96 * by_cell.std(ddof=1) / 16
    assert half < (found.high - found.low) / 2 < 2 * half  # that errors reach no further is not certain
    assert found.decided


def test_no_error_seen_is_not_no_error_and_next_to_nothing_is_nowhere():
    """100 places in two frames that agree, of two classes: some disagreement may have been missed."""
    labels = np.tile((np.arange(100) % 10 < 5)[:, None], (1, 2)).astype(int)
    sums = sums_from(labels, 10)
    keys = ("alpha", "voxel_alpha", "psa")
    alpha, of_voxels, psa = (estimate(sums, key, scope=THESE_FRAMES) for key in keys)
    assert alpha.value == alpha.high == of_voxels.value == of_voxels.high == psa.high == 1
    assert psa.low == pytest.approx(0.025 ** (1 / 100))
    assert of_voxels.low == pytest.approx(1 - (1 - psa.low) / 0.5, abs=0.01)
    assert [part.cells for part in (sums, *sums.answers)] == [100] * 4
    assert alpha.low == pytest.approx(of_voxels.low)  # the second answers are the first ones: there is no fall
    # Of 150 classes so few voxels may be stable that the square of their number is none any more
    rng = np.random.default_rng(0)
    places = Cubes.from_table(log_of(np.zeros((32 * 32, 3), dtype=int), K=2, index=grid(32), voxel_size=0.125).table())
    columns = np.stack([rng.random(32 * 32) < 0.3, np.ones(32 * 32)], axis=1)
    assert places.estimate(columns, ratio_of).decided
    assert places.estimate(1e-112 * columns, ratio_of).undecided == NO_LOCATIONS


@pytest.mark.parametrize("wrong", [1, 2, 5, 20])
def test_a_few_errors_leave_an_interval_that_is_narrow_and_holds_one(wrong):
    """Of 10,404 places in eight frames so many err once; the ends are no narrower than without a single error."""
    labels = np.repeat(np.arange(102 * 102)[:, None] % 3, 8, axis=1)
    none = estimate(sums_of_spots(spots_of(labels, index=grid(102))), "alpha")
    labels[:wrong, 0] = (labels[:wrong, 0] + 1) % 3
    found = estimate(sums_of_spots(spots_of(labels, index=grid(102))), "alpha")
    assert 0.9 < found.low < found.value < found.high == 1
    assert found.low <= none.low + 0.05
    assert probability_above(found, 0.8, "agreement") > 0.99


@pytest.mark.parametrize("value", [-0.9, 0.0, 0.5, 0.9, 0.99, 0.99995, 1.0])
def test_ends_of_an_agreement_grow_with_its_error_without_a_jump(value):
    """From no error at all to more than everything; nothing explodes where 1 is within noise."""
    halves = np.geomspace(1e-5, 3, 4000)
    ends = [_ends(value, Spread((half / 1.96) ** 2, math.inf), 0.02, "agreement", 0.95) for half in halves]
    low, high = np.array(ends).T
    assert (np.diff(low) < 1e-12).all()
    assert np.diff(low).min() > -0.02
    assert (value - low <= 2 * halves + 0.02).all()
    assert ((low <= value) & (value <= high) & (high <= 1)).all()
    assert (np.diff(high) >= 0).all()
    assert not ((high > 1 - RESOLUTION) & (high < 1)).any()
    assert (high == 1).all() == (value >= 1 - RESOLUTION)


def test_an_interval_says_its_level_and_what_follows_from_it_does_not_depend_on_that():
    sums = simulated(frames=32, observations=8, side=24)
    usual, narrow = estimate(sums, "alpha"), estimate(sums, "alpha", level=0.8)
    assert (usual.level, narrow.level, narrow.interval_name) == (0.95, 0.8, "80 % CI")
    assert narrow.high - narrow.low < 0.8 * (usual.high - usual.low)
    above = usual.value - (usual.value - usual.low) / 2
    assert 0.6 < probability_above(usual, above, "agreement") < 0.99
    assert probability_above(narrow, above, "agreement") == pytest.approx(probability_above(usual, above, "agreement"))
    half = difference(sums, simulated(frames=32, observations=8, side=24, quality="bad"), "psa", level=0.8)
    assert half.level == 0.8
    assert mean_of([half, half]).level == 0.8


def test_few_places_or_places_that_err_alike_leave_a_wide_interval_and_one_cube_none():
    labels = np.zeros((36 * 36, 3), dtype=int)
    labels[: 18 * 36] = 1
    labels[[5, 700, 1200], 0] ^= 1
    found = estimate(sums_from(labels, 36), "alpha", scope=THESE_FRAMES)
    assert 0.95 < found.low < found.value < found.high == 1  # it cannot be told from 1
    near, far = (estimate(simulated(side=64, reach=reach), "alpha", scope=THESE_FRAMES) for reach in (6.0, 0.5))
    assert near.high - near.low > 3 * (far.high - far.low)
    only = estimate(sums_from(np.zeros((4, 3), dtype=int), 2, 0.5), "alpha", scope=THESE_FRAMES)
    assert math.isnan(only.low)


def test_bad_frames_widen_the_interval_of_another_flight():
    sums = simulated(frames=64, observations=64, quality="bad", side=32)
    here, again, elsewhere = (
        estimate(sums, "alpha", scope=scope) for scope in (THESE_FRAMES, THIS_SCENE, OTHER_SCENES)
    )
    assert elsewhere.high - elsewhere.low > again.high - again.low
    assert (here.scope, again.scope, elsewhere.scope, again.frames) == (THESE_FRAMES, THIS_SCENE, OTHER_SCENES, 64)


def test_the_interval_is_narrow_where_frames_are_alike_wide_where_quality_lasts():
    sums = simulated(frames=64, observations=64, side=32)
    here, again = estimate(sums, "alpha", scope=THESE_FRAMES), estimate(sums, "alpha")
    assert again.high - again.low < 0.2 * (here.high - here.low)
    alike, lasting = (
        simulated(6, frames=32, observations=32, quality=quality, side=24) for quality in ("alike", "lasting")
    )
    one, other = (estimate(sums, "alpha") for sums in (alike, lasting))
    assert other.high - other.low > 5 * (one.high - one.low)


def test_every_number_has_an_interval_and_few_frames_say_so():
    sums = simulated(frames=6, observations=4)
    few = estimate(sums, "alpha")
    assert "take 8 or more" in few.undecided
    without = sums.coarsened(sums.edge, 0)
    assert estimate(without, "voxel_alpha").scope == THESE_FRAMES
    assert estimate(without, "voxel_alpha").value == pytest.approx(value(sums, "voxel_alpha"))
    assert estimate(without, "alpha") == few  # spots know their views though a map has no log
    sums = simulated(frames=64, observations=6, quality="uneven")
    keys = ("psa", "vss", "entropy", "accuracy", "observation_accuracy", "wrong_of_consistent")
    for key, k in [*((key, None) for key in (*keys, "alpha")), ("alpha", 0), ("accuracy", 1)]:
        found = estimate(sums, key, k)
        assert found.low < found.value < found.high, key
        assert found.value == value(sums, key, k)


def test_numbers_asked_of_one_map_have_the_intervals_that_each_has_alone():
    """Spots of one are those of another without some; the same map elsewhere has nothing from before at hand."""
    labels = np.random.default_rng(0).integers(0, 2, (24 * 24, 4))
    labels[: 24 * 16] = 0
    labels[: 24 * 8, 2:] = -1  # seen twice
    sums = sums_from(labels, 24)
    elsewhere = moved(sums, [5, -3, 2])
    numbers = [("psa", None), ("alpha", None), ("vss", None), ("alpha", 1)]
    together = [estimate(sums, key, k) for key, k in numbers]
    assert len({found.locations for found in together}) > 1
    for (key, k), found in zip(numbers, together, strict=True):
        alone = estimate(elsewhere, key, k)
        for field in ("value", "low", "high", "degrees"):
            assert getattr(found, field) == pytest.approx(getattr(alone, field), rel=1e-9, nan_ok=True)
        assert found.undecided == alone.undecided


def test_a_worse_map_differs_and_what_pairs_share_does_not_blur_it():
    sums = simulated(frames=64, observations=64, side=32)
    same = difference(sums, sums, "psa")
    assert same.low == same.value == same.high == 0
    rng = np.random.default_rng(0)
    flight = SimulatedFlight(frames=64, observations=64, side=32)
    over = world(flight, rng)
    worse = sums_of(fly(flight, over, rng, ease=0.4), over)
    found = difference(sums, worse, "alpha")
    assert found.low > 0
    assert found.p_value < 0.001
    # One scene and the same bad frames for both: what they share does not blur the difference
    flight = SimulatedFlight(frames=64, observations=64, side=32, quality="bad")
    over = world(flight, np.random.default_rng(0))
    pair = [sums_of(fly(flight, over, np.random.default_rng(1), ease=ease), over) for ease in (1.0, 0.8)]
    paired, apart = difference(*pair, "alpha"), difference(*pair, "alpha", same_frames=False)
    assert paired.high - paired.low < 0.7 * (apart.high - apart.low)
    elsewhere = [moved(sums, 1000 * i) for i, sums in enumerate(pair)]
    unpaired = difference(*elsewhere, "alpha", scope=THESE_FRAMES)
    both = [estimate(sums, "alpha", scope=THESE_FRAMES) for sums in pair]
    assert unpaired.high - unpaired.low > 0.5 * max(one.high - one.low for one in both)  # reaches differ


@pytest.mark.parametrize(("flight", "scope"), [
    (SimulatedFlight(side=64, reach=2.0), THESE_FRAMES), (SimulatedFlight(24, 1.5, 1.0, 24, 24, "lasting"), THIS_SCENE),
    (SimulatedFlight(32, 2.0, 1.0, 40, 5, "lasting"), OTHER_SCENES),
])  # fmt: skip
def test_intervals_hold_their_target(flight, scope):
    """So many of few intervals hold it that their level may be 95 %: 3 standard errors below."""
    (row,) = trials(flight, 20, 0, scope, ("alpha",))
    assert row.covered() >= 0.95 - 3 * math.sqrt(0.95 * 0.05 / len(row.intervals))


def around(value, error, degrees=30.0, **more):
    half = stats.t.ppf(0.975, degrees) * error
    return Interval(value, value - half, value + half, degrees=degrees, **more)


def test_errors_of_a_mean_over_scenes_and_of_numbers_that_share_nothing():
    scenes = [around(0.3, 0.1), around(-0.1, 0.1), around(0.1, 0.1), around(0.1, 0.1)]
    found = mean_of(scenes)
    assert found.value == pytest.approx(0.1)
    assert (found.high - found.value) == pytest.approx((scenes[0].high - 0.3) / 2)
    assert found.degrees == pytest.approx(120)
    assert found.p_value == pytest.approx(2 * stats.t.sf(0.1 / 0.05, 120))
    assert mean_of(scenes[:1]) is scenes[0]
    found = mean_of([around(0.0, 1.0, scope=THIS_SCENE), around(0.0, 1.0, scope=THESE_FRAMES, undecided="too few")])
    assert (found.scope, found.undecided) == (THESE_FRAMES, "too few")
    found = unpaired(around(0.5, 0.3, 20), around(0.1, 0.4, 50))
    assert found.value == pytest.approx(0.4)
    assert standard_error(around(0.5, 0.3, 20)) == pytest.approx(0.3)
    assert found.p_value == pytest.approx(2 * stats.t.sf(0.4 / 0.5, 0.25**2 / (0.09**2 / 20 + 0.16**2 / 50)))
    assert found.low == pytest.approx(0.4 - math.hypot(0.3 * stats.t.ppf(0.975, 20), 0.4 * stats.t.ppf(0.975, 50)))
