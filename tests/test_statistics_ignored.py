"""Backbones on the looks that all of them made: pixels that are left out, and labels beside scores."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from simulated_events import grid, log_of_evidence
from striped_floor import K, flight, sampler_of

from semstab import backends
from semstab.errors import DataError
from semstab.model.contrast import ComparedObservations
from semstab.statistics import CellObservations, compare_backbones, psa
from semstab.statistics.paired_differences import common_observations, psa_bounds, stratum_counts, thin_share

SIZE = 0.2


def compared(**flights):
    """Backbones that made these frames, on common looks."""
    tables, looks = {}, {}
    for name, frames in flights.items():
        backend = backends.create("numpy", voxel_size=SIZE, num_classes=K)
        for frame in frames:
            backend.integrate(frame)
        tables[name], looks[name] = backend.table(), sampler_of(frames, SIZE).looks()
    return compare_backbones(tables, looks=looks)


def without(frames, left_out):
    """The frames with pixels ignored where `left_out(frame)` says so."""
    return [dataclasses.replace(f, labels=np.where(left_out(f), 255, f.labels).astype(np.uint8)) for f in frames]


def test_pixels_that_are_dropped_at_random_make_no_difference():
    rng = np.random.default_rng(0)
    frames = list(flight(6, flicker=0.2, patch=10))
    half = without(frames, lambda frame: rng.random(frame.shape) < 0.5)
    found = compared(whole=frames, half=half)
    rows = {row.measure: row for row in found.paired.differences}
    for measure in ("vss", "sbd", "entropy", "alpha_between"):
        difference = rows[measure].difference
        assert abs(difference.value) < 0.004
    on_all_looks = compare_backbones(
        {name: sampler_of(own, SIZE).looks().observations().table() for name, own in {"a": frames, "b": half}.items()}
    )
    apart = {row.measure: row.difference for row in on_all_looks.paired.differences}
    assert apart["entropy"].low > 0
    assert abs(apart["entropy"].value) > 5 * abs(rows["entropy"].difference.value)


def test_the_order_is_said_to_depend_on_errors_that_were_left_out():
    frames, clean = list(flight(8, flicker=0.3, patch=10, seed=1)), list(flight(8))
    rng = np.random.default_rng(1)
    wrong = {f.index: f.labels != c.labels for f, c in zip(frames, clean, strict=True)}
    silent = without(frames, lambda f: wrong[f.index] & (np.kron(rng.random((6, 8)), np.ones((10, 10))) < 0.6))
    better = list(flight(8, flicker=0.22, patch=10, seed=2))
    found = compared(silent=silent, better=better)
    looks = found.observations
    missing = {row.backbone: row for row in looks.ignored}
    assert looks.order[0] == "silent"
    assert looks.depends
    assert missing["silent"].missing == pytest.approx(0.6 * np.mean(list(wrong.values())), abs=0.03)
    assert missing["better"].missing == 0
    whole = compared(a=frames, b=frames).observations.ignored[0]
    assert whole.psa_low == whole.psa_high
    assert missing["silent"].psa_low < whole.psa_low < missing["silent"].psa_high
    assert missing["silent"].alpha < missing["better"].alpha


def test_maps_that_left_nothing_out_have_an_order_that_depends_on_nothing():
    found = compared(steady=list(flight(6, flicker=0.1, patch=10)), nervous=list(flight(6, flicker=0.4, patch=10)))
    assert found.observations.order == ("steady", "nervous")
    assert not found.observations.depends
    assert not found.observations.decided
    assert found.paired.primary == "alpha_between"


def test_labels_and_scores_are_compared_by_what_they_decide():
    frames = list(flight(6, flicker=0.2, patch=10))
    unsure = [dataclasses.replace(f, labels=None, scores=0.2 + 0.4 * np.eye(K)[f.labels]) for f in frames]
    found = compared(labels=frames, scores=unsure)
    assert found.observations.decided
    assert found.paired.primary == "alpha"
    (row,) = (row for row in found.paired.differences if row.measure == "alpha")
    assert row.difference.value == pytest.approx(0, abs=1e-12)
    (proper,) = (row for row in found.paired.differences if row.measure == "alpha_between")
    assert proper.difference.value != 0  # of the scores themselves
    assert found.standardised.values == {}


def test_bounds_of_agreement_by_hand_and_thin_strata():
    """One place, three looks: class 0, class 0, left out. Of three pairs one agrees, of two nothing is known."""
    looks = np.zeros((1, 3, 3))
    looks[0, [0, 1, 2], [0, 0, 2]] = 1
    assert psa_bounds(log_of_evidence(looks)) == (pytest.approx(1 / 3), pytest.approx(1))
    assert all(map(math.isnan, psa_bounds(log_of_evidence(looks[:, :1]))))
    seen = {"rarely": 2, "often": 8}
    tables = {
        name: log_of_evidence(np.tile(np.eye(3)[0], (400, op, 1)), index=grid(20)).table() for name, op in seen.items()
    }
    few = log_of_evidence(
        np.tile(np.eye(3)[0], (400, 8, 1)), np.arange(8) < np.where(np.arange(400) < 20, 8, 2)[:, None], index=grid(20)
    ).table()
    found = compare_backbones({"a": tables["often"], "b": few})
    assert found.standardised.thin == 1
    same = {"a": tables["often"], "b": tables["often"]}
    assert thin_share(stratum_counts(same), np.array([0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 0])) == 0
    apart = [dataclasses.replace(f, index=f.index + 10) for f in flight(4)]
    found = compared(a=list(flight(4)), b=apart)
    assert isinstance(found.observations, ComparedObservations)
    assert (found.observations.voxels, found.paired.voxels) == (0, 0)
    assert psa(compared(a=list(flight(2)), b=list(flight(2))) and log_of_evidence(np.eye(3)[None]).table()).shape == (
        1,
    )


def test_looks_come_back_from_their_file_and_stay_when_more_frames_come(tmp_path):
    looks = sampler_of(flight(4, flicker=0.2), 0.4).looks(("a", "b", "c"))
    looks.save(tmp_path / "looks.parquet")
    back = CellObservations.load(tmp_path / "looks.parquet")
    (a, b) = common_observations([looks, back]).logs
    np.testing.assert_array_equal(a.evidence, b.evidence)
    np.testing.assert_array_equal(looks.observations().frame, back.observations().frame)
    assert back.classes == ("a", "b", "c")
    np.testing.assert_array_equal(back.views.rows(), looks.views.rows())
    (tmp_path / "other.parquet").write_bytes(b"no")
    with pytest.raises(DataError, match="not a file of sampled looks"):
        CellObservations.load(tmp_path / "other.parquet")
    frames = list(flight(6, flicker=0.2))
    sampler = sampler_of(frames[:3], 0.1, budget=6000)
    before, share = sampler.looks(), sampler.looks().share
    cells, seen = before.cell, sampler.sample().seen
    for frame in frames[3:]:
        sampler.add(frame)
    assert sampler.looks().share < share
    np.testing.assert_array_equal(before.cell, cells)
    np.testing.assert_array_equal(before.sample().seen.evidence, seen.evidence)


def test_samples_of_other_voxels_are_refused_and_less_dense_ones_or_others_meet():
    looks = sampler_of(flight(4), 0.4).looks()
    with pytest.raises(DataError, match="fuse both alike"):
        common_observations([looks, sampler_of(flight(4), 0.2).looks()])
    thinned = sampler_of(flight(4), 0.4, budget=1500).looks()
    assert thinned.share < looks.share
    both = common_observations([looks, thinned])
    assert both.missing == (0, 0)
    assert len(both.logs[0]) == len(both.logs[1]) == len(thinned.observations())
    frames = list(flight(6, flicker=0.2, step=0.5))
    looks, back = sampler_of(frames, 0.1).looks(), sampler_of(frames[::-1], 0.1).looks()
    assert looks.low != back.low
    both = common_observations([looks, back])
    assert both.missing == (0, 0)
    np.testing.assert_array_equal(both.logs[0].evidence, both.logs[1].evidence)
    np.testing.assert_array_equal(both.logs[0].evidence, looks.observations().evidence)
    far = dataclasses.replace(back, low=(back.low[0], back.low[1] - (1 << 19), back.low[2]))
    with pytest.raises(DataError, match="larger voxels"):
        common_observations([looks, far])
