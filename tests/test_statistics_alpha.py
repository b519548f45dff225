"""Alpha: its definition over spots, and all that it must not depend on."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
import os
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from corners import corners
from simulated_events import grid, log_of, log_of_evidence, soft, spots_of
from striped_floor import K, flight, fused, numbered, sampled

from semstab import backends
from semstab.comparison.observations import common_observations
from semstab.datasets import open_dataset
from semstab.errors import DataError
from semstab.statistics import Sampler, SpotObservations, Views, describe, disagreement, psa
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import lever_of, value
from semstab.statistics.intervals import estimate
from semstab.statistics.loops.cells import EDGE, hash_cell
from semstab.statistics.observations import COLUMNS

DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[2] / "shared/data"))


def alpha_of(frames):
    return estimate(sums_of_spots(sampled(frames)), "alpha").value


# --- Definition -------------------------------------------------------------------------------------------------------


F, Z = 50.0, np.float64(np.float32(3.887))
"""Focal length, and depth of the floor, of the flight over stripes."""

SIDES = (0, 1), (1, 0), (0, -1), (-1, 0)


def seen_by(frame, point):
    """Image coordinates (n,) of points of the floor, their pixels, and which of them are near a pixel's centre."""
    x, y = (point[:, :2] - frame.T_wc[:2, 3]).T / Z * F
    u, v = x + frame.intrinsics.cx, frame.intrinsics.cy - y
    column, row = np.floor(u + 0.5).astype(int), np.floor(v + 0.5).astype(int)
    H, W = frame.shape
    inside = (column >= 0) & (column < W) & (row >= 0) & (row < H)
    return u, v, column, row, inside


def with_a_hole(frames, *, said):
    """The frames, of which the second has pixels without a label; said if the model was asked for them."""
    there = np.ones((60, 80), bool)
    there[10:30, 20:50] = False
    labels = np.where(there, frames[1].labels, 255).astype(np.uint8)
    frames[1] = dataclasses.replace(frames[1], labels=labels, unlabelled=~there if said else None)
    return frames


@pytest.mark.parametrize("said", [False, True])
def test_a_spot_has_the_label_of_the_pixel_at_it_of_each_view_since_it_was_found(said):
    """Of every view in which a pixel's centre is near the spot, to one side or the other."""
    frames = with_a_hole(list(flight(5, flicker=0.3)), said=said)
    spots = sampled(frames)
    counts = [len(sampled(frames[:n]).point) for n in range(1, 6)]
    found = np.searchsorted(counts, np.arange(len(spots.point)), side="right")
    np.testing.assert_allclose(spots.point[:, 2], 4.0 - Z, atol=1e-6)
    expected = {}
    for view, frame in enumerate(frames):
        _, _, column, row, near = seen_by(frame, spots.point)
        for spot in np.flatnonzero(near & (found <= view)).tolist():
            label = frame.labels[row[spot], column[spot]]
            if label < K or said:
                expected[spot, view] = min(label, K)
    rows = zip(spots.spot.tolist(), spots.view.tolist(), strict=True)
    assert dict(zip(rows, spots.label.tolist(), strict=True)) == expected
    assert len(expected) == len(spots) > 10000
    assert (K in expected.values()) == said


def test_the_second_and_the_third_answer_are_the_next_pixels_to_one_side():
    frames = with_a_hole(list(flight(3, flicker=0.3)), said=True)
    spots, alone = sampled(frames), 0
    for view, frame in enumerate(frames):
        answers = spots.only((spots.view == view) & (spots.label < K))
        u, v, column, row, _ = (values[answers.spot] for values in seen_by(frame, spots.point))
        np.testing.assert_allclose(
            answers.near, ((column - u) ** 2 + (row - v) ** 2) * (Z / F) ** 2, rtol=1e-3, atol=1e-8
        )
        padded = np.pad(frame.labels, 2, constant_values=255)
        possible, any_side = np.zeros(len(answers), bool), np.zeros(len(answers), bool)
        for down, right in SIDES:
            second, third = (padded[row + 2 + k * down, column + 2 + k * right] for k in (1, 2))
            there = (second < K) & (third < K)
            apart = ((column + right - u) ** 2 + (row + down - v) ** 2) * (Z / F) ** 2
            same = (answers.neighbour == second) & (answers.beyond == third) & np.isclose(answers.far, apart, rtol=1e-3)
            possible, any_side = possible | there & same, any_side | there
        np.testing.assert_array_equal(possible, any_side)
        rest = answers.only(~any_side)
        assert (rest.neighbour == rest.label).all()
        assert (rest.far == rest.near).all()
        alone += len(rest)
    assert alone < 0.01 * len(spots)


