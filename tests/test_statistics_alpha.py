"""Alpha: its definition over spots, and all that it must not depend on."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from simulated_events import grid, log_of, log_of_evidence, soft, spots_of
from striped_floor import K, flight, fused, numbered, sampled

from semstab import backends
from semstab.datasets import open_dataset
from semstab.errors import DataError
from semstab.statistics import Sampler, SpotObservations, Views, describe, disagreement, psa
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import value
from semstab.statistics.intervals import estimate
from semstab.statistics.loops.observations import hash_row
from semstab.statistics.paired_differences import common_observations

DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[2] / "shared/data"))


def alpha_of(frames):
    return estimate(sums_of_spots(sampled(frames)), "alpha").value


# --- Definition -------------------------------------------------------------------------------------------------------


def cell_alpha(frames, edge):
    """Krippendorff's alpha, nominal: cells are units, each weighted by its number of views, and views are raters."""
    counts = defaultdict(lambda: np.zeros(K))
    for view, frame in enumerate(frames):
        camera = frame.intrinsics
        v, u = np.indices(frame.shape)
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(frame.shape)], axis=-1)
        points = (rays * frame.depth[..., None].astype(float)) @ frame.T_wc[:3, :3].T + frame.T_wc[:3, 3]
        cells = np.floor(points / edge).astype(int).reshape(-1, 3).tolist()
        for cell, label in zip(cells, frame.labels.ravel(), strict=True):
            if label < K:
                counts[*cell, view][label] += 1
    units = defaultdict(list)
    for (*cell, _), own in counts.items():
        units[*cell].append(own / own.sum())
    units = [shares for shares in units.values() if len(shares) > 1]
    agreeing = [len(shares) * np.mean([a @ b for a, b in itertools.permutations(shares, 2)]) for shares in units]
    every = np.concatenate(units)
    n, total = len(every), every.sum(axis=0)
    by_chance = (total @ total - (every**2).sum()) / (n * (n - 1))
    return 1 - (1 - sum(agreeing) / n) / (1 - by_chance)


@pytest.mark.parametrize("options", [{"flicker": 0.3}, {"flicker": 0.4, "patch": 5}, {"coin": True}])
def test_alpha_is_its_definition(options):
    """The cells are as wide as the power of 2 next above a pixel's footprint, 3.887 m / 50."""
    frames = list(flight(4, **options))
    there = np.ones((60, 80), bool)
    there[10:30, 20:50] = False
    frames[1] = dataclasses.replace(frames[1], labels=np.where(there, frames[1].labels, 255).astype(np.uint8))
    fine, coarse = cell_alpha(frames, 0.125), cell_alpha(frames, 0.25)
    sums = sums_of_spots(sampled(frames))
    assert (sums.near.voxel_size, sums.far.voxel_size) == (0.125, 0.25)
    assert value(sums.near, "voxel_alpha") == pytest.approx(fine, abs=1e-9)
    assert value(sums, "alpha") == pytest.approx(2 * fine - coarse, abs=1e-9)


def test_disagreement_is_within_a_frame_and_between_frames_whatever_the_number_of_frames():
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


def verdicts(**options):
    frames = list(flight(16, step=0.35, **options))
    return [describe(fused(frames, size).table(), spots=sampled(frames)) for size in SIZES]


@pytest.mark.parametrize("options", [{}, {"flicker": 0.3, "patch": 5}, {"flicker": 0.2}])
def test_alpha_is_the_same_whatever_the_size_of_the_voxels(options):
    found = verdicts(**options)
    by_cells = [summary.headline.alpha.value for summary in found]
    assert by_cells == pytest.approx([by_cells[0]] * 3, abs=1e-12)
    by_voxels = [summary.agreement.voxel_alpha.value for summary in found]
    assert by_voxels[0] - by_voxels[-1] > 0.1


def test_the_truth_is_stable_at_every_voxel_size():
    found = verdicts()
    assert {summary.verdict.level for summary in found} == {"stable"}
    assert found[0].headline.alpha.value >= 0.9


@pytest.mark.parametrize("patch", [None, 10])
def test_a_coin_is_unstable_at_every_voxel_size(patch):
    found = verdicts(coin=True, patch=patch)
    assert {summary.verdict.level for summary in found} == {"unstable"}
    assert found[0].headline.alpha.value < 0.2


