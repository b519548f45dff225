"""Agreement between frames and its ceiling: measures and verdicts that do not move with the size of the voxels."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array
from simulated_events import grid, log_of, log_of_evidence, soft
from striped_floor import K, flight, sampler_of

from semstab import backends
from semstab.datasets import open_dataset
from semstab.metrics.agreement import shared_rows
from semstab.statistics import (
    ObservationSample,
    Sampler,
    Views,
    alpha_between,
    ceiling_share,
    describe,
    disagreement,
    krippendorff_alpha,
    psa,
)  # fmt: skip
from semstab.statistics.accumulate import cluster_sums_of
from semstab.statistics.cluster_sums import value
from semstab.statistics.loops.observations import hash_row

DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[2] / "shared/data"))


def test_alpha_between_frames_is_its_definition_and_of_labels_krippendorffs():
    labels = log_of(np.random.default_rng(0).integers(-1, 3, size=(80, 5))).table()
    assert alpha_between(labels) == pytest.approx(krippendorff_alpha(labels))
    evidence = soft(np.random.default_rng(1), 12, 4)
    apart = ((evidence[:, :, None] - evidence[:, None]) ** 2).sum(axis=3) / 2
    every = evidence.reshape(-1, 3)
    expected = ((every[:, None] - every[None]) ** 2).sum() / 2 / (len(every) * (len(every) - 1))
    found = alpha_between(log_of_evidence(evidence).table())
    assert found == pytest.approx(1 - apart.sum() / (12 * 4 * 3) / expected)


def test_disagreement_is_within_a_frame_and_between_frames_whatever_the_number_of_frames():
    rng = np.random.default_rng(3)
    parts = []
    for T in (2, 4, 30):
        table = log_of_evidence(soft(rng, 4000, T)).table()
        within, between = disagreement(table)
        np.testing.assert_allclose(within + between, 1 - psa(table))
        parts.append((within.mean(), between.mean()))
    np.testing.assert_allclose(parts, np.broadcast_to(parts[-1], (3, 2)), atol=0.01)


def test_weights_that_are_fixed_make_flights_comparable_that_linger_elsewhere():
    """One model that errs in the left half; one flight lingers there, the other in the right half."""
    rng = np.random.default_rng(4)
    own, left = rng.integers(0, 3, size=(2000, 1)), np.arange(2000) < 1000
    labels = np.where((rng.random((2000, 20)) < 0.5) & left[:, None], rng.integers(0, 3, size=(2000, 20)), own)
    by_flight = [describe(log_of(np.where(np.arange(20) < seen[:, None], labels, -1)).table()).agreement for seen in
                 (np.where(left, 20, 3), np.where(left, 3, 20))]  # fmt: skip
    easy, hard = by_flight[1], by_flight[0]
    assert easy.alpha_between.value - hard.alpha_between.value > 0.2
    assert easy.voxel_weighted.value == pytest.approx(hard.voxel_weighted.value, abs=0.03)


def sampled(frames, voxel_size=0.4, budget=1 << 19):
    return sampler_of(frames, voxel_size, budget).sample()


def fused(frames, voxel_size):
    backend = backends.create("numpy", voxel_size=voxel_size, num_classes=K)
    for frame in frames:
        backend.integrate(frame)
    return backend


def test_a_sample_of_all_voxels_is_the_log_and_scores_are_sampled_as_labels_are():
    frames = list(flight(3, flicker=0.3))
    twice = [*frames, *(dataclasses.replace(frame, index=frame.index + 3) for frame in frames)]
    seen, log = sampled(twice).seen, fused(twice, 0.4).events()
    assert np.array_equal(seen.ix, log.ix)
    np.testing.assert_allclose(seen.evidence, log.evidence)
    np.testing.assert_array_equal(seen.frame, log.frame)
    np.testing.assert_array_equal(seen.pixels, log.pixels)
    frames = list(flight(4, flicker=0.3))
    soft_ones = [dataclasses.replace(f, labels=None, scores=np.eye(K, dtype=np.float32)[f.labels]) for f in frames]
    by_labels, by_scores = sampled(frames), sampled(soft_ones)
    np.testing.assert_allclose(by_labels.seen.evidence, by_scores.seen.evidence)
    shifts = [coo_array((own.shift, (own.voxel, own.label))).toarray() for own in (by_labels, by_scores)]
    np.testing.assert_allclose(*shifts, atol=1e-12)
    assert (by_labels.soft, by_scores.soft) == (False, True)


def test_a_bounded_sample_holds_some_voxels_whole_and_all_maps_the_same():
    everything, some = sampled(flight(), 0.1), sampled(flight(), 0.1, budget=20000)
    assert 0.2 < len(some.seen.ix) / len(everything.seen.ix) < 0.8
    whole = everything.seen.rows(shared_rows(everything.seen.table(), some.seen.table())[0])
    np.testing.assert_array_equal(whole.evidence, some.seen.evidence)
    other = sampled(flight(flicker=0.2, seed=1), 0.1, budget=20000)
    assert len(shared_rows(some.seen.table(), other.seen.table())[0]) > 0.4 * len(some.seen.ix)


def hash_of(x, y, z):
    """The hash of a voxel, from its definition."""
    h = (0xD1B54A33 * x + 0xABC98389 * y + 0x8CB92BA7 * z) % 2**32
    h = (h ^ h >> 16) * 0x7FEB352D % 2**32
    h = (h ^ h >> 15) * 0x846CA68B % 2**32
    return h ^ h >> 16


def test_what_is_drawn_is_its_definition():
    looks = sampler_of(flight(flicker=0.2), 0.1, budget=20000).looks()
    voxels = (looks.cell // 4).tolist()
    assert min(min(voxel) for voxel in voxels) < 0
    assert [hash_of(*voxel) for voxel in voxels] == looks.drawn.tolist()
    assert max(looks.drawn) < looks.share < 2**32


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
    assert (len(sampled([]).seen), len(sampled([]).views)) == (0, 0)
    views = Views(np.array([7, 2, 5]), np.arange(9.0).reshape(3, 3), np.array([0.5, math.nan, 1.0]))
    assert views.rank(np.array([5, 7, 7, 2])).tolist() == [2, 0, 0, 1]
    np.testing.assert_array_equal(Views.of(views.rows().tolist()).rows(), views.rows())
    with pytest.raises(ValueError, match="without an index"):
        Views.of([[math.nan, 0, 0, 0, 0]])


SIZES = (0.15, 0.3, 0.6)


def verdict_at(voxel_size, **options):
    frames = list(flight(16, step=0.35, **options))
    table = fused(frames, voxel_size).table()
    return describe(table, observations=sampled(frames, voxel_size))


def test_the_truth_reaches_its_ceiling_at_every_voxel_size_while_alpha_falls():
    found = [verdict_at(size) for size in SIZES]
    assert found[0].agreement.alpha.value - found[-1].agreement.alpha.value > 0.1
    assert {summary.verdict.level for summary in found} == {"stable"}
    assert min(summary.ceiling_share.share.value for summary in found) > 0.93


@pytest.mark.parametrize("patch", [None, 10])
def test_a_coin_is_stable_at_no_voxel_size(patch):
    found = [verdict_at(size, coin=True, patch=patch) for size in SIZES]
    assert {"stable", "usable"}.isdisjoint(summary.verdict.level for summary in found)
    assert max(summary.ceiling_share.share.value for summary in found) < 0.2


@pytest.mark.parametrize("flicker", [0.0, 0.2, 0.5])
def test_errors_lower_alpha_and_leave_the_ceiling_where_the_truths_is(flicker):
    """The floor's classes meet within voxels: what alpha of the truth falls short of 1 is the ceiling."""
    frames, right = list(flight(20, flicker=flicker, patch=5)), sampled(flight(20))
    found = ceiling_share(sampled(frames), fused(frames, 0.4).table())
    assert found.ceiling.value == pytest.approx(alpha_between(right.seen.table()), abs=0.03)
    assert found.share.value == pytest.approx(found.alpha.value / found.ceiling.value)
    assert (found.share.value < 0.8) == (flicker > 0)