def alpha_by_hand(spots, answers):
    """Krippendorff's alpha, nominal: spots are units, each weighted by its number of views, and views are raters."""
    counts = defaultdict(lambda: np.zeros(K))
    for spot, view, label, share in zip(spots.spot, spots.view, spots.label, answers, strict=True):
        if label < K:
            counts[spot, view][share] += 1
    units = defaultdict(list)
    for (spot, _), share in counts.items():
        units[spot].append(share / share.sum())
    units = [shares for shares in units.values() if len(shares) > 1]
    agreeing = [len(shares) * np.mean([a @ b for a, b in itertools.permutations(shares, 2)]) for shares in units]
    every = np.concatenate(units)
    n, total = len(every), every.sum(axis=0)
    by_chance = (total @ total - (every**2).sum()) / (n * (n - 1))
    return 1 - (1 - sum(agreeing) / n) / (1 - by_chance)


@pytest.mark.parametrize("options", [{"flicker": 0.3}, {"flicker": 0.4, "patch": 5}, {"coin": True}])
def test_alpha_is_its_definition(options):
    """Alpha of the first answers, and how much it lies above that of the second ones, which `lever_of` weighs.

    A frame of a standing camera is part of its view.
    """
    frames = with_a_hole(list(flight(4, **options)), said=True)
    frames.append(dataclasses.replace(next(flight(1, seed=7, **options)), index=4, T_wc=frames[3].T_wc))
    spots = sampled(frames)
    assert (len(spots.views), spots.frames) == (4, 5)
    sums = sums_of_spots(spots)
    first, second = alpha_by_hand(spots, spots.label), alpha_by_hand(spots, spots.neighbour)
    assert value(sums.answers[0], "voxel_alpha") == pytest.approx(first, abs=1e-9)
    assert value(sums.answers[1], "voxel_alpha") == pytest.approx(second, abs=1e-9)
    lever = lever_of(sums.answers)
    assert lever > 0
    assert value(sums, "alpha") == pytest.approx(first + lever * (first - second), abs=1e-9)


@pytest.mark.parametrize(("step", "frames"), [(0.11, 8), (0.29, 12), (1 / 3, 12), (0.35, 12), (0.37, 12)])
def test_alpha_of_perfect_labels_is_about_1(step, frames):
    """Though pixels at the borders of stripes, of which one in twelve is one, have other labels in other views."""
    sums = sums_of_spots(sampled(flight(frames, step=step)))
    assert value(sums.answers[0], "voxel_alpha") < 0.985
    assert value(sums, "alpha") == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("patch", corners([None, 5], always=[5]))
def test_a_worse_model_has_lower_alpha(patch):
    found = [alpha_of(flight(12, flicker=flicker, patch=patch, step=0.37)) for flicker in (0.0, 0.05, 0.1, 0.2, 0.4)]
    assert (np.diff(found) < -0.04).all()


def test_disagreement_within_and_between_frames_does_not_depend_on_their_number():
    rng = np.random.default_rng(3)
    parts = []
    for T in (2, 4, 30):
        table = log_of_evidence(soft(rng, 4000, T)).table()
        within, between = disagreement(table)
        np.testing.assert_allclose(within + between, 1 - psa(table))
        parts.append((within.mean(), between.mean()))
    np.testing.assert_allclose(parts, np.broadcast_to(parts[-1], (3, 2)), atol=0.01)


# --- It does not depend on voxels, resolution or scores ---------------------------------------------------------------

SIZES = (0.15, 0.3, 0.6)


@functools.cache
def verdicts(**options):
    """What is said at each size of voxels; several tests look at the truth."""
    frames = list(flight(16, step=0.35, **options))
    spots = sampled(frames)
    return [describe(fused(frames, size).table(), spots=spots) for size in SIZES]


@pytest.mark.parametrize("options", [{}, {"flicker": 0.3, "patch": 5}])
def test_alpha_is_the_same_whatever_the_size_of_the_voxels(options):
    found = verdicts(**options)
    by_spots = [summary.headline.alpha.value for summary in found]
    assert by_spots == pytest.approx([by_spots[0]] * 3, abs=1e-12)
    by_voxels = [summary.agreement.voxel_alpha_op2.value for summary in found]
    assert by_voxels[0] - by_voxels[-1] > 0.1