@pytest.mark.parametrize("options", [{}, {"flicker": 0.3, "patch": 10}, {"coin": True, "patch": 20}])
def test_alpha_is_about_the_same_where_only_every_second_or_third_pixel_is_taken(options):
    frames = list(flight(12, step=0.35, **options))
    found = [alpha_of(frame.every(stride) for frame in frames) for stride in (1, 2, 3)]
    assert max(found) - min(found) < 0.04


def test_scores_have_the_alpha_and_the_level_of_their_likeliest_class():
    frames = list(flight(12, flicker=0.2, patch=5))
    unsure = [dataclasses.replace(f, labels=None, scores=0.2 + 0.4 * np.eye(K)[f.labels]) for f in frames]
    by_labels, by_scores = (describe(fused(own, 0.3).table(), spots=sampled(own)) for own in (frames, unsure))
    assert by_scores.headline.alpha == by_labels.headline.alpha
    assert by_scores.verdict.level == by_labels.verdict.level
    assert by_scores.agreement.voxel_alpha.value < by_labels.agreement.voxel_alpha.value - 0.1


# --- It counts views, not frames --------------------------------------------------------------------------------------


def again(frames, times):
    return numbered(frame for frame in frames for _ in range(times))


@pytest.mark.parametrize("flown", [
    lambda frames: again(frames, 2), lambda frames: again(frames, 4), lambda frames: numbered(frames * 2),
], ids=["hovers twice", "hovers four times", "flies again"])  # fmt: skip
def test_a_frame_that_says_the_same_again_is_no_further_view(flown):
    frames = list(flight(16, flicker=0.2, patch=5))
    once, more = sampled(frames), sampled(flown(frames))
    assert len(once.views) == len(more.views) == 16
    assert more.frames > once.frames == 16
    one, other = (estimate(sums_of_spots(cells), "alpha") for cells in (once, more))
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
    assert moved == [len(sampled([frame, own]).views) for own in other] == [1, 2]


def test_of_the_frames_of_one_view_all_labels_count():
    first, second = flight(2, step=0.0, flicker=0.5)
    assert sampled([first, second]).weight.sum() == 2 * sampled([first]).weight.sum()


def test_a_camera_that_stood_still_has_no_verdict():
    frames = list(flight(12, step=0.0, flicker=0.3))
    found = describe(fused(frames, 0.3).table(), spots=sampled(frames))
    assert (found.spots.frames, found.spots.views) == (12, 1)
    assert found.verdict.level == "no verdict"
    assert "the camera stood still" in found.verdict.line


# --- What the verdict says of it --------------------------------------------------------------------------------------


def test_a_map_of_nearly_one_class_is_uninformative():
    """97 % of all that the camera sees is class 0; 94 % is not enough to say so."""
    levels = []
    for rows in (2, 4):
        labels = np.zeros((60, 80), np.uint8)
        labels[:rows] = 1
        frames = [dataclasses.replace(frame, labels=labels) for frame in flight(16)]
        found = describe(fused(frames, 0.3).table(), spots=sampled(frames))
        assert found.spots.largest_share == pytest.approx(1 - rows / 60, abs=0.01)
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
    own = rng.integers(0, 2, size=(n, 1))
    rare = np.arange(n)[:, None] % 50 == 0
    labels = np.where(rare, rng.integers(2, 4, size=(n, 4)), own)
    table, cells = log_of(labels, K=4, index=grid(102)).table(), spots_of(labels, K=4, index=grid(102))
    found = describe(table, spots=cells)
    assert found.headline.alpha.value > 0.95
    assert found.verdict.level == "stable"
    first = found.spots.critical_classes[0]
    assert (first.name, first.unstable > 0.99) == ("2", True)
    assert "probably unstable: 2 (100%)" in found.verdict.line
    assert {row.name: row.counts_for_verdict for row in found.spots.classes}["3"] is False  # 68 voxels
    named = dataclasses.replace(table, classes=("road", "grass", "car", "person"))
    critical = describe(named, spots=cells, critical=["person"])
    assert [row.name for row in critical.cells.critical_classes] == ["person"]


