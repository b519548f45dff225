"""Agreement by how far apart two observations are: against its definition, and on errors that are tied to the view."""

from __future__ import annotations

import math

import numpy as np
import pytest
from simulated_events import grid, log_of, spots_of

from semstab.core.types import THESE_FRAMES, THIS_SCENE
from semstab.recording.voxel_maps import agreement_report
from semstab.statistics import correlogram, describe, krippendorff_alpha

SIDE = 20


def sample_of(labels, centres, K=3):
    """Labels (n, F) of spots on a floor, 0.2 m apart, seen from cameras at (F, 3)."""
    return spots_of(labels, K=K, index=grid(SIDE), centres=centres, spacing=0.2)


def flown(step, frames=8, height=10.0):
    return [(2.0 + step * frame, 2.0, height) for frame in range(frames)]


def tied_to_the_view(rng, frames=8, lasts=2):
    """Each place's label is drawn anew every `lasts` frames, but half of the places are always right."""
    usual = rng.integers(0, 3, size=(SIDE**2, 1))
    drawn = np.repeat(rng.integers(0, 3, size=(SIDE**2, frames // lasts)), lasts, axis=1)
    return np.where(rng.random((SIDE**2, 1)) < 0.5, drawn, usual)


def test_alpha_of_two_frames_is_krippendorffs_and_distances_are_those_of_the_cameras():
    labels = np.random.default_rng(0).choice(3, size=(SIDE**2, 2), p=[0.6, 0.3, 0.1])
    (row,) = correlogram(sample_of(labels, flown(1.0, 2))).time
    assert (row.mean, row.pairs) == (1, SIDE**2)
    assert row.alpha.value == pytest.approx(krippendorff_alpha(log_of(labels).table()))
    found = correlogram(sample_of(np.zeros((SIDE**2, 2), int), [(2, 2, 10), (2, 7, 20)]))
    (baseline,), (ratio,) = found.baseline, found.range
    assert baseline.mean == pytest.approx(math.hypot(5, 10))
    assert ratio.mean == pytest.approx(2, abs=0.15)
    assert 300 < sum(row.pairs for row in found.angle) <= SIDE**2
    assert math.isnan(found.time[0].alpha.value)  # one class: chance alone always agrees


def test_errors_that_last_show_as_agreement_that_falls_with_distance():
    labels = tied_to_the_view(np.random.default_rng(1), frames=32, lasts=4)
    found = correlogram(sample_of(labels, flown(0.5, 32)))
    alphas = {round(row.mean): row.alpha for row in found.time}
    assert alphas[1].value > alphas[2].value + 0.1 > alphas[8].value + 0.2
    assert alphas[1].value == pytest.approx(0.5 + 0.5 * 3 / 4, abs=0.05)
    assert alphas[16].low < 0.5 < alphas[16].high
    angles = [row.alpha.value for row in found.angle]
    assert angles[0] > angles[-1] + 0.2


def errs_by_view(rng, centres, sector=20.0):
    """Half of the places change their label, at random, each time the direction of view has turned by that much."""
    place = 0.2 * (grid(SIDE)[:, 0] + 0.25)
    angle = np.degrees(np.arctan2(np.array(centres)[:, 0] - place[:, None], 10.0)) + rng.uniform(
        0, sector, (SIDE**2, 1)
    )
    labels = rng.integers(0, 3, size=(SIDE**2, 12))
    by_sector = np.take_along_axis(labels, (np.floor(angle / sector) + 5).astype(int), axis=1)
    return np.where(rng.random((SIDE**2, 1)) < 0.5, by_sector, labels[:, :1])


def test_at_the_stated_angle_two_flights_say_the_same_of_one_model():
    """One flight is dense and short, the other one far: over all of their pairs alpha differs."""
    rng = np.random.default_rng(2)
    flights = [flown(step, 16) for step in (0.3, 2.0)]
    samples = [sample_of(errs_by_view(rng, centres), centres) for centres in flights]
    near, far = (krippendorff_alpha(sample.observations().table()) for sample in samples)
    assert near - far > 0.15
    at_angle = [correlogram(sample).standard.alpha for sample in samples]
    assert at_angle[0].value == pytest.approx(at_angle[1].value, abs=0.05)


def test_observations_of_one_view_have_no_correlogram_and_all_outputs_take_it():
    once = np.where(np.arange(2) == 0, np.zeros((SIDE**2, 1), int), -1)
    found = correlogram(sample_of(once, flown(1.0, 2)))
    assert found.time == found.angle == ()
    assert (found.standard.pairs, math.isnan(found.standard.alpha.value)) == (0, True)
    summary = describe(log_of(once).table(), spots=sample_of(once, flown(1.0, 2)))
    assert "no verdict" in agreement_report(summary)
    labels = tied_to_the_view(np.random.default_rng(3))
    report = agreement_report(describe(log_of(labels).table(), spots=sample_of(labels, flown(1.0))))
    assert report.count("| for |") == 4


def test_bands_are_for_another_flight_where_a_bin_has_the_frames_for_it():
    """Frames of uneven quality widen them; errors of places alone leave them as they are."""
    rng = np.random.default_rng(5)
    frames, few = 64, slice(0, 6)
    wrong = rng.random((SIDE**2, frames))
    centres = flown(0.2, frames)
    alike, uneven = (np.where(wrong < share, 1, 0) for share in (0.2, rng.choice([0.05, 0.35], size=frames)))
    widths = []
    for labels in (alike, uneven):
        band = correlogram(sample_of(labels, centres, K=2)).time[0].alpha
        assert (band.scope, band.undecided) == (THIS_SCENE, "")
        widths.append(band.high - band.low)
        assert correlogram(sample_of(labels[:, few], centres[few], K=2)).time[0].alpha.scope == THESE_FRAMES
    assert widths[1] > 1.5 * widths[0]