def test_the_truth_is_stable_at_every_voxel_size():
    found = verdicts()
    assert {summary.verdict.level for summary in found} == {"stable"}
    assert found[0].headline.alpha.value >= 0.9


@pytest.mark.parametrize("patch", corners([None, 10], always=[None]))
def test_a_coin_is_unstable_at_every_voxel_size(patch):
    found = verdicts(coin=True, patch=patch)
    assert {summary.verdict.level for summary in found} == {"unstable"}
    assert found[0].headline.alpha.value < 0.2


@pytest.mark.parametrize("options", [{}, {"flicker": 0.3, "patch": 10}, {"coin": True, "patch": 20}])
def test_alpha_is_about_the_same_where_only_every_second_or_third_pixel_is_taken(options):
    """A step is 4.8 of its pixels, 2.4 of every second and 1.6 of every third: the pixels of two views differ in place.

    At a step of .35 m, 1.5 of every third pixel, only views of which the pixels coincide show the same spots.
    """
    frames = list(flight(12, step=0.37, **options))
    found = [alpha_of(frame.every(stride) for frame in frames) for stride in (1, 2, 3)]
    assert max(found) - min(found) < 0.04


def test_scores_have_the_alpha_and_the_level_of_their_likeliest_class():
    frames = list(flight(12, flicker=0.2, patch=5))
    unsure = [dataclasses.replace(f, labels=None, scores=0.2 + 0.4 * np.eye(K)[f.labels]) for f in frames]
    by_labels, by_scores = (describe(fused(series, 0.3).table(), spots=sampled(series)) for series in (frames, unsure))
    assert by_scores.headline.alpha == by_labels.headline.alpha
    assert by_scores.verdict.level == by_labels.verdict.level
    assert by_scores.agreement.voxel_alpha_op2.value < by_labels.agreement.voxel_alpha_op2.value - 0.1


# --- It counts views, not frames --------------------------------------------------------------------------------------


def again(frames, times):
    return numbered(frame for frame in frames for _ in range(times))


@pytest.mark.parametrize("flown", [
    lambda frames: again(frames, 2), lambda frames: again(frames, 4), lambda frames: numbered(frames * 2),
], ids=["hovers twice", "hovers four times", "flies again"])  # fmt: skip
def test_a_frame_that_says_the_same_again_is_no_further_view(flown):
    """The frames without those that repeat another keep their numbers, by which spots are drawn."""
    frames = list(flight(16, flicker=0.2, patch=5))
    every = flown(frames)
    firsts = [f for k, f in enumerate(every) if not any((f.T_wc == before.T_wc).all() for before in every[:k])]
    once, more = sampled(firsts), sampled(every)
    assert len(once.views) == len(more.views) == 16
    assert more.frames > once.frames == 16
    one, other = (estimate(sums_of_spots(spots), "alpha") for spots in (once, more))
    assert other == one