def test_places_that_flip_between_two_common_classes_are_said_beside_the_verdict():
    """No class is at fault, and each has an alpha of 0.96: only the places tell."""
    rng = np.random.default_rng(5)
    n = 10404
    own, coin = np.arange(n)[:, None] % 3, np.arange(n)[:, None] % 50 == 0
    labels = np.where(coin, rng.integers(0, 2, size=(n, 8)), own)
    found = describe(log_of(labels, index=grid(102)).table(), spots=spots_of(labels, index=grid(102)))
    assert found.flipping.share.low < 0.02 < found.flipping.share.high < 0.045
    assert (found.flipping.a, found.flipping.b) == ("0", "1")
    assert found.flipping.part > 0.9
    assert found.verdict.level == "stable"
    assert "1.9% of the locations of this map flip" in found.verdict.line
    assert "of them between 0 and 1" in found.verdict.line
    labels = np.repeat(own, 2, axis=1)
    twice = describe(log_of(labels, index=grid(102)).table(), spots=spots_of(labels, index=grid(102)))
    assert "seen too seldom to tell which of them flip" in twice.verdict.line


# --- The sample -------------------------------------------------------------------------------------------------------


def blocks(cells):
    return cells.cell // 4


def entries(cells):
    return {(*cell, view, label): weight for *cell, view, label, weight in np.column_stack(
        [cells.cell, cells.view, cells.label, cells.weight]).tolist()}  # fmt: skip


def test_a_bounded_sample_holds_some_blocks_whole():
    everything, some = sampled(flight()), sampled(flight(), budget=5000)
    assert 0.2 < len(some) / len(everything) < 0.8
    drawn = {tuple(block) for block in blocks(some).tolist()}
    whole = everything.only([tuple(block) in drawn for block in blocks(everything).tolist()])
    assert entries(some) == entries(whole)


def test_the_samples_of_all_models_are_of_the_same_blocks():
    some, other = sampled(flight(), budget=5000), sampled(flight(flicker=0.05, seed=1), budget=5000)
    share = min(some.share, other.share)
    one, two = ({tuple(block) for block in blocks(own.only(own.drawn < share)).tolist()} for own in (some, other))
    assert one == two
    assert len(one) > 20


def hash_of(x, y, z):
    """The hash of a voxel, from its definition."""
    h = (0xD1B54A33 * x + 0xABC98389 * y + 0x8CB92BA7 * z) % 2**32
    h = (h ^ h >> 16) * 0x7FEB352D % 2**32
    h = (h ^ h >> 15) * 0x846CA68B % 2**32
    return h ^ h >> 16


def test_what_is_drawn_is_its_definition():
    cells = sampled(flight(flicker=0.2), budget=5000)
    drawn = blocks(cells).tolist()
    assert min(min(block) for block in drawn) < 0
    assert [hash_of(*block) for block in drawn] == cells.drawn.tolist()
    assert max(cells.drawn) < cells.share < 2**32


