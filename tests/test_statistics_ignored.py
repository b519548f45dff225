"""Models on the observations that all of them made: pixels that are left out, and labels beside scores."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from simulated_events import log_of_evidence
from striped_floor import K, flight, numbered, sampled

from semstab.comparison.differences import sums_difference
from semstab.comparison.observations import common_observations, compared_observations, psa_bounds
from semstab.data.contrast import ComparedObservations
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import value
from semstab.statistics.observations import COLUMNS


def compared(**flights):
    """Models that made these frames, on common observations."""
    return compared_observations({name: sampled(frames) for name, frames in flights.items()})


def of_alpha(found):
    """Alpha of the first model minus alpha of the second one."""
    first, second = found.sums.values()
    return sums_difference("alpha", first, second)


def without(frames, left_out):
    """The frames with pixels ignored where `left_out(frame)` says so."""
    return [_without(frame, np.broadcast_to(left_out(frame), frame.shape)) for frame in frames]


def _without(frame, out):
    labels = np.where(out, 255, frame.labels).astype(np.uint8)
    return dataclasses.replace(frame, labels=labels, unlabelled=out & (frame.depth > 0))


def test_pixels_that_are_dropped_at_random_make_no_difference():
    rng = np.random.default_rng(0)
    frames = list(flight(12, flicker=0.2, patch=10))
    half = without(frames, lambda frame: rng.random(frame.shape) < 0.5)
    row = of_alpha(compared(whole=frames, half=half))
    assert row.value == row.low == row.high == 0


def errs_silently(seed=1):
    """A model that leaves out 60 % of its errors, patch by patch, and the share of all pixels that these are."""
    frames, clean = list(flight(8, flicker=0.3, patch=10, seed=seed)), list(flight(8))
    rng = np.random.default_rng(seed)
    wrong = {f.index: f.labels != c.labels for f, c in zip(frames, clean, strict=True)}
    silent = without(frames, lambda f: wrong[f.index] & (np.kron(rng.random((6, 8)), np.ones((10, 10))) < 0.6))
    return silent, 0.6 * np.mean(list(wrong.values()))


def test_the_order_is_said_to_depend_on_errors_that_were_left_out():
    silent, share = errs_silently()
    found = compared(silent=silent, better=list(flight(8, flicker=0.22, patch=10, seed=2))).compared
    missing = {row.model: row for row in found.ignored}
    assert found.order == ("silent", "better")
    assert found.order_ignored == ("better", "silent")
    assert found.depends
    assert missing["silent"].missing == pytest.approx(share, abs=0.03)
    assert missing["better"].missing == 0
    assert missing["silent"].alpha < missing["better"].alpha


def hovering(flicker, frames=4):
    """A camera that stands at eight places; its labels err differently in each frame."""
    series = [flight(8, flicker=flicker, patch=10, seed=seed) for seed in range(frames)]
    return numbered(frame for of_place in zip(*series, strict=True) for frame in of_place)


def test_frames_of_a_standing_camera_that_repeat_others_leave_nothing_out():
    """They count once: a model that repeats its labels has fewer answers than one that flickers."""
    found = compared(steady=hovering(0.0), nervous=hovering(0.3)).compared
    assert [row.missing for row in found.ignored] == [0, 0]
    assert found.order == found.order_ignored == ("steady", "nervous")
    assert not found.depends
    half = without(hovering(0.0), lambda frame: np.arange(80) < 40)
    (left, _) = compared(half=half, nervous=hovering(0.3)).compared.ignored
    assert left.missing == pytest.approx(0.5, abs=0.03)


def test_bounds_hold_the_agreement_that_there_is_where_nothing_is_left_out():
    silent, _ = errs_silently()
    whole = list(flight(8, flicker=0.3, patch=10, seed=1))
    (full,) = (row for row in compared(a=whole, b=whole).compared.ignored if row.model == "a")
    (some,) = (row for row in compared(silent=silent, whole=whole).compared.ignored if row.model == "silent")
    assert full.psa_low == full.psa_high
    assert some.psa_low < full.psa_low < some.psa_high


def test_maps_that_left_nothing_out_have_an_order_that_depends_on_nothing():
    found = compared(steady=list(flight(8, flicker=0.1, patch=10)), nervous=list(flight(8, flicker=0.4, patch=10)))
    assert found.compared.order == ("steady", "nervous")
    assert found.compared.bounded
    assert not found.compared.depends
    assert of_alpha(found).p_value < 0.05


def test_the_order_of_a_model_and_itself_depends_on_nothing():
    frames = list(flight(8, flicker=0.3, patch=10, seed=1))
    found = compared(a=frames, b=frames).compared
    assert (found.order, found.bounded, found.depends) == (("a", "b"), True, False)


def test_scores_whose_likeliest_class_is_the_label_have_the_same_alpha():
    frames = list(flight(8, flicker=0.2, patch=10))
    unsure = [dataclasses.replace(f, labels=None, scores=0.2 + 0.4 * np.eye(K)[f.labels]) for f in frames]
    found = compared(labels=frames, scores=unsure)
    row = of_alpha(found)
    assert row.value == row.low == row.high == 0


def across(frame):
    """Metres (80,) along the floor of the columns of a frame."""
    return (np.arange(80) - 40) / 50 * frame.depth + frame.T_wc[0, 3]


def at_borders(frame):
    """The pixels around the borders of stripes: 15 % of all, beside easy ones."""
    stripe = across(frame) / 0.9
    return np.abs(stripe - np.round(stripe)) < 0.15 / 2


def anew_in_each_frame(frame):
    """Pixels in strips across the floor: 15 % of all, others in each frame."""
    strip = np.floor(across(frame) / 0.25).astype(int)
    return np.random.default_rng(frame.index).random(200)[strip] < 0.15


def bold_and_shy(hardest):
    """Errors in the hardest pixels alone: the shy model says what the bold one says wherever it says something."""
    rng = np.random.default_rng(3)
    bold = []
    for frame in flight(12, step=0.35):
        drawn = np.where(rng.random(frame.shape) < 0.8, rng.integers(0, K, frame.shape), frame.labels)
        labels = np.where(hardest(frame), drawn, frame.labels).astype(np.uint8)
        bold.append(dataclasses.replace(frame, labels=labels))
    return bold, without(bold, hardest)


@pytest.mark.parametrize("hardest", [at_borders, anew_in_each_frame])
def test_a_model_that_leaves_the_hardest_out_is_not_more_stable(hardest):
    bold, shy = bold_and_shy(hardest)
    apart = [value(sums_of_spots(sampled(frames)), "alpha") for frames in (bold, shy)]
    assert apart[1] - apart[0] > 0.05  # each on its own observations
    found = compared(bold=bold, shy=shy)
    row = of_alpha(found)
    assert row.value == row.low == row.high == 0
    missing = {row.model: row for row in found.compared.ignored}
    assert missing["shy"].alpha < missing["bold"].alpha


@pytest.mark.parametrize("hardest", [at_borders, anew_in_each_frame])
def test_that_a_model_leaves_the_hardest_out_is_said(hardest):
    bold, shy = bold_and_shy(hardest)
    found = compared(shy=shy, bold=bold).compared
    missing = {row.model: row.missing for row in found.ignored}
    assert missing["shy"] == pytest.approx(0.15, abs=0.02)
    assert missing["bold"] == 0
    assert found.depends


def test_common_observations_are_of_spots_that_all_models_label_at_the_same_pixels():
    frames = list(flight(4, flicker=0.2))
    rng = np.random.default_rng(4)
    whole = sampled(frames)
    both = common_observations([whole, sampled(without(frames, lambda frame: rng.random(frame.shape) < 0.5))])
    one, other = both.shared
    assert len(one) > 1000
    for name in COLUMNS:  # of the second and the third answers, too
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.observations().evidence, other.observations().evidence)
    assert both.missing[0] == 0
    assert both.missing[1] == pytest.approx(0.5, abs=0.01)
    assert [len(spots) for spots in both.ignoring] == [len(whole)] * 2
    for spots in both.ignoring:
        assert spots.K == K + 1
    assert np.mean(both.ignoring[0].label == K) == 0
    assert np.mean(both.ignoring[1].label == K) == pytest.approx(both.missing[1])


def test_models_without_common_frames_have_no_common_observations():
    apart = [dataclasses.replace(f, index=f.index + 10) for f in flight(4)]
    found = compared(a=list(flight(4)), b=apart)
    assert isinstance(found.compared, ComparedObservations)
    assert (found.compared.spots, found.compared.observations) == (0, 0)
    assert math.isnan(of_alpha(found).value)


def test_bounds_of_agreement_by_hand():
    """One place, three views: class 0, class 0, left out. Of three pairs one agrees, of two nothing is known."""
    views = np.zeros((1, 3, 3))
    views[0, [0, 1, 2], [0, 0, 2]] = 1
    assert psa_bounds(log_of_evidence(views)) == (pytest.approx(1 / 3), pytest.approx(1))
    assert all(map(math.isnan, psa_bounds(log_of_evidence(views[:, :1]))))