def turned(frame, angle):
    T = frame.T_wc.copy()
    T[:3, :3] = T[:3, :3] @ [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    return dataclasses.replace(frame, index=1, T_wc=T)


def test_a_camera_that_moves_or_turns_by_less_than_a_pixel_has_one_view():
    """A pixel is 0.078 m, or 0.02 radians, wide."""
    moved = [len(sampled(flight(2, step=step, flicker=0.3)).views) for step in (0.07, 0.09)]
    (frame,) = flight(1)
    other = [turned(frame, angle) for angle in (0.018, 0.022)]
    assert moved == [len(sampled([frame, second]).views) for second in other] == [1, 2]


def test_of_the_frames_of_one_view_all_labels_count():
    first, second = flight(2, step=0.0, flicker=0.5)
    once, twice = sampled([first]), sampled([first, second])
    again = twice.only(twice.spot < len(once.point))
    assert (len(twice.views), len(again)) == (1, 2 * len(once))
    (times,) = np.unique(again.spot, return_counts=True)[1:]
    assert set(times.tolist()) == {2}
    shares = again.observations().evidence.weight
    assert set(shares.tolist()) == {0.5, 1.0}  # one observation of each spot, of both labels


def test_a_camera_that_stood_still_has_no_verdict():
    frames = list(flight(12, step=0.0, flicker=0.3))
    found = describe(fused(frames, 0.3).table(), spots=sampled(frames))
    assert (found.spots.frames, found.spots.views) == (12, 1)
    assert found.verdict.level == "no verdict"
    assert "all frames show one view: the camera stood still" in found.verdict.line


# --- What the verdict says of it --------------------------------------------------------------------------------------


def test_a_map_of_nearly_one_class_is_uninformative():
    """98.5 % of all that the camera sees is class 0; 94 % is not enough to say so.

    These are shares of the pixels: spots are a random sample of the floor, whose share is a little off.
    """
    levels = []
    for rows in (1, 4):
        labels = np.zeros((60, 80), np.uint8)
        labels[:rows, :72] = 1
        frames = [dataclasses.replace(frame, labels=labels) for frame in flight(16)]
        found = describe(fused(frames, 0.3).table(), spots=sampled(frames))
        assert found.spots.largest_share == pytest.approx(1 - rows * 0.015, abs=0.01)
        levels.append(found.verdict.level)
    assert levels == ["uninformative", "stable"]


def test_one_class_alone_is_uninformative():
    frames = [dataclasses.replace(frame, labels=np.zeros_like(frame.labels)) for frame in flight(16)]
    found = describe(fused(frames, 0.3).table(), spots=sampled(frames))
    assert math.isnan(found.headline.alpha.value)
    assert found.verdict.level == "uninformative"
    assert "100% of the observations are 0" in found.verdict.line


def test_a_class_that_flips_a_coin_is_unstable_though_it_is_rare():
    """Two of a hundred places flip between two rare classes: alpha hardly sees it."""
    rng = np.random.default_rng(5)
    n = 10404
    usual = rng.integers(0, 2, size=(n, 1))
    rare = np.arange(n)[:, None] % 50 == 0
    labels = np.where(rare, rng.integers(2, 4, size=(n, 4)), usual)
    table, spots = log_of(labels, K=4, index=grid(102)).table(), spots_of(labels, K=4, index=grid(102))
    found = describe(table, spots=spots)
    assert found.headline.alpha.value > 0.95
    assert found.verdict.level == "stable"
    first = found.spots.critical_classes[0]
    assert (first.name, first.unstable > 0.99) == ("2", True)
    assert "probably unstable: 2 (100%)" in found.verdict.line
    assert {row.name: row.counts_for_verdict for row in found.spots.classes}["3"] is False  # 68 voxels
    renamed = dataclasses.replace(table, classes=("road", "grass", "car", "person"))
    critical = describe(renamed, spots=spots, critical=["person"])
    assert [row.name for row in critical.spots.critical_classes] == ["person"]


def test_places_that_flip_between_two_common_classes_are_said_beside_the_verdict():
    """No class is at fault, and each has an alpha of 0.96: only the places tell."""
    rng = np.random.default_rng(5)
    n = 10404
    usual, coin = np.arange(n)[:, None] % 3, np.arange(n)[:, None] % 50 == 0
    labels = np.where(coin, rng.integers(0, 2, size=(n, 8)), usual)
    found = describe(log_of(labels, index=grid(102)).table(), spots=spots_of(labels, index=grid(102)))
    assert found.flipping.share.low < 0.02 < found.flipping.share.high < 0.045
    assert (found.flipping.a, found.flipping.b) == ("0", "1")
    assert found.flipping.part > 0.9
    assert found.verdict.level == "stable"
    assert "1.9% of the locations of this map flip" in found.verdict.line
    assert "of them between 0 and 1" in found.verdict.line
    labels = np.repeat(usual, 2, axis=1)
    twice = describe(log_of(labels, index=grid(102)).table(), spots=spots_of(labels, index=grid(102)))
    assert "seen too seldom to tell which of them flip" in twice.verdict.line


# --- The sample -------------------------------------------------------------------------------------------------------


FIRST = "label", "near"
"""What a sample keeps of an answer whatever else is in it; to which side the next pixels lie is drawn by number."""


def entries(spots, names=FIRST):
    """How often there is each answer: point, view, and the columns named."""
    columns = [spots.view, *(getattr(spots, name) for name in names)]
    return Counter(zip(*spots.point[spots.spot].T.tolist(), *(values.tolist() for values in columns), strict=True))


def places(spots):
    return {*map(tuple, spots.point.tolist())}


def test_a_bounded_sample_keeps_some_spots_with_all_their_answers():
    everything = sampled(flight())
    for budget in (len(everything) - 1, 5000, 1500):
        some = sampled(flight(), budget)
        halvings = math.log2((1 << 32) / some.share)
        assert halvings == round(halvings)
        assert budget / 3 < len(some) <= budget
        assert len(some.point) == pytest.approx(len(everything.point) / 2**halvings, rel=0.15)
        whole = everything.within(some.share)
        np.testing.assert_array_equal(some.point, whole.point)
        assert entries(some) == entries(whole)


def test_a_budget_that_holds_all_keeps_all():
    everything = sampled(flight())
    assert everything.share == 1 << 32
    assert entries(sampled(flight(), len(everything)), COLUMNS[2:]) == entries(everything, COLUMNS[2:])


def test_spots_that_are_seen_once_are_bounded_as_well(monkeypatch):
    """A flight that sees no place twice."""
    frames = list(flight(6, step=7.0))
    everything = sampled(frames)
    assert len(everything.point) > 15000
    monkeypatch.setattr("semstab.statistics.sampler.MOST_SPOTS", 3000)
    some = sampled(frames)
    assert 1000 < len(some.point) <= 3000
    assert entries(some) == entries(everything.within(some.share))


def test_one_frame_adds_spots_of_a_bounded_number_of_cells(monkeypatch):
    """They are spread over the image, as the order in which it is looked through jumps over it."""
    monkeypatch.setattr("semstab.statistics.sampler.MOST_NEW", 400)
    some = sampled(flight(1)).point
    assert len(some) == pytest.approx(400 * EDGE**2, abs=4 * math.sqrt(400 * EDGE**2 * (1 - EDGE**2)))
    x, y = (some[:, :2] - some[:, :2].min(axis=0)).T / np.ptp(some[:, :2], axis=0)[:, None]
    counts, *_ = np.histogram2d(x, y, bins=4)
    assert counts.min() > 5


@pytest.mark.parametrize("budget", [1 << 19, 5000])
def test_all_models_are_asked_at_the_same_spots(budget):
    """Also a model that errs, and one that leaves out half of the pixels."""
    rng = np.random.default_rng(0)
    frames = list(flight())
    silent = [
        dataclasses.replace(f, labels=np.where(out, 255, f.labels).astype(np.uint8), unlabelled=out)
        for f in frames for out in [rng.random(f.shape) < 0.5]
    ]  # fmt: skip
    without = [dataclasses.replace(frame, unlabelled=None) for frame in silent]
    models = [sampled(model, budget) for model in (frames, flight(flicker=0.3, seed=1), silent, without)]
    first = models[0]
    for model in models[1:]:
        assert (model.share, model.spacing, len(model.views)) == (first.share, first.spacing, len(first.views))
        np.testing.assert_array_equal(model.point, first.point)
        np.testing.assert_array_equal(model.drawn, first.drawn)
    for model in models[1:3]:
        for name in ("spot", "view", "near"):
            np.testing.assert_array_equal(getattr(model, name), getattr(first, name))
    assert np.mean(models[2].label == K) == pytest.approx(0.5, abs=0.03)
    assert entries(models[3]) == entries(models[2].labelled())
    both = common_observations(models[:3])
    assert both.missing[:2] == (0, 0)
    assert both.missing[2] == pytest.approx(0.5, abs=0.03)


def test_the_samples_of_all_models_are_of_the_same_spots_whatever_their_budget():
    some, other = sampled(flight(), budget=5000), sampled(flight(flicker=0.05, seed=1), budget=1500)
    share = min(some.share, other.share)
    assert places(some.within(share)) == places(other.within(share))
    assert len(other.point) > 100


def test_spots_are_one_in_a_coarse_cell_and_even_over_the_floor():
    """Most of the cells which the first image shows have one."""
    spots = sampled(flight(1))
    assert len({*map(tuple, spots.cell.tolist())}) == len(spots.point)
    assert len({*map(tuple, spots.places(np.arange(len(spots.point))).tolist())}) == len(spots.point)
    expected = 60 * 80 * (Z / F) ** 2 / spots.spacing**2
    assert 0.75 < len(spots.point) / expected < 1.1
    assert len(spots.point) == len(sampled([next(flight(1, coin=True))]).point)


def hash_of(x, y, z):
    """The hash of a coarse cell, from its definition."""
    h = (0xD1B54A33 * x + 0xABC98389 * y + 0x8CB92BA7 * z) % 2**32
    h = (h ^ h >> 16) * 0x7FEB352D % 2**32
    h = (h ^ h >> 15) * 0x846CA68B % 2**32
    return h ^ h >> 16


def test_what_is_drawn_is_its_definition():
    spots = sampled(flight(flicker=0.2), budget=5000)
    drawn = spots.cell.tolist()
    assert min(min(cell) for cell in drawn) < 0
    assert [hash_of(*cell) for cell in drawn] == spots.drawn.tolist()
    assert max(spots.drawn) < spots.share < 2**32


@pytest.mark.parametrize(("along", "shape"), [
    ([(1, 0, 0)], (60000,)), ([(3, -2, 1)], (60000,)), ([(1, 0, 0), (0, 1, 0)], (250, 240)),
    ([(0, 1, 0), (0, 0, 1)], (250, 240)), ([(1, 1, 0), (0, 1, -1)], (250, 240)),
    ([(2, 0, 1), (1, -2, 0)], (250, 240)), ([(256, 0, 0), (0, 256, 0)], (250, 240)),
    ([(1, 0, 0), (0, 1, 0), (0, 0, 1)], (40, 40, 38)),
])  # fmt: skip
def test_lines_planes_and_blocks_of_coarse_cells_are_sampled_evenly(along, shape):
    """About the origin and far from it: the share below a threshold, of all and of stretches, is as if at random."""
    steps = np.stack(np.meshgrid(*(np.arange(n) - n // 2 for n in shape), indexing="ij"), axis=-1).reshape(
        -1, len(shape)
    )
    for origin in ((0, 0, 0), (-70001, 1234567, -13)):
        drawn = np.array([hash_cell(*cell) for cell in (steps @ np.array(along) + origin).tolist()], np.uint32)
        for p in (1 / 2, 1 / 8, 1 / 64):
            below = drawn < p * 2**32
            n = below.size
            assert abs(below.sum() - n * p) < 4 * math.sqrt(n * p * (1 - p))
            few = below[: n // 500 * 500].reshape(-1, 500).sum(axis=1)
            assert few.var() == pytest.approx(500 * p * (1 - p), rel=0.45)
            assert abs((below[1:] & below[:-1]).sum() - n * p * p) < 5 * math.sqrt(n) * p


def test_views_are_found_by_the_index_of_their_frame_whatever_their_order():
    views = Views(np.array([7, 2, 5]), np.arange(9.0).reshape(3, 3), np.array([0.5, math.nan, 1.0]), np.full(3, 0.1))
    assert views.rank(np.array([5, 7, 7, 2])).tolist() == [2, 0, 0, 1]
    assert views.rows()[1].tolist() == [2, 3, 4, 5, pytest.approx(math.nan, nan_ok=True), 0.1]
    np.testing.assert_array_equal(Views.from_rows(views.rows().tolist()).rows(), views.rows())
    with pytest.raises(ValueError, match="without an index"):
        Views.from_rows([[math.nan, 0, 0, 0, 0, 1]])


def test_a_sampler_that_saw_no_frame_has_an_empty_sample():
    found = sampled([])
    assert (len(found), len(found.views), found.frames, len(found.observations())) == (0, 0, 0, 0)


def test_a_sample_comes_back_from_its_file(tmp_path):
    spots = dataclasses.replace(sampled(flight(4, flicker=0.2), budget=5000), classes=("a", "b", "c"))
    spots.save(tmp_path / "spots.parquet")
    back = SpotObservations.load(tmp_path / "spots.parquet")
    order = np.argsort(spots.spot, kind="stable")  # the file has them by spot
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(back, name), getattr(spots, name)[order], strict=True)
    for name in ("point", "drawn"):
        np.testing.assert_array_equal(getattr(back, name), getattr(spots, name), strict=True)
    for name in ("spacing", "K", "share", "classes", "frames"):
        assert getattr(back, name) == getattr(spots, name)
    np.testing.assert_array_equal(back.views.rows(), spots.views.rows())
    assert value(sums_of_spots(back), "alpha") == value(sums_of_spots(spots), "alpha")


@pytest.mark.parametrize("frames", [[], list(flight(1)), list(flight(2, step=100.0))], ids=["none", "one", "apart"])
def test_a_sample_of_little_comes_back_from_its_file(frames, tmp_path):
    spots = sampled(frames)
    spots.save(tmp_path / "spots.parquet")
    back = SpotObservations.load(tmp_path / "spots.parquet")
    assert entries(back, COLUMNS[2:]) == entries(spots, COLUMNS[2:])
    assert (back.frames, len(back.views), len(back.point)) == (spots.frames, len(spots.views), len(spots.point))


def _written(path, change=None, **about):
    """A file of a sample, after a change of its table, or of what it says about itself."""
    spots = sampled(flight(2))
    spots.save(path)
    content = pq.ParquetFile(path).read()
    about_file = json.loads(content.schema.metadata[b"semstab"]) | about
    if change is not None:
        content = change(content)
    pq.write_table(content.replace_schema_metadata({"semstab": json.dumps(about_file)}), path)


def _with(content, name, values):
    return content.set_column(content.column_names.index(name), name, pa.chunked_array([values]))


def _set(name, value):
    """A change: the first answer, or spot, that there is has another value."""

    def change(content):
        values = content.column(name).to_pylist()
        first = next(k for k, values_of_spot in enumerate(values) if values_of_spot)
        values[first] = [value, *values[first][1:]] if isinstance(values[first], list) else value
        return _with(content, name, pa.array(values, content.column(name).type))

    return change


def _shorter(content):
    values = content.column("label").to_pylist()
    return _with(
        content, "label", pa.array([values_of_spot[1:] for values_of_spot in values], content.column("label").type)
    )


@pytest.mark.parametrize(("change", "about"), [
    (None, {"schema": 4}), (None, {"kind": "CellObservations"}), (None, {"views": []}), (None, {"spacing": 0.0}),
    (None, {"spacing": float("nan")}), (None, {"K": 1}), (None, {"further": 1}), (None, {"views": [[0, 1]]}),
    (_shorter, {}), (lambda content: content.drop_columns(["near"]), {}),
    (lambda content: content.drop_columns(["x"]), {}), (_set("view", 2), {}), (_set("view", -1), {}),
    (_set("label", K + 1), {}), (_set("neighbour", K + 1), {}), (_set("beyond", 60000), {}),
    (_set("x", math.nan), {}), (_set("y", math.inf), {}), (_set("z", 1e12), {}),
])  # fmt: skip
def test_a_damaged_file_is_refused(change, about, tmp_path):
    _written(tmp_path / "spots.parquet", change, **about)
    with pytest.raises(DataError, match="not a file of sampled observations"):
        SpotObservations.load(tmp_path / "spots.parquet")


def test_what_is_no_file_of_a_sample_is_refused(tmp_path):
    path = tmp_path / "spots.parquet"
    sampled(flight(2)).save(path)
    half = path.read_bytes()[: path.stat().st_size // 2]
    for content in (b"no", b"", half):
        path.write_bytes(content)
        with pytest.raises(DataError, match="not a file of sampled observations"):
            SpotObservations.load(path)
    with pytest.raises(DataError):
        SpotObservations.load(tmp_path / "none.parquet")


def test_a_sample_stays_when_more_frames_come():
    frames = list(flight(6, flicker=0.2))
    sampler = Sampler(K, 3000)
    for frame in frames[:3]:
        sampler.add(frame)
    before = sampler.sample()
    held = entries(before)
    for frame in frames[3:]:
        sampler.add(frame)
    assert sampler.sample().share < before.share
    assert entries(before) == held


def test_after_a_take_off_the_sample_begins_anew():
    """From a footprint of 8 mm to one of 78 mm; the median has risen from the fifth view on."""
    frames = numbered([*flight(2, height=0.503, step=0.01), *flight(8)])
    found, without = sampled(frames), sampled(frames[4:])
    assert sampled(frames[:4]).spacing == 1 / 128
    assert found.spacing == without.spacing == 1 / 16
    assert (len(found.views), found.frames) == (10, 10)
    assert set(found.view.tolist()) == set(range(4, 10))
    later = dataclasses.replace(without, view=without.view + 4)
    assert entries(found, COLUMNS[2:]) == entries(later, COLUMNS[2:])


def test_a_climb_by_less_than_eight_keeps_the_sample():
    """From a footprint of 18 mm to one of 78 mm."""
    low = list(flight(2, height=1.013, step=0.03))
    found, before = sampled(numbered([*low, *flight(8)])), sampled(low)
    assert found.spacing == before.spacing == 1 / 64
    assert set(found.view.tolist()) == set(range(10))
    assert places(before.within(found.share)) <= places(found)


def test_samples_of_other_cells_meet_at_the_larger_ones():
    frames = list(flight(6, flicker=0.2, step=0.37))
    fine, large = sampled(frames), sampled([frame.every(2) for frame in frames])
    assert (fine.spacing, large.spacing) == (0.0625, 0.125)
    both = common_observations([fine, large])
    assert [sample.spacing for sample in both.shared] == [0.125, 0.125]
    logs = [sample.observations() for sample in both.shared]
    for name in ("ix", "iy", "iz", "voxel", "frame"):
        np.testing.assert_array_equal(*(getattr(log, name) for log in logs))
    assert len(logs[0]) > 1000
    np.testing.assert_array_equal(both.shared[0].point, both.shared[1].point)


def test_a_less_dense_sample_meets_a_denser_one():
    spots, thinned = sampled(flight(4)), sampled(flight(4), budget=1500)
    assert thinned.share < spots.share
    both = common_observations([spots, thinned])
    assert both.missing == (0, 0)
    # Fails as long as the side of the second answers is drawn by the number of a spot in its sample, not by its cell
    assert [entries(sample) for sample in both.shared] == [entries(thinned)] * 2


def test_samples_that_begin_elsewhere_meet():
    """Frames far apart, from the first or from the last on: the first of a flight finds more spots than the others."""
    frames = list(flight(6, flicker=0.2, step=40.0))
    spots, back = sampled(frames), sampled(frames[::-1])
    both = common_observations([spots, back])
    assert both.missing == (0, 0)
    assert entries(both.shared[0]) == entries(both.shared[1])
    assert not entries(both.shared[0]) - entries(spots)
    assert len(both.shared[0]) > 0.8 * len(spots)


def test_samples_of_frames_in_another_order_have_about_the_same_alpha():
    """Frames find other points of the same cells."""
    frames = list(flight(12, flicker=0.2, step=0.37))
    both = common_observations([sampled(frames), sampled(frames[::-1])])
    one, other = (value(sums_of_spots(sample), "alpha") for sample in both.shared)
    assert one == pytest.approx(other, abs=0.03)


def test_what_lies_too_far_away_has_no_spot():
    """A sampler that has begun asks later frames at the same size, here 70 km away; their own answers are left out."""
    frames = list(flight(4))
    T = frames[-1].T_wc.copy()
    T[0, 3] += 70_000.0
    away = dataclasses.replace(frames[-1], index=4, T_wc=T)
    near, both = sampled(frames), sampled([*frames, away])
    assert (len(both.views), both.frames) == (5, 5)
    assert entries(both, COLUMNS[2:]) == entries(near, COLUMNS[2:])


def test_samples_that_differ_in_classes_are_refused():
    spots = sampled(flight(4))
    with pytest.raises(DataError, match="different classes cannot be compared"):
        common_observations([spots, dataclasses.replace(spots, K=4)])


# --- A real scene -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("voxel_size", [0.02, 0.08])
def test_the_ground_truth_of_a_real_scene_is_stable_at_every_voxel_size(voxel_size, shelf):
    sampler = Sampler(5)
    backend = backends.create("numba", voxel_size=voxel_size, num_classes=5)
    for frame in shelf:
        sampler.add(frame)
        backend.integrate(frame)
    assert describe(backend.table(), spots=sampler.sample()).verdict.level == "stable"


@pytest.fixture(scope="module")
def shelf():
    if not (DATA / "apc_shelf").is_dir():
        pytest.skip(f"no {DATA / 'apc_shelf'}; set SEMSTAB_DATA to the folder that holds apc_shelf/")
    scene = open_dataset("posed_folder", {"root": DATA / "apc_shelf"}).scene("apc_shelf")
    return [scene.frame(index, "gt") for index in range(15)]


def test_two_spots_beside_a_face_of_their_cells_are_two_units():
    """A face of cells lies halfway between two of the 64ths in which a log tells places."""
    column = np.array([0, 0, 1, 1])
    spots = SpotObservations(
        spot=column.astype(np.int32),
        view=np.array([0, 1, 0, 1], np.int32),
        **dict.fromkeys(("label", "neighbour", "beyond"), column.astype(np.uint16)),
        **dict.fromkeys(("near", "far"), np.zeros(4, np.float32)),
        point=np.array([[0.507, 0.1, 0.1], [0.5085, 0.1, 0.1]]),
        drawn=np.arange(2, dtype=np.uint32),
        views=Views.from_rows([[index, index, 0, 0, 0, 0.01] for index in range(2)]),
        spacing=1.0,
        K=2,
    )
    assert len({*map(tuple, spots.cell.tolist())}) == 2
    log = spots.observations()
    assert np.bincount(log.voxel).tolist() == [2, 2]
    assert log.evidence.weight.tolist() == [1, 1, 1, 1]
    assert value(sums_of_spots(spots).answers[0], "voxel_alpha") == 1