@pytest.mark.parametrize("wrong", [0.1, 0.25, 0.4])
@pytest.mark.parametrize("voxel_size", [0.1, 0.4])
def test_where_voxels_hold_one_class_the_ceiling_is_one_whatever_part_is_wrong(wrong, voxel_size):
    """Stripes as wide as two voxels, with patches of wrong labels that are larger than a voxel, or smaller."""
    frames = []
    for one, right in zip(flight(20, flicker=wrong, patch=5), flight(20), strict=True):
        x = (np.arange(80) - 40) / 50 * one.depth + one.T_wc[0, 3]
        labels = (np.floor(x / 0.8).astype(int) + (one.labels != right.labels)) % K
        frames.append(dataclasses.replace(one, labels=labels.astype(np.uint8)))
    sums = cluster_sums_of(fused(frames, voxel_size).table(), sample=sampled(frames, voxel_size))
    assert value(sums, "ceiling") == pytest.approx(1, abs=0.02)


def test_what_seeing_other_cells_costs_is_its_definition():
    looks = sampler_of(flight(5, flicker=0.3), 0.4).looks()
    sample = looks.sample()
    cell, frame = looks.key & 63, looks.view
    expected = {}
    voxels = {tuple(v): i for i, v in enumerate(np.stack([sample.seen.ix, sample.seen.iy, sample.seen.iz], 1).tolist())}
    for at, row in voxels.items():
        own = (looks.cell // 4 == at).all(axis=1)
        seen = [c for c in set(cell[own]) if len(set(frame[own & (cell == c)])) >= 2]
        x = {}  # share of each frame's pixels by cell and class
        for t in sorted(set(frame[own & np.isin(cell, seen)])):
            some = own & (frame == t) & np.isin(cell, seen)
            x[t] = np.zeros((64, K))
            np.add.at(x[t], (cell[some], looks.label[some]), looks.weight[some] / looks.weight[some].sum())
        same = other = np.zeros(K)
        n_same = n_other = 0.0
        for a, b in itertools.permutations(x.values(), 2):
            at_once = (a * b.sum(axis=1)[:, None] + b * a.sum(axis=1)[:, None] - 2 * a * b).sum(axis=0)
            share = float(a.sum(axis=1) @ b.sum(axis=1))
            same, n_same = same + at_once, n_same + share
            everything = a.sum(axis=0) + b.sum(axis=0) - 2 * a.sum(axis=0) * b.sum(axis=0)
            other, n_other = other + everything - at_once, n_other + 1 - share
        if n_same > 1e-9 and n_other > 1e-9:
            within = np.mean([(a.sum(axis=1) ** 2).sum() for a in x.values()])
            for k, shift in enumerate((within - n_same / (n_same + n_other)) * (same / n_same - other / n_other)):
                if sum(a[:, k].sum() for a in x.values()) > 0:
                    expected[row, k] = shift
    found = dict(zip(zip(sample.voxel.tolist(), sample.label.tolist(), strict=True), sample.shift, strict=True))
    assert found == pytest.approx(expected, abs=1e-12)
    assert len(found) > 20


def test_a_class_that_flips_a_coin_is_unstable_though_it_is_rare():
    """Two of a hundred places flip between two rare classes: alpha hardly sees it."""
    rng = np.random.default_rng(5)
    n = 10404
    own = rng.integers(0, 2, size=(n, 1))
    rare = np.arange(n)[:, None] % 50 == 0
    log = log_of(np.where(rare, rng.integers(2, 4, size=(n, 4)), own), K=4, index=grid(102))
    views = Views(np.arange(4), np.tile([3.0, 3.0, 9.0], (4, 1)), np.arange(4.0))
    sample = ObservationSample(log, *([np.zeros(0, int)] * 3), views, soft=False)
    found = describe(log.table(), observations=sample)
    assert found.agreement.alpha.value > 0.95
    assert found.verdict.level == "stable"
    first = found.ceiling_share.judged_classes[0]
    assert (first.name, first.unstable > 0.99) == ("2", True)
    assert "probably unstable: 2 (100%)" in found.verdict.line
    assert {row.name: row.counts_for_verdict for row in found.ceiling_share.classes}["3"] is False  # 68 voxels
    critical = describe(log.table(), observations=sample, critical=["0"]).ceiling_share
    assert [row.name for row in critical.judged_classes] == ["0"]


def test_places_that_flip_between_two_common_classes_are_said_beside_the_verdict():
    """No class is at fault, and each has an alpha of 0.96: only the places tell."""
    rng = np.random.default_rng(5)
    n = 10404
    own, coin = np.arange(n)[:, None] % 3, np.arange(n)[:, None] % 50 == 0
    log = log_of(np.where(coin, rng.integers(0, 2, size=(n, 8)), own), K=3, index=grid(102))
    found = describe(log.table())
    assert found.flipping.share.low < 0.02 < found.flipping.share.high < 0.035
    assert (found.flipping.a, found.flipping.b) == ("0", "1")
    assert found.flipping.part > 0.9
    assert found.verdict.level == "stable"
    assert "not to act on: 1.9% of the locations of this map flip" in found.verdict.line
    assert "of that between 0 and 1" in found.verdict.line
    twice = describe(log_of(np.repeat(own, 2, axis=1), K=3, index=grid(102)).table())
    assert "seen too seldom to tell which of them flip" in twice.verdict.line


@pytest.mark.parametrize("voxel_size", [0.01, 0.02, 0.04, 0.08])
def test_the_ground_truth_of_a_real_scene_is_stable_at_every_voxel_size(voxel_size, shelf):
    sampler = Sampler(voxel_size, 5)
    backend = backends.create("numba", voxel_size=voxel_size, num_classes=5)
    for frame in shelf:
        sampler.add(frame)
        backend.integrate(frame)
    assert describe(backend.table(), observations=sampler.sample()).verdict.level == "stable"


@pytest.fixture(scope="module")
def shelf():
    if not (DATA / "apc_shelf").is_dir():
        pytest.skip(f"no {DATA / 'apc_shelf'}; set SEMSTAB_DATA to the folder that holds apc_shelf/")
    scene = open_dataset("posed_folder", {"root": DATA / "apc_shelf"}).scene("apc_shelf")
    return [scene.frame(index, "gt") for index in range(15)]