@pytest.mark.parametrize(("along", "shape"), [
    ([(1, 0, 0)], (60000,)), ([(3, -2, 1)], (60000,)), ([(1, 0, 0), (0, 1, 0)], (250, 240)),
    ([(0, 1, 0), (0, 0, 1)], (250, 240)), ([(1, 1, 0), (0, 1, -1)], (250, 240)),
    ([(2, 0, 1), (1, -2, 0)], (250, 240)), ([(256, 0, 0), (0, 256, 0)], (250, 240)),
    ([(1, 0, 0), (0, 1, 0), (0, 0, 1)], (40, 40, 38)),
])  # fmt: skip
def test_lines_planes_and_blocks_of_voxels_are_sampled_evenly(along, shape):
    """About the origin and far from it: the share below a threshold, of all and of stretches, is as if at random."""
    steps = np.stack(np.meshgrid(*(np.arange(n) - n // 2 for n in shape), indexing="ij"), axis=-1).reshape(
        -1, len(shape)
    )
    for origin in ((0, 0, 0), (-70001, 1234567, -13)):
        index = (steps @ np.array(along) + origin).astype(np.int32)
        drawn = np.empty(len(index), np.uint32)
        hash_row(*np.ascontiguousarray(index.T), drawn)
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
    np.testing.assert_array_equal(Views.of(views.rows().tolist()).rows(), views.rows())
    with pytest.raises(ValueError, match="without an index"):
        Views.of([[math.nan, 0, 0, 0, 0, 1]])


def test_a_sampler_that_saw_no_frame_has_an_empty_sample():
    found = sampled([])
    assert (len(found), len(found.views), found.frames, len(found.observations())) == (0, 0, 0, 0)


def test_a_sample_comes_back_from_its_file(tmp_path):
    cells = dataclasses.replace(sampled(flight(4, flicker=0.2), budget=5000), classes=("a", "b", "c"))
    cells.save(tmp_path / "cells.parquet")
    back = SpotObservations.load(tmp_path / "cells.parquet")
    assert entries(back) == entries(cells)
    for name in ("drawn", "view", "label", "weight"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cells, name))
    for name in ("cell_size", "K", "share", "classes", "frames"):
        assert getattr(back, name) == getattr(cells, name)
    np.testing.assert_array_equal(back.views.rows(), cells.views.rows())
    assert value(sums_of_spots(back), "alpha") == value(sums_of_spots(cells), "alpha")
    (tmp_path / "other.parquet").write_bytes(b"no")
    with pytest.raises(DataError, match="not a file of sampled observations"):
        SpotObservations.load(tmp_path / "other.parquet")


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
    """From a footprint of 4 mm to one of 78 mm."""
    low, high = list(flight(2, height=0.313, step=0.01)), list(flight(8))
    found, without = sampled(numbered([*low, *high])), sampled(high)
    assert found.cell_size == without.cell_size == 0.125
    assert (len(found.views), found.frames) == (10, 10)
    assert set(found.view.tolist()) == set(range(4, 10))  # from the frame on at which the median had risen
    own = without.only(without.view >= 2)
    assert {(*cell, view - 2, label): weight for (*cell, view, label), weight in entries(found).items()} == entries(own)


def test_a_climb_by_less_than_eight_keeps_the_sample_and_makes_the_fine_cells_two_cells_wide():
    """From a footprint of 18 mm, cells of 31 mm, to one of 78 mm."""
    found = sampled(numbered([*flight(2, height=1.013, step=0.03), *flight(8)]))
    assert (found.cell_size, found.coarsening) == (1 / 32, 2)
    assert set(found.view.tolist()) == set(range(10))
    assert found.observations().voxel_size == 1 / 16


def test_samples_of_other_cells_meet_at_the_larger_ones():
    frames = list(flight(6, flicker=0.2, step=0.35))
    fine, large = sampled(frames), sampled([frame.every(2) for frame in frames])
    assert (fine.cell_size, large.cell_size) == (0.125, 0.25)
    both = common_observations([fine, large])
    assert [own.cell_size for own in both.shared] == [0.25, 0.25]
    logs = [own.observations() for own in both.shared]
    for name in ("ix", "iy", "iz", "voxel", "frame"):
        np.testing.assert_array_equal(*(getattr(log, name) for log in logs))
    assert len(logs[0]) == len(large.observations())
    assert both.missing[0] == pytest.approx(0)
    assert both.missing[1] == pytest.approx(3 / 4, abs=0.01)


def test_a_less_dense_sample_meets_a_denser_one():
    cells, thinned = sampled(flight(4)), sampled(flight(4), budget=1500)
    assert thinned.share < cells.share
    both = common_observations([cells, thinned])
    assert both.missing == (0, 0)
    assert [entries(own) for own in both.shared] == [entries(thinned)] * 2


def test_samples_that_begin_elsewhere_meet():
    frames = list(flight(6, flicker=0.2, step=40.0))
    cells, back = sampled(frames), sampled(frames[::-1])
    assert cells.low != back.low
    both = common_observations([cells, back])
    assert both.missing == (0, 0)
    assert entries(both.shared[0]) == entries(both.shared[1]) == entries(cells)


def test_samples_that_span_too_much_or_differ_in_classes_are_refused():
    cells = sampled(flight(4))
    far = dataclasses.replace(cells, low=(cells.low[0], cells.low[1] - (1 << 19), cells.low[2]))
    with pytest.raises(DataError, match="leave out far depth"):
        common_observations([cells, far])
    with pytest.raises(DataError, match="different classes cannot be compared"):
        common_observations([cells, dataclasses.replace(cells, K=4)])


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
