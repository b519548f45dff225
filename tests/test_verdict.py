"""The verdict: its level, the level of all, and what is printed of both."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from simulated_events import grid, log_of, spots_of
from striped_floor import flight, fused, sampled
from test_statistics_ignored import errs_silently, without

from semstab.data.statistics import UNKNOWN, HeadlineStatistics, Interval, LabelledPairs, SpotAgreement
from semstab.statistics import describe
from semstab.statistics.intervals import probability_above
from semstab.statistics.silence import silence
from semstab.statistics.verdict import LEAST_CLASSES, holds_all_levels, level_probabilities, verdict, why_undecided

SPOTS = SpotAgreement(0.1, 1000, 100, 20, 20, 0.5, "road", 0.6, 1.0, (), None, 1.0, 1.0)


def judged(alpha, **spots):
    headline = HeadlineStatistics(Interval(*alpha, degrees=20), UNKNOWN, UNKNOWN, UNKNOWN, UNKNOWN)
    return verdict("m", headline=headline, spots=dataclasses.replace(SPOTS, **spots), voxels=1000, share=0.5)


@pytest.mark.parametrize(("alpha", "level"), [
    ((0.87, 0.20, 0.98), "undecided"), ((0.75, 0.60, 0.85), "undecided"), ((0.95, 0.66, 1.0), "undecided"),
    ((0.87, 0.70, 0.98), "stable"), ((0.75, 0.70, 0.79), "usable"), ((0.5, 0.2, 0.79), "unstable"),
    ((0.68, 0.55, 0.78), "undecided"),
])  # fmt: skip
def test_an_interval_that_holds_both_limits_is_undecided(alpha, level):
    assert judged(alpha).level == level


def test_spots_with_fewer_effective_classes_than_are_needed_are_uninformative():
    assert judged((0.87, 0.83, 0.90), chance=1 / LEAST_CLASSES).level == "stable"
    assert judged((0.87, 0.83, 0.90), chance=1.001 / LEAST_CLASSES).level == "uninformative"


def test_the_reason_why_nothing_is_decided_does_not_contradict_itself():
    """P(unstable) is .596: rounded it would be the .60 that no level is said to have."""
    low, alpha = 0.5, None
    for value in np.linspace(0.60, 0.70, 2001):
        alpha = Interval(value, low, value + 0.1, degrees=20)
        if 0.5955 < 1 - probability_above(alpha, 2 / 3, "agreement") < 0.5995:
            break
    assert not holds_all_levels(alpha)
    assert "unstable .59" in why_undecided(alpha)
    assert why_undecided(alpha).startswith("no level has p .60 (stable ")
    assert why_undecided(Interval(0.87, 0.2, 0.98)) == "the interval holds both .667 and .80"


@pytest.mark.parametrize(("alpha", "share", "level", "of_all"), [
    ((0.82, 0.81, 0.83), 1.0, "stable", None),
    ((0.82, 0.81, 0.83), math.nan, "stable", None),
    ((0.82, 0.81, 0.83), 0.93, "stable", "usable"),
    ((0.82, 0.81, 0.83), 0.5, "stable", "unstable"),
    ((0.82, 0.81, 0.83), 0.0, "stable", "unstable"),
    ((0.95, 0.94, 0.96), 0.96, "stable", None),
    ((0.70, 0.69, 0.71), 0.9804, "usable", "undecided"),
])  # fmt: skip
def test_the_level_of_all_counts_what_has_no_label_as_disagreeing(alpha, share, level, of_all):
    found = judged(alpha, pairs_labelled=share, pixels_labelled=0.92)
    assert (found.level, found.of_all, found.decisive) == (level, of_all, of_all or level)
    said = f"{level} of the 92 % that it labels, {of_all} of all" if of_all else ""
    assert found.difference == said
    assert (said or f"m: {level} (") in found.line


def test_probabilities_of_all_sum_to_one():
    for share in (1.0, 0.9, 0.7, 0.3):
        pairs = LabelledPairs(share, chance=0.3)
        assert sum(level_probabilities(Interval(0.8, 0.7, 0.9, degrees=9), pairs=pairs).values()) == pytest.approx(1)
        assert pairs.of_labelled(pairs.of_all(0.8)) == pytest.approx(0.8)
    assert math.isinf(LabelledPairs(0.0, 0.3).of_labelled(0.5))
    assert math.isnan(LabelledPairs(0.9, 1.0).of_all(math.nan))
    assert math.isnan(LabelledPairs(0.9, 1.0).of_labelled(0.8))


def test_the_share_of_pairs_is_that_of_views_that_both_label():
    """Three views of 400 places: the first labels all, the second every second one, the third none of 100."""
    labels = np.zeros((400, 3), int)
    labels[::2, 1] = labels[:100, 2] = 3  # K: no label
    found = silence(spots_of(labels, index=grid(20)))
    assert found.pixels == pytest.approx((400 + 200 + 300) / 1200)
    both = labels != 3
    pairs = [(both[:, a] & both[:, b]).sum() for a, b in ((0, 1), (0, 2), (1, 2))]
    assert found.pairs == pytest.approx(sum(pairs) / 1200)
    nothing = silence(spots_of(np.full((0, 3), 0), index=np.zeros((0, 3))))
    assert math.isnan(nothing.pixels)


def test_a_model_that_leaves_out_its_errors_is_no_better_of_all():
    """It leaves out 60 % of its errors: alpha rises, and what it left out is said."""
    frames, (silent, _) = list(flight(8, flicker=0.3, patch=10, seed=1)), errs_silently()
    open_, closed = (describe(fused(series, 0.2).table(), spots=sampled(series)) for series in (frames, silent))
    assert open_.spots.pixels_labelled == open_.spots.pairs_labelled == 1
    assert closed.headline.alpha.value > open_.headline.alpha.value + 0.05
    of_all = closed.spots.pairs.of_all(closed.headline.alpha.value)
    assert abs(of_all - open_.headline.alpha.value) < 0.6 * (closed.headline.alpha.value - open_.headline.alpha.value)
    assert 0.7 < closed.spots.pairs_labelled < closed.spots.pixels_labelled < 0.95
    assert closed.verdict.of_all not in (None, closed.verdict.level)
    assert "that it labels" in closed.verdict.line


def test_silence_at_random_keeps_alpha_and_is_said():
    rng = np.random.default_rng(0)
    half = without(list(flight(12)), lambda frame: rng.random(frame.shape) < 0.3)
    found = describe(fused(half, 0.2).table(), spots=sampled(half))
    assert found.spots.pixels_labelled == pytest.approx(0.7, abs=0.02)
    assert found.verdict.decisive != "stable"


def test_a_moving_box_on_perfect_labels_is_stable_and_may_be_perfect():
    """One of 10,404 places changes once."""
    labels = np.repeat(np.arange(102 * 102)[:, None] % 3, 8, axis=1)
    labels[0, 4] = 2
    found = describe(log_of(labels, index=grid(102)).table(), spots=spots_of(labels, index=grid(102)))
    alpha = found.headline.alpha
    assert 0.9 < alpha.low < alpha.value < alpha.high == 1
    assert found.verdict.level == "stable"
